"""The estimator: ``ros2 launch psd_deflection estimator.launch.py port:=/dev/ttyACM0 record:=true``."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """One node; every argument has the default that `psd-deflection params` lists."""
    return LaunchDescription(
        [
            DeclareLaunchArgument('port', default_value='', description='serial port; empty: the simulated rig'),
            DeclareLaunchArgument(
                'params_file',
                default_value=[FindPackageShare('psd_deflection'), '/config/thesis_rig.yaml'],
                description='ROS 2 parameter file with the rig',
            ),
            DeclareLaunchArgument('record', default_value='false', description='record from the start'),
            DeclareLaunchArgument('bag_dir', default_value='recordings', description='where recordings go'),
            DeclareLaunchArgument('monitor', default_value='false', description='serve the live page'),
            DeclareLaunchArgument('markers', default_value='false', description='publish markers for RViz'),
            Node(
                package='psd_deflection',
                executable='estimator',
                name='estimator',
                output='screen',
                parameters=[
                    LaunchConfiguration('params_file'),
                    {
                        'port': ParameterValue(LaunchConfiguration('port'), value_type=str),
                        'record': ParameterValue(LaunchConfiguration('record'), value_type=bool),
                        'monitor': ParameterValue(LaunchConfiguration('monitor'), value_type=bool),
                        'markers': ParameterValue(LaunchConfiguration('markers'), value_type=bool),
                        'bag_dir': ParameterValue(LaunchConfiguration('bag_dir'), value_type=str),
                    },
                ],
            ),
        ]
    )
