# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A chain of links: ``ros2 launch psd_deflection chain.launch.py chain:=my_arm.yaml record:=recordings``.

``/end_effector/deflection``, the topics of each link below its name, and ``/tf`` from the base to the end effector.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

ARGUMENTS: dict[str, str] = {
    'namespace': 'namespace of the node and its topics',
    'slopes': 'where the tilts of the tips come from: ratio or end_force (empty: as the chain file says)',
    'record': 'folder below which each link is recorded from the start (empty: no recording)',
}
"""Arguments with their descriptions; the default of each is empty."""


def generate_launch_description() -> LaunchDescription:
    """One node for all links."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'chain',
                default_value=[FindPackageShare('psd_deflection'), '/config/two_links.yaml'],
                description='chain file with the links; default: two simulated links',
            ),
            *(DeclareLaunchArgument(name, default_value='', description=what) for name, what in ARGUMENTS.items()),
            OpaqueFunction(function=chain),
        ]
    )


def chain(context: LaunchContext) -> list[Node]:
    """The node, with the arguments that were given."""
    arguments = [LaunchConfiguration('chain')]
    for name in ('slopes', 'record'):
        value = LaunchConfiguration(name).perform(context)
        if value:
            arguments += [f'--{name}', value]
    return [
        Node(
            package='psd_deflection',
            executable='chain',
            name='chain',
            namespace=LaunchConfiguration('namespace'),
            output='screen',
            arguments=arguments,
        )
    ]
