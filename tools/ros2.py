"""What the documents' ``ros2`` lines do, with rclpy alone: ros2cli and launch have no wheel.

``python -m tools.ros2 'ros2 topic echo /link_tip/deflection'`` does one of them.
"""

from __future__ import annotations

import importlib
import runpy
import shlex
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import yaml

from tools.terminal import WAIT_S


class Said:
    """Whatever a launch file makes: what it is called, and with what."""

    def __init__(self, *given: Any, **named: Any) -> None:
        self.given = given
        self.named = named

    def perform(self, context: Callable[[Any], str]) -> str:
        """Its text; our context is what finds it."""
        return context(self)


KINDS = {
    'launch': ('LaunchContext', 'LaunchDescription'),
    'launch.actions': ('DeclareLaunchArgument', 'OpaqueFunction'),
    'launch.substitutions': ('LaunchConfiguration',),
    'launch_ros.actions': ('Node',),
    'launch_ros.parameter_descriptions': ('ParameterValue',),
    'launch_ros.substitutions': ('FindPackageShare',),
}
"""What our launch file uses of launch and launch_ros."""


def launched(line: str, prefix: Path, scratch: Path) -> list[str]:
    """The words of the command that ``ros2 launch`` would start; RuntimeError where it would not.

    ``prefix`` is where the package is installed. The launch file is run with stand-ins for what it imports; its
    parameters go to a file in ``scratch``, as launch_ros hands them over.
    """
    _, _, package, file, *arguments = shlex.split(line)
    if not (prefix / 'share/ament_index/resource_index/packages' / package).exists():
        raise RuntimeError(f'no package {package}')
    given = dict(argument.split(':=', 1) for argument in arguments)

    def text(value: Any) -> str:
        if isinstance(value, (list, tuple)):
            return ''.join(map(text, value))
        match type(value).__name__:
            case 'FindPackageShare':
                return str(prefix / 'share' / value.given[0])
            case 'LaunchConfiguration':
                return given[value.given[0]] if value.given[0] in given else text(defaults[value.given[0]])
            case _:
                return str(value)

    modules = {name: ModuleType(name) for name in KINDS}
    for name, kinds in KINDS.items():
        for kind in kinds:
            setattr(modules[name], kind, type(kind, (Said,), {}))
    with mock.patch.dict(sys.modules, {**modules, 'launch_ros': ModuleType('launch_ros')}):
        said = runpy.run_path(str(prefix / 'share' / package / 'launch' / file))['generate_launch_description']()
    actions = {kind: [a for a in said.given[0] if type(a).__name__ == kind] for kind in KINDS['launch.actions']}
    defaults = {a.given[0]: a.named['default_value'] for a in actions['DeclareLaunchArgument']}
    if unknown := set(given) - set(defaults):
        raise RuntimeError(f'{file} has no argument {", ".join(unknown)}')
    (opaque,) = actions['OpaqueFunction']
    (node,) = opaque.named['function'](text)
    words = [str(prefix / 'lib' / node.named['package'] / node.named['executable']), '--ros-args']
    words += [*map(text, node.named['ros_arguments']), '-r', f'__node:={node.named["name"]}']
    for number, parameters in enumerate(node.named['parameters']):
        # With value_type str the text is the value; the others are read as YAML.
        values = {
            key: text(value.given[0]) if value.named['value_type'] is str else yaml.safe_load(text(value.given[0]))
            for key, value in parameters.items()
        }
        path = scratch / f'launch_params_{number}.yaml'
        path.write_text(yaml.safe_dump({'/**': {'ros__parameters': values}}), encoding='utf-8')
        words += ['--params-file', str(path)]
    return words


class Asker:
    """A node that does what is asked and gives the first good answer; SystemExit where there is none in time."""

    def __init__(self) -> None:
        import rclpy

        rclpy.init()
        self._rclpy = rclpy
        self._node = rclpy.create_node('reader_of_the_documents')
        self._end = time.monotonic() + WAIT_S

    def echo(self, topic: str) -> Any:
        """``ros2 topic echo --once``."""
        while not (types := dict(self._node.get_topic_names_and_types()).get(topic)):
            self._spin(f'no topic {topic}')
        heard: list[Any] = []
        self._node.create_subscription(_type_of(types[0]), topic, heard.append, 10)
        while not heard:
            self._spin(f'nothing on {topic}')
        return heard[0]

    def call(self, service: str, kind: str, **request: Any) -> Any:
        """``ros2 service call``, until it succeeds: before the first block there is nothing to be zeroed."""
        service_type = _type_of(kind)
        client = self._node.create_client(service_type, service)
        if not client.wait_for_service(WAIT_S):
            raise SystemExit(f'no service {service}')
        while True:
            future = client.call_async(service_type.Request(**request))
            while not future.done():
                self._spin(f'no answer from {service}')
            answer = future.result()
            if answer is not None and answer.success:
                return answer
            self._spin(f'{service}: {answer}')

    def change_state(self, node: str, transition: str) -> Any:
        """``ros2 lifecycle set``."""
        message = _type_of('lifecycle_msgs/msg/Transition')
        return self.call(f'{node}/change_state', 'lifecycle_msgs/srv/ChangeState', transition=message(label=transition))

    def _spin(self, otherwise: str) -> None:
        self._rclpy.spin_once(self._node, timeout_sec=0.1)
        if time.monotonic() > self._end:
            raise SystemExit(otherwise)


def _type_of(name: str) -> Any:
    package, kind, message = name.split('/')
    return getattr(importlib.import_module(f'{package}.{kind}'), message)


def main() -> None:
    """Do the line that is the first argument, and print the answer."""
    _, what, verb, name, *rest = shlex.split(sys.argv[1])
    asker = Asker()
    if (what, verb) == ('topic', 'echo'):
        print(asker.echo(name))
    elif (what, verb) == ('service', 'call'):
        print(asker.call(name, rest[0], **(yaml.safe_load(rest[1]) if len(rest) > 1 else {})))
    elif (what, verb) == ('lifecycle', 'set'):
        print(asker.change_state(name, rest[0]))
    else:
        raise SystemExit(f'not known: {sys.argv[1]}')


if __name__ == '__main__':
    main()
