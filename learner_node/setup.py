from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

package_name = 'learner_node'
# the one place of the version: ROS tools read it there and nowhere else
version = ElementTree.parse(Path(__file__).resolve().parent / 'package.xml').findtext('version')

setup(
    name=package_name,
    version=version,
    description='Learns a policy from inferred step rewards; drives a robot by a trained one.',
    maintainer='The codetr_ros maintainers',
    maintainer_email='maintainers@codetr-ros.example',
    license='Apache-2.0',
    packages=find_packages(exclude=['test']),
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{package_name}']),
        (f'share/{package_name}', ['package.xml']),
    ],
    install_requires=['setuptools'],
    zip_safe=True,
    entry_points={
        'console_scripts': [
            'learner = learner_node.learner:main',
            'act = learner_node.act:main',
        ],
    },
)
