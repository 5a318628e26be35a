"""Files that are written whole or not at all."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path


def replace_file(path: Path, content: bytes) -> None:
    """Write ``path`` under another name, flush it, then rename it: a crash leaves the old file or the new.

    A symbolic link stays a link. Raises OSError; then ``path`` is unchanged.
    """
    place = path.resolve()
    partial = place.with_name(place.name + '.partial')
    try:
        with partial.open('wb') as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        partial.replace(place)
    except OSError:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise
