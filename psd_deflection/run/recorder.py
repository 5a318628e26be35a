# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The recorder thread writes the published messages to a bag without delaying the pipeline: a bounded queue, whose
overflow is counted; a disk error or too little room ends the recording, never the run. It attaches between two
blocks."""

from __future__ import annotations

import contextlib
import queue
import shutil
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from pathlib import Path

from psd_deflection.base.bounds import MESSAGE_BYTES, BoundedMap, ByteBudget
from psd_deflection.base.errors import RecordingError
from psd_deflection.base.log import ERROR, WARNING, LogCallback
from psd_deflection.recordings.write.bag_writer import BagWriter
from psd_deflection.records import ParameterChange
from psd_deflection.rig.config import Rig
from psd_deflection.rig.running import AcquisitionConfig
from psd_deflection.run.realtime import SLOW, lag_reason

MESSAGES_PER_BLOCK = 100
"""The recorder's queue holds this many messages for each block of ``queue_blocks``. A block makes
about ten messages, so the disk may pause ten times as long as the pipeline: 50 s by default, in 25
MB."""
MOST_THREADS = 8
"""Recordings that may hang at a time: each has its thread."""
QUEUE_BYTES = 100_000_000
"""The recorder's queue holds no more bytes than this."""
JOIN_S = 1.0
"""How long the program waits at its end for a recording that takes nothing more."""
PATIENCE_S = 3.0
"""How long it waits for recordings that are still being written."""

IDLE_S = 0.5
GATHER_S = 0.005
"""Pause of the recorder when it has written what there was: waking up for each message costs more than writing it. So
short that it writes between two blocks of 20 ms, and takes no time from an estimate.
"""
LOOK_EVERY = 250
"""Messages between two checks of the file and of the room on its disk: half a second's worth."""

ELSEWHERE = 'record elsewhere (parameter bag_dir)'

QueuedMessage = tuple[str, str, bytes, int]
Item = QueuedMessage | ParameterChange | None


def new_folder(parent: Path, stem: str = 'psd') -> Path:
    """A folder that does not exist yet: ``stem``, ``_`` and the time, then ``_2``, ``_3`` ..."""
    stem += time.strftime('_%Y%m%d_%H%M%S')
    folder = parent / stem
    count = 1
    while folder.exists():
        count += 1
        folder = parent / f'{stem}_{count}'
    return folder


class _FullError(Exception):
    """The disk has less room than the reserve."""


class _GoneError(Exception):
    """Somebody deleted or moved the file: further messages would be lost."""


class RecordingJob:
    """One recording.

    ``opened``: resolves to its folder once it is attached, or to the error that prevented it.
    ``closed``: resolves to its folder once the bag is closed, or to the error that prevented it.
    Neither can be cancelled.
    """

    def __init__(self, config: AcquisitionConfig) -> None:
        self.config = config
        self.folder: Path | None = None
        self.attached = False
        self.beat = time.monotonic()
        self.queue: queue.SimpleQueue[Item] = queue.SimpleQueue()
        self.opened: Future[Path | None] = Future()
        self.closed: Future[Path | None] = Future()
        # What waits is bounded in bytes too: others may send long messages.
        self.budget = ByteBudget(QUEUE_BYTES)
        # Samples that the run had dropped when it began and when it ended, messages that it could
        # not take.
        self.dropped_before = self.dropped_until = self.dropped_messages = 0
        for answer in (self.opened, self.closed):
            answer.set_running_or_notify_cancel()


class Recorder:
    """Makes one recording at a time; a wire like any other. ``log`` gets a line if a recording ends by itself.

    ``dropped_samples``: how many the run has dropped so far, before those that it processed last; a
    recording says how many it lacks because of that. ``between_blocks`` runs an action in the
    thread that calls the wires (``Processing.request``). ``node``: full name of the recorded ROS
    node. ``failure``: why the last recording ended by itself, empty while all is well.
    ``ended_early``: the same of each such recording, by its folder.
    """

    def __init__(
        self,
        queue_blocks: int,
        log: LogCallback,
        between_blocks: Callable[[Callable[[], None]], None],
        dropped_samples: Callable[[], int] = lambda: 0,
        node: str = '',
    ) -> None:
        self._node = node
        self._dropped_samples = dropped_samples
        self.dropped = 0
        self.written = 0
        self.files_deleted = 0
        self.failure = ''
        self.ended_early: BoundedMap[Path, str] = BoundedMap()
        self._log = log
        self._between_blocks = between_blocks
        self._limit = queue_blocks * MESSAGES_PER_BLOCK
        # Held to swap references and to count, never while waiting for the disk.
        self._lock = threading.Lock()
        # Two recordings opened in one second must not choose the same name.
        self._naming = threading.Lock()
        self._opening: RecordingJob | None = None
        self._take: RecordingJob | None = None
        self._writing: dict[RecordingJob, threading.Thread] = {}
        self._threads: list[threading.Thread] = []
        self._ended = False

    @property
    def folder(self) -> Path | None:
        """Folder of the recording, or None while there is none."""
        take = self._take
        return take.folder if take is not None else None

    @property
    def opening(self) -> bool:
        """Whether a recording waits for the disk to begin."""
        return self._opening is not None

    @property
    def waiting(self) -> int:
        """Messages that wait for the disk."""
        take = self._take
        return take.queue.qsize() if take is not None else 0

    def start(
        self,
        rig: Rig,
        hello: Mapping[str, object] | None,
        memory: Callable[[Rig], ParameterChange | None],
    ) -> Future[Path | None]:
        """Start a recording in ``bag_dir``; the future gives its folder once it runs.

        If a recording already runs or starts, its future is returned. ``memory``: called with
        ``rig`` when the recording is attached; its records come first. The future raises
        RecordingError if the folder cannot be made, the disk has no room, or the recording was
        ended before the disk answered; TimeoutError if no data flows.
        """
        with self._lock:
            take = self._take or self._opening
            if take is None:
                take = RecordingJob(rig.acquisition)
                if self._ended:
                    take.opened.set_exception(RecordingError('not recorded: the run has ended'))
                    return take.opened
                self._threads = [thread for thread in self._threads if thread.is_alive()]
                if len(self._threads) >= MOST_THREADS:
                    why = f'not recorded: {MOST_THREADS} recordings wait for the disk already'
                    take.opened.set_exception(RecordingError(why))
                    return take.opened
                thread = threading.Thread(
                    target=self._run, args=(take, rig, hello, memory), name='recorder', daemon=True
                )
                thread.start()
                self._threads = [*self._threads, thread]
                self._opening = take
            return take.opened

    def put(self, topic: str, type_name: str, cdr: bytes, t_ns: int) -> None:
        """Record one message; count it as dropped if the disk is too slow."""
        take = self._take
        if take is None:
            return
        if take.queue.qsize() >= self._limit or not take.budget.take(len(cdr) + MESSAGE_BYTES):
            take.dropped_messages += 1
            self.dropped += 1
            if self.dropped == 1:
                self._log(f'{take.folder}: messages are dropped: {self._lag_reason(take)}', WARNING)
        else:
            take.queue.put((topic, type_name, cdr, t_ns))

    def put_change(self, change: ParameterChange) -> None:
        """Record a change of parameters. Never dropped: without it the replay would differ."""
        take = self._take
        if take is not None:
            take.queue.put(change)

    def stop(self) -> Future[Path | None]:
        """Detach the recording; the future gives its folder once it is closed, None if there was none.

        A recording that is being opened does not begin. To be called between two blocks, so that
        the last block is whole. The future raises RecordingError if the recording could not be
        closed.
        """
        with self._lock:
            opening, self._opening = self._opening, None
            take, self._take = self._take, None
        if opening is not None:
            opening.opened.set_exception(
                RecordingError('the recording was ended before the disk answered; nothing was recorded')
            )
        if take is not None:
            take.dropped_until = self._dropped_samples()
            take.queue.put(None)
            return take.closed
        none: Future[Path | None] = Future()
        none.set_result(None)
        return none

    def close(self) -> Path | None:
        """End for good; wait ``JOIN_S`` for a disk that takes nothing, ``PATIENCE_S`` for one that is slow.

        Return the folder of the recording that ran, None if there was none or if its end went
        wrong.
        """
        folder = self.folder
        with self._lock:
            self._ended = True
        ended = self.stop()
        until = time.monotonic() + PATIENCE_S
        for take, thread in tuple(self._writing.items()):
            waits = take.queue.qsize() + 1
            while thread.is_alive() and time.monotonic() < until:
                before = waits
                thread.join(JOIN_S)
                waits = take.queue.qsize()
                if waits >= before:
                    break
            if thread.is_alive():
                waiting = f'it is not waited for, and {take.budget.holders} messages are not written'
                why = (
                    f'{take.folder}: {self._lag_reason(take)}; {waiting}. '
                    f'If the end is missing, `psd-deflection recover {take.folder}` makes it whole'
                )
                if take.folder is not None:
                    self._end_early(take.folder, why)
                self._log(why, WARNING)
        return None if ended.done() and ended.exception() is not None else folder

    def _end_early(self, folder: Path, why: str) -> None:
        self.failure = self.ended_early[folder] = why

    def _lag_reason(self, take: RecordingJob) -> str:
        thread = self._writing.get(take)
        return lag_reason(thread, time.monotonic() - take.beat) if thread is not None else SLOW

    def _run(
        self,
        take: RecordingJob,
        rig: Rig,
        hello: Mapping[str, object] | None,
        memory: Callable[[Rig], ParameterChange | None],
    ) -> None:
        try:
            bag = self._open(rig, hello)
        except Exception as error:
            self._reject(take, error)
            return
        take.folder = bag.folder
        thread = threading.current_thread()

        def attach() -> None:
            with self._lock:
                if self._opening is not take:
                    return
                first = memory(rig)
                if first is not None:
                    take.queue.put(first)
                self._writing[take] = thread
                take.dropped_before = take.dropped_until = self._dropped_samples()
                self._opening, self._take, take.attached, self.failure = None, take, True, ''

        try:
            self._between_blocks(attach)
        except Exception as error:
            self._reject(take, error)
        if not take.attached:
            with contextlib.suppress(OSError, RecordingError):
                bag.discard()
            return
        take.opened.set_result(bag.folder)
        why = self._record(take, bag)
        del self._writing[take]
        if not why:
            take.closed.set_result(bag.folder)
            return
        self._end_early(bag.folder, why)
        self._log(f'recording stopped: {why}', ERROR)
        take.closed.set_exception(RecordingError(f'recording stopped: {why}'))

    def _open(self, rig: Rig, hello: Mapping[str, object] | None) -> BagWriter:
        config = rig.acquisition
        with self._naming:
            folder = new_folder(Path(config.bag_dir).expanduser())
            missing = missing_room(_nearest(folder), config.disk_reserve)
            if missing:
                raise RecordingError(f'{folder}: {missing}; make room, or {ELSEWHERE}')
            try:
                return BagWriter(
                    folder,
                    rig_values=rig.flat(),
                    device_hello=hello,
                    max_bytes=config.bag_max_bytes,
                    max_s=config.bag_max_duration,
                    durable=True,
                    node=self._node,
                )
            except RecordingError as error:
                raise RecordingError(f'{error}; {ELSEWHERE}') from None

    def _reject(self, take: RecordingJob, error: Exception) -> None:
        """Resolve ``take.opened`` with an error, unless it is resolved already."""
        with self._lock:
            if self._opening is not take:
                return
            self._opening = None
        take.opened.set_exception(error)

    def _record(self, take: RecordingJob, bag: BagWriter) -> str:
        """Write until the end, and close; return '' or why the recording ended early."""
        try:
            try:
                try:
                    self._write(bag, take)
                finally:
                    # Before waiting for the disk again: a new start must not be told that this
                    # recording runs.
                    with self._lock:
                        if self._take is take:
                            self._take = None
            except _FullError as error:
                # The reserve leaves room for index and summary.
                bag.close()
                return f'{bag.folder}: {error}; it is complete up to here'
            _look_for(bag)
            samples = take.dropped_until - take.dropped_before
            if samples or take.dropped_messages:
                bag.note_dropped(samples, take.dropped_messages)
            bag.close()
        except _GoneError as error:
            with contextlib.suppress(RecordingError):
                bag.close()
            return str(error)
        except RecordingError as error:
            with contextlib.suppress(RecordingError):
                bag.close()
            return f'{error}; `psd-deflection recover {bag.folder}` makes it whole'
        except Exception as error:
            # Any error at all: a recorder that died without a message would be worse.
            with contextlib.suppress(Exception):
                bag.close()
            return f'{bag.folder}: {type(error).__name__}: {error}'
        return ''

    def _write(self, bag: BagWriter, take: RecordingJob) -> None:
        items, config = take.queue, take.config
        since_look = 0
        unwritten = buffered = False
        while True:
            take.beat = time.monotonic()
            try:
                item = items.get_nowait() if buffered else items.get(timeout=IDLE_S)
            except queue.Empty:
                if buffered:
                    time.sleep(GATHER_S)
                elif unwritten:
                    bag.flush()
                    unwritten = False
                buffered = False
                continue
            buffered = True
            if item is None:
                return
            if isinstance(item, ParameterChange):
                bag.put(item)
            else:
                bag.write_encoded(*item)
                take.budget.give_back(len(item[2]) + MESSAGE_BYTES)
                with self._lock:
                    self.written += 1
            unwritten = True
            since_look += 1
            if since_look >= LOOK_EVERY:
                since_look = 0
                _look_for(bag)
                self._make_room(bag, config)

    def _make_room(self, bag: BagWriter, config: AcquisitionConfig) -> None:
        while missing := missing_room(bag.folder, config.disk_reserve):
            if config.disk_full != 'delete_oldest':
                raise _FullError(missing)
            deleted = bag.drop_oldest()
            if deleted is None:
                raise _FullError(f'{missing} and there is no older file of this recording to delete')
            self.files_deleted += 1
            self._log(f'{deleted}: deleted, {missing} (disk_full is delete_oldest)', WARNING)


def _look_for(bag: BagWriter) -> None:
    if not bag.in_place:
        raise _GoneError(f'{bag.path}: was deleted or moved while it was recorded; start another recording')


def _nearest(folder: Path) -> Path:
    """The folder itself, or its nearest parent that exists."""
    return next((p for p in (folder, *folder.absolute().parents) if p.exists()), Path('/'))


def missing_room(folder: Path, reserve: int) -> str:
    """Why the disk of ``folder`` is too full (less than ``reserve`` bytes left); '' if it is not."""
    try:
        free = shutil.disk_usage(folder).free
    except OSError:
        # A disk that does not tell its free space is written to until it rejects.
        return ''
    if free >= reserve:
        return ''
    return f'the disk has {free / 1e6:.0f} MB left, less than disk_reserve = {reserve / 1e6:.0f} MB'
