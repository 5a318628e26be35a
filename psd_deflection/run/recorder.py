# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The recorder thread writes the published messages to a bag without delaying the pipeline. Messages pass through a
bounded queue; those that do not fit are counted. A disk error or too little room ends the recording, never the run."""

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
from psd_deflection.base.log import ERROR, INFO, WARNING, LogCallback
from psd_deflection.recordings.write.bag_writer import BagWriter
from psd_deflection.records import ParameterChange
from psd_deflection.rig.config import Rig
from psd_deflection.rig.running import AcquisitionConfig
from psd_deflection.run.realtime import SLOW, lag_reason

QUEUED_PER_BLOCK = 100
"""The queue holds this many messages for each block of ``queue_blocks``. A block makes about ten, so the disk may pause
ten times as long as the pipeline: 50 s by default, in 25 MB."""
MOST_THREADS = 8
"""Recorder threads that are alive at once, as a detached recording is still written; beyond it a start is rejected."""
QUEUE_BYTES = 100_000_000
"""The recorder's queue holds no more bytes than this."""
JOIN_S = 1.0
"""At the end of the run, a recording whose queue has not shrunk for this long is given up."""
PATIENCE_S = 3.0
"""At the end of the run, the longest wait for all recordings together."""

IDLE_S = 0.5
GATHER_S = 0.005
"""When the queue runs empty, the recorder pauses this long to gather messages: waking up for each costs more than
writing it. It is short enough to write before the next block (20 ms), so that no estimate is delayed."""
CHECK_EVERY = 250
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
        self.queue: queue.SimpleQueue[Item] = queue.SimpleQueue()  # Bound: QUEUE_BYTES.
        self.opened: Future[Path | None] = Future()
        self.closed: Future[Path | None] = Future()
        # What waits is bounded in bytes too: messages of other nodes (loads, references, marks) may be long.
        self.budget = ByteBudget(QUEUE_BYTES)
        # Samples that the run had dropped when this recording began and when it ended, and messages that did not fit
        # into the queue.
        self.dropped_before = self.dropped_until = self.dropped_messages = 0
        for answer in (self.opened, self.closed):
            answer.set_running_or_notify_cancel()


class Recorder:
    """Makes one recording at a time; a sink of the fan-out. ``log`` gets a line if a recording ends by itself.

    ``dropped_samples``: returns the number of samples that the run had dropped before the chunk processed last; a
    recording notes by how much it rose. ``between_blocks`` runs an action in the pipeline thread
    (``Processing.request``). ``node``: full name of the recorded ROS node. ``dropped``: messages not recorded, over all
    recordings of the run. ``failure``: why the last recording ended by itself, empty while all is well.
    ``ended_early``: why each recording that ended by itself did so, by its folder.
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
        self._limit = queue_blocks * QUEUED_PER_BLOCK
        # Held to swap references and to count, never while waiting for the disk.
        self._lock = threading.Lock()
        # Two recordings opened in one second must not choose the same name.
        self._naming = threading.Lock()
        self._opening: RecordingJob | None = None
        self._job: RecordingJob | None = None
        self._writing: dict[RecordingJob, threading.Thread] = {}  # Bound: MOST_THREADS.
        self._threads: list[threading.Thread] = []
        self._ended = False

    @property
    def folder(self) -> Path | None:
        """Folder of the recording, or None while there is none."""
        job = self._job
        return job.folder if job is not None else None

    @property
    def opening(self) -> bool:
        """Whether a recording waits for the disk to begin."""
        return self._opening is not None

    @property
    def waiting(self) -> int:
        """Messages that wait for the disk."""
        job = self._job
        return job.queue.qsize() if job is not None else 0

    def start(
        self,
        rig: Rig,
        hello: Mapping[str, object] | None,
        memory: Callable[[Rig], ParameterChange | None],
    ) -> Future[Path | None]:
        """Start a recording in ``bag_dir``; the future gives its folder once it runs.

        If a recording already runs or starts, its future is returned. ``memory``: called with ``rig`` when the
        recording is attached; returns the state of the pipeline, which is written first, or None. The future raises
        RecordingError if the folder cannot be made, the disk has no room, or the recording was ended before the disk
        answered; TimeoutError if no data flows.
        """
        with self._lock:
            job = self._job or self._opening
            if job is None:
                job = RecordingJob(rig.acquisition)
                if self._ended:
                    job.opened.set_exception(RecordingError('not recorded: the run has ended'))
                    return job.opened
                self._threads = [thread for thread in self._threads if thread.is_alive()]
                if len(self._threads) >= MOST_THREADS:
                    why = f'not recorded: {MOST_THREADS} recordings wait for the disk already'
                    job.opened.set_exception(RecordingError(why))
                    return job.opened
                thread = threading.Thread(
                    target=self._run, args=(job, rig, hello, memory), name='recorder', daemon=True
                )
                thread.start()
                self._threads = [*self._threads, thread]
                self._opening = job
            return job.opened

    def put(self, topic: str, type_name: str, cdr: bytes, t_ns: int) -> None:
        """Record one message; count it as dropped if the disk is too slow."""
        job = self._job
        if job is None:
            return
        if job.queue.qsize() >= self._limit or not job.budget.take(len(cdr) + MESSAGE_BYTES):
            job.dropped_messages += 1
            self.dropped += 1
            if self.dropped == 1:
                self._log(f'{job.folder}: messages are dropped: {self._lag_reason(job)}', WARNING)
        else:
            job.queue.put((topic, type_name, cdr, t_ns))

    def put_change(self, change: ParameterChange) -> None:
        """Record a change of parameters. Never dropped: without it the replay would differ."""
        job = self._job
        if job is not None:
            job.queue.put(change)

    def stop(self) -> Future[Path | None]:
        """Detach the recording; the future gives its folder once it is closed, None if there was none.

        A recording that is being opened does not begin. To be called between two blocks, so that
        the last block is whole. The future raises RecordingError if the recording could not be
        closed.
        """
        with self._lock:
            opening, self._opening = self._opening, None
            job, self._job = self._job, None
        if opening is not None:
            opening.opened.set_exception(
                RecordingError('the recording was ended before the disk answered; nothing was recorded')
            )
        if job is not None:
            job.dropped_until = self._dropped_samples()
            job.queue.put(None)
            return job.closed
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
        for job, thread in tuple(self._writing.items()):
            left = job.queue.qsize() + 1
            while thread.is_alive() and time.monotonic() < until:
                before = left
                thread.join(JOIN_S)
                left = job.queue.qsize()
                if left >= before:
                    break
            if thread.is_alive():
                why = (
                    f'{job.folder}: {self._lag_reason(job)}; it is not waited for, and {job.budget.holders} messages '
                    f'are not written. If the file is cut off, `psd-deflection recover {job.folder}` repairs it'
                )
                if job.folder is not None:
                    self._end_early(job.folder, why)
                self._log(why, WARNING)
        return None if ended.done() and ended.exception() is not None else folder

    def _end_early(self, folder: Path, why: str) -> None:
        self.failure = self.ended_early[folder] = why

    def _lag_reason(self, job: RecordingJob) -> str:
        thread = self._writing.get(job)
        return lag_reason(thread, time.monotonic() - job.beat) if thread is not None else SLOW

    def _run(
        self,
        job: RecordingJob,
        rig: Rig,
        hello: Mapping[str, object] | None,
        memory: Callable[[Rig], ParameterChange | None],
    ) -> None:
        try:
            bag = self._open(rig, hello)
        except Exception as error:
            self._reject(job, error)
            return
        job.folder = bag.folder
        thread = threading.current_thread()

        def attach() -> None:
            with self._lock:
                if self._opening is not job:
                    return
                first = memory(rig)
                if first is not None:
                    job.queue.put(first)
                self._writing[job] = thread
                job.dropped_before = job.dropped_until = self._dropped_samples()
                self._opening, self._job, job.attached, self.failure = None, job, True, ''

        try:
            self._between_blocks(attach)
        except Exception as error:
            self._reject(job, error)
        if not job.attached:
            with contextlib.suppress(OSError, RecordingError):
                bag.discard()
            return
        job.opened.set_result(bag.folder)
        why = self._record(job, bag)
        del self._writing[job]
        if not why:
            job.closed.set_result(bag.folder)
            return
        self._end_early(bag.folder, why)
        self._log(f'recording stopped: {why}', ERROR)
        job.closed.set_exception(RecordingError(f'recording stopped: {why}'))

    def _open(self, rig: Rig, hello: Mapping[str, object] | None) -> BagWriter:
        config = rig.acquisition
        with self._naming:
            folder = new_folder(Path(config.bag_dir).expanduser())
            missing = why_full(_nearest(folder), config.disk_reserve)
            if missing:
                raise RecordingError(f'{folder}: {missing}; make room, or {ELSEWHERE}')
            try:
                return BagWriter(
                    folder,
                    rig_values=rig.flat(),
                    device_hello=hello,
                    max_bytes=config.bag_max_bytes,
                    max_s=config.bag_max_duration or config.bag_keep / 7.0,
                    durable=True,
                    node=self._node,
                )
            except RecordingError as error:
                raise RecordingError(f'{error}; {ELSEWHERE}') from None

    def _reject(self, job: RecordingJob, error: Exception) -> None:
        """Resolve ``job.opened`` with an error, unless it is resolved already."""
        with self._lock:
            if self._opening is not job:
                return
            self._opening = None
        job.opened.set_exception(error)

    def _record(self, job: RecordingJob, bag: BagWriter) -> str:
        """Write until the end, and close; return '' or why the recording ended early."""
        try:
            try:
                try:
                    self._write(bag, job)
                finally:
                    # Before the slow close: a new start must not get this recording's future.
                    with self._lock:
                        if self._job is job:
                            self._job = None
            except _FullError as error:
                # The reserve leaves room for index and summary.
                bag.close()
                return f'{bag.folder}: {error}; it is complete up to here'
            _require_in_place(bag)
            samples = job.dropped_until - job.dropped_before
            if samples or job.dropped_messages:
                bag.note_dropped(samples, job.dropped_messages)
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

    def _write(self, bag: BagWriter, job: RecordingJob) -> None:
        items, config = job.queue, job.config
        since_check = 0
        unflushed = draining = False
        while True:
            job.beat = time.monotonic()
            try:
                item = items.get_nowait() if draining else items.get(timeout=IDLE_S)
            except queue.Empty:
                if draining:
                    time.sleep(GATHER_S)
                elif unflushed:
                    bag.flush()
                    unflushed = False
                draining = False
                continue
            draining = True
            if item is None:
                return
            if isinstance(item, ParameterChange):
                bag.put(item)
            else:
                bag.write_encoded(*item)
                job.budget.give_back(len(item[2]) + MESSAGE_BYTES)
                with self._lock:
                    self.written += 1
            unflushed = True
            since_check += 1
            if since_check >= CHECK_EVERY:
                since_check = 0
                _require_in_place(bag)
                self._make_room(bag, config)

    def _make_room(self, bag: BagWriter, config: AcquisitionConfig) -> None:
        while 0.0 < config.bag_keep < bag.oldest_age_s:
            self._drop_oldest(bag, f'it ended more than bag_keep = {config.bag_keep:g} s ago')
        while missing := why_full(bag.folder, config.disk_reserve):
            if config.disk_full != 'delete_oldest':
                raise _FullError(missing)
            if not self._drop_oldest(bag, f'{missing} (disk_full is delete_oldest)', WARNING):
                raise _FullError(f'{missing} and there is no older file of this recording to delete')

    def _drop_oldest(self, bag: BagWriter, why: str, level: int = INFO) -> bool:
        deleted = bag.drop_oldest()
        if deleted is not None:
            self.files_deleted += 1
            self._log(f'{deleted}: deleted, {why}', level)
        return deleted is not None


def _require_in_place(bag: BagWriter) -> None:
    if not bag.in_place:
        raise _GoneError(f'{bag.path}: was deleted or moved while it was recorded; start another recording')


def _nearest(folder: Path) -> Path:
    """The folder itself, or its nearest parent that exists."""
    return next((p for p in (folder, *folder.absolute().parents) if p.exists()), Path('/'))


def why_full(folder: Path, reserve: int) -> str:
    """Why the disk of ``folder`` is too full (less than ``reserve`` bytes left); '' if it is not."""
    try:
        free = shutil.disk_usage(folder).free
    except OSError:
        # The free space is not known: messages are written until a write fails.
        return ''
    if free >= reserve:
        return ''
    return f'the disk has {free / 1e6:.0f} MB left, less than disk_reserve = {reserve / 1e6:.0f} MB'
