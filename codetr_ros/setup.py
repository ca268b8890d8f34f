from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

package_name = 'codetr_ros'
# the one place of the version: ROS tools read it there and nowhere else
version = ElementTree.parse(Path(__file__).resolve().parent / 'package.xml').findtext('version')

setup(
    name=package_name,
    version=version,
    description='Learns policies from composite delayed rewards, as ROS 2 nodes.',
    maintainer='The codetr_ros maintainers',
    maintainer_email='maintainers@codetr-ros.example',
    license='Apache-2.0',
    packages=find_packages(exclude=['test']),
    package_data={
        'codetr_ros': ['py.typed'],
        'codetr_ros.config.presets': ['*.yaml'],
        'codetr_ros.processes': ['*.xml'],
        'codetr_ros.bags': ['msg/*.msg'],
        'codetr_ros.runs.recorded': ['*.json'],
        'codetr_ros.pages': ['static/*', 'static/uplot/*'],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{package_name}']),
        (f'share/{package_name}', ['package.xml']),
        (f'share/{package_name}/launch', glob('launch/*.py')),
        (f'share/{package_name}/config', glob('config/*.yaml') + glob('config/*.json')),
    ],
    python_requires='>=3.10',  # colcon cannot read it in setup.cfg; install_requires is there
    zip_safe=False,  # presets are read as files
    entry_points={
        'console_scripts': [
            'codetr = codetr_ros.cli:main',
            'record = codetr_ros.ros.record:main',
            'score = codetr_ros.ros.score:main',
        ],
    },
)
