# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The shaper: ``ros2 launch psd_deflection shaper.launch.py params_file:=modes/rig.yaml shaped:=/arm/trajectory``.

Trajectories on ``given`` come out on ``shaped``, which no link rings after.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

ARGUMENTS: dict[str, str] = {
    'params_file': 'rig file with the modes, as identify writes it',
    'modes': 'modes of the rig file: bending, torsion or bending,torsion (empty: bending)',
    'frequency': 'of the mode, Hz, instead of a rig file',
    'damping_ratio': 'of that mode',
    'shaper': 'zv, mzv, zvd, ei, or none to pass trajectories through (empty: the recommended one)',
    'urdf': 'refuse trajectories beyond the limits of the joints of this file, or of the topic robot_description',
    'max_step': 'refuse a trajectory that begins further from where the joints are, rad or m (empty: 0.05)',
    'action': "the controller's action FollowJointTrajectory, for MoveIt (empty: topics alone)",
    'lead': 'a trajectory begins so much later, s, so that it has arrived when it does (empty: 0.1)',
}
"""Options of the command with their descriptions; the default of each is empty."""

TOPICS = {'given': 'shaper/trajectory', 'shaped': 'shaper/shaped'}
"""Topics with their names in the namespace."""


def generate_launch_description() -> LaunchDescription:
    """One node."""
    return LaunchDescription(
        [
            DeclareLaunchArgument('namespace', default_value='', description='namespace of the node and its topics'),
            *(DeclareLaunchArgument(name, default_value='', description=what) for name, what in ARGUMENTS.items()),
            *(
                DeclareLaunchArgument(name, default_value=topic, description=f'topic of the {name} trajectories')
                for name, topic in TOPICS.items()
            ),
            OpaqueFunction(function=shaper),
        ]
    )


def shaper(context: LaunchContext) -> list[Node]:
    """The node, with the arguments that were given."""
    arguments = []
    for name in ARGUMENTS:
        value = LaunchConfiguration(name).perform(context)
        if value:
            arguments += ['--' + name.replace('_', '-'), value]
    return [
        Node(
            package='psd_deflection',
            executable='shaper',
            name='shaper',
            namespace=LaunchConfiguration('namespace'),
            output='screen',
            arguments=arguments,
            remappings=[
                ('~/trajectory', LaunchConfiguration('given')),
                ('~/shaped', LaunchConfiguration('shaped')),
            ],
        )
    ]
