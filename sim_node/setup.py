from setuptools import find_packages, setup

package_name = 'sim_node'

setup(
    name=package_name,
    version='0.1.0',
    description='Simulates a MuJoCo task under the policies it is sent, and evaluates policies.',
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
        'console_scripts': ['sim = sim_node.sim:main', 'evaluate = sim_node.evaluate:main']
    },
)
