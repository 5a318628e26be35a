"""The answer of identify: modes, lines for the rig file, input shapers."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from psd_deflection import __version__
from psd_deflection.arms.shapers import Shaper, recommended
from psd_deflection.model.simulation.catalogue import effects_of_rig
from psd_deflection.records import FloatArray
from psd_deflection.rig.parameter_files import with_values
from psd_deflection.studies.axes import AXES, SHOWN, SHOWN_UNITS, SYMBOLS, UNITS
from psd_deflection.studies.identify.from_recordings import IdentifyProblem
from psd_deflection.studies.identify.modes import AxisModes
from psd_deflection.studies.study import PageSection, StudyResult, described, edited_rig_file, named


@dataclass(frozen=True)
class Identified(StudyResult):
    """``axes``: the modes of dX, dY, theta in ``problem.poses``."""

    study, json_name = 'identify', 'identify.json'
    title = 'Modes of the link'

    problem: IdentifyProblem
    axes: tuple[AxisModes, AxisModes, AxisModes]

    @property
    def poses(self) -> FloatArray:
        """See :class:`~psd_deflection.studies.identify.from_recordings.IdentifyProblem`."""
        return self.problem.poses

    @property
    def rate(self) -> float:
        """Samples a second."""
        return self.problem.rate

    @property
    def values(self) -> dict[str, float]:
        """Parameters of the rig file. Bending is the surer of X and Y, for which the file has one value."""
        out: dict[str, float] = {}
        bending = [m for a in self.axes[:2] for m in a.modes[:1]]
        for name, modes in (('bending', bending), ('torsion', list(self.axes[2].modes[:1]))):
            if modes:
                best = min(modes, key=lambda m: m.frequency_sd / m.frequency)
                out[f'dynamics.{name}_frequency'] = float(f'{best.frequency:.8g}')
                out[f'dynamics.{name}_damping_ratio'] = float(f'{best.damping:.6g}')
        return out

    def shaper_of(self, axis: int) -> Shaper | None:
        """The shaper that is recommended for the loudest mode of an axis; None if it has none."""
        if not self.axes[axis].modes:
            return None
        mode = self.axes[axis].modes[0]
        return recommended(mode.frequency, mode.frequency_sd, mode.damping)

    @property
    def sources(self) -> dict[str, str]:
        """The recording and the rig."""
        return self.problem.opened.sources

    def sentences(self) -> list[str]:
        """One line for each mode, and the shaper."""
        out = []
        for i, axis in enumerate(self.axes):
            if not axis.modes:
                out.append(f'{SYMBOLS[i]}: no mode stands out of the noise. Knock on the link, or release a load.')
                continue
            how = f'{len(axis.stretches)} ring-downs' if axis.how == 'ring-down' else 'the spectrum in operation'
            for mode in axis.modes:
                out.append(
                    f'{SYMBOLS[i]}: {_pm(mode.frequency, mode.frequency_sd)} Hz, damping ratio '
                    f'{_pm(mode.damping, mode.damping_sd)} (95 %), '
                    f'{SHOWN[i] * mode.amplitude:.1f} {SHOWN_UNITS[i]}, from {how}'
                )
            best = self.shaper_of(i)
            if best is not None:
                pairs = ', '.join(f'{s:.4f} at {1e3 * t:.1f} ms' for t, s in zip(best.times, best.sizes, strict=True))
                out.append(f'{SYMBOLS[i]}: input shaper {best.name.upper()}: {pairs}')
        return out

    def lines(self) -> list[str]:
        """The sentences, and the lines for the rig file."""
        if not self.values:
            return self.sentences()
        values = [f'    {name}: {value:g}' for name, value in self.values.items()]
        return [*self.sentences(), '', 'Lines for the rig file, below ros__parameters:', '', *values]

    def tree(self) -> dict[str, Any]:
        """Modes and shapers of each axis, and parameters, SI units."""
        return {
            'axes': {name: self._axis_tree(i) for i, name in enumerate(AXES)},
            'parameters': self.values,
        }

    def _axis_tree(self, i: int) -> dict[str, Any]:
        axis, best = self.axes[i], self.shaper_of(i)
        return {
            'unit': UNITS[i],
            'how': axis.how,
            'noise': axis.noise,
            'stretches': [[a / self.rate, b / self.rate] for a, b in axis.stretches],
            'modes': [
                {
                    'frequency': m.frequency,
                    'frequency_sd': m.frequency_sd,
                    'damping_ratio': m.damping,
                    'damping_ratio_sd': m.damping_sd,
                    'amplitude': m.amplitude,
                }
                for m in axis.modes
            ],
            'shaper': None if best is None else {'name': best.name, 'times': best.times, 'sizes': best.sizes},
        }

    def sections(self) -> Iterable[PageSection]:
        """Spectra, ring-downs, shapers."""
        from psd_deflection.studies.identify.pictures import DrawnModes, sections

        shapers = [self.shaper_of(i) for i in range(len(self.axes))]
        return sections(DrawnModes(self.poses, self.rate, self.axes, shapers))

    def rig_yaml(self) -> str:
        """The user's parameter file with the modes, comments kept; without one what describes the rig."""
        recording, rig, params_file, tell = self.problem.opened
        date = datetime.now(UTC).date().isoformat()
        recorded = named(recording.path.name, recording.digest)
        source = f'Identified by psd-deflection {__version__}, {date}, from {recorded}'

        def edit(text: str, path: Path) -> str:
            return with_values(text, self.values, source, path)

        return edited_rig_file(params_file, 'rig.yaml', lambda: described(rig, effects_of_rig(rig)), edit, tell)

    def files(self) -> dict[str, str]:
        """The page, the JSON, and ``rig.yaml`` with the modes in it."""
        return {**super().files(), 'rig.yaml': self.rig_yaml()}


def _pm(value: float, sd: float) -> str:
    """Value and 95 % interval, with two digits of the latter."""
    half = 1.96 * sd
    digits = min(max(1 - math.floor(math.log10(half)), 0), 9) if 0.0 < half < math.inf else 6
    return f'{value:.{digits}f} ± {half:.{digits}f}'
