# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A chain of links: ``ros2 launch psd_deflection chain.launch.py chain:=my_arm.yaml record:=true``.

``/end_effector/deflection``, the topics of each link below its name, and ``/tf`` from the base to the end effector.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PARAMETERS: dict[str, tuple[type, str]] = {
    'chain': (str, 'chain file with the links; default: two simulated links'),
    'slopes': (str, 'where the tilts of the tips come from: ratio or end_force (empty: as the chain file says)'),
    'record': (bool, 'record each link from the start (empty: no recording)'),
    'bag_dir': (str, 'folder below which each link has its recordings (empty: recordings)'),
}
"""Parameters of the node that may be given as arguments, with their types."""


def start(context: LaunchContext) -> list[Node]:
    """Return the node with the parameters that are given."""
    given = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind)
        for name, (kind, _) in PARAMETERS.items()
        if LaunchConfiguration(name).perform(context)
    }
    node = Node(
        package='psd_deflection',
        executable='chain',
        name='chain',
        namespace=LaunchConfiguration('namespace'),
        output='screen',
        parameters=[given],
    )
    return [node]


def generate_launch_description() -> LaunchDescription:
    """One node for all links."""
    default = {'chain': [FindPackageShare('psd_deflection'), '/config/two_links.yaml']}
    return LaunchDescription(
        [
            DeclareLaunchArgument('namespace', default_value='', description='namespace of the node and its topics'),
            *(
                DeclareLaunchArgument(name, default_value=default.get(name, ''), description=what)
                for name, (_, what) in PARAMETERS.items()
            ),
            OpaqueFunction(function=start),
        ]
    )
