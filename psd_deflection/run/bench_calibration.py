# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Calibrates at the bench: computes the calibration again and again from a recording that is still being written."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from psd_deflection.base.errors import RecordingError
from psd_deflection.studies.calibrate.from_recordings import CalibrationOptions
from psd_deflection.studies.calibrate.progress import CalibrationProgress, progress_of
from psd_deflection.studies.calibrate.result import Calibrated

LOOK_S = 0.5
"""How often it looks whether the recording has grown or ended, s."""
LEAST_PAUSE_S = 2.0
"""Least time between two calibrations, s."""
IDLE_SHARE = 2.0
"""Pause after a calibration, in times that it took: the daemon needs the processor, too."""


class BenchStep(NamedTuple):
    """One look at the recording. ``answer``, ``progress``: None while it has too little; ``words`` say what it lacks.

    ``warnings``: of the calibration, such as a load that was noted late. ``ended``: the recording was closed.
    """

    answer: Calibrated | None
    progress: CalibrationProgress | None
    words: str
    warnings: tuple[str, ...]
    ended: bool


def follow(
    folder: Path,
    asked: CalibrationOptions,
    recording: Callable[[], bool],
    *,
    pause: Callable[[float], None] = time.sleep,
    now: Callable[[], float] = time.monotonic,
) -> Iterator[BenchStep]:
    """Calibrate by the recording in ``folder`` whenever it has grown, until nothing is open or it has ended.

    ``recording``: is it still being written? ``pause``, ``now``: the clock, s. The last step has ``ended`` True
    or a progress without needs. Raises RecordingError if the recording goes away, ConfigError for a rig that cannot
    be calibrated.
    """
    size, next_time = -1, now()
    while True:
        running = recording()
        grown = _size(folder)
        if running and (grown == size or now() < next_time):
            pause(LOOK_S)
            continue
        size, began = grown, now()
        step = _step(folder, asked, ended=not running)
        yield step
        if step.ended or (step.progress is not None and not step.progress.needs):
            return
        next_time = now() + max(LEAST_PAUSE_S, IDLE_SHARE * (now() - began))


def _step(folder: Path, asked: CalibrationOptions, *, ended: bool) -> BenchStep:
    warnings: list[str] = []
    try:
        rig = asked.rig([folder], warnings.append)
        answer = asked.calibrated(asked.runs([folder], rig), rig, (), lambda words: None, warnings.append)
    except RecordingError as error:
        return BenchStep(
            answer=None, progress=None, words=f'too little so far: {error}', warnings=tuple(warnings), ended=ended
        )
    progress = progress_of(answer.calibration)
    return BenchStep(answer=answer, progress=progress, words='', warnings=tuple(warnings), ended=ended)


def _size(folder: Path) -> int:
    """Bytes of the recording. Raises RecordingError if it is not there."""
    try:
        return sum(path.stat().st_size for path in folder.iterdir())
    except OSError as error:
        raise RecordingError(f'{folder}: cannot be read ({error.strerror or error})') from None
