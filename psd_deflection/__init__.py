"""Tip deflection and twist of a flexible link from two position sensing detectors.

The rooms of the house, and which way the imports point, are in ``docs/architecture.md``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from psd_deflection.config import Rig
    from psd_deflection.discovery.discover import Discovery
    from psd_deflection.recordings.recording import Recording

__version__ = '0.1.0'


def open(path: str | Path) -> Recording:
    """Open a recording: a bag folder, an ``.mcap`` or a ``.csv``; ``.samples`` is a numpy array of it.

    Raises :class:`psd_deflection.errors.RecordingError` where it cannot be read.
    """
    # Only here, so that `import psd_deflection` stays light.
    from psd_deflection.recordings.readers import open_recording

    return open_recording(path)


def discover(recordings: Sequence[str | Path], rig: Rig | str | Path | None = None, *, seed: int = 0) -> Discovery:
    """Name what the simulation lacks to explain ``recordings``: files with loads, or ``.yaml`` lists of them.

    ``rig``: the rig as it is known, or its parameter file; by default what the recordings themselves
    tell. The same ``seed`` gives the same answer. ``psd_deflection.discovery.result`` turns it into
    ``result.json`` and ``model.yaml``. Raises :class:`psd_deflection.errors.RecordingError` where a
    recording cannot be read or holds no loads, :class:`~psd_deflection.errors.ConfigError` for a bad
    parameter.
    """
    from pathlib import Path

    from psd_deflection.config import load_rig
    from psd_deflection.discovery.discover import discover as of_observations
    from psd_deflection.recordings.observations import read_observations

    known = load_rig(rig) if isinstance(rig, str | Path) else rig
    return of_observations(read_observations(recordings, known), known, seed=seed)
