"""Tip deflection and twist of a flexible link from two position sensing detectors.

``docs/architecture.md`` lists the subpackages and the direction of the imports between them.
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
    """Open a recording: a bag folder, an ``.mcap`` or a ``.csv``. ``.samples`` is a numpy array of its samples.

    Raises :class:`psd_deflection.errors.RecordingError` if it cannot be read.
    """
    # Imported here to keep `import psd_deflection` fast.
    from psd_deflection.recordings.readers import open_recording

    return open_recording(path)


def discover(recordings: Sequence[str | Path], rig: Rig | str | Path | None = None, *, seed: int = 0) -> Discovery:
    """Name the effects that the simulation lacks to explain ``recordings``.

    ``recordings``: files with loads, or ``.yaml`` lists of them.
    ``rig``: the known rig, or its parameter file; by default the parameters in the recordings. The same
    ``seed`` gives the same answer. ``psd_deflection.discovery.result`` turns the answer into
    ``result.json`` and ``model.yaml``. Raises :class:`psd_deflection.errors.RecordingError` if a
    recording cannot be read or holds no loads, :class:`~psd_deflection.errors.ConfigError` for a bad
    parameter.
    """
    from pathlib import Path

    from psd_deflection.config import load_rig
    from psd_deflection.discovery.discover import discover as of_observations
    from psd_deflection.recordings.observations import read_observations

    known = load_rig(rig) if isinstance(rig, str | Path) else rig
    return of_observations(read_observations(recordings, known), known, seed=seed)
