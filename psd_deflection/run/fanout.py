# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Encodes each record once and hands the bytes to every wire: ROS publishers and the recorder."""

from typing import Protocol

from msg_adapters import (
    DEFLECTION,
    FILTER_INPUTS,
    FILTER_TOPICS,
    INPUTS,
    TOPIC_TYPES,
    messages,
    solver_topic,
    spot_topics,
)
from psd_deflection.model.solvers.subset import NAME as ONE_PSD
from psd_deflection.recordings import cdr
from psd_deflection.records import MOST_PSDS, ParameterChange, Record
from psd_deflection.rig.config import Rig


def published(rig: Rig) -> dict[str, str]:
    """The topics of what a run of ``rig`` puts out, with their types."""
    excluded = {*INPUTS, *spot_topics(MOST_PSDS)[len(rig.psds) :]}
    outputs = {topic: kind for topic, kind in TOPIC_TYPES.items() if topic not in excluded}
    if rig.estimator.filter == 'none':
        outputs = {topic: kind for topic, kind in outputs.items() if topic not in FILTER_TOPICS}
    return outputs | {solver_topic(s): TOPIC_TYPES[DEFLECTION] for s in (*rig.estimator.solvers, ONE_PSD)}


def subscribed(rig: Rig) -> tuple[str, ...]:
    """The topics of what a run of ``rig`` takes in."""
    return tuple(topic for topic in INPUTS if rig.estimator.filter != 'none' or topic not in FILTER_INPUTS)


class MessageSink(Protocol):
    """Takes encoded messages."""

    def put(self, topic: str, type_name: str, cdr: bytes, t_ns: int) -> None:
        """``type_name`` as ``pkg/msg/Name``; ``t_ns`` is the header's stamp."""


class ChangeSink(Protocol):
    """Takes changes of parameters, which are not messages."""

    def put_change(self, change: ParameterChange) -> None:
        """Note the change."""


class Fanout:
    """A sink of records. ``sinks`` in the order in which they are served. ``frame_prefix``: before names of frames."""

    def __init__(self, frame_prefix: str = '') -> None:
        self._frame_prefix = frame_prefix
        self.sinks: list[MessageSink] = []
        self.change_sinks: list[ChangeSink] = []

    def put(self, record: Record) -> None:
        """Encode and hand on."""
        if isinstance(record, ParameterChange):
            for change_sink in self.change_sinks:
                change_sink.put_change(record)
            return
        last: object = None
        encoded = b''
        for topic, type_name, t_ns, fields in messages(record, self._frame_prefix):
            # The same message on two topics is encoded once.
            if fields is not last:
                last, encoded = fields, cdr.encode(type_name, fields)
            for sink in self.sinks:
                sink.put(topic, type_name, encoded, t_ns)

    def close(self) -> None:
        """Nothing is held back."""
