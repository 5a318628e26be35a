# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Files that are written whole or not at all, and files that stay in the folder that they were made in."""

from __future__ import annotations

import contextlib
import errno
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, cast

from psd_deflection.base.errors import RecordingError

HOLDS = os.open in os.supports_dir_fd
"""Whether the system makes files in a folder that is held open; Windows does not, and takes their paths instead."""
_NEW = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, 'O_CLOEXEC', 0) | getattr(os, 'O_BINARY', 0)
"""O_EXCL: a link of that name, even one that leads nowhere, is rejected."""


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
        self._fd = -1
        if HOLDS:
            # With O_PATH a folder that may not be listed can be written to all the same.
            flags = getattr(os, 'O_PATH', os.O_RDONLY) | os.O_DIRECTORY | os.O_CLOEXEC
            self._fd = os.open(path, flags | (0 if follow else os.O_NOFOLLOW))
        elif not path.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(path))

    def create(self, name: str) -> BinaryIO:
        """A new file, open for writing. Raises FileExistsError if there is anything of that name."""
        return os.fdopen(self._make(name), 'wb')

    def unnamed(self, name: str) -> BinaryIO:
        """A new file that is gone once it is closed, made under ``name``, which must be free."""
        if not HOLDS:
            # An open file cannot be removed there.
            return cast(BinaryIO, tempfile.TemporaryFile(dir=self.path))
        stream = os.fdopen(self._make(name), 'w+b')
        self.remove(name)
        return stream

    def _make(self, name: str) -> int:
        return os.open(name, _NEW, 0o666, dir_fd=self._fd) if HOLDS else os.open(self.path / name, _NEW, 0o666)

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
            if HOLDS:
                os.replace(partial, name, src_dir_fd=self._fd, dst_dir_fd=self._fd)
            else:
                (self.path / partial).replace(self.path / name)
        except OSError:
            with contextlib.suppress(OSError):
                self.remove(partial)
            raise

    def remove(self, name: str) -> None:
        """Delete the file of that name."""
        if HOLDS:
            os.unlink(name, dir_fd=self._fd)
        else:
            (self.path / name).unlink()

    def holds(self, name: str, stream: BinaryIO) -> bool:
        """Whether ``name`` in this folder still is the file that ``stream`` writes. Raises nothing."""
        with contextlib.suppress(OSError):
            there = os.stat(name, dir_fd=self._fd, follow_symlinks=False) if HOLDS else (self.path / name).lstat()
            return os.path.samestat(there, os.fstat(stream.fileno()))
        return False

    def in_place(self) -> bool:
        """Whether ``path`` still leads to this folder. Raises nothing."""
        if not HOLDS:
            return self.path.is_dir()
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


def lock(stream: BinaryIO, *, shared: bool = False) -> bool:
    """Lock a file until it is closed; False if another program has locked it. Raises OSError if it cannot be."""
    try:
        import fcntl
    except ImportError:
        # Windows: files are not locked.
        return True
    try:
        fcntl.flock(stream, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


@contextlib.contextmanager
def creating(path: object) -> Iterator[None]:
    """Raise RecordingError if the recording ``path`` exists already or cannot be made inside."""
    try:
        yield
    except FileExistsError:
        raise RecordingError(f'{path}: exists already; a recording is never overwritten') from None
    except OSError as error:
        raise RecordingError(f'{path}: cannot be made ({error.strerror or error})') from None
