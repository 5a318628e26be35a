# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Writes the published messages to a bag in a separate thread, so that the disk never delays the pipeline. Messages
pass through a bounded queue; a message that does not fit is dropped and counted. A disk error or a nearly full disk
ends the recording, never the run."""

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
"""Limit of the queue in messages, per block of ``queue_blocks`` (default: 25,000 messages, 25 MB). A block (20 ms)
makes only about ten, so the queue fills in 2,500 blocks: no message is lost until the disk has hung for 50 s."""
MOST_THREADS = 8
"""Limit of recorder threads: a further start is rejected. A stopped recording has a thread until its bag is closed."""
QUEUE_BYTES = 100_000_000
"""Limit of the queue in bytes, because other nodes' messages (loads, references, marks) may be long."""
JOIN_S = 1.0
"""Length of one wait for a recorder thread at the end of the run, s (see :func:`_wait_for_writer`)."""
PATIENCE_S = 3.0
"""The end of the run waits about so long, s, for all recorder threads together."""
IDLE_S = 0.5
"""If no message comes for this time, s, the recorder thread flushes the bag: a crash then loses no message."""
GATHER_S = 0.005
"""Pause of the recorder thread when its queue runs empty, s. Messages gather meanwhile, because waking up for each
costs more than writing it. Blocks are 20 ms apart: writing ends before the next block, and delays no estimate."""
CHECK_EVERY = 250
"""Items written between two checks that the file is in place and the disk has room: about half a second of them."""

RECORD_ELSEWHERE = 'record elsewhere (parameter bag_dir)'
QueuedMessage = tuple[str, str, bytes, int]  # Topic, type name, message encoded as CDR, log time in ns.
QueueItem = QueuedMessage | ParameterChange | None  # None ends the recording.
StateGetter = Callable[[Rig], ParameterChange | None]
"""``Pipeline.snapshot``: what the pipeline carries over from earlier blocks, as a ParameterChange, or None."""


def new_folder(parent: Path, stem: str = 'psd') -> Path:
    """Return a path in ``parent`` that does not exist yet: ``STEM_DATE_TIME``, or with ``_2``, ``_3`` ... appended."""
    stem += time.strftime('_%Y%m%d_%H%M%S')
    folder, number = parent / stem, 1
    while folder.exists():
        number += 1
        folder = parent / f'{stem}_{number}'
    return folder


class _DiskFullError(Exception):
    """The disk has less free space than ``disk_reserve``."""


class _FileGoneError(Exception):
    """The file being written was deleted or moved; further messages would be lost."""


class RecordingJob:
    """One recording: its queue, its counters and two futures of its folder.

    ``opened`` is resolved when the recording is attached (see :class:`Recorder`), ``closed`` when its bag is closed. A
    future gets the error instead if that step fails. Neither can be cancelled.
    """

    def __init__(self, config: AcquisitionConfig) -> None:
        self.config = config
        self.folder: Path | None = None  # None until the bag is open.
        self.was_attached = False  # Never reset: also True of a recording that is detached.
        self.last_step_s = time.monotonic()  # Monotonic time of the recorder thread's last step, s.
        self.queue: queue.SimpleQueue[QueueItem] = queue.SimpleQueue()  # Bound: QUEUE_BYTES.
        self.opened: Future[Path | None] = Future()
        self.closed: Future[Path | None] = Future()
        self.budget = ByteBudget(QUEUE_BYTES)  # Bytes (held) and number (holders) of the messages in the queue.
        # Samples that the run had dropped when this recording began, and when it ended.
        self.samples_dropped_at_start = self.samples_dropped_at_end = 0
        self.messages_dropped = 0  # Dropped because the queue was full.
        for future in (self.opened, self.closed):
            future.set_running_or_notify_cancel()  # From now on cancel() has no effect.


class Recorder:
    """A sink of :class:`psd_deflection.run.fanout.Fanout` that makes one recording at a time, each in its own thread.

    A recording is *attached* between two blocks, once its bag is open; from then on :meth:`put` queues messages for it.
    :meth:`stop` detaches it; its thread then writes the rest of the queue and closes the bag. A recording *ends early*
    if anything but :meth:`stop` ends it, or if the rest of its queue cannot be written.

    ``queue_blocks``: the rig's parameter of this name. ``log`` gets a line for the first dropped message, each deleted
    file and each early end. ``between_blocks`` runs an action in the pipeline thread between two blocks
    (``Processing.request``). ``dropped_samples`` returns how many samples the run had dropped up to the one that was
    processed last. ``node``: full name of the recorded ROS node.

    ``dropped``, ``written``: messages dropped and messages written, in all recordings of the run. ``files_deleted``:
    files deleted to make room. ``failure``: why the last recording ended early; empty once another one is attached.
    ``ended_early``: why each recording that ended early did so, by folder.
    """

    def __init__(
        self,
        queue_blocks: int,
        log: LogCallback,
        between_blocks: Callable[[Callable[[], None]], None],
        dropped_samples: Callable[[], int] = lambda: 0,
        node: str = '',
    ) -> None:
        self.dropped = self.written = self.files_deleted = 0
        self.failure = ''
        self.ended_early: BoundedMap[Path, str] = BoundedMap()
        self._log, self._node = log, node
        self._between_blocks, self._dropped_samples = between_blocks, dropped_samples
        self._most_queued = queue_blocks * QUEUED_PER_BLOCK
        self._lock = threading.Lock()  # Held to change attributes, never while waiting for the disk.
        self._folder_lock = threading.Lock()  # Held until a folder is made, so that no other thread takes its name.
        self._opening: RecordingJob | None = None
        self._attached: RecordingJob | None = None
        # Threads that write: from the attachment of the job until its bag is closed.
        self._writers: dict[RecordingJob, threading.Thread] = {}  # Bound: MOST_THREADS.
        self._threads: list[threading.Thread] = []  # All recorder threads. Bound: MOST_THREADS.
        self._run_ended = False

    @property
    def folder(self) -> Path | None:
        """Folder of the attached recording, or None."""
        job = self._attached
        return job.folder if job is not None else None

    @property
    def opening(self) -> bool:
        """Whether a recording was started and is not attached yet."""
        return self._opening is not None

    @property
    def waiting(self) -> int:
        """Number of items in the queue of the attached recording, or 0."""
        job = self._attached
        return job.queue.qsize() if job is not None else 0

    def start(self, rig: Rig, hello: Mapping[str, object] | None, get_state: StateGetter) -> Future[Path | None]:
        """Start a recording in ``bag_dir``; return a future of its folder, resolved when the recording is attached.

        If a recording is attached or opening already, return the future of that recording. ``hello``: the device's
        description of itself, or None. ``get_state``: called at the attachment; the bag begins with its result.

        The future raises RecordingError if the bag cannot be made, the disk is nearly full, ``MOST_THREADS`` threads
        are alive, the run has ended, or :meth:`stop` is called before the bag is open; TimeoutError if no data flows.
        """
        with self._lock:
            current = self._attached or self._opening
            if current is not None:
                return current.opened
            job = RecordingJob(rig.acquisition)
            self._threads = [thread for thread in self._threads if thread.is_alive()]
            why = ''
            if self._run_ended:
                why = 'the run has ended'
            elif len(self._threads) >= MOST_THREADS:
                why = f'{MOST_THREADS} recordings wait for the disk already'
            if why:
                job.opened.set_exception(RecordingError(f'not recorded: {why}'))
                return job.opened
            thread = threading.Thread(target=self._run, args=(job, rig, hello, get_state), name='recorder', daemon=True)
            thread.start()
            self._threads.append(thread)
            self._opening = job
            return job.opened

    def put(self, topic: str, type_name: str, cdr: bytes, t_ns: int) -> None:
        """Queue one message for the attached recording; drop and count the message if the queue is full."""
        job = self._attached
        if job is None:
            return
        if job.queue.qsize() < self._most_queued and job.budget.take(len(cdr) + MESSAGE_BYTES):
            job.queue.put((topic, type_name, cdr, t_ns))
            return
        job.messages_dropped += 1
        self.dropped += 1
        if self.dropped == 1:
            self._log(f'{job.folder}: messages are dropped: {self._lag_reason(job)}', WARNING)

    def put_change(self, change: ParameterChange) -> None:
        """Queue a change of parameters even if the queue is full: without the change a replay would differ."""
        job = self._attached
        if job is not None:
            job.queue.put(change)

    def stop(self) -> Future[Path | None]:
        """Detach the recording; return a future of its folder, resolved when the bag is closed.

        The future gives None if no recording is attached; it raises RecordingError if the bag cannot be written or
        closed. A recording that is still opening is abandoned. Call between two blocks, so that no block is cut.
        """
        with self._lock:
            opening, self._opening = self._opening, None
            job, self._attached = self._attached, None
        if opening is not None:
            why = 'the recording was ended before the disk answered; nothing was recorded'
            opening.opened.set_exception(RecordingError(why))
        if job is not None:
            job.samples_dropped_at_end = self._dropped_samples()
            job.queue.put(None)
            return job.closed
        no_recording: Future[Path | None] = Future()
        no_recording.set_result(None)
        return no_recording

    def close(self) -> Path | None:
        """Reject further starts, stop the recording, and wait a limited time for the threads that still write.

        Return the folder of the attached recording; None if there is none, or if its bag cannot be written or closed.
        """
        folder = self.folder
        with self._lock:
            self._run_ended = True
        closed = self.stop()
        deadline_s = time.monotonic() + PATIENCE_S
        for job, thread in tuple(self._writers.items()):
            _wait_for_writer(job, thread, deadline_s)
            if thread.is_alive():
                unwritten = f'the run ends before its bag is closed: {job.budget.holders} messages are not written'
                repair = f'If the file is cut off, `psd-deflection recover {job.folder}` repairs it'
                why = f'{job.folder}: {self._lag_reason(job)}; {unwritten}. {repair}'
                if job.folder is not None:
                    self.failure = self.ended_early[job.folder] = why
                self._log(why, WARNING)
        return None if closed.done() and closed.exception() is not None else folder

    def _lag_reason(self, job: RecordingJob) -> str:
        """Return why the thread of ``job`` does not keep up."""
        thread = self._writers.get(job)
        return lag_reason(thread, time.monotonic() - job.last_step_s) if thread is not None else SLOW

    def _run(self, job: RecordingJob, rig: Rig, hello: Mapping[str, object] | None, get_state: StateGetter) -> None:
        """Body of the recorder thread: open the bag, attach ``job`` between two blocks, and record."""
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
                    return  # Stopped or rejected.
                state = get_state(rig)
                if state is not None:
                    job.queue.put(state)
                self._writers[job] = thread
                job.samples_dropped_at_start = job.samples_dropped_at_end = self._dropped_samples()
                self._opening, self._attached = None, job
                job.was_attached, self.failure = True, ''

        try:
            self._between_blocks(attach)
        except Exception as error:
            self._reject(job, error)
        if not job.was_attached:  # A request that timed out may still have attached the job.
            with contextlib.suppress(OSError, RecordingError):
                bag.discard()
            return
        job.opened.set_result(bag.folder)
        why = self._record(job, bag)
        del self._writers[job]
        if not why:
            job.closed.set_result(bag.folder)
            return
        self.failure = self.ended_early[bag.folder] = why
        self._log(f'recording stopped: {why}', ERROR)
        job.closed.set_exception(RecordingError(f'recording stopped: {why}'))

    def _open(self, rig: Rig, hello: Mapping[str, object] | None) -> BagWriter:
        """Return a new bag in ``bag_dir``. Raises RecordingError if the disk is nearly full or rejects the bag."""
        config = rig.acquisition
        # bag_keep deletes only complete files. If bag_max_duration is 0, a file ends after a seventh of bag_keep.
        file_s = config.bag_max_duration or config.bag_keep / 7.0
        with self._folder_lock:
            folder = new_folder(Path(config.bag_dir).expanduser())
            if why := why_full(folder, config.disk_reserve):
                raise RecordingError(f'{folder}: {why}; make room, or {RECORD_ELSEWHERE}')
            try:
                return BagWriter(
                    folder,
                    rig_values=rig.flat(),
                    device_hello=hello,
                    max_bytes=config.bag_max_bytes,
                    max_s=file_s,
                    durable=True,
                    node=self._node,
                )
            except RecordingError as error:
                raise RecordingError(f'{error}; {RECORD_ELSEWHERE}') from None

    def _reject(self, job: RecordingJob, error: Exception) -> None:
        """Resolve ``job.opened`` with ``error``, unless ``job`` was attached or stopped meanwhile."""
        with self._lock:
            if self._opening is not job:
                return
            self._opening = None
        job.opened.set_exception(error)

    def _record(self, job: RecordingJob, bag: BagWriter) -> str:
        """Write the queue to the bag until the recording ends, and close the bag; return why it ended early, or ''."""
        try:
            try:
                self._write_and_detach(job, bag)
            except _DiskFullError as error:
                # disk_reserve leaves room for the bag's index and summary.
                bag.close()
                return f'{bag.folder}: {error}; the bag is closed and complete up to this time'
            _require_in_place(bag)
            samples = job.samples_dropped_at_end - job.samples_dropped_at_start
            if samples or job.messages_dropped:
                bag.note_dropped(samples, job.messages_dropped)
            bag.close()
        except _FileGoneError as error:
            with contextlib.suppress(RecordingError):
                bag.close()
            return str(error)
        except RecordingError as error:
            with contextlib.suppress(RecordingError):
                bag.close()
            return f'{error}; `psd-deflection recover {bag.folder}` makes it whole'
        except Exception as error:
            # Any other error is reported too: a thread that died would end the recording without a message.
            with contextlib.suppress(Exception):
                bag.close()
            return f'{bag.folder}: {type(error).__name__}: {error}'
        return ''

    def _write_and_detach(self, job: RecordingJob, bag: BagWriter) -> None:
        try:
            self._write(job, bag)
        finally:
            # Closing the bag may be slow: a start in that time must not get the future of this job.
            with self._lock:
                if self._attached is job:
                    self._attached = None

    def _write(self, job: RecordingJob, bag: BagWriter) -> None:
        """Write the items of the queue up to the None that ends the recording."""
        items_since_check = 0
        unflushed = False  # Whether items were written since the last flush.
        queue_had_item = False  # Whether the last attempt to get an item succeeded.
        while True:
            job.last_step_s = time.monotonic()
            try:
                item = job.queue.get_nowait() if queue_had_item else job.queue.get(timeout=IDLE_S)
            except queue.Empty:
                if queue_had_item:
                    time.sleep(GATHER_S)
                elif unflushed:
                    bag.flush()
                    unflushed = False
                queue_had_item = False
                continue
            queue_had_item = True
            if item is None:
                return
            if isinstance(item, ParameterChange):
                bag.put(item)
            else:
                topic, type_name, cdr, t_ns = item
                bag.write_encoded(topic, type_name, cdr, t_ns)
                job.budget.give_back(len(cdr) + MESSAGE_BYTES)
                with self._lock:
                    self.written += 1
            unflushed = True
            items_since_check += 1
            if items_since_check >= CHECK_EVERY:
                items_since_check = 0
                _require_in_place(bag)
                self._make_room(bag, job.config)

    def _make_room(self, bag: BagWriter, config: AcquisitionConfig) -> None:
        """Delete files older than ``bag_keep``; if the disk is nearly full, do as ``disk_full`` says."""
        while 0.0 < config.bag_keep < bag.oldest_age_s:
            self._drop_oldest(bag, f'it ended more than bag_keep = {config.bag_keep:g} s ago')
        while why := why_full(bag.folder, config.disk_reserve):
            if config.disk_full != 'delete_oldest':
                raise _DiskFullError(why)
            if not self._drop_oldest(bag, f'{why} (disk_full is delete_oldest)', WARNING):
                raise _DiskFullError(f'{why} and there is no older file of this recording to delete')

    def _drop_oldest(self, bag: BagWriter, why: str, level: int = INFO) -> bool:
        """Delete the oldest complete file of the bag and log ``why``; return False if there is no such file."""
        deleted = bag.drop_oldest()
        if deleted is not None:
            self.files_deleted += 1
            self._log(f'{deleted}: deleted, {why}', level)
        return deleted is not None


def _wait_for_writer(job: RecordingJob, thread: threading.Thread, deadline_s: float) -> None:
    """Wait until ``thread`` ends, the queue of ``job`` stops shrinking, or ``deadline_s`` (monotonic time) passes."""
    # + 1: wait twice if the queue is empty, because the thread may still be closing the bag.
    remaining = job.queue.qsize() + 1
    while thread.is_alive() and time.monotonic() < deadline_s:
        before = remaining
        thread.join(JOIN_S)
        remaining = job.queue.qsize()
        if remaining >= before:
            return


def _require_in_place(bag: BagWriter) -> None:
    if not bag.in_place:
        raise _FileGoneError(f'{bag.path}: was deleted or moved while it was recorded; start another recording')


def why_full(folder: Path, reserve: int) -> str:
    """Return why the disk of ``folder`` is too full; '' if ``reserve`` bytes are free or the free space is unknown.

    A folder that does not exist yet is on the disk of its nearest parent.
    """
    existing = next((path for path in (folder, *folder.absolute().parents) if path.exists()), Path('/'))
    try:
        free = shutil.disk_usage(existing).free
    except OSError:
        return ''  # Messages are written until a write fails.
    if free >= reserve:
        return ''
    return f'the disk has {free / 1e6:.0f} MB left, less than disk_reserve = {reserve / 1e6:.0f} MB'
