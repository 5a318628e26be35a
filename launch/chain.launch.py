# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A chain of links: ``ros2 launch psd_deflection chain.launch.py chain:=my_arm.yaml record:=recordings``.

``/end_effector/deflection``, the topics of each link below its name, and ``/tf`` from the base to the end effector.
"""

from typing import Any

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction
from launch.conditions import IfCondition
from launch.substitutions import EqualsSubstitution, LaunchConfiguration, NotEqualsSubstitution
from launch_ros.actions import Node, SetParameter
from launch_ros.substitutions import FindPackageShare

ARGUMENTS: dict[str, str] = {
    'namespace': 'namespace of the node and its topics',
    'slopes': 'where the tilts of the tips come from: ratio or end_force (empty: as the chain file says)',
    'record': 'folder below which each link is recorded from the start (empty: no recording)',
}
"""Arguments with their descriptions; the default of each is empty."""


def generate_launch_description() -> LaunchDescription:
    """One node for all links."""
    chain, record, slopes = (LaunchConfiguration(name) for name in ('chain', 'record', 'slopes'))
    node: dict[str, Any] = {
        'package': 'psd_deflection',
        'executable': 'chain',
        'name': 'chain',
        'namespace': LaunchConfiguration('namespace'),
        'output': 'screen',
    }
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'chain',
                default_value=[FindPackageShare('psd_deflection'), '/config/two_links.yaml'],
                description='chain file with the links; default: two simulated links',
            ),
            *(DeclareLaunchArgument(name, default_value='', description=what) for name, what in ARGUMENTS.items()),
            GroupAction(
                [
                    SetParameter('slopes', slopes, condition=IfCondition(NotEqualsSubstitution(slopes, ''))),
                    Node(**node, arguments=[chain], condition=IfCondition(EqualsSubstitution(record, ''))),
                    Node(
                        **node,
                        arguments=[chain, '--record', record],
                        condition=IfCondition(NotEqualsSubstitution(record, '')),
                    ),
                ]
            ),
        ]
    )
