"""Tip deflection and twist of a flexible link from two position sensing detectors.

The rooms of the house, and which way the imports point, are in ``docs/architecture.md``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    from psd_deflection.io.recording import Recording

__version__ = '0.1.0'


def open(path: str | Path) -> Recording:
    """Open a recording: a bag folder, an ``.mcap`` or a ``.csv``; ``.samples`` is a numpy array of it.

    Raises :class:`psd_deflection.errors.RecordingError` where it cannot be read.
    """
    # Only here, so that `import psd_deflection` stays light.
    from psd_deflection.io.recordings import open_recording

    return open_recording(path)
