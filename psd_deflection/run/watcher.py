# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The watch in a run: the last minutes are kept encoded in memory, bounded in bytes and time, each segment with the rig
and the pipeline's memory; an alarm writes them below ``watch_dir``, in a thread of its own."""

import contextlib
import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from msg_adapters import INPUTS, SAMPLES
from psd_deflection.base.bounds import MESSAGE_BYTES, ByteBudget
from psd_deflection.base.errors import RecordingError
from psd_deflection.base.files import HeldFolder
from psd_deflection.base.log import ERROR, WARNING, LogCallback
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.measure.watch import Alarm, Watch
from psd_deflection.recordings.write.bag_writer import BagWriter
from psd_deflection.records import AppliedLoad, DiagnosticEntry, ParameterChange, Record, SampleBlock
from psd_deflection.rig.config import Rig
from psd_deflection.run.alarm_out import AlarmOut
from psd_deflection.run.recorder import new_folder, why_full

SEGMENT_NS = 30_000_000_000
AFTER_NS = 60_000_000_000
"""What follows the alarm is kept too."""
NAME = 'psd_deflection: watch'
STEM = 'watch'
"""What is kept is called so, and then the time: nothing else in the folder is ever deleted."""
OK, WARN = 0, 1

Kept = ParameterChange | tuple[str, str, bytes, int]


@dataclass(slots=True)
class _Segment:
    """``began_ns``: of its first block. ``memory``, ``load``: as they were before it. ``bytes``: held by ``items``."""

    rig: Rig
    began_ns: int
    memory: ParameterChange | None
    load: AppliedLoad | None
    items: list[Kept] = field(default_factory=list)  # Bound: watch_memory.
    bytes: int = 0


class Watcher:
    """A sink of records, after the one that publishes them, and a wire. ``log``: takes a line for each alarm.

    ``hello``: the device's. ``node``: full name of the ROS node, for what is kept and handed on. Raises ConfigError
    if ``watch_command`` or ``watch_webhook`` cannot be used.
    """

    def __init__(
        self, pipeline: Pipeline, log: LogCallback, hello: Mapping[str, object] | None, node: str = ''
    ) -> None:
        config = pipeline.rig.acquisition
        self.watch = Watch(pipeline.rig, pipeline.tip_loads.compliance)
        self.folder: Path | None = None
        self.failure = ''
        self._pipeline, self._log, self._hello, self._node = pipeline, log, hello, node
        self._parent = Path(config.watch_dir).expanduser() if config.watch_dir else None
        self._config = config
        serial = str((hello or {}).get('serial', ''))
        self._out = AlarmOut(config.watch_command, config.watch_webhook, log, {'device': serial, 'node': node})
        self._window_ns = round(60e9 * config.watch_minutes) + 2 * SEGMENT_NS
        self._memory = ByteBudget(config.watch_memory)
        self._forgotten = 0
        # Held to change the segments; never while waiting for the disk.
        self._lock = threading.Lock()
        self._segments: deque[_Segment] = deque()  # Bound: watch_memory and watch_minutes.
        self._last_ns = 0
        self._due_ns: int | None = None
        self._logged = 0
        self._writing: threading.Thread | None = None

    @property
    def keeps(self) -> bool:
        """Whether the minutes around an alarm are kept."""
        return self._parent is not None

    def put(self, record: Record) -> None:
        """One record, in the thread of the pipeline."""
        if isinstance(record, ParameterChange):
            self.watch.changed(record, self._pipeline.rig)
            self.put_change(record)
            return
        self.watch.put(record)
        if not isinstance(record, SampleBlock):
            return
        t_ns = int(record.t_ns[-1])
        if self.watch.alarms > self._logged and self.watch.alarm is not None:
            self._logged = self.watch.alarms
            self._log(f'watch: since {_clock(self.watch.alarm.since_ns)}: {self.watch.alarm.words}', WARNING)
            self._out.put(self.watch.alarm)
            if self._parent is not None and self._due_ns is None:
                self._due_ns = t_ns + AFTER_NS
        if self._due_ns is not None and t_ns >= self._due_ns:
            self._keep()
        # A block's last record: the next one begins with what the pipeline remembers now.
        if self.keeps:
            self._last_ns = t_ns
            if not self._segments or t_ns - self._segments[-1].began_ns >= SEGMENT_NS:
                rig = self._pipeline.rig
                segment = _Segment(rig, t_ns, self._pipeline.snapshot(rig), self.watch.load)
                with self._lock:
                    self._segments.append(segment)
                    self._forget_older(t_ns)

    def put_message(self, topic: str, type_name: str, message: bytes, t_ns: int) -> None:
        """An encoded message; of samples and inputs from any thread."""
        if topic == SAMPLES or topic in INPUTS:
            self._hold((topic, type_name, message, t_ns), len(message), t_ns)

    def put_change(self, change: ParameterChange) -> None:
        """A change of parameters."""
        self._hold(change, MESSAGE_BYTES * len(change.values), change.t_ns)

    def _hold(self, item: Kept, size: int, t_ns: int) -> None:
        size += MESSAGE_BYTES
        full = False
        with self._lock:
            if t_ns - self._last_ns > self._window_ns:
                # No block for so long: of all that is held nothing would be kept.
                self._drop(len(self._segments))
            while self._segments and not self._memory.take(size):
                full = True
                self._drop(1)
            # If all is dropped, the next block begins anew, with the pipeline's memory.
            if self._segments:
                self._segments[-1].items.append(item)
                self._segments[-1].bytes += size
        if full:
            self._forgotten += 1
            if self._forgotten == 1:
                self._log(
                    f'watch: {self._memory.most / 1e6:g} MB are full (watch_memory): '
                    'what is kept begins later than watch_minutes says',
                    WARNING,
                )

    def _forget_older(self, t_ns: int) -> None:
        while len(self._segments) > 1 and t_ns - self._segments[1].began_ns > self._window_ns:
            self._drop(1)

    def _drop(self, count: int) -> None:
        for _ in range(count):
            segment = self._segments.popleft()
            self._memory.give_back(segment.bytes, len(segment.items))

    @property
    def held_bytes(self) -> int:
        """What is held in memory, with what Python needs for it."""
        return self._memory.held

    def close(self, patience_s: float) -> str:
        """Write what is to be kept and hand on what waits, each within ``patience_s``; what is not done, or ''."""
        if self._due_ns is not None:
            self._keep()
        unfinished = [] if self._out.close(patience_s) else ['an alarm may not be handed on']
        if self._writing is not None:
            self._writing.join(patience_s)
            unfinished += ['what was to be kept may lack its end'] * self._writing.is_alive()
        return f'not ended within {patience_s:g} s: {", ".join(unfinished)}' if unfinished else ''

    def entry(self) -> DiagnosticEntry:
        """The state, for ``/diagnostics``."""
        watch, alarm = self.watch, self.watch.alarm
        values = [
            ('watched', watch.state),
            ('windows', str(watch.windows)),
            ('spoilt by motion', str(watch.spoilt)),
            ('alarms', str(watch.alarms)),
            ('kept', str(self.folder or '')),
            ('held in memory (MB)', f'{self.held_bytes / 1e6:.1f}'),
            ('dropped from memory, because it was full', str(self._forgotten)),
            *self._out.values(),
        ]
        if alarm is not None:
            values += _reported(alarm)
            return DiagnosticEntry(NAME, WARN, f'since {_clock(alarm.since_ns)}: {alarm.words}', tuple(values))
        if self.failure:
            return DiagnosticEntry(NAME, WARN, self.failure, tuple(values))
        return DiagnosticEntry(NAME, OK, f'the rig matches its model; watched: {watch.state}', tuple(values))

    def _keep(self) -> None:
        self._due_ns = None
        with self._lock:
            segments = list(self._segments)
            self._segments.clear()
        if self._writing is not None and self._writing.is_alive():
            self._memory.give_back(sum(s.bytes for s in segments), sum(len(s.items) for s in segments))
            self._log('watch: the disk still writes what was kept before; this is not kept', WARNING)
            return
        self._writing = threading.Thread(target=self._write, args=(segments,), name='watch', daemon=True)
        self._writing.start()

    def _write(self, segments: list[_Segment]) -> None:
        try:
            self.folder = self._written(segments)
            self._empty_folder()
        except RecordingError as error:
            self.failure = f'not kept: {error}'
            self._log(f'watch: {self.failure}', ERROR)
            return
        finally:
            self._memory.give_back(sum(s.bytes for s in segments), sum(len(s.items) for s in segments))
        self._log(f'watch: kept as {self.folder}; see `psd-deflection discover {self.folder}`')

    def _written(self, segments: list[_Segment]) -> Path:
        if self._parent is None or not segments:
            raise RecordingError('no block has come since the last alarm was kept')
        folder = new_folder(self._parent, STEM)
        if missing := why_full(folder, self._config.disk_reserve):
            raise RecordingError(f'{folder}: {missing}; make room, or name another folder (parameter watch_dir)')
        first = segments[0]
        bag = BagWriter(folder, rig_values=first.rig.flat(), device_hello=self._hello, node=self._node)
        try:
            if first.memory is not None:
                bag.put(first.memory)
            if first.load is not None:
                bag.put(first.load._replace(t_ns=first.began_ns))
            for item in (i for s in segments for i in s.items):
                if isinstance(item, ParameterChange):
                    bag.put(item)
                else:
                    bag.write_encoded(*item)
        finally:
            bag.close()
        return folder

    def _empty_folder(self) -> None:
        """Delete the oldest of what was kept, until the folder is within its bounds; the newest always stays."""
        if self._parent is None:
            return
        most, most_bytes = self._config.watch_dir_max_recordings, self._config.watch_dir_max_bytes
        sizes = [(path, size) for path in sorted(self._parent.glob(f'{STEM}_*'), key=_made) if (size := _size_of(path))]
        total = sum(size for _, size in sizes)
        for number, (path, size) in enumerate(sizes[:-1]):
            if len(sizes) - number <= most and total <= most_bytes:
                break
            total -= size
            try:
                names = [file.name for file in path.iterdir()]
                with HeldFolder(path, follow=False) as held:
                    for name in names:
                        held.remove(name)
                path.rmdir()
            except OSError as error:
                self._log(f'watch: {path}: cannot be deleted ({error.strerror or error})', WARNING)
                continue
            bounds = f'at most {most} recordings and {most_bytes / 1e6:g} MB stay in watch_dir'
            self._log(f'watch: {path}: deleted, the oldest of what was kept ({bounds})')


def _made(path: Path) -> tuple[int, str]:
    """By time; of one second ``_2`` after ``_10`` would be wrong."""
    with contextlib.suppress(OSError):
        return path.lstat().st_mtime_ns, path.name
    return 0, path.name


def _size_of(path: Path) -> int:
    """Bytes of a recording of the watch; 0 if it is none, or if somebody put something else into it."""
    size = 0
    with contextlib.suppress(OSError):
        if path.is_symlink() or not path.is_dir():
            return 0
        for file in path.iterdir():
            if file.is_symlink() or not (file.suffix == '.mcap' or file.name == 'metadata.yaml'):
                return 0
            size += file.stat().st_size
    return size


class WatcherSink:
    """The watcher as one of the wires of the fan-out."""

    def __init__(self, watcher: Watcher) -> None:
        self._watcher = watcher

    def put(self, topic: str, type_name: str, cdr: bytes, t_ns: int) -> None:
        """Keep one message."""
        self._watcher.put_message(topic, type_name, cdr, t_ns)


def _clock(t_ns: int) -> str:
    return time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(t_ns / 1e9))


def _reported(alarm: Alarm) -> list[tuple[str, str]]:
    unit = '(urad)' if alarm.channel == 'theta' else '(um)'
    return [
        ('since', _clock(alarm.since_ns)),
        ('sure since', _clock(alarm.observed_ns)),
        ('channel', alarm.channel),
        (f'shift {unit}', f'{1e6 * alarm.shift:.3f}'),
        (f'its standard deviation {unit}', f'{1e6 * alarm.sd:.3f}'),
        ('standard deviations', f'{alarm.sigmas:.1f}'),
        ('also shifted', ', '.join(alarm.also)),
    ]
