# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The dots of one block at its stamp and how sure they are: by the rule that the rig asks for.

Joins what is measured of the noise (:mod:`psd_deflection.measure.uncertainty.noise`), the fit through the block
(:mod:`psd_deflection.measure.uncertainty.block_fit`) and the check of the readings against each other
(:mod:`psd_deflection.measure.uncertainty.consistency`, of more than two PSDs
:mod:`psd_deflection.measure.uncertainty.redundancy`), and tells what they remember.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from psd_deflection.base.arithmetic import FIXED
from psd_deflection.measure.memory import Memory, Value, misfit, numbers
from psd_deflection.measure.uncertainty.block_fit import BlockFit, Fitted
from psd_deflection.measure.uncertainty.combinations import Left
from psd_deflection.measure.uncertainty.consistency import LIMIT, UNMEASURED, Consistency, ConsistencyCheck, Suspect
from psd_deflection.measure.uncertainty.converter import ConverterSteps, Volts
from psd_deflection.measure.uncertainty.noise import StreamNoise
from psd_deflection.measure.uncertainty.redundancy import Redundancy, survival
from psd_deflection.measure.uncertainty.vibration import Tone, words_of
from psd_deflection.model.detector import dot_noise_variances
from psd_deflection.model.plate.plate import Tilts, flat_points, flat_poses, plate_points, reading_slopes, tied_pose
from psd_deflection.records import FloatArray, IntArray, channel_names, dot_names
from psd_deflection.rig.config import Rig

NOISE, SEGMENT = 'state.noise', 'state.noise_segment'
FIT, HELD_RESIDUAL = 'state.block_fit', 'state.residual'
VIBRATION, SUMS, STEPS = 'state.vibration', 'state.sums_segment', 'state.converter_steps'
REDUNDANCY, SOME = 'state.redundancy', 'state.psds.'
"""Names under which :meth:`StampedDots.memory` tells what is remembered; ``SOME`` goes on with the
PSDs (from 0) that are kept."""


_STEPS = 7
"""Steps from rest that leave less than the last digit of a nanometre, at the largest poses."""


class PlateModel:
    """Where the beams of some PSDs meet the plate, as far as a method knows. ``beams`` (P, 2), m."""

    def __init__(self, rig: Rig, kept: Sequence[int], tilts: Tilts) -> None:
        """``kept``: PSDs (from 0). ``tilts``: what the method says of the plate's tilts."""
        at = list(kept)
        self._by = FIXED
        self._centers, self._heights = rig.centers[at], rig.heights[at]
        self.beams = self._centers + rig.zeros[at]
        self._tilts: Tilts = tilts
        self._link = rig.link.slope_ratio, rig.link.length
        self._tie = 0.0 if tilts == 'none' else rig.link.slope_ratio
        self._gain = self._by.pseudo_inverse(self.slopes_at((0.0,) * 5))

    def slopes_at(self, pose: Sequence[float]) -> FloatArray:
        """How the readings go with what is solved for (C, unknowns) at ``pose``: dX, dY m, theta, phi, omega rad."""
        return reading_slopes(self.beams, self._heights, np.array(pose), self._tilts, *self._link, self._by)

    def left(self, dots: FloatArray) -> FloatArray:
        """What the best pose leaves of ``dots`` (n, C), m, all readings of one weight."""
        points = self._centers + dots.reshape(len(dots), -1, 2)
        heights = self._heights if self._tilts != 'none' else np.zeros(len(self._heights))
        unknowns = np.zeros((len(dots), self._gain.shape[0]))
        # The slopes at rest are right to some per cent, so each step leaves some per cent of the error before it.
        for _ in range(_STEPS):
            pose = unknowns if self._tilts == 'free' else tied_pose(unknowns, self._tie, self._link[1])
            there = plate_points(pose, self.beams, heights, self._by)
            left: FloatArray = (points - there).reshape(len(dots), -1)
            unknowns = unknowns + self._by.einsum('us,ns->nu', self._gain, left)
        return left

    def residual(self, dots: tuple[float, ...], residual: tuple[float, ...]) -> tuple[float, ...]:
        """What a pose near the best leaves of ``dots`` (C,), m; ``residual``: what the method leaves.

        A method for small angles leaves its own error besides: of a flat plate it is computed anew.
        """
        if self._tilts != 'none':
            return residual
        points = self._centers + np.reshape(dots, (-1, 2))
        left = points - flat_points(flat_poses(points, self.beams, self._by), self.beams, self._by)
        return tuple(left.ravel().tolist())


class SomePsds:
    """The fit and the check of some of a rig's PSDs, while the others cannot be believed.

    ``columns``: of their readings among all.
    """

    def __init__(self, rig: Rig, kept: Sequence[int], tilts: Tilts) -> None:
        """``kept``: PSDs (from 0), two or more. ``tilts``: what the method says that solves them."""
        at = list(kept)
        self.columns = [2 * psd + axis for psd in at for axis in (0, 1)]
        self._model = PlateModel(rig, at, tilts)
        rest = self._model.slopes_at((0.0,) * 5)
        by = FIXED
        self.fit = BlockFit(rig.estimator.block_size, rig.centers[at], self._model.beams, rest, by)
        # Of a plate whose tilt is not known, dots may contradict each other.
        unknowns = 2 * len(at) if tilts == 'bounded' else rest.shape[1]
        self._redundancy = Redundancy(len(at), unknowns, by)

    def set_noise(self, noise: StreamNoise) -> None:
        """Use their part of what is known of all readings."""
        own = np.ix_(self.columns, self.columns)
        self.fit.set_noise(noise.gamma[own], [Tone(t.frequency, t.covariance[own]) for t in noise.tones])

    def check(
        self,
        dots: tuple[float, ...],
        residual: tuple[float, ...],
        covariance: FloatArray,
        pose: Sequence[float],
        times: float,
        agree_without: Callable[[int], bool] | None,
    ) -> ConsistencyCheck:
        """As :meth:`StampedDots.check`; ``times``: as :meth:`Redundancy.check`."""
        slopes = self._model.slopes_at(pose)
        return self._redundancy.check(self._model.residual(dots, residual), slopes, covariance, times, agree_without)

    def agree(
        self,
        dots: tuple[float, ...],
        residual: tuple[float, ...],
        covariance: FloatArray,
        pose: Sequence[float],
        times: float,
    ) -> bool:
        """Whether these readings agree with each other, and are enough to tell."""
        slopes = self._model.slopes_at(pose)
        return self._redundancy.agrees(self._model.residual(dots, residual), slopes, covariance, times)

    def state(self) -> tuple[float, ...]:
        """What :meth:`set_state` needs to go on from here."""
        check = self._redundancy.state()
        return (float(len(check)), *check, *self.fit.state())

    def set_state(self, values: tuple[float, ...]) -> None:
        """Go on from :meth:`state` of another one. Raises ValueError if it was of other PSDs or another block size."""
        head = 1 + int(values[0])
        self._redundancy.set_state(values[1:head])
        self.fit.set_state(values[head:])


class StampedDots:
    """Dots at the stamp of block after block.

    ``contradictions``: blocks whose readings contradict each other. ``misfits``: blocks with motion that the fit cannot
    follow. ``chi_square``: of the last block's readings, of ``freedom`` degrees. ``left_out``: PSDs (from 1) without
    which the last block was solved. ``vibrates``: what is faster than a block can follow, such as "14 um rms near
    87 Hz"; '' if nothing is.
    """

    part = 'the fit and the noise of the dots'
    remembers = (NOISE, FIT, HELD_RESIDUAL, REDUNDANCY, SOME, VIBRATION, SUMS, STEPS)

    def __init__(self, rig: Rig, flat: bool = True, tilts: Tilts = 'none') -> None:
        """``flat``: the PSDs are on the plate, and the base line between the dots keeps its length.

        ``tilts``: what the rig's solver says of the plate's tilts; it counts for more than two PSDs.
        """
        config = rig.estimator
        self._rig = rig
        self.flat = flat
        by = self._by = FIXED
        # What does not move with the link tells the noise.
        self._measures = flat
        self._beams = rig.centers + rig.zeros
        variances = dot_noise_variances(rig)
        steps = rig.converter.volts_per_count * rig.sensitivities.ravel()
        self._tilts: Tilts = tilts
        self._all: PlateModel | None = None
        slopes = self._rest_slopes(rig)
        self.noise = StreamNoise(config.block_size, rig.centers, self._beams, variances, steps, slopes, self._left, by)
        self._volt: FloatArray | None = None
        if self._measures:
            self._volt = 0.5 * (rig.sensitivities[:, 0] + rig.sensitivities[:, 1])
            self.noise.look_for_tones(len(rig.psds))
        self._converter: ConverterSteps | None = None
        if self._measures:
            self._converter = ConverterSteps.of_rig(rig)
        self._stated_sd = np.sqrt(variances)
        self._fit = BlockFit(config.block_size, rig.centers, self._beams, slopes, by)
        self._fit.set_noise(self.noise.gamma)
        self._consistency = Consistency(self._by)
        self._suspect = Suspect(rig.centers, self._beams)
        self._redundancy = None if slopes is None else self._check_of(slopes)
        self._some: dict[tuple[int, ...], SomePsds] = {}
        self._told: dict[tuple[int, ...], tuple[float, ...]] = {}
        self.left_out: tuple[int, ...] = ()
        self.freedom = 1
        self._size = config.block_size
        self.vibrates = ''
        self.contradictions = 0
        self.chi_square = 0.0
        self.misfits = 0
        (x1, y1), (x2, y2) = rig.centers[:2].tolist()
        self._apart = (x1 - x2, y1 - y2)

    def set_zeros(self, rig: Rig) -> None:
        """Take the rig's zeros from now on."""
        self._rig = rig
        self._beams = rig.centers + rig.zeros
        slopes = self._rest_slopes(rig)
        self.noise.set_geometry(rig.centers, self._beams, slopes, self._left)
        self._fit.set_geometry(rig.centers, self._beams, slopes)
        self._use_noise()
        self._suspect = Suspect(rig.centers, self._beams)
        self._consistency = Consistency(self._by)
        if slopes is not None:
            self._redundancy = self._check_of(slopes)
            self._some, self._told = {}, {}

    def _check_of(self, slopes: FloatArray) -> Redundancy:
        psds, unknowns = len(self._rig.psds), slopes.shape[1]
        return Redundancy(psds, unknowns, self._by)

    @property
    def _left(self) -> Left | None:
        return None if self._all is None else self._all.left

    def _rest_slopes(self, rig: Rig) -> FloatArray | None:
        """Of more than two PSDs how the readings go with what is solved for, at rest."""
        if len(rig.psds) == 2:
            return None
        self._all = PlateModel(rig, range(len(rig.psds)), self._tilts)
        return self._all.slopes_at((0.0,) * 5)

    def some(self, kept: tuple[int, ...], tilts: Tilts) -> SomePsds:
        """The fit and the check of the PSDs ``kept`` (from 0), two or more; ``tilts``: as of :class:`SomePsds`."""
        found = self._some.get(kept)
        if found is None:
            found = self._some[kept] = SomePsds(self._rig, kept, tilts)
            found.set_noise(self.noise)
            if kept in self._told:
                found.set_state(self._told.pop(kept))
        return found

    def fit_some(self, some: SomePsds, slots: IntArray, samples: FloatArray) -> Fitted:
        """The dots of some PSDs at the middle of a block; ``samples`` (n, C) m of all."""
        fitted = some.fit.fit(slots, samples[:, some.columns])
        self.misfits += fitted.misfit
        return fitted

    def fit(self, slots: IntArray, samples: FloatArray) -> Fitted:
        """The dots at the middle of a block. ``slots`` (n,): which samples are present; ``samples`` (n, C), m."""
        fitted = self._fit.fit(slots, samples)
        self.misfits += fitted.misfit
        return fitted

    def mean_variances(self, present: int) -> tuple[float, ...]:
        """Variance (C,), m^2, of the mean of that many samples of each reading."""
        more = self._size / present
        return tuple(more * sd * sd for sd in self.noise.mean_sd().tolist())

    def check(
        self,
        dots: tuple[float, ...],
        residual: tuple[float, ...],
        covariance: FloatArray,
        pose: Sequence[float] = (),
        some: SomePsds | None = None,
        agree_without: Callable[[int], bool] | None = None,
    ) -> ConsistencyCheck:
        """Hold the readings of a block against each other; ``pose``: dX, dY m, theta, phi, omega rad.

        ``some``: it is theirs. ``agree_without``: as :meth:`Redundancy.check` has it. :attr:`Checked.wrong` counts
        among those that are checked.
        """
        times = self._times
        if some is not None:
            checked = some.check(dots, residual, covariance, pose, times, agree_without)
        elif self._redundancy is not None and self._all is not None:
            slopes = self._all.slopes_at(pose)
            left = self._all.residual(dots, residual)
            checked = self._redundancy.check(left, slopes, covariance, times, agree_without)
        else:
            x1, y1, x2, y2 = dots
            ax, ay = self._apart
            checked = self._consistency.check((ax + x1 - x2, ay + y1 - y2), residual, covariance, limit=times * LIMIT)
        self.contradictions += checked.contradict
        self.chi_square, self.freedom = checked.chi_square, checked.freedom
        return checked

    @property
    def _times(self) -> float:
        """By how much more a chi-square may be than with known noise."""
        return 1.0 if self.noise.measured or not self._measures else UNMEASURED

    def agree(
        self,
        some: SomePsds,
        dots: tuple[float, ...],
        residual: tuple[float, ...],
        covariance: FloatArray,
        pose: Sequence[float],
    ) -> bool:
        """Whether the readings of some PSDs agree with each other, and are enough to tell."""
        return some.agree(dots, residual, covariance, pose, self._times)

    def learn(self, index: int, slots: IntArray, samples: FloatArray, volts: Volts) -> bool:
        """Take a good block into what is known of the noise; True if that changed. ``volts`` (n, 3P): x y sum of each.

        Nothing of this block's estimate waits for it.
        """
        if not self._measures:
            return False
        changed = self._converter is not None and self._converter.add(volts)
        if changed:
            self._use_steps()
        sums = None if self._volt is None else np.multiply(volts[:, 2::3], self._volt, dtype=np.float64)
        changed |= self.noise.add(index, slots, samples, sums)
        if not changed:
            return False
        self._use_noise()
        for some in self._some.values():
            some.set_noise(self.noise)
        return True

    def _use_steps(self) -> None:
        """Those of the rig file where the samples show none that are coarser."""
        if self._converter is None:
            return
        rig = self._rig
        seen = self._converter.steps.reshape(-1, 3)[:, :2]
        steps = np.maximum(seen, rig.converter.volts_per_count) * rig.sensitivities
        self.noise.set_steps(steps.ravel())

    def _use_noise(self) -> None:
        self._fit.set_noise(self.noise.gamma, self.noise.tones)
        self.vibrates = words_of(self.noise.tones, self._rig.converter.sample_rate_hz)

    def suspect(self, index: int, dots: tuple[float, ...], checked: ConsistencyCheck) -> None:
        """Take a block into the search for a wrong reading: each that contradicts itself, of the others some."""
        if len(dots) == 4 and (checked.contradict or index % 10 == 0):
            self._suspect.add(dots, checked.errors)

    def most_likely_wrong(self) -> str:
        """The reading that is most likely wrong and what is wrong with it, or '' if it cannot be told."""
        if self._redundancy is None:
            return self._suspect.most_likely(float(self.noise.mean_sd().max()))
        names = ' and '.join(f'psd_{psd}' for psd in self.left_out)
        return f'{names} does not fit the others and is left out' if names else ''

    def noise_source(self) -> str:
        """Where the noise that covariances use comes from, in words."""
        if not self.noise.measured:
            return 'of the rig file until it is measured'
        return 'measured at rest' if self.noise.at_rest else 'measured in motion'

    def words(self) -> tuple[tuple[str, str], ...]:
        """For /diagnostics: the check of the readings, and the noise against the rig file's."""
        return (
            ('chi-square of the readings', f'{self.chi_square:.2f}' + self._of_freedom()),
            ('p of that chi-square', f'{self._p_value():.2g}'),
            ('blocks whose readings contradict each other', str(self.contradictions)),
            ('blocks with motion that the fit cannot follow', str(self.misfits)),
            ('covariance from', f'noise {self.noise_source()}' if self._measures else 'noise of the rig file'),
            *((('vibrates', self.vibrates or 'no'),) if self._volt is not None else ()),
            *self._step_words(),
            *(self.noise_words() if self._measures else ()),
        )

    def _p_value(self) -> float:
        """Share of sound blocks with a larger chi-square."""
        if self._redundancy is not None:
            return survival(self.chi_square, self.freedom)
        # The survival function for one degree of freedom.
        return math.erfc(math.sqrt(0.5 * self.chi_square))

    def _of_freedom(self) -> str:
        """With two PSDs it is always one degree."""
        return '' if self._redundancy is None else f' of {self.freedom} degrees of freedom'

    def _step_words(self) -> tuple[tuple[str, str], ...]:
        if self._converter is None or not self._converter.steps.any():
            return ()
        said = self._rig.converter.volts_per_count * 1e3
        seen = zip(channel_names(len(self._beams)), self._converter.steps.tolist(), strict=True)
        words = ', '.join(f'{name} {step * 1e3:.3g} mV' for name, step in seen if step)
        return (('steps of the converter', f'{words} (rig file {said:.3g} mV)'),)

    def noise_words(self) -> tuple[tuple[str, str], ...]:
        """Of each reading, the noise of a sample and of a block's mean against the rig file's, um."""
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

    def memory(self) -> Memory:
        """What the next block depends on."""
        out: Memory = {}
        if self._measures:
            out[NOISE] = self.noise.state()
            if self.noise.tones:
                out[VIBRATION] = tuple(
                    v for t in self.noise.tones for v in (t.frequency, *t.covariance.ravel().tolist())
                )
            if segment := self.noise.segment():
                out[SEGMENT] = segment
                if sums := self.noise.sums():
                    out[SUMS] = sums
        if self._converter is not None and (steps := self._converter.state()):
            out[STEPS] = steps
        out[FIT] = self._fit.state()
        said = self._consistency
        residual = (said.held, said.mean, said.lasting) if self._rig.estimator.consistency == 'widen' else (said.held,)
        if any(residual):
            out[HELD_RESIDUAL] = residual
        if self._redundancy is not None and any(state := self._redundancy.state()):
            out[REDUNDANCY] = state
        for kept, state in {**self._told, **{kept: some.state() for kept, some in self._some.items()}}.items():
            out[SOME + '_'.join(map(str, kept))] = state
        return out

    def restore(self, values: Mapping[str, Value]) -> None:
        """Go on from another one's :meth:`memory`. Raises ValueError if it had another block size or other PSDs."""
        steps = numbers(values, STEPS, 'the steps of these channels')
        if steps and self._converter is not None:
            self._converter.set_state(steps)
            self._use_steps()
        if noise := numbers(values, NOISE, 'the noise of this rig'):
            self.noise.set_state(noise)
            # Recordings from before segments were told began a new one.
            sums = numbers(values, SUMS, 'sum signals of a segment') or ()
            self.noise.set_segment(numbers(values, SEGMENT, 'blocks of a segment') or (), sums)
            self.noise.tones = _tones(numbers(values, VIBRATION, 'what vibrates') or (), 2 * len(self._beams))
            self._use_noise()
        if fit := numbers(values, FIT, 'the fit of this rig'):
            self._fit.set_state(fit)
        if residual := numbers(values, HELD_RESIDUAL, 'what the residual was lately', 1, 3):
            # Recordings from before the mean was kept have the first alone.
            held, mean, lasting = (*residual, 0.0, 0.0)[:3]
            self._consistency.held, self._consistency.mean, self._consistency.lasting = held, mean, lasting
        if check := numbers(values, REDUNDANCY, 'the check of more than two PSDs'):
            if self._redundancy is None:
                raise misfit(REDUNDANCY, check, 'none with two PSDs')
            self._redundancy.set_state(check)
        for name in values:
            if name.startswith(SOME):
                kept = self._kept_of(name)
                own = 6 + len(self._fit.state()) // len(self._beams)
                count = 3 + own * len(kept)
                # They need the method that solves them, so that they begin when they are first asked for.
                self._told[kept] = numbers(values, name, 'the fit of these PSDs', count) or ()
                self._some.pop(kept, None)

    def _kept_of(self, name: str) -> tuple[int, ...]:
        """The PSDs (from 0) of a name that begins with ``SOME``. Raises ValueError if this rig has not got them."""
        kept = tuple(int(n) for n in name.removeprefix(SOME).split('_'))
        if len(kept) < 2 or max(kept) >= len(self._beams):
            raise ValueError(f'{name}: expected two or more of {len(self._beams)} PSDs')
        return kept


def _tones(values: tuple[float, ...], count: int) -> tuple[Tone, ...]:
    """Tones of ``count`` readings of what was told of them. Raises ValueError if they were of others."""
    each = 1 + count * count
    if len(values) % each:
        raise misfit(VIBRATION, values, f'{each} numbers for each tone')
    rows = np.reshape(values, (-1, each))
    return tuple(Tone(float(row[0]), row[1:].reshape(count, count)) for row in rows)
