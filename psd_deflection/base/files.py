"""Files that are written whole or not at all, and files that stay in the folder that they were made in."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from psd_deflection.base.errors import RecordingError


def replace_file(path: Path, content: bytes) -> None:
    """Write ``path`` under another name, flush it, then rename it: a crash leaves the old file or the new.

    A symbolic link stays a link. Raises OSError; then ``path`` is unchanged.
    """
    place = path.resolve()
    with HeldFolder(place.parent) as folder:
        folder.replace(place.name, content)


class HeldFolder:
    """An existing folder, held open. Everything is made in it by name, and nothing follows a symbolic link.

    So another program that moves the folder away, or puts a link in its place, cannot redirect what is
    written. ``follow``: whether ``path`` itself may be a link. Every method raises OSError.
    """

    def __init__(self, path: Path, *, follow: bool = True) -> None:
        self.path = path
        # With O_PATH a folder that may not be listed can be written to all the same.
        flags = getattr(os, 'O_PATH', os.O_RDONLY) | os.O_DIRECTORY | os.O_CLOEXEC
        self._fd = os.open(path, flags | (0 if follow else os.O_NOFOLLOW))

    def create(self, name: str) -> BinaryIO:
        """A new file, open for writing. Raises FileExistsError if there is anything of that name."""
        return os.fdopen(self._make(name), 'wb')

    def unnamed(self, name: str) -> BinaryIO:
        """A new file that is gone once it is closed, made under ``name``, which must be free."""
        stream = os.fdopen(self._make(name), 'w+b')
        self.remove(name)
        return stream

    def _make(self, name: str) -> int:
        # O_EXCL: a link of that name, even one that leads nowhere, is refused.
        return os.open(name, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666, dir_fd=self._fd)

    def replace(self, name: str, content: bytes) -> None:
        """Write ``name`` completely or not at all; a link of that name is replaced, not followed."""
        partial = name + '.partial'
        with contextlib.suppress(FileNotFoundError):
            self.remove(partial)
        try:
            with self.create(partial) as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(partial, name, src_dir_fd=self._fd, dst_dir_fd=self._fd)
        except OSError:
            with contextlib.suppress(OSError):
                self.remove(partial)
            raise

    def remove(self, name: str) -> None:
        """Delete the file of that name."""
        os.unlink(name, dir_fd=self._fd)

    def holds(self, name: str, stream: BinaryIO) -> bool:
        """Whether ``name`` in this folder still is the file that ``stream`` writes. Raises nothing."""
        with contextlib.suppress(OSError):
            return os.path.samestat(os.stat(name, dir_fd=self._fd, follow_symlinks=False), os.fstat(stream.fileno()))
        return False

    def in_place(self) -> bool:
        """Whether ``path`` still leads to this folder. Raises nothing."""
        with contextlib.suppress(OSError):
            return os.path.samestat(self.path.stat(), os.fstat(self._fd))
        return False

    def close(self) -> None:
        """Let go of the folder; a second call does nothing."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    def __enter__(self) -> HeldFolder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextlib.contextmanager
def creating(path: object) -> Iterator[None]:
    """Raise RecordingError if the recording ``path`` exists already or cannot be made inside."""
    try:
        yield
    except FileExistsError:
        raise RecordingError(f'{path}: exists already; a recording is never overwritten') from None
    except OSError as error:
        raise RecordingError(f'{path}: cannot be made ({error.strerror or error})') from None
