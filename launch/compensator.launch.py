# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The compensator: ``ros2 launch psd_deflection compensator.launch.py tip:=tool0 drive:=true``.

Kinematics come from the topic ``robot_description``. With ``drive`` it is silent until
``/compensator/enable`` is called. For ``forward_position_controller``::

    ros2 launch psd_deflection compensator.launch.py tip:=tool0 drive:=true \
        output:=commands commands:=/forward_position_controller/commands
"""

from typing import List  # noqa: UP035, launch knows no list[str]

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

PARAMETERS: dict[str, tuple[type, str]] = {
    'tip': (str, 'link of the end effector; must be given, here or in params_file'),
    'base': (str, 'link from which on joints count (empty: the root)'),
    'urdf': (str, 'URDF file with the kinematics (empty: the topic robot_description)'),
    'drive': (bool, 'publish for a controller, once enabled (empty: false, proposals alone)'),
    'axes': (List[str], 'axes that are corrected, as [x, z] (empty: [x, y, z])'),  # noqa: UP006
    'output': (str, 'offsets, which your controller adds, or commands, position plus offset (empty: offsets)'),
    'max_offset': (float, 'largest offset of a joint, rad or m (empty: 0.05)'),
    'max_rate': (float, 'largest rate of an offset, rad/s or m/s (empty: 0.1)'),
    'controller_state': (str, 'type of what an active controller reports on controller_state (empty: not used)'),
}
"""Parameters of the node that may be given as arguments, with their types; the others stand in ``params_file``."""

TOPICS = {
    name: f'compensator/{name}'
    for name in ('offsets', 'commands', 'applied', 'reference', 'robot_running', 'speed_scaling', 'controller_state')
}
"""Topics with their names in the namespace."""
TOPIC_OF = {'controller_state': 'controller_state_topic'}
"""The argument of a topic, if it has another name."""


def start(context: LaunchContext) -> list[Node]:
    """Return the node. What is given here is written under its full name, so it wins over any line of a file."""
    given = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind)
        for name, (kind, _) in PARAMETERS.items()
        if LaunchConfiguration(name).perform(context)
    }
    file = LaunchConfiguration('params_file')
    node = Node(
        package='psd_deflection',
        executable='compensator',
        name='compensator',
        namespace=LaunchConfiguration('namespace'),
        output='screen',
        # Not under `parameters`: launch_ros passes over a file that is not there with a warning.
        ros_arguments=['--params-file', file] if file.perform(context) else [],
        parameters=[given] if given else [],
        remappings=[(f'~/{name}', LaunchConfiguration(TOPIC_OF.get(name, name))) for name in TOPICS],
    )
    return [node]


def generate_launch_description() -> LaunchDescription:
    """One node."""
    return LaunchDescription(
        [
            DeclareLaunchArgument('namespace', default_value='', description='namespace of the node and its topics'),
            DeclareLaunchArgument('params_file', default_value='', description='ROS parameters of the node'),
            *(
                DeclareLaunchArgument(name, default_value='', description=what)
                for name, (_, what) in PARAMETERS.items()
            ),
            *(
                DeclareLaunchArgument(TOPIC_OF.get(name, name), default_value=topic, description=f'topic of the {name}')
                for name, topic in TOPICS.items()
            ),
            OpaqueFunction(function=start),
        ]
    )
