# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Metadata as rosbag2 Jazzy writes it beside the messages: ``metadata.yaml`` version 9 and QoS profiles.

A bag holds the QoS of a topic twice, in ``metadata.yaml`` and in the MCAP channel. Some readers
skip a topic if the two differ, so both are made here from one value.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import yaml

from psd_deflection.base.files import HeldFolder

METADATA_VERSION = 9

_INFINITE = {'sec': 9223372036, 'nsec': 854775807}

Qos = Mapping[str, Any]


DEFAULT_QOS: Qos = {
    'history': 'keep_last',
    'depth': 10,
    'reliability': 'reliable',
    'durability': 'volatile',
    'deadline': _INFINITE,
    'lifespan': _INFINITE,
    'liveliness': 'automatic',
    'liveliness_lease_duration': _INFINITE,
    'avoid_ros_namespace_conventions': False,
}
"""Our publishers' profile, named as rosbag2 names it from version 9 on."""

LATCHED_QOS: Qos = {**DEFAULT_QOS, 'depth': 1, 'durability': 'transient_local'}
"""The profile of a topic whose last message a late subscriber gets."""


def qos_text(qos: Qos) -> str:
    """The channel metadata ``offered_qos_profiles``."""
    return to_yaml([dict(qos)])


def to_yaml(tree: object) -> str:
    """YAML in block style, in the given order, as rosbag2 writes it."""

    class Dumper(yaml.SafeDumper):
        def ignore_aliases(self, data: object) -> bool:
            return True

    text: str = yaml.dump(tree, Dumper=Dumper, sort_keys=False, default_flow_style=False, width=1000)
    return text


@dataclass(slots=True)
class TopicCount:
    """One topic of a bag. ``qos``: one profile, or the list of all that were offered."""

    name: str
    type: str
    qos: Qos | list[Qos]
    type_hash: str
    messages: int = 0


def totals(counts: Iterable[TopicCount]) -> list[TopicCount]:
    """One count a topic, of all files together."""
    topics: dict[str, TopicCount] = {}
    for t in counts:
        known = topics.setdefault(t.name, TopicCount(t.name, t.type, t.qos, t.type_hash))
        known.messages += t.messages
    return list(topics.values())


@dataclass(frozen=True, slots=True)
class FileCount:
    """One file of a bag: ``path`` relative to its folder; times are log times, ns."""

    path: str
    start_ns: int
    end_ns: int
    messages: int


def _times(start_ns: int, end_ns: int, count: int) -> dict[str, Any]:
    # The value that rosbag2 writes for a bag without messages.
    return {
        'starting_time': {'nanoseconds_since_epoch': start_ns if count else 2**63 - 1},
        'duration': {'nanoseconds': end_ns - start_ns if count else 0},
    }


def bag_information(
    files: Sequence[FileCount], topics: Sequence[TopicCount], custom: Mapping[str, str]
) -> dict[str, Any]:
    """The tree below ``rosbag2_bagfile_information``."""
    count = sum(t.messages for t in topics)
    filled = [f for f in files if f.messages]
    times = _times(min((f.start_ns for f in filled), default=0), max((f.end_ns for f in filled), default=0), count)
    return {
        'version': METADATA_VERSION,
        'storage_identifier': 'mcap',
        'duration': times['duration'],
        'starting_time': times['starting_time'],
        'message_count': count,
        'topics_with_message_count': [
            {
                'topic_metadata': {
                    'name': t.name,
                    'type': t.type,
                    'serialization_format': 'cdr',
                    'offered_qos_profiles': [dict(q) for q in t.qos] if isinstance(t.qos, list) else [dict(t.qos)],
                    'type_description_hash': t.type_hash,
                },
                'message_count': t.messages,
            }
            for t in topics
        ],
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [f.path for f in files],
        'files': [
            {'path': f.path, **_times(f.start_ns, f.end_ns, f.messages), 'message_count': f.messages} for f in files
        ],
        'custom_data': dict(custom),
        'ros_distro': 'jazzy',
    }


def write_metadata(folder: HeldFolder, information: Mapping[str, Any]) -> None:
    """Write ``metadata.yaml`` completely or not at all. Raises OSError."""
    text = to_yaml({'rosbag2_bagfile_information': information})
    folder.replace('metadata.yaml', text.encode())
