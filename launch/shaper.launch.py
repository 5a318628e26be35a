# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The shaper: ``ros2 launch psd_deflection shaper.launch.py params_file:=modes/rig.yaml shaped:=/arm/trajectory``.

Shapes the trajectories of the topic ``given`` so that no link rings, and publishes them on ``shaped``.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

PARAMETERS: dict[str, tuple[type, str]] = {
    'params_file': (str, 'rig file with the modes, as identify writes it'),
    'frequency': (float, 'frequency of the mode, Hz, instead of a rig file'),
    'damping_ratio': (float, 'damping ratio of that mode'),
    'shaper': (str, 'zv, mzv, zvd, ei, or none to pass trajectories through (empty: the recommended one)'),
    'urdf': (str, 'reject trajectories beyond the joint limits of this URDF file, or of the topic robot_description'),
    'max_step': (float, 'reject a trajectory that begins further from the joints, rad or m (empty: 0.05)'),
    'action': (str, 'FollowJointTrajectory action of the controller, for MoveIt (empty: topics only)'),
    'lead': (float, 'delay of each trajectory, s, so that it arrives before it begins (empty: 0.1)'),
}
"""Parameters of the node that may be given as arguments, with their types; `modes` stands in a parameter file."""

TOPICS = {'given': ('~/trajectory', 'shaper/trajectory'), 'shaped': ('~/shaped', 'shaper/shaped')}
"""Arguments with the topic of the node and its name in the namespace."""


def start(context: LaunchContext) -> list[Node]:
    """Return the node with the parameters that are given."""
    given = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind)
        for name, (kind, _) in PARAMETERS.items()
        if LaunchConfiguration(name).perform(context)
    }
    node = Node(
        package='psd_deflection',
        executable='shaper',
        name='shaper',
        namespace=LaunchConfiguration('namespace'),
        output='screen',
        parameters=[given] if given else [],
        remappings=[(topic, LaunchConfiguration(name)) for name, (topic, _) in TOPICS.items()],
    )
    return [node]


def generate_launch_description() -> LaunchDescription:
    """One node; an argument that is not given leaves the parameter at its default."""
    return LaunchDescription(
        [
            DeclareLaunchArgument('namespace', default_value='', description='namespace of the node and its topics'),
            *(
                DeclareLaunchArgument(name, default_value='', description=what)
                for name, (_, what) in PARAMETERS.items()
            ),
            *(
                DeclareLaunchArgument(name, default_value=topic, description=f'topic of the {name} trajectories')
                for name, (_, topic) in TOPICS.items()
            ),
            OpaqueFunction(function=start),
        ]
    )
