"""The estimator: ``ros2 launch psd_deflection estimator.launch.py port:=/dev/ttyACM0 record:=true``.

Parameters that are not given here come from ``params_file``.
"""

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

ARGUMENTS: dict[str, tuple[type, str]] = {
    'port': (str, 'serial port; without one, here or in params_file: the simulated rig'),
    'record': (bool, 'record from the start'),
    'bag_dir': (str, 'where recordings go'),
    'monitor': (bool, 'serve the live page'),
    'markers': (bool, 'publish markers for RViz'),
}


def generate_launch_description() -> LaunchDescription:
    """One node; an argument that is not given leaves the parameter as params_file or its default has it."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                'params_file',
                default_value=[FindPackageShare('psd_deflection'), '/config/thesis_rig.yaml'],
                description='ROS 2 parameter file with the rig',
            ),
            *(
                DeclareLaunchArgument(name, default_value='', description=f'{what} (empty: as params_file says)')
                for name, (_, what) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=estimator),
        ]
    )


def estimator(context: LaunchContext) -> list[Node]:
    """The node, with the arguments that were given."""
    given = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind)
        for name, (kind, _) in ARGUMENTS.items()
        if LaunchConfiguration(name).perform(context)
    }
    return [
        Node(
            package='psd_deflection',
            executable='estimator',
            name='estimator',
            output='screen',
            # Not under `parameters`: launch_ros passes over a file that is not there with a warning.
            ros_arguments=['--params-file', LaunchConfiguration('params_file')],
            parameters=[given] if given else [],
        )
    ]
