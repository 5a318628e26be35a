"""The recorder thread: what was published, written to a bag without holding up what is to come.

It takes encoded messages from a bounded queue; what does not fit is counted, never waited for. An
error of the disk ends the recording with a message; acquisition and publishing go on.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from psd_deflection.config import Rig
from psd_deflection.errors import RecordingError
from psd_deflection.io.bag_writer import BagWriter
from psd_deflection.records import ParameterChange

MESSAGES_PER_BLOCK = 10
JOIN_S = 1.5

Message = tuple[str, str, bytes, int]


def new_folder(parent: Path, now: float | None = None) -> Path:
    """A folder that does not exist yet: ``psd_`` and the time, then ``_2``, ``_3`` ..."""
    stem = time.strftime('psd_%Y%m%d_%H%M%S', time.localtime(now))
    folder = parent / stem
    count = 1
    while folder.exists():
        count += 1
        folder = parent / f'{stem}_{count}'
    return folder


class Recorder:
    """One recording at a time; a wire like any other. ``say`` is told when one ends by itself."""

    def __init__(self, queue_blocks: int, say: Callable[[str], None]) -> None:
        self.dropped = 0
        self.written = 0
        self._say = say
        self._limit = queue_blocks * MESSAGES_PER_BLOCK
        self._bag: BagWriter | None = None
        self._queue: queue.SimpleQueue[Message | ParameterChange | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    @property
    def folder(self) -> Path | None:
        """Where the recording goes, or None while none is made."""
        return self._bag.folder if self._bag is not None else None

    def start(self, rig: Rig, hello: Mapping[str, object] | None) -> Path:
        """Start a recording in ``bag_dir``; the one that runs, if one does.

        Raises RecordingError where the folder cannot be made.
        """
        if self._bag is not None:
            return self._bag.folder
        effects = {f'effects.{name}': value for name, value in rig.effects.items()}
        folder = new_folder(Path(rig.acquisition.bag_dir).expanduser())
        bag = BagWriter(folder, rig_values={**rig.values, **effects}, device_hello=hello)
        self._queue = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, args=(bag, self._queue), name='recorder', daemon=True)
        self._bag = bag
        self._thread.start()
        return folder

    def put(self, topic: str, type_name: str, cdr: bytes, t_ns: int) -> None:
        """Record one message; count it as dropped where the disk is too slow."""
        if self._bag is not None:
            self._enqueue((topic, type_name, cdr, t_ns))

    def put_change(self, change: ParameterChange) -> None:
        """Note that parameters changed."""
        if self._bag is not None:
            self._enqueue(change)

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

    def _enqueue(self, item: Message | ParameterChange) -> None:
        if self._queue.qsize() >= self._limit:
            self.dropped += 1
        else:
            self._queue.put(item)

    def _run(self, bag: BagWriter, items: queue.SimpleQueue[Message | ParameterChange | None]) -> None:
        try:
            while (item := items.get()) is not None:
                if isinstance(item, ParameterChange):
                    bag.write(item)
                else:
                    bag.write_encoded(*item)
                self.written += 1
            bag.close()
        except RecordingError as error:
            if self._bag is bag:
                self._bag = None
            self._say(f'recording stopped: {error}')
