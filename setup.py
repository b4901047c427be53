"""How colcon and pip install the package."""

from glob import glob
import xml.etree.ElementTree as ET

from setuptools import find_packages, setup

NAME = 'depth_deblur_ros'
PACKAGE_XML = ET.parse('package.xml')  # where the version stands
# ROS from wheels exists for x86_64 alone; elsewhere, and on robots, rclpy comes with ROS itself.
ON_X86_LINUX = "; sys_platform == 'linux' and platform_machine == 'x86_64'"

setup(
    name=NAME,
    version=PACKAGE_XML.findtext('version'),
    description='Deblurs RGB-D images and tells the camera motion during the exposure',
    license='Apache-2.0',
    maintainer='depth_deblur_ros maintainers',
    maintainer_email='maintainers@example.org',
    python_requires='>=3.11',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (
            f'share/{NAME}/config',
            [
                'config/deblur.yaml',
                'config/fastdds.xml',
                'config/foxglove.json',
                'config/paper.yaml',
                'config/robot_localization.yaml',
                'config/sros2_policy.xml',
                'config/view.rviz',
            ],
        ),
        (f'share/{NAME}/config/presets', sorted(glob('config/presets/*.yaml'))),
    ],
    zip_safe=False,
    install_requires=[  # the lowest versions are those of Ubuntu 24.04
        'setuptools',
        'numpy>=1.26',
        'scipy>=1.11',
        'opencv-python-headless>=4.6',
        'numba>=0.58',
        'PyYAML>=6.0',
        'tqdm>=4.66',
        'rosbags>=0.11',
        'mcap>=1.2',
        'zstandard>=0.22',
        'lz4>=4.0',
    ],
    extras_require={
        'ros': [
            f'ros-jazzy-rclpy[fastrtps]==7.1.6{ON_X86_LINUX}',
            f'ros-jazzy-common-interfaces==5.3.6{ON_X86_LINUX}',
        ],
        'cluster': ['distributed>=2024.4'],
        'fuzz': ["atheris>=3.0; sys_platform == 'linux'"],
        'bench': ['scikit-image>=0.22'],
        'test': [
            'setuptools>=71',
            'distributed>=2024.4',
            "atheris>=3.0; sys_platform == 'linux' and platform_machine == 'x86_64'",
            'pytest>=8',
            'pytest-timeout>=2.2',
            'hypothesis>=6.98',
            'mcap-ros2-support>=0.5',
            f'cyclonedds>=11{ON_X86_LINUX}',
            'scikit-image>=0.22',
            'colcon-common-extensions>=0.3',
            'colcon-ros>=0.5',
        ],
        'lint': [
            'ruff>=0.17,<0.18',
            'mypy>=2.4,<2.5',
            'types-PyYAML',
            'types-tqdm',
            'scipy-stubs',
        ],
    },
    entry_points={
        'console_scripts': [
            f'depth-deblur = {NAME}.cli:main',
            f'replay = {NAME}.cli:replay_main',
            f'deblur_node = {NAME}.deblur_node:main',
        ],
    },
)
