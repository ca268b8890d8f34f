from glob import glob

from setuptools import find_packages, setup

package_name = 'codetr_ros'

setup(
    name=package_name,
    version='0.1.0',
    description='Learns policies from composite delayed rewards, as ROS 2 nodes.',
    maintainer='The codetr_ros maintainers',
    maintainer_email='maintainers@codetr-ros.example',
    license='Apache-2.0',
    packages=find_packages(exclude=['test']),
    package_data={'codetr_ros.config.presets': ['*.yaml'], 'codetr_ros.bags': ['msg/*.msg']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{package_name}']),
        (f'share/{package_name}', ['package.xml']),
        (f'share/{package_name}/launch', glob('launch/*.py')),
        (f'share/{package_name}/config', glob('config/*.yaml')),
    ],
    install_requires=['setuptools'],
    zip_safe=False,  # presets are read as files
    entry_points={
        'console_scripts': ['codetr = codetr_ros.cli:main', 'record = codetr_ros.ros.record:main'],
    },
)
