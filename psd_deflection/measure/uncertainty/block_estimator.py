# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Estimate of the dots at a block's timestamp, its covariance, and the check of the readings.

Joins the noise of the stream (:mod:`psd_deflection.measure.uncertainty.noise`) with the fit and the check of each set
of PSDs (:mod:`psd_deflection.measure.uncertainty.psd_set`), and knows their state.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
import numpy.typing as npt

from psd_deflection.measure.averaging import SEGMENT_BLOCKS
from psd_deflection.measure.state import State, Value, mismatch, numbers
from psd_deflection.measure.uncertainty.block_fit import FittedBlock
from psd_deflection.measure.uncertainty.combinations import Residual
from psd_deflection.measure.uncertainty.consistency import (
    UNMEASURED,
    ConsistencyResult,
    OutlierSearch,
    Unexplained,
    survival,
)
from psd_deflection.measure.uncertainty.noise import StreamNoise
from psd_deflection.measure.uncertainty.psd_set import PsdSet
from psd_deflection.measure.uncertainty.vibration import Hum, Tone, words_of
from psd_deflection.model.detector import dot_noise_variances
from psd_deflection.model.plate.plate import Tilts
from psd_deflection.records import FloatArray, IntArray, channel_names, dot_names
from psd_deflection.rig.config import Rig
from psd_deflection.rig.declarations import LEAST_BITS

Volts = npt.NDArray[np.float32] | FloatArray

BELIEVED = 30
"""Samples off a channel's first level that all are multiples of its step."""

_FINE = 1.5
"""Times the rig file's step: not coarser than that."""

_ROUNDING = 2.5e-7
"""Of a difference of two float32, as a share of their size."""

_OFF = 0.25
"""Share of the rig file's step by which a multiple may be off."""

_LEVELS = 4
"""Channels off 0 V whose levels have a common divisor."""


class ConverterSteps:
    """Takes volts and tells the steps; it looks on for as long as a channel may be coarse.

    ``steps`` (C,): V of each channel, 0 where it is that of the rig file or not known.

    Volts of a converter lie on a grid: their differences are multiples of its step. The greatest common divisor of the
    differences of one channel is that step, once neighbouring levels were seen; noise makes them follow each other. It
    is found by Euclid's algorithm, sample by sample, within the rounding of float32. One difference that is no multiple
    of it makes it finer, so that the steps of a finer converter are never taken for coarse: 19 independent differences
    all being even has a chance of 2 in 10^6, and a channel is believed after ``BELIEVED``.

    A channel that does not leave its level (noise far below a step) tells no step by its differences. Its volts and
    those of the other channels are multiples of the step themselves, so the divisor of all levels is taken.
    """

    def __init__(self, channels: int, step: float, coarsest: float) -> None:
        """``step``: of the rig file, V. ``coarsest``: V; what is coarser is no step."""
        self._step, self._coarsest = step, coarsest
        self._first = np.full(channels, np.nan)
        self._divisor = np.zeros(channels)
        self._off = np.zeros(channels)
        self.steps = np.zeros(channels)
        # What is fine stays so.
        self._all_fine = False

    @classmethod
    def of_rig(cls, rig: Rig) -> ConverterSteps:
        """Of the channels of its PSDs."""
        converter = rig.converter
        return cls(3 * len(rig.psds), converter.volts_per_count, converter.full_scale / (1 << (LEAST_BITS - 1)))

    @property
    def _fine(self) -> npt.NDArray[np.bool_]:
        return (self._divisor > 0.0) & (self._divisor < _FINE * self._step)

    def add(self, volts: Volts) -> bool:
        """``volts`` (n, C), none of them NaN; True if :attr:`steps` changed."""
        if self._all_fine:
            return False
        fine = self._fine
        levels: FloatArray = np.asarray(volts, dtype=np.float64)
        self._first = np.where(np.isnan(self._first), levels[0], self._first)
        apart = np.abs(levels - self._first)
        rounding = self._tolerance(levels)
        self._off += np.count_nonzero(apart > rounding, axis=0)
        with np.errstate(divide='ignore', invalid='ignore'):
            times = apart / self._divisor
            fits = np.abs(times - np.rint(times)) * self._divisor <= rounding
        for channel in np.flatnonzero(~fine & ~fits.all(axis=0)).tolist():
            divisor = float(self._divisor[channel])
            for value in np.unique(apart[:, channel]).tolist():
                divisor = _common(divisor, value, float(rounding[channel]))
            # Not many times the rounding of float32, it is none.
            least = max(_FINE * self._step, 8.0 * _ROUNDING * float(np.abs(levels[:, channel]).max()))
            self._divisor[channel] = divisor if divisor == 0.0 or divisor > least else self._step
        before = self.steps
        self.steps = self._find_steps()
        self._all_fine = bool(self._fine.all())
        return not np.array_equal(before, self.steps)

    def state(self) -> tuple[float, ...]:
        """What :meth:`set_state` needs to go on from here; () before the first sample."""
        if np.isnan(self._first).any():
            return ()
        return tuple(v for part in (self._first, self._divisor, self._off) for v in part.tolist())

    def set_state(self, values: tuple[float, ...]) -> None:
        """Go on from :meth:`state` of another one. Raises ValueError if it had other channels."""
        if len(values) != 3 * len(self.steps):
            raise ValueError(f'steps of {len(self.steps)} channels have {3 * len(self.steps)} values')
        self._first, self._divisor, self._off = np.reshape(values, (3, -1)).copy()
        self.steps = self._find_steps()
        self._all_fine = bool(self._fine.all())

    def _tolerance(self, volts: FloatArray) -> FloatArray:
        return np.asarray(np.maximum(_OFF * self._step, _ROUNDING * np.abs(volts).max(axis=0)))

    def _find_steps(self) -> FloatArray:
        fine = self._fine
        reported = (self._divisor > 0.0) & ~fine & (self._divisor <= self._coarsest) & (self._off >= BELIEVED)
        out = np.where(reported, self._divisor, 0.0)
        silent = (self._off < BELIEVED) & ~fine
        if silent.any():
            # The same converter has the others; if none of them tells, the levels themselves.
            common = float(out.max()) if reported.any() else 0.0 if fine.any() else self._of_levels()
            out[silent & (self._first != 0.0)] = common
        return out

    def _of_levels(self) -> float:
        divisor = 0.0
        levels = np.abs(self._first)
        if np.count_nonzero(levels > 0.0) < _LEVELS:
            return 0.0
        for value in (*levels.tolist(), *self._divisor.tolist()):
            divisor = _common(divisor, value, float(self._tolerance(levels[None, :]).max()))
        return divisor if _FINE * self._step <= divisor <= self._coarsest else 0.0


def _common(a: float, b: float, within: float) -> float:
    """The greatest common divisor of two numbers, each of them known ``within`` so much; 0 has every divisor."""
    a, b = max(a, b), min(a, b)
    while b > within:
        rest = a % b
        a, b = b, min(rest, b - rest)
    return a


NOISE, SEGMENT, SUMS = 'state.noise', 'state.noise_segment', 'state.sums_segment'
VIBRATION, HUM, DRIFT, MOVES, CANDIDATES, STEPS, PSDS = (
    'state.vibration',
    'state.hum',
    'state.drift',
    'state.moves',
    'state.candidates',
    'state.converter_steps',
    'state.psds.',
)
"""Names of the state; ``PSDS`` goes on with the PSDs (from 0) of a set, such as "state.psds.0_1"."""


_LONG = 64
"""Samples of a block for each of which "moves" is reported one block longer."""


class BlockEstimator:
    """Fits, checks and learns from block after block.

    ``full``: all PSDs. ``contradictions``: inconsistent blocks. ``poor_fits``: blocks with motion that the fit cannot
    follow. ``chi_square``: of the last check, of ``freedom`` degrees. ``excluded``: PSDs (from 1) without which the
    last block was solved. ``vibrating``: the tones that the last block could not follow. ``on_plate``: whether the PSDs
    are on the plate: then the noise is measured, and the readings checked.
    """

    part = 'the fit and the noise of the dots'
    prefixes = (NOISE, SUMS, VIBRATION, HUM, DRIFT, MOVES, CANDIDATES, STEPS, PSDS)

    def __init__(self, rig: Rig, on_plate: bool = True, tilts: Tilts = 'none') -> None:
        """``tilts``: what the rig's solver says of the plate's tilts; it counts for more than two PSDs."""
        self._rig = rig
        self.on_plate = on_plate
        self._size = rig.estimator.block_size
        variances = dot_noise_variances(rig)
        self._stated_sd = np.sqrt(variances)
        self.full = PsdSet(rig, range(len(rig.psds)), tilts)
        self._subsets: dict[tuple[int, ...], PsdSet] = {}  # Bound: sets of at most six PSDs.
        self._pending: dict[tuple[int, ...], tuple[float, ...]] = {}  # Bound: sets of at most six PSDs.
        steps = rig.converter.volts_per_count * rig.sensitivities.ravel()
        self.noise = StreamNoise(self._size, rig.centers, rig.centers + rig.zeros, variances, steps, *self._model())
        self._meters_per_volt = 0.5 * (rig.sensitivities[:, 0] + rig.sensitivities[:, 1])
        self._converter = ConverterSteps.of_rig(rig)
        if on_plate:
            self.noise.look_for_tones(len(rig.psds))
        self._outliers = OutlierSearch(rig.centers, rig.centers + rig.zeros)
        self.excluded: tuple[int, ...] = ()
        self.freedom = 1
        self.contradictions = 0
        self.chi_square = 0.0
        self.poor_fits = 0
        self.vibrating: tuple[Tone, ...] = ()
        self._disturbed, self._moves = False, 0
        self._use_noise()

    def _model(self) -> tuple[FloatArray | None, Residual | None]:
        """Return the slopes at rest and the residuals of the solver's model, None for two PSDs."""
        model = self.full.model
        return (None, None) if model is None else (model.rest_slopes, model.residuals)

    def set_zeros(self, rig: Rig) -> None:
        """Use the zeros of ``rig`` from now on; the checks begin anew."""
        self._rig = rig
        beams = rig.centers + rig.zeros
        self.full.set_geometry(rig)
        self.noise.set_geometry(rig.centers, beams, *self._model())
        self._subsets, self._pending = {}, {}
        self._use_noise()
        self._outliers = OutlierSearch(rig.centers, beams)

    def subset(self, psds: tuple[int, ...], tilts: Tilts) -> PsdSet:
        """Return the set of ``psds`` (from 0), two or more; ``tilts``: as of :class:`PsdSet`."""
        psd_set = self._subsets.get(psds)
        if psd_set is None:
            psd_set = self._subsets[psds] = PsdSet(self._rig, psds, tilts)
            psd_set.set_noise(self.noise)
            if psds in self._pending:
                psd_set.load_state(self._pending.pop(psds))
        return psd_set

    def record(self, fitted: FittedBlock | None, excluded: tuple[int, ...]) -> None:
        """Take what the last block was solved from: its fit, None without one, and the PSDs (from 1) not used."""
        self.excluded, self.vibrating, self._disturbed = excluded, (), fitted is not None
        if fitted is not None:
            self.poor_fits += fitted.poor_fit
            # Blocks of many samples hide the end of a motion that one before them showed.
            self._moves = 2 + self._size // _LONG if fitted.poor_fit else max(self._moves - 1, 0)
            self.vibrating = tuple(self.noise.tones[i] for i in fitted.vibrating)

    def mean_variances(self, present: int) -> tuple[float, ...]:
        """Return the variances (C,), m^2, of the mean of so many samples of each reading."""
        more = self._size / present
        return tuple(more * sd * sd for sd in self.noise.mean_sd().tolist())

    @property
    def limit_factor(self) -> float:
        """Factor on the limits of the checks."""
        return 1.0 if self.noise.measured or not self.on_plate else UNMEASURED

    def check(self, psds: PsdSet, unexplained: Unexplained | None, blamed: Collection[int] | None) -> ConsistencyResult:
        """Check the readings of a block and update the check's state; as :meth:`ConsistencyCheck.update`."""
        result = psds.check.update(unexplained, self.limit_factor, blamed)
        self.contradictions += result.contradict
        self.chi_square, self.freedom = result.chi_square, result.freedom
        return result

    def learn(self, index: int, slots: IntArray, samples: FloatArray, volts: Volts) -> bool:
        """Take a good block into the noise; True if that changed. ``volts`` (n, 3P): x, y, sum of each PSD.

        Nothing of this block's estimate waits for it.
        """
        if not self.on_plate:
            return False
        changed = self._converter.add(volts)
        if changed:
            self._use_steps()
        sums = np.multiply(volts[:, 2::3], self._meters_per_volt, dtype=np.float64)
        changed |= self.noise.add(index, slots, samples, sums)
        if changed:
            self._use_noise()
        return changed

    def _use_steps(self) -> None:
        """Use the steps of the rig file where the samples show none that are coarser."""
        rig = self._rig
        shown = self._converter.steps.reshape(-1, 3)[:, :2]
        steps = np.maximum(shown, rig.converter.volts_per_count) * rig.sensitivities
        self.noise.set_steps(steps.ravel())

    def _use_noise(self) -> None:
        for psds in (self.full, *self._subsets.values()):
            psds.set_noise(self.noise)

    @property
    def vibrates(self) -> str:
        """What the last block could not follow, such as "14 um rms near 87 Hz"; '' if nothing was."""
        return words_of(self.vibrating, self._rig.converter.sample_rate_hz)

    @property
    def findings(self) -> tuple[str, ...]:
        """Return what disturbs the last block: vibration, hum, drift, motion that its polynomials cannot follow."""
        if not self._disturbed:
            return ()
        vibrates = f'vibrates: {self.vibrates}' if self.vibrating else ''
        hum = words_of(self.noise.hum, self._rig.converter.sample_rate_hz)
        moves = f'moves: faster than {self._size} samples show' if self._moves and self.noise.measured else ''
        return tuple(filter(None, (vibrates, f'hum: {hum}' if hum else '', self._drift_words(), moves)))

    def _drift_words(self) -> str:
        slope = np.abs(self.noise.drift.slope)
        rate = float(slope.max()) * self._rig.converter.sample_rate_hz / (SEGMENT_BLOCKS * self._size)
        return f'drifts: {dot_names(len(slope) // 2)[int(slope.argmax())]}, {rate * 1e6:.2g} µm/s' if rate else ''

    def search_outliers(self, index: int, dots: tuple[float, ...], result: ConsistencyResult) -> None:
        """Take a block into the search for a wrong reading: each inconsistent one, of the others every tenth."""
        if len(dots) == 4 and (result.contradict or index % 10 == 0):
            self._outliers.add(dots, result.errors)

    def most_likely_wrong(self) -> str:
        """Return which reading is most likely wrong and what is wrong with it, or '' if unknown."""
        if self.full.model is None:
            return self._outliers.most_likely(float(self.noise.mean_sd().max()))
        names = ' and '.join(f'psd_{psd}' for psd in self.excluded)
        return f'{names} does not fit the others and is left out' if names else ''

    def noise_source(self) -> str:
        """Return where the noise that covariances use comes from, in words."""
        if not self.noise.measured:
            return 'of the rig file until it is measured'
        return 'measured at rest' if self.noise.at_rest else 'measured in motion'

    def words(self) -> tuple[tuple[str, str], ...]:
        """Return rows for /diagnostics: the check of the readings, and the noise against the rig file's."""
        two = self.full.model is None
        freedom = '' if two else f' of {self.freedom} degrees of freedom'
        share = survival(self.chi_square, 1 if two else self.freedom)
        rows = (
            ('chi-square of the readings', f'{self.chi_square:.2f}{freedom}'),
            ('p of that chi-square', f'{share:.2g}'),
            ('blocks whose readings contradict each other', str(self.contradictions)),
            ('blocks with motion that the fit cannot follow', str(self.poor_fits)),
        )
        if not self.on_plate:
            return (*rows, ('covariance from', 'noise of the rig file'))
        source = ('covariance from', f'noise {self.noise_source()}')
        return (*rows, source, ('vibrates', self.vibrates or 'no'), *self._step_words(), *self.noise_words())

    def _step_words(self) -> tuple[tuple[str, str], ...]:
        if not self._converter.steps.any():
            return ()
        stated = self._rig.converter.volts_per_count * 1e3
        shown = zip(channel_names(len(self._rig.psds)), self._converter.steps.tolist(), strict=True)
        words = ', '.join(f'{name} {step * 1e3:.3g} mV' for name, step in shown if step)
        return (('steps of the converter', f'{words} (rig file {stated:.3g} mV)'),)

    def noise_words(self) -> tuple[tuple[str, str], ...]:
        """Return for each reading the noise of a sample and of a block's mean against the rig file's, um."""
        stated = self._stated_sd * 1e6
        names = dot_names(len(stated) // 2)
        rows = zip(names, self.noise.sample_sd(), self.noise.mean_sd(), stated, stated / self._size**0.5, strict=True)
        return tuple(
            (
                f'noise of {name} (um)',
                f'{a * 1e6:.3f} a sample (rig file {file:.3f}), {b * 1e6:.3f} a block ({mean:.3f})',
            )
            for name, a, b, file, mean in rows
        )

    def state_dict(self) -> State:
        """See :class:`psd_deflection.measure.state.Part`."""
        out: State = {MOVES: (float(self._moves),)} if self._moves else {}
        if self.on_plate:
            tones = tuple(v for t in self.noise.tones for v in (t.frequency, *t.covariance.ravel().tolist()))
            hum = tuple(v for h in self.noise.hum for v in (h.frequency, *h.cosine.tolist(), *h.sine.tolist()))
            rows = {NOISE: self.noise.state(), VIBRATION: tones, HUM: hum, SEGMENT: self.noise.segment()}
            rows |= {
                SUMS: self.noise.sums(),
                DRIFT: self.noise.drift.state(),
                CANDIDATES: self.noise.candidates,
                STEPS: self._converter.state(),
            }
            out |= {name: row for name, row in rows.items() if row}
        sets = {self.full.psds: self.full, **self._subsets}
        states = {**self._pending, **{psds: psd_set.state() for psds, psd_set in sets.items()}}
        return out | {PSDS + '_'.join(map(str, psds)): state for psds, state in states.items()}

    def load_state_dict(self, values: Mapping[str, Value]) -> None:
        """See :class:`psd_deflection.measure.state.Part`. Raises ValueError for another block size or other PSDs."""
        if steps := numbers(values, STEPS, 'the steps of these channels'):
            self._converter.set_state(steps)
            self._use_steps()
        self._moves = int((numbers(values, MOVES, 'blocks', 1) or (0.0,))[0])
        if noise := numbers(values, NOISE, 'the noise of this rig'):
            self.noise.hum = _hum(numbers(values, HUM, 'the hum') or (), 2 * len(self._rig.psds))
            self.noise.set_state(noise)
            sums = numbers(values, SUMS, 'sum signals of a segment') or ()
            self.noise.set_segment(numbers(values, SEGMENT, 'blocks of a segment') or (), sums)
            self.noise.tones = _tones(numbers(values, VIBRATION, 'what vibrates') or (), 2 * len(self._rig.psds))
            self.noise.candidates = numbers(values, CANDIDATES, 'frequencies') or ()
            if drift := numbers(values, DRIFT, 'the drift of these readings'):
                self.noise.drift.set_state(drift)
            self._use_noise()
        for name in values:
            if name.startswith(PSDS):
                self._load_set(name, values)

    def _load_set(self, name: str, values: Mapping[str, Value]) -> None:
        count = len(self._rig.psds)
        psds = tuple(int(n) for n in name.removeprefix(PSDS).split('_'))
        if len(psds) < 2 or max(psds) >= count:
            raise ValueError(f'{name}: expected two or more of {count} PSDs')
        if psds == self.full.psds:
            self.full.load_state(numbers(values, name, 'the fit of this rig') or ())
            return
        size = 3 + len(psds) * (6 + len(self.full.fit.state()) // count)
        # They need the method that solves them, so they begin when they are first asked for.
        self._pending[psds] = numbers(values, name, 'the fit of these PSDs', size) or ()
        self._subsets.pop(psds, None)


def _hum(values: tuple[float, ...], count: int) -> tuple[Hum, ...]:
    """Return the hum of ``count`` readings. Raises ValueError if it is that of others."""
    each = 1 + 2 * count
    if len(values) % each:
        raise mismatch(HUM, values, f'{each} numbers for each tone')
    rows = np.reshape(values, (-1, each))
    return tuple(Hum(float(row[0]), row[1 : 1 + count], row[1 + count :]) for row in rows)


def _tones(values: tuple[float, ...], count: int) -> tuple[Tone, ...]:
    """Return the tones of ``count`` readings. Raises ValueError if they are those of others."""
    each = 1 + count * count
    if len(values) % each:
        raise mismatch(VIBRATION, values, f'{each} numbers for each tone')
    rows = np.reshape(values, (-1, each))
    return tuple(Tone(float(row[0]), row[1:].reshape(count, count)) for row in rows)
