# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The estimator: ``ros2 launch psd_deflection estimator.launch.py port:=/dev/ttyACM0 record:=true``.

Parameters that are not given here come from ``params_file``. Two rigs on one graph::

    ros2 launch psd_deflection estimator.launch.py namespace:=left frame_prefix:=left_ port:=/dev/psd_left
    ros2 launch psd_deflection estimator.launch.py namespace:=right frame_prefix:=right_ port:=/dev/psd_right

``autostart:=false`` leaves the transitions to you or to a lifecycle manager.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PARAMETERS: dict[str, tuple[type, str]] = {
    'port': (str, 'serial port; without one, here or in params_file: the simulated rig'),
    'demo': (bool, 'weights hang on the simulated rig in turn; false: annotated loads are applied to it'),
    'source': (str, 'protocol of the device (psd-deflection devices --help)'),
    'solver': (str, 'solver whose answer is /link_tip/deflection (ros2 param describe NODE solver)'),
    'autostart': (bool, 'configure and activate at start; false: wait for lifecycle transitions'),
    'record': (bool, 'record from the start'),
    'bag_dir': (str, 'folder of recordings'),
    'monitor': (bool, 'serve the live page'),
    'markers': (bool, 'publish markers for RViz'),
    'publish_tf': (bool, 'publish the frames on /tf and /tf_static'),
    'publish_volts': (bool, 'publish raw samples as plain numbers, for plots'),
    'frame_prefix': (str, 'prefix of every frame name'),
}
"""Parameters of the node that may be given as arguments, with their types."""


def start(context: LaunchContext) -> list[Node]:
    """Return the node. What is given here is written under its full name, so it wins over any line of a file."""
    given = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind)
        for name, (kind, _) in PARAMETERS.items()
        if LaunchConfiguration(name).perform(context)
    }
    node = Node(
        package='psd_deflection',
        executable='estimator',
        name='estimator',
        namespace=LaunchConfiguration('namespace'),
        output='screen',
        # Not under `parameters`: launch_ros passes over a file that is not there with a warning.
        ros_arguments=[
            '--params-file',
            LaunchConfiguration('params_file'),
            '--log-level',
            LaunchConfiguration('log_level'),
        ],
        parameters=[given] if given else [],
    )
    return [node]


def generate_launch_description() -> LaunchDescription:
    """One node; an argument that is not given leaves the parameter as params_file or its default has it."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'params_file',
                default_value=[FindPackageShare('psd_deflection'), '/config/thesis_rig.yaml'],
                description='ROS 2 parameter file with the rig',
            ),
            DeclareLaunchArgument('namespace', default_value='', description='namespace of the node and its topics'),
            DeclareLaunchArgument(
                'log_level',
                default_value='info',
                description='least severity that is logged: debug, info, warn, error, fatal',
            ),
            *(
                DeclareLaunchArgument(name, default_value='', description=f'{what} (empty: as params_file says)')
                for name, (_, what) in PARAMETERS.items()
            ),
            OpaqueFunction(function=start),
        ]
    )
