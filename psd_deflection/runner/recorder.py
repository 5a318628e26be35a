"""The recorder thread: what was published, written to a bag without holding up what is to come.

It takes encoded messages from a bounded queue; what does not fit is counted, never waited for. An
error of the disk, or a disk with less room than the reserve, ends the recording with a message;
acquisition and publishing go on. Once a chunk is on the disk a crash does not cost it any more; a
chunk ends after half a second of log time, or of nothing to write.
"""

from __future__ import annotations

import contextlib
import queue
import shutil
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from psd_deflection.config import AcquisitionConfig, Rig
from psd_deflection.errors import RecordingError
from psd_deflection.recordings.bag_writer import BagWriter
from psd_deflection.records import ParameterChange

MESSAGES_PER_BLOCK = 100
"""The recorder's queue holds this many messages for each block of ``queue_blocks``. A block makes about
ten, so that a disk may stand still ten times as long as the pipeline may: 50 s by default, in 25 MB."""
JOIN_S = 1.0
IDLE_S = 0.5
LOOK_EVERY = 250
"""Messages between two looks at the file and the room on its disk: half a second's worth."""

ELSEWHERE = 'make room, or record elsewhere (--record FOLDER, bag_dir)'

Message = tuple[str, str, bytes, int]
Item = Message | ParameterChange | None


def new_folder(parent: Path) -> Path:
    """A folder that does not exist yet: ``psd_`` and the time, then ``_2``, ``_3`` ..."""
    stem = time.strftime('psd_%Y%m%d_%H%M%S')
    folder = parent / stem
    count = 1
    while folder.exists():
        count += 1
        folder = parent / f'{stem}_{count}'
    return folder


class _FullError(Exception):
    """The disk has less room than the reserve."""


class _GoneError(Exception):
    """Somebody deleted or moved the file: what is written into it from now on, nobody finds."""


class Recorder:
    """One recording at a time; a wire like any other. ``say`` is told when one ends by itself.

    ``failure``: why the last recording ended by itself, empty while all is well; for diagnostics.
    """

    def __init__(self, queue_blocks: int, say: Callable[[str], None]) -> None:
        self.dropped = 0
        self.written = 0
        self.files_deleted = 0
        self.failure = ''
        self._say = say
        self._limit = queue_blocks * MESSAGES_PER_BLOCK
        self._bag: BagWriter | None = None
        self._queue: queue.SimpleQueue[Item] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    @property
    def folder(self) -> Path | None:
        """Where the recording goes, or None while none is made."""
        bag = self._bag
        return bag.folder if bag is not None else None

    @property
    def waiting(self) -> int:
        """Messages that wait for the disk."""
        return self._queue.qsize() if self._bag is not None else 0

    def start(self, rig: Rig, hello: Mapping[str, object] | None) -> Path:
        """Start a recording in ``bag_dir``; the one that runs, if one does.

        Raises RecordingError where the folder cannot be made or the disk has no room.
        """
        if self._bag is not None:
            return self._bag.folder
        config = rig.acquisition
        folder = new_folder(Path(config.bag_dir).expanduser())
        missing = _missing_room(_nearest(folder), config.disk_reserve)
        if missing:
            raise RecordingError(f'{folder}: {missing}; {ELSEWHERE}')
        try:
            bag = BagWriter(
                folder,
                rig_values=rig.flat(),
                device_hello=hello,
                max_bytes=config.bag_max_bytes,
                max_s=config.bag_max_duration,
                durable=True,
            )
        except RecordingError as error:
            raise RecordingError(f'{error}; {ELSEWHERE}') from None
        self.failure = ''
        self._queue = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, args=(bag, self._queue, config), name='recorder', daemon=True)
        self._bag = bag
        self._thread.start()
        return folder

    def put(self, topic: str, type_name: str, cdr: bytes, t_ns: int) -> None:
        """Record one message; count it as dropped where the disk is too slow."""
        if self._bag is not None:
            self._enqueue((topic, type_name, cdr, t_ns))

    def put_change(self, change: ParameterChange) -> None:
        """Note that parameters changed. Never dropped: without it no replay is the same."""
        if self._bag is not None:
            self._queue.put(change)

    def stop(self) -> Path | None:
        """End the recording and return its folder; None where none was made."""
        bag, thread = self._bag, self._thread
        if bag is None or thread is None:
            return None
        self._bag = None
        self._queue.put(None)
        thread.join(JOIN_S)
        if thread.is_alive():
            self._say(f'{bag.folder}: the disk is slow; still writing in the background')
        return bag.folder

    def _enqueue(self, item: Message) -> None:
        if self._queue.qsize() >= self._limit:
            self.dropped += 1
        else:
            self._queue.put(item)

    def _run(self, bag: BagWriter, items: queue.SimpleQueue[Item], config: AcquisitionConfig) -> None:
        try:
            try:
                self._write(bag, items, config)
            except _FullError as error:
                # There is room for index and summary: that is what the reserve is for.
                bag.close()
                self._ended(bag, f'{bag.folder}: {error}; it is complete up to here')
            else:
                bag.close()
        except _GoneError as error:
            with contextlib.suppress(RecordingError):
                bag.close()
            self._ended(bag, str(error))
        except RecordingError as error:
            self._ended(bag, f'{error}; `psd-deflection recover {bag.folder}` makes it whole')
        except Exception as error:
            # Whatever it was: a recorder that is dead and says nothing would be worse.
            with contextlib.suppress(Exception):
                bag.close()
            self._ended(bag, f'{bag.folder}: {type(error).__name__}: {error}')

    def _ended(self, bag: BagWriter, why: str) -> None:
        if self._bag is bag:
            self._bag = None
        self.failure = why
        self._say(f'recording stopped: {why}')

    def _write(self, bag: BagWriter, items: queue.SimpleQueue[Item], config: AcquisitionConfig) -> None:
        since_look = 0
        unwritten = False
        while True:
            try:
                item = items.get(timeout=IDLE_S)
            except queue.Empty:
                if unwritten:
                    bag.flush()
                    unwritten = False
                continue
            if item is None:
                return
            if isinstance(item, ParameterChange):
                bag.write(item)
            else:
                bag.write_encoded(*item)
                self.written += 1
            unwritten = True
            since_look += 1
            if since_look >= LOOK_EVERY:
                since_look = 0
                if not bag.path.exists():
                    raise _GoneError(f'{bag.path}: was deleted or moved while it was recorded; start another recording')
                self._make_room(bag, config)

    def _make_room(self, bag: BagWriter, config: AcquisitionConfig) -> None:
        while missing := _missing_room(bag.folder, config.disk_reserve):
            if config.disk_full != 'delete_oldest':
                raise _FullError(missing)
            deleted = bag.drop_oldest()
            if deleted is None:
                raise _FullError(f'{missing} and there is no older file of this recording to delete')
            self.files_deleted += 1
            self._say(f'{deleted}: deleted, {missing} (disk_full is delete_oldest)')


def _nearest(folder: Path) -> Path:
    """The folder, or the nearest above it that exists."""
    return next((p for p in (folder, *folder.absolute().parents) if p.exists()), Path('/'))


def _missing_room(folder: Path, reserve: int) -> str:
    """What to say where the disk of ``folder`` has less than ``reserve`` bytes of room; else ''."""
    try:
        free = shutil.disk_usage(folder).free
    except OSError:
        # A disk that does not say is written to until it refuses.
        return ''
    if free >= reserve:
        return ''
    return f'the disk has {free / 1e6:.0f} MB left, less than disk_reserve = {reserve / 1e6:.0f} MB'
