# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A chain of links: ``ros2 launch psd_deflection chain.launch.py chain:=my_arm.yaml record:=true``.

``/end_effector/deflection``, the topics of each link below its name, and ``/tf`` from the base to the end effector.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, NotEqualsSubstitution
from launch_ros.actions import Node, SetParameter
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PARAMETERS: dict[str, tuple[type, str]] = {
    'slopes': (str, 'where the tilts of the tips come from: ratio or end_force (empty: as the chain file says)'),
    'record': (bool, 'record each link from the start (empty: no recording)'),
    'bag_dir': (str, 'folder below which each link has its recordings (empty: recordings)'),
}
"""Parameters of the node that may be given as arguments, with their types, besides ``chain``."""


def generate_launch_description() -> LaunchDescription:
    """One node for all links."""
    node = Node(
        package='psd_deflection',
        executable='chain',
        name='chain',
        namespace=LaunchConfiguration('namespace'),
        output='screen',
        parameters=[{'chain': ParameterValue(LaunchConfiguration('chain'), value_type=str)}],
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'chain',
                default_value=[FindPackageShare('psd_deflection'), '/config/two_links.yaml'],
                description='chain file with the links; default: two simulated links',
            ),
            DeclareLaunchArgument('namespace', default_value='', description='namespace of the node and its topics'),
            *(
                DeclareLaunchArgument(name, default_value='', description=what)
                for name, (_, what) in PARAMETERS.items()
            ),
            GroupAction(
                [
                    *(
                        SetParameter(
                            name,
                            ParameterValue(LaunchConfiguration(name), value_type=kind),
                            condition=IfCondition(NotEqualsSubstitution(LaunchConfiguration(name), '')),
                        )
                        for name, (kind, _) in PARAMETERS.items()
                    ),
                    node,
                ]
            ),
        ]
    )
