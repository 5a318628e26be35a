# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A recorder that joins late: what it hears from then on, written as rosbag2 does, without metadata of ours."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from mcap.writer import Writer

from msg_adapters import MESSAGE_TYPES


class Heard(NamedTuple):
    """One message, encoded; ``t_ns``: when it arrived."""

    topic: str
    type: str
    cdr: bytes
    t_ns: int


def written(folder: Path, heard: Iterable[Heard], files: int = 2) -> Path:
    """A bag of several files, each with a part of the messages in order."""
    folder.mkdir()
    messages = list(heard)
    each = len(messages) // files + 1
    for number in range(files):
        with (folder / f'{folder.name}_{number}.mcap').open('wb') as stream:
            writer = Writer(stream)
            writer.start('ros2')
            channels: dict[str, int] = {}
            for topic, kind, message, t_ns in messages[number * each : (number + 1) * each]:
                if topic not in channels:
                    schema = writer.register_schema(kind, 'ros2msg', MESSAGE_TYPES[kind].definition.encode())
                    channels[topic] = writer.register_channel(topic, 'cdr', schema)
                writer.add_message(channels[topic], t_ns, message, t_ns)
            writer.finish()
    return folder
