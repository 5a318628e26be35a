# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""How far a calibration is: what the motion so far has determined, what is open, and what would determine it."""

import math
from typing import Any, NamedTuple

from psd_deflection.model.misalignment.model import ALL
from psd_deflection.studies.calibrate.calibrate import MOTIONS, OPEN, ROTATED, Calibration, needs_of
from psd_deflection.studies.calibrate.fit import NAMES, REPORTED, UNITS, Kind

WORDS = {p.name: p.words for p in ALL} | {
    'clamp.bending_compliance': 'turn of the clamp per moment',
    'clamp.torsional_compliance': 'twist of the clamp per torque',
}
"""What each parameter is, for people."""
FULL = 0.01
"""Share of the tolerance that is left when a parameter's bar is full: it is known 100 times better than before."""
_READ = {'rad': (1e3, 'mrad'), 'm': (1e3, 'mm'), 's': (1e3, 'ms'), '': (1.0, '')}


def in_words(i: int, value: float, sd: float | None = None) -> str:
    """Return the value of parameter ``i`` of ``NAMES`` in the unit that people use, with its ± if ``sd`` is given."""
    factor, unit = _READ.get(UNITS[i], (1.0, UNITS[i]))
    number = f'{factor * value:.5g}' if sd is None else f'{factor * value:.5g} ± {factor * sd:.2g}'
    return f'{number} {unit}'.strip()


class ParameterProgress(NamedTuple):
    """``value``: with its ±. ``sd_ratio``: sd over that of the rig file. ``determined``: is it known better than that?

    ``filled``: 0 (as the file has it) to 1 (``FULL`` is reached), in proportion to the logarithm of ``sd_ratio``.
    """

    name: str
    words: str
    value: str
    sd_ratio: float
    determined: bool

    @property
    def filled(self) -> float:
        """Length of its bar, 0 to 1."""
        if not self.determined or not self.sd_ratio < 1.0:
            return 0.0
        return min(1.0, math.log(max(self.sd_ratio, FULL)) / math.log(FULL))

    def tree(self) -> dict[str, Any]:
        """For JSON and for the live page."""
        names = {'name': self.name, 'words': self.words, 'value': self.value}
        return {**names, 'sd_ratio': self.sd_ratio, 'determined': self.determined, 'filled': self.filled}


class Need(NamedTuple):
    """``motion``: what would determine the parameters ``names``."""

    motion: str
    names: tuple[str, ...]


class CalibrationProgress(NamedTuple):
    """``seconds``: of motion that were read. ``needs``: what to do next, what is easily done first.

    What no motion can tell apart, such as a turned PSD and one whose axes are not square, is no need.
    """

    kind: Kind
    seconds: float
    parameters: tuple[ParameterProgress, ...]
    needs: tuple[Need, ...]
    rejected: str

    @property
    def determined(self) -> int:
        """Number of parameters that are determined."""
        return sum(p.determined for p in self.parameters)

    def tree(self) -> dict[str, Any]:
        """For JSON and for the live page."""
        rows = [p.tree() for p in self.parameters]
        needs = [need._asdict() for need in self.needs]
        return {**self._asdict(), 'determined': self.determined, 'parameters': rows, 'needs': needs}


def progress_of(calibration: Calibration) -> CalibrationProgress:
    """How far ``calibration`` is."""
    share_of_prior = calibration.sd / calibration.prior.sd
    known = {NAMES[i] for i in REPORTED if calibration.fit.free[i] and share_of_prior[i] <= OPEN}
    motions: dict[str, list[str]] = {}
    for direction in calibration.undetermined:
        if direction.needs != ROTATED:
            # Of a combination those that are not known one by one, else the largest.
            for name in [part for part in direction.parts if part not in known] or [*direction.parts][:1]:
                motions.setdefault(needs_of([name]), []).append(name)
    needs = [Need(motion, tuple(dict.fromkeys(names))) for motion, names in motions.items()]
    # What is in a need is not determined: the two add up to all.
    known -= {name for need in needs for name in need.names}
    return CalibrationProgress(
        kind=calibration.kind,
        seconds=float(sum(run.t[-1] - run.t[0] for run in calibration.runs)),
        parameters=tuple(
            ParameterProgress(
                name=NAMES[i],
                words=WORDS[NAMES[i]],
                value=in_words(i, float(calibration.values[i]), float(calibration.sd[i])),
                sd_ratio=float(share_of_prior[i]),
                determined=NAMES[i] in known,
            )
            for i in REPORTED
        ),
        needs=tuple(sorted(needs, key=lambda need: MOTIONS.index(need.motion))),
        rejected=calibration.rejected,
    )
