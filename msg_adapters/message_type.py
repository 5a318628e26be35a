# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A message type: its name, its definition as text and its hash. Each adapter declares its own.

The definitions are kept here as text because ROS need not be installed. A recording carries the
definition of each of its types (MCAP schema encoding ``ros2msg``), and the CDR encoder is made from
the same text. The comments and constants of the standard files are left out; they change neither
bytes nor hashes. The tests compare fields and hashes with an independent collection of the standard
definitions.
"""

from collections.abc import Mapping
from functools import cached_property
from typing import Any

_SHARED: Mapping[str, str] = {
    'builtin_interfaces/Time': 'int32 sec\nuint32 nanosec\n',
    'std_msgs/Header': 'builtin_interfaces/Time stamp\nstring frame_id\n',
    'geometry_msgs/Point': 'float64 x\nfloat64 y\nfloat64 z\n',
    'geometry_msgs/Vector3': 'float64 x\nfloat64 y\nfloat64 z\n',
    'geometry_msgs/Quaternion': 'float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n',
    'geometry_msgs/Pose': 'geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n',
}
"""Types that several messages contain."""

_SEPARATOR = '=' * 80 + '\n'


class Constant(list[Any]):
    """The elements of an array field that never change, so that what is written of them may be kept."""


class MessageType:
    """One type. ``name``: ``pkg/msg/Name``. ``text``: its fields, one a line, other types as ``pkg/Name``.

    ``type_hash``: its REP-2011 hash, which rosbag2 stores for each topic. ``parts``: the types of
    fields that only this message has.
    """

    def __init__(self, name: str, type_hash: str, text: str, parts: Mapping[str, str] | None = None) -> None:
        self.name = name
        self.type_hash = type_hash
        self._short = name.replace('/msg/', '/')
        self._texts = {**_SHARED, **(parts or {}), self._short: text}

    def members(self, kind: str = '') -> list[tuple[str, str]]:
        """(type, name) of each field of the message or of its part ``kind``; none if ``kind`` is no message."""
        lines = self._texts.get(kind or self._short, '').splitlines()
        return [(line.split()[0], line.split()[1]) for line in lines if '=' not in line]

    @cached_property
    def definition(self) -> str:
        """The text, followed by the texts of all parts that it is made of."""
        observed: list[str] = []

        def visit(kind: str) -> None:
            if kind in self._texts and kind not in observed:
                observed.append(kind)
                for line in self._texts[kind].splitlines():
                    visit(line.split()[0].partition('[')[0])

        visit(self._short)
        parts = ''.join(f'{_SEPARATOR}MSG: {kind}\n{self._texts[kind]}' for kind in observed[1:])
        return self._texts[self._short] + parts
