# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compares the messages of a replay with the recorded ones, byte by byte, in streams, by topic and stamp; a recording
may be partial. Rounding is counted apart: a defect only if nothing that computes has changed (provenance)."""

import math
from collections import deque
from collections.abc import Iterator, Mapping

import numpy as np

from msg_adapters import DIAGNOSTICS, FILTERED, INPUTS, RIG, SAMPLES, pose_stamped, to_messages
from psd_deflection.base.errors import RecordingError
from psd_deflection.measure.state import FULL
from psd_deflection.recordings import cdr
from psd_deflection.recordings.provenance import differences, provenance
from psd_deflection.recordings.recording import Recording, RecordingWindow
from psd_deflection.records import ParameterChange, Record
from psd_deflection.rig.declarations import FRAME_PREFIX

_NOT_ESTIMATED = {DIAGNOSTICS, RIG, SAMPLES, *INPUTS}
_LAG_NS = 2_000_000_000
"""How far the recorded side is read ahead of the replayed one."""

ROUNDING = 1e-9
"""Share of the largest number of a group (a vector, a quaternion; of a covariance the two standard deviations) by which
rounding may change it."""
_LEAST = {'geometry_msgs/msg/WrenchStamped': 1e-9, 'geometry_msgs/msg/TwistStamped': 1e-11}
"""What rounding may change at least, by message type: N and N m; m/s and rad/s."""
_LEAST_OF_OTHERS = 1e-13
"""m and rad: a ten-thousandth of a nanometre."""


class ReplayComparison:
    """Feed it the replay's records in order, then call ``finish``.

    ``different``: messages that differ, ``rounded`` of them by rounding alone. ``rounding_explained``: what computes is
    not what computed the recording, as ``changed`` tells; so rounding may differ.

    ``from_block``: of a recording that starts in mid-run, the block from which on it is compared, because the pipeline
    said what it remembered there; None: from the start.

    ``only_recorded``, ``only_replayed``: messages that the other side lacks. ``missing``: how many of them neither the
    edges of the recording nor a topic that it does not have explains.

    ``part``: only what lies in this part of the recording is compared, by its stamps.

    Raises RecordingError if the recording holds no estimates to compare with, or if ``part`` ends before it says what
    the pipeline remembered when it began.
    """

    def __init__(self, recording: Recording, part: RecordingWindow | None = None) -> None:
        topics = [t for t in recording.topics() if t not in _NOT_ESTIMATED]
        if not topics:
            raise RecordingError(f'{recording.path}: holds no estimates to compare with')
        self._part = part
        if part is not None:
            _check_memory(recording, part)
        self.equal = 0
        self.different = 0
        self.rounded = 0
        self.changed = differences(recording.made_with, provenance())
        self.only_recorded = 0
        self.only_replayed = 0
        self.missing = 0
        self.from_block: int | None = None
        # Last stamp of each topic before that.
        self._before: dict[str, int] = {}
        # A recorder of ours writes every message, or counts it; another one may lose some on the way.
        self._gapless = recording.recorded_by_us
        self._between: dict[str, int] = {}
        self._recording = recording
        self._frame_prefix = str(recording.parameters.get(FRAME_PREFIX, ''))
        self._complete = True
        self._recorded: dict[str, deque[tuple[int, bytes]]] = {t: deque() for t in topics}
        self._replayed: dict[str, deque[tuple[int, bytes]]] = {t: deque() for t in topics}
        self._types: dict[str, str] = {}
        self._worst: dict[str, float] = {}
        self._first_difference = ''
        self._stream: Iterator[tuple[str, int, bytes]] = (
            (m.channel.topic, m.log_time, m.cdr) for m in recording.messages(topics)
        )
        self._ended = False
        self._newest = 0

    @property
    def same(self) -> bool:
        """True if no bit differs in what both sides hold, and there is something that both hold."""
        return self.equal > 0 and not (self.different or self.missing)

    @property
    def same_but_for_rounding(self) -> bool:
        """As ``same``, but rounding may differ if what computes has changed since the recording was made."""
        explained = self.rounded if self.changed else 0
        return self.equal + explained > 0 and self.different == explained and not self.missing

    @property
    def identical(self) -> bool:
        """True if each side has every message of the other, and no bit differs."""
        return not (self.different or self.only_recorded or self.only_replayed)

    def add(self, records: list[Record]) -> None:
        """Compare the messages of ``records``."""
        newest = 0
        for record in records:
            if isinstance(record, ParameterChange):
                if self._newest and any(name == FULL for name, _ in record.values):
                    self._begin(record)
                continue
            for topic, type_name, t_ns, fields in to_messages(record, self._frame_prefix):
                if self._part is not None and not self._part.has(t_ns):
                    continue
                if topic in self._replayed:
                    self._types[topic] = type_name
                    self._replayed[topic].append((t_ns, cdr.encode(type_name, fields)))
                elif topic not in _NOT_ESTIMATED:
                    # A solver that runs now but did not when the recording was made.
                    self._count_only_replayed(topic, t_ns)
                newest = max(newest, t_ns)
        if newest:
            self._newest = newest
            self._read_until(newest + _LAG_NS)
            self._match()

    def _begin(self, memory: ParameterChange) -> None:
        """Compare from here on: before, the replay did not know what the run remembered."""
        self.from_block = memory.block
        for topic, replayed in self._replayed.items():
            last = replayed[-1][0] if replayed else self._before.get(topic, 0)
            self._before[topic] = max(memory.t_ns, last)
            replayed.clear()
        self.equal = self.different = self.rounded = self.only_recorded = self.only_replayed = self.missing = 0
        self._between.clear()
        self._worst.clear()
        self._first_difference = ''

    def finish(self) -> None:
        """Report messages that are left on either side: they have no counterpart."""
        self._read_until(None)
        self._complete = self._recording.complete
        self._match()
        for topic in self._recorded:
            for t_ns, _ in self._recorded[topic]:
                if t_ns > self._newest and not self._complete:
                    # The cut removed the samples but not the estimates made from them.
                    continue
                self._count_only_recorded(topic, t_ns)
            for t_ns, _ in self._replayed[topic]:
                self._count_only_replayed(topic, t_ns)

    def counts(self) -> dict[str, int | bool]:
        """For programs: numbers of equal, different and unmatched messages, and ``same``."""
        return {
            'same': self.same,
            'identical': self.identical,
            'equal': self.equal,
            'different': self.different,
            'rounded': self.rounded,
            'same_but_for_rounding': self.same_but_for_rounding,
            'only_recorded': self.only_recorded,
            'only_replayed': self.only_replayed,
            **({} if self.from_block is None else {'from_block': self.from_block}),
        }

    def summary(self) -> str:
        """One line, and the largest difference if there is one."""
        if self.from_block is not None:
            return f'starts in mid-run; compared from block {self.from_block}\n{self._summary()}'
        return self._summary()

    def _summary(self) -> str:
        if self.identical:
            return f'compared: {self.equal} messages, no bit differs'
        if self.same:
            return (
                f'compared: {self.equal} messages that both hold, no bit differs\n'
                f'  the recording is partial: {self.only_recorded} messages are only in it, '
                f'{self.only_replayed} only in the replay'
            )
        lines = [
            f'compared: {self.equal} messages equal, {self._differences()}, '
            f'{self.only_recorded} only recorded, {self.only_replayed} only in the replay'
        ]
        if self.rounded and self.changed:
            lines.append(f'  rounding may differ: recorded with {"; ".join(self.changed)}')
        elif self.rounded and self.rounded == self.different:
            lines.append('  rounding differs although the same versions recorded it: please report this')
        lines += [f'  largest difference: {name} {value:.3g}' for name, value in sorted(self._worst.items())]
        if self._first_difference:
            lines.append(f'  first: {self._first_difference}')
        return '\n'.join(lines)

    def _differences(self) -> str:
        if self.different and self.rounded == self.different:
            return f'{self.different} differ by rounding alone'
        return f'{self.different} differ' + (f', {self.rounded} of them by rounding alone' if self.rounded else '')

    def _count_only_replayed(self, topic: str, t_ns: int) -> None:
        self.only_replayed += 1
        self._unmatched(topic)
        self._note(f'{topic} at {t_ns} ns is in the replay and was not recorded')

    def _count_only_recorded(self, topic: str, t_ns: int) -> None:
        self.only_recorded += 1
        self._unmatched(topic)
        self._note(f'{topic} at {t_ns} ns is recorded, the replay has none')

    def _unmatched(self, topic: str) -> None:
        """Count it as missing once a later message of its topic has a counterpart, if an earlier one had."""
        if self._gapless and topic in self._between:
            self._between[topic] += 1

    def _matched(self, topic: str) -> None:
        self.missing += self._between.get(topic, 0)
        self._between[topic] = 0

    def _note(self, text: str) -> None:
        if not self._first_difference:
            self._first_difference = text

    def _read_until(self, t_ns: int | None) -> None:
        while not self._ended:
            message = next(self._stream, None)
            if message is None:
                self._ended = True
                return
            topic, log_time, encoded = message
            stamp = _stamp(encoded, log_time)
            if self._part is None or self._part.has(stamp):
                self._recorded[topic].append((stamp, encoded))
            elif log_time > self._part.end_ns + _LAG_NS:
                self._ended = True
                return
            if t_ns is not None and log_time > t_ns:
                return

    def _match(self) -> None:
        for topic, recorded in self._recorded.items():
            replayed = self._replayed[topic]
            while recorded and recorded[0][0] <= self._before.get(topic, -1):
                recorded.popleft()
            while recorded and replayed:
                (t_a, a), (t_b, b) = recorded[0], replayed[0]
                if t_a == t_b:
                    recorded.popleft()
                    replayed.popleft()
                    self._matched(topic)
                    if a == b:
                        self.equal += 1
                    else:
                        self._differ(topic, t_a, a, b)
                elif t_a < t_b:
                    recorded.popleft()
                    self._count_only_recorded(topic, t_a)
                else:
                    replayed.popleft()
                    self._count_only_replayed(topic, t_b)

    def _differ(self, topic: str, t_ns: int, a: bytes, b: bytes) -> None:
        self.different += 1
        self.rounded += self._by_rounding(topic, a, b)
        self._note(f'{topic} at {t_ns} ns')
        if topic == FILTERED or not topic.endswith('/deflection'):
            return
        try:
            sides = np.array([cdr.numbers(pose_stamped.MESSAGE.name, side)[1] for side in (a, b)])
        except ValueError:
            return
        (old, new), _ = pose_stamped.to_poses(sides)
        for name, difference in zip(('ΔX (m)', 'ΔY (m)', 'θ (rad)'), np.abs(old - new).tolist(), strict=True):
            self._worsen(f'{topic} {name}', difference)

    def _by_rounding(self, topic: str, a: bytes, b: bytes) -> bool:
        """Whether two messages agree but for rounding."""
        name = self._types.get(topic, '')
        try:
            return agree(cdr.decode(name, a), cdr.decode(name, b), _LEAST.get(name, _LEAST_OF_OTHERS))
        except (KeyError, ValueError):
            return False

    def _worsen(self, name: str, difference: float) -> None:
        self._worst[name] = max(self._worst.get(name, 0.0), difference)


def _check_memory(recording: Recording, part: RecordingWindow) -> None:
    """Raise RecordingError if nothing of ``part`` can be compared, because the recording starts in mid-run."""
    first = next(recording.blocks())
    memory = recording.memory_from(first.index)
    if memory is not None and memory.block > first.index and memory.t_ns >= part.end_ns:
        reported_s = (memory.t_ns - int(first.t_ns[0])) / 1e9
        raise RecordingError(
            f'{recording.path}: starts in mid-run and says {reported_s:.1f} s after its first sample what the pipeline '
            'remembers; nothing before that can be compared: give a later --to'
        )


def _stamp(encoded: bytes, log_time: int) -> int:
    """The header's stamp, ns: all our messages begin with one."""
    return cdr.header_stamp_ns(encoded) if len(encoded) >= cdr.FRAME_AT else log_time


def agree(a: object, b: object, least: float) -> bool:
    """Whether two decoded values agree but for rounding; ``least``: what rounding may change at least."""
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        if set(a) != set(b):
            return False
        numbers = [name for name in a if isinstance(a[name], float) and isinstance(b[name], float)]
        rest = [name for name in a if name not in numbers]
        return _group([a[name] for name in numbers], [b[name] for name in numbers], least) and all(
            _covariance(a[name], b[name]) if name == 'covariance' else agree(a[name], b[name], least) for name in rest
        )
    if isinstance(a, float) and isinstance(b, float):
        return _group([a], [b], least)
    return bool(np.array_equal(np.asarray(a), np.asarray(b)))


def _group(a: list[float], b: list[float], least: float) -> bool:
    """Whether numbers of one vector agree, by the largest of them."""
    allowed = max([ROUNDING * abs(v) for v in a if math.isfinite(v)] + [least])
    return all(v == w or (v != v and w != w) or abs(v - w) <= allowed for v, w in zip(a, b, strict=True))


def _covariance(a: object, b: object) -> bool:
    """Whether two covariances (k * k,) agree, each element by the standard deviations of its row and column."""
    first, second = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    size = math.isqrt(first.size)
    if first.shape != second.shape or size * size != first.size:
        return False
    sd = np.sqrt(np.abs(np.diag(first.reshape(size, size))))
    close = np.abs(first - second).reshape(size, size) <= ROUNDING * sd[:, None] * sd
    return bool((close.ravel() | (first == second) | (np.isnan(first) & np.isnan(second))).all())
