"""What the documents' ``ros2`` lines do, with rclpy alone: ros2cli and launch have no wheel.

``python -m docs.ros2 'ros2 topic echo /link_tip/deflection'`` does one of them.
"""

from __future__ import annotations

import importlib
import os
import re
import shlex
import sys
import time
from pathlib import Path
from typing import Any

from docs.terminal import WAIT_S


def check_launch(line: str) -> None:
    """That ``ros2 launch`` would find package, file and arguments."""
    _, _, package, file, *arguments = shlex.split(line)
    prefix = Path(os.environ['VIRTUAL_ENV'])
    installed = prefix / 'share' / package / 'launch' / file
    if not (prefix / 'share/ament_index/resource_index/packages' / package).exists() or not installed.exists():
        raise RuntimeError(f'{package}/{file} is not installed')
    declared = set(re.findall(r"DeclareLaunchArgument\(\s*'(\w+)'", installed.read_text(encoding='utf-8')))
    unknown = {a.partition(':=')[0] for a in arguments} - declared
    if unknown:
        raise RuntimeError(f'{file} has no argument {", ".join(unknown)}')


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
    import yaml

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
