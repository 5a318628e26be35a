# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Finds the modes of the link in a recording; the answer, its page and its rig file (docs/identification.md)."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from psd_deflection import __version__
from psd_deflection.base.axes import AXES, SHOWN, SHOWN_UNITS, SYMBOLS, UNITS
from psd_deflection.base.pages import table
from psd_deflection.base.tables import Column, Table, text_column
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.detector import dot_noise_variances
from psd_deflection.model.link.shapers import Shaper, recommended
from psd_deflection.model.simulation.catalogue import effects_of_rig
from psd_deflection.model.solvers.registry import solver_from_rig
from psd_deflection.recordings.charts import moments
from psd_deflection.recordings.read.references import read_run
from psd_deflection.records import FloatArray, Moment, SampleBlock
from psd_deflection.rig.parameter_files import with_values
from psd_deflection.studies.identify.modes import modes_of
from psd_deflection.studies.identify.spectra import AxisModes, Mode
from psd_deflection.studies.study import Opened, PageSection, StudyResult, described, edited_rig_file, named

Counted = Callable[[Iterable[SampleBlock]], Iterable[SampleBlock]]
"""Hands blocks on and counts them, for a progress bar."""


@dataclass(frozen=True)
class IdentifyProblem:
    """``poses`` (n, 3): dX m, dY m, theta rad of single samples on an even grid, NaN if lost; ``rate``, Hz.

    ``marks``: of the recording, from the first of them.
    """

    opened: Opened
    poses: FloatArray
    rate: float
    marks: tuple[Moment, ...] = ()


def read_identify(opened: Opened, with_progress: Counted = iter) -> IdentifyProblem:
    """Solve every trusted sample. Raises RecordingError if there are none."""
    recording, rig = opened.recording, opened.rig
    run = read_run(recording, Pipeline(rig), with_progress(recording.blocks()))
    rate = rig.converter.sample_rate_hz
    solved = solver_from_rig(rig.estimator.solver, rig).solve_many(run.dots, dot_noise_variances(rig))
    place = np.rint((run.t_ns - run.t_ns[0]) * 1e-9 * rate).astype(np.int64)
    poses = np.full((int(place[-1]) + 1, 3), np.nan)
    good = solved.status == 0
    poses[place[good]] = solved.pose[good]
    return IdentifyProblem(opened, poses, rate, moments(recording.marks(), int(run.t_ns[0])))


KINDS = {'bending': (0, 1), 'torsion': (2,)}
"""Modes of the rig file, and the axes that show them."""
CLOSE = 0.3
"""Modes within this share of the loudest one's frequency are close to it: neither rings alone."""
AGREE = 0.005
"""X and Y agree within this share of the frequency."""
KNOWN = (0.01, 0.34)
"""Standard deviations of frequency and damping ratio, as shares, beyond which the rig file keeps
what it has."""


@dataclass(frozen=True, repr=False)
class Identified(StudyResult):
    """``axes``: the modes of dX, dY, theta in ``problem.poses``."""

    study, json_name = 'identify', 'identify.json'
    title = 'Modes of the link'

    problem: IdentifyProblem
    axes: tuple[AxisModes, AxisModes, AxisModes]

    @property
    def poses(self) -> FloatArray:
        """See :class:`IdentifyProblem`."""
        return self.problem.poses

    @property
    def rate(self) -> float:
        """Samples a second."""
        return self.problem.rate

    @property
    def values(self) -> dict[str, float]:
        """Parameters of the rig file. Bending is the surer of X and Y, for which the file has one value.

        None of a mode that is not known well, that has another close to it, or that X and Y do not
        agree on.
        """
        out: dict[str, float] = {}
        for name, axes in KINDS.items():
            modes = [self.axes[i].modes[0] for i in axes if self.axes[i].modes]
            if modes and self.withheld_reason(name) is None:
                best = min(modes, key=lambda m: m.frequency_sd / m.frequency)
                out[f'dynamics.{name}_frequency'] = float(f'{best.frequency:.8g}')
                out[f'dynamics.{name}_damping_ratio'] = float(f'{best.damping:.6g}')
        return out

    def withheld_reason(self, name: str) -> str | None:
        """Why the rig file does not get the mode of this kind; None if it does, or if none was found."""
        mode_lists = [self.axes[i].modes for i in KINDS[name] if self.axes[i].modes]
        if not mode_lists:
            return None
        if any(len(close_modes(modes)) > 1 for modes in mode_lists):
            return 'two modes close to each other, and the rig file describes one'
        first = [modes[0] for modes in mode_lists]
        apart = abs(first[0].frequency - first[-1].frequency)
        if apart > max(3.0 * math.hypot(first[0].frequency_sd, first[-1].frequency_sd), AGREE * first[0].frequency):
            return f'{SYMBOLS[0]} and {SYMBOLS[1]} ring at different frequencies, and the rig file has one for both'
        best = min(first, key=lambda m: m.frequency_sd / m.frequency)
        if best.frequency_sd >= KNOWN[0] * best.frequency or best.damping_sd >= KNOWN[1] * best.damping:
            return 'not known well enough; knock on the link, or release a load'
        return None

    def shaper_of(self, axis: int) -> Shaper | None:
        """The shaper that is recommended for the loudest mode of an axis; None if there is none, or not known well.

        Of modes close to each other it works for all.
        """
        modes = close_modes(self.axes[axis].modes)
        if not modes or min(m.damping / m.damping_sd if m.damping_sd else 0.0 for m in modes) < 1.0 / KNOWN[1]:
            return None
        low, high = min(m.frequency for m in modes), max(m.frequency for m in modes)
        sd = max(m.frequency_sd for m in modes)
        return recommended(0.5 * (low + high), sd + (high - low) / 6.0, modes[0].damping)

    @property
    def sources(self) -> dict[str, str]:
        """The recording and the rig."""
        return self.problem.opened.sources

    def sentences(self) -> list[str]:
        """Return one line for each mode, and the shaper."""
        out = []
        for i, axis in enumerate(self.axes):
            if not axis.modes:
                why = axis.why or 'no mode stands out of the noise'
                out.append(f'{SYMBOLS[i]}: {why}. Knock on the link, or release a load.')
            for mode in axis.modes:
                frequency, damping, size, how = self.mode_words(i, mode)
                out.append(f'{SYMBOLS[i]}: {frequency} Hz, damping ratio {damping} (95 %), {size}, from {how}')
            if best := self.shaper_words(i):
                out.append(f'{SYMBOLS[i]}: input shaper {best}')
        return [*out, *self.withheld_sentences()]

    def page_sentences(self) -> list[str]:
        """How many modes there are; what they are stands in a table."""
        counts = [f'{len(axis.modes)} along {SYMBOLS[i]}' for i, axis in enumerate(self.axes) if axis.modes]
        first = f'Modes: {", ".join(counts)}.' if counts else 'No mode was found.'
        whys = [f'{SYMBOLS[i]}: {axis.why}.' for i, axis in enumerate(self.axes) if axis.why]
        return [first, *whys, *self.withheld_sentences()]

    def rows(self) -> list[list[str]]:
        """Return the modes as a table: axis, frequency, damping ratio, amplitude, what from, and the shaper."""
        out = []
        for i, axis in enumerate(self.axes):
            if not axis.modes:
                out.append([SYMBOLS[i], 'none: knock on the link, or release a load', '', '', '', ''])
            for number, mode in enumerate(axis.modes):
                shaper = self.shaper_words(i).partition(':')[0] if number == 0 else ''
                out.append([SYMBOLS[i], *self.mode_words(i, mode), shaper])
        return out

    def mode_words(self, i: int, mode: Mode) -> tuple[str, str, str, str]:
        """Frequency, damping ratio, amplitude of a mode of axis ``i``, and what it was found from."""
        axis = self.axes[i]
        count = len(axis.stretches)
        rings = f'{count} ring-down{"" if count == 1 else "s"}'
        return (
            interval_words(mode.frequency, mode.frequency_sd),
            interval_words(mode.damping, mode.damping_sd),
            f'{SHOWN[i] * mode.amplitude:.1f} {SHOWN_UNITS[i]}',
            rings if axis.how == 'ring-down' else 'the spectrum in operation',
        )

    def shaper_words(self, i: int) -> str:
        """Return the recommended shaper of axis ``i``; '' if there is none."""
        best = self.shaper_of(i)
        if best is None:
            return ''
        pairs = ', '.join(f'{s:.4f} at {1e3 * t:.1f} ms' for t, s in zip(best.times, best.sizes, strict=True))
        return f'{best.name.upper()}: {pairs}'

    def withheld_sentences(self) -> list[str]:
        """What the rig file does not get, and why."""
        whys = [(name, self.withheld_reason(name)) for name in KINDS]
        return [f'Nothing for dynamics.{name}_*: {why}.' for name, why in whys if why is not None]

    def lines(self) -> list[str]:
        """Return the sentences, and the lines for the rig file."""
        if not self.values:
            return self.sentences()
        values = [f'    {name}: {value:g}' for name, value in self.values.items()]
        return [*self.sentences(), '', 'Lines for the rig file, below ros__parameters:', '', *values]

    def tree(self) -> dict[str, Any]:
        """Modes and shapers of each axis, and parameters, SI units."""
        return {'axes': {name: self._axis_tree(i) for i, name in enumerate(AXES)}, 'parameters': self.values}

    def _axis_tree(self, i: int) -> dict[str, Any]:
        axis, best = self.axes[i], self.shaper_of(i)
        return {
            'unit': UNITS[i],
            'how': axis.how,
            'why': axis.why,
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

    def table(self) -> Table:
        """Return one row a mode: Hz and damping ratio with their standard deviations, amplitude in m or rad."""
        modes = [(AXES[i], mode, UNITS[i], axis.how) for i, axis in enumerate(self.axes) for mode in axis.modes]

        def column(name: str, values: list[float], unit: str, words: str) -> Column:
            return Column(name, np.array(values, dtype=np.float64), unit, words)

        return Table(
            text_column('axis', [axis for axis, *_ in modes], 'along which it shows'),
            [
                column('frequency', [m.frequency for _, m, *_ in modes], 'Hz', 'of the mode'),
                column('frequency_sd', [m.frequency_sd for _, m, *_ in modes], 'Hz', 'its standard deviation'),
                column('damping_ratio', [m.damping for _, m, *_ in modes], '', 'of the mode'),
                column('damping_ratio_sd', [m.damping_sd for _, m, *_ in modes], '', 'its standard deviation'),
                column('amplitude', [m.amplitude for _, m, *_ in modes], '', 'in the unit of the row'),
                text_column('unit', [unit for _, _, unit, _ in modes], 'of the amplitude'),
                text_column('how', [how for *_, how in modes], 'it was found'),
            ],
        )

    def sections(self) -> Iterable[PageSection]:
        """Return the table of modes, spectra, ring-downs, shapers."""
        from psd_deflection.studies.identify.pictures import DrawnModes, sections

        shapers = [self.shaper_of(i) for i in range(len(self.axes))]
        head = ('axis', 'frequency, Hz (95 %)', 'damping ratio (95 %)', 'amplitude', 'from', 'input shaper')
        modes = PageSection('', (table(head, self.rows()),))
        return [modes, *sections(DrawnModes(self.poses, self.rate, self.problem.marks, self.axes, shapers))]

    def rig_yaml(self) -> str:
        """Return the user's parameter file with the modes, comments kept; without one what describes the rig."""
        recording, rig, params_file, notify, _ = self.problem.opened
        date = datetime.now(UTC).date().isoformat()
        recorded = named(recording.name, recording.digest)
        source = f'Identified by psd-deflection {__version__}, {date}, from {recorded}'

        def edit(text: str, path: Path) -> str:
            return with_values(text, self.values, source, path)

        return edited_rig_file(params_file, 'rig.yaml', lambda: described(rig, effects_of_rig(rig)), edit, notify)

    def files(self) -> dict[str, str]:
        """Return the page, the JSON, and ``rig.yaml`` with the modes in it."""
        return {**super().files(), 'rig.yaml': self.rig_yaml()}


def close_modes(modes: Sequence[Mode]) -> list[Mode]:
    """Return the loudest mode and those that are close to it; empty if there is none."""
    return [m for m in modes if abs(m.frequency - modes[0].frequency) < CLOSE * modes[0].frequency]


def interval_words(value: float, sd: float) -> str:
    """Value and 95 % interval, with two digits of the latter."""
    half = 1.96 * sd
    digits = min(max(1 - math.floor(math.log10(half)), 0), 9) if 0.0 < half < math.inf else 6
    return f'{value:.{digits}f} ± {half:.{digits}f}'


def identify(problem: IdentifyProblem) -> Identified:
    """Return the modes of each axis; see :mod:`psd_deflection.studies.identify.modes` for the methods."""
    x, y, twist = (modes_of(problem.poses[:, i], problem.rate) for i in range(3))
    return Identified(problem, (x, y, twist))
