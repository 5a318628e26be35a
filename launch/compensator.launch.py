# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The compensator: ``ros2 launch psd_deflection compensator.launch.py urdf:=arm.urdf tip:=tool0 drive:=true``.

It is silent until ``/compensator/enable`` is called. For ``forward_position_controller``::

    ros2 launch psd_deflection compensator.launch.py urdf:=arm.urdf tip:=tool0 drive:=true \
        output:=commands commands:=/forward_position_controller/commands
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS: dict[str, str] = {
    'urdf': 'kinematics of the arm (empty: the topic robot_description)',
    'tip': 'link of the end effector',
    'base': 'link from which on joints count (empty: the root)',
    'axes': "axes of the end effector's pose that are corrected, of x,y,z,rx,ry,rz (empty: x,y,z)",
    'output': 'offsets, which your controller adds, or commands, position plus offset (empty: offsets)',
    'max_offset': 'largest offset of a joint, rad or m (empty: 0.05)',
    'max_rate': 'largest rate of an offset, rad/s or m/s (empty: 0.1)',
    'controller_state': 'type of what an active controller tells on controller_state (empty: not listened to)',
}
"""Options of the command with their descriptions; the default of each is empty."""

TOPICS = {
    name: f'compensator/{name}'
    for name in ('offsets', 'commands', 'applied', 'reference', 'robot_running', 'speed_scaling', 'controller_state')
}
"""Topics with their names in the namespace."""
TOPIC_OF = {'controller_state': 'controller_state_topic'}
"""The argument of a topic, if it has another name."""


def generate_launch_description() -> LaunchDescription:
    """One node."""
    return LaunchDescription(
        [
            DeclareLaunchArgument('namespace', default_value='', description='namespace of the node and its topics'),
            DeclareLaunchArgument('drive', default_value='false', description='publish for a controller'),
            DeclareLaunchArgument('params_file', default_value='', description='ROS parameters of the node'),
            *(DeclareLaunchArgument(name, default_value='', description=what) for name, what in ARGUMENTS.items()),
            *(
                DeclareLaunchArgument(TOPIC_OF.get(name, name), default_value=topic, description=f'topic of the {name}')
                for name, topic in TOPICS.items()
            ),
            OpaqueFunction(function=compensator),
        ]
    )


def compensator(context: LaunchContext) -> list[Node]:
    """The node, with the arguments that were given."""
    given = {name: LaunchConfiguration(name).perform(context) for name in (*ARGUMENTS, 'drive', 'params_file')}
    arguments = [given['urdf']] if given['urdf'] else []
    for name in ARGUMENTS:
        if name != 'urdf' and given[name]:
            arguments += ['--' + name.replace('_', '-'), given[name]]
    if given['drive'].lower() in ('true', '1'):
        arguments.append('--drive')
    return [
        Node(
            package='psd_deflection',
            executable='compensator',
            name='compensator',
            namespace=LaunchConfiguration('namespace'),
            output='screen',
            arguments=arguments,
            parameters=[given['params_file']] if given['params_file'] else [],
            remappings=[(f'~/{name}', LaunchConfiguration(TOPIC_OF.get(name, name))) for name in TOPICS],
        )
    ]
