# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tells a wire what the rig is, and what the pipeline remembers: ``/link_tip/rig``."""

import threading
import time
from collections import deque
from collections.abc import Mapping

from msg_adapters import to_messages
from psd_deflection import __version__
from psd_deflection.recordings import cdr
from psd_deflection.recordings.provenance import provenance
from psd_deflection.records import ENVIRONMENT, KNOWN_LOAD, ParameterChange, Record, RigState, SampleBlock
from psd_deflection.rig.config import Rig
from psd_deflection.run.fanout import MessageSink
from psd_deflection.run.session import Session

MEMORY_S = 10.0
"""Time between messages with the pipeline's memory, s; each waits for the end of a segment of the noise."""
LATE = 100
"""Blocks after which the memory is sent though a segment is under way, if that segment is short."""
MOST_BUFFERED = 20_000
"""Numbers of a segment under way that are reported; a longer one is waited for."""


class RigPublisher:
    """Publishes rig, zero and hello of ``session``: on activation, at each change, and if the hello changes.

    Changes come in the pipeline thread, between two blocks. Our own recordings hold the same without it. As a sink of
    the session's records it takes what the pipeline remembers, every ``MEMORY_S``, so that whatever recorder joins late
    replays bit for bit from there; :meth:`notify` encodes and publishes it, in its own thread.
    """

    def __init__(self, sink: MessageSink, session: Session) -> None:
        self._sink = sink
        self._session = session
        self._reported: Mapping[str, object] | None = None
        self._last = ParameterChange(0, 0, ())
        self._environment: dict[str, object] = {}  # Bound: our own names.
        rig = session.rig
        self._every = max(round(MEMORY_S * rig.converter.sample_rate_hz / rig.estimator.block_size), 1)
        # What holds before the first block is known now; which block that is, when it comes.
        self._first: ParameterChange | None = self._memory()
        self._next_index: int | None = None
        self._untold: deque[tuple[Rig, ParameterChange]] = deque(maxlen=2)
        self._lock = threading.Lock()

    def _memory(self) -> ParameterChange:
        pipeline = self._session.pipeline
        return pipeline.snapshot(pipeline.rig) or ParameterChange(0, 0, ())

    def put(self, record: Record) -> None:
        """Take what the pipeline remembers after the block ``record``, if it is due."""
        if not isinstance(record, SampleBlock):
            return
        pipeline, index = self._session.pipeline, record.index
        if self._first is not None:
            first, self._first = self._first, None
            self._untold.append((pipeline.rig, first._replace(block=index)))
        next_index = self._next_index if self._next_index is not None else index
        if index < next_index:
            return
        buffered = pipeline.buffers
        if not buffered or (index >= next_index + LATE and buffered <= MOST_BUFFERED):
            self._next_index = index + self._every
            self._untold.append((pipeline.rig, self._memory()._replace(block=index + 1)))

    def put_change(self, change: ParameterChange) -> None:
        """Publish the rig after ``change``."""
        if all(name == KNOWN_LOAD for name, _ in change.values):
            # A reader has the load from its own topic.
            return
        # In order: what was remembered is of the rig before.
        self._notify_memories()
        with self._lock:
            self._last = change
            self._environment |= {name: value for name, value in change.values if name in ENVIRONMENT}
            self._publish(dict(change.values))

    def notify(self, again: bool = True) -> None:
        """Publish what is remembered, if that is due; the present rig if ``again``, or if the hello is another one."""
        self._notify_memories()
        with self._lock:
            if again or self._hello() != self._reported:
                # A recorder that joins from now on waits for what comes next.
                self._next_index = None
                self._publish(self._environment)

    def _notify_memories(self) -> None:
        with self._lock:
            while self._untold:
                rig, memory = self._untold.popleft()
                values = dict(memory.values)
                self._send(self._state(rig, memory, {})._replace(memory=values))

    def _hello(self) -> Mapping[str, object] | None:
        hello = self._session.acquisition.hello
        return None if hello is None else hello.info

    def _publish(self, changed: Mapping[str, object]) -> None:
        self._reported = self._hello()
        self._send(self._state(self._session.rig, self._last, changed))

    def _state(self, rig: Rig, at: ParameterChange, changed: Mapping[str, object]) -> RigState:
        return RigState(
            t_ns=at.t_ns,
            block=at.block,
            parameters=rig.flat(),
            hello=self._reported,
            changed=changed,
            version=__version__,
            made_with=provenance(),
        )

    def _send(self, state: RigState) -> None:
        for message in to_messages(state):
            self._sink.put(message.topic, message.type, cdr.encode(message.type, message.fields), time.time_ns())
