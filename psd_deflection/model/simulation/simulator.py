# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The forward model: from loads to converter counts, all at once or in steps of any size with the same bits: states are
kept, every operation is elementwise or a recursive filter, noise is drawn sample by sample."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from psd_deflection.base.errors import ConfigError
from psd_deflection.model.simulation.catalogue import acting, effects_of_rig
from psd_deflection.model.simulation.declaration import ActiveEffect, Point, State
from psd_deflection.model.simulation.modes import Filter, mode_coefficients
from psd_deflection.model.simulation.physics import Physics, dots_on_plate
from psd_deflection.model.simulation.samples import SimulatedSamples, no_samples_between
from psd_deflection.model.solvers.registry import check_arrangement
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.rig.wiring import Wiring

BEFORE_PLATE: tuple[Point, ...] = ('configure', 'load', 'static', 'pose', 'beam')
"""Where an effect acts before the dots fall on the plate."""

PIECE = 20_000
"""Samples of a piece of :meth:`ForwardModel.expect_in_pieces`: shorter ones are more calls, longer ones leave the
processor's cache."""


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedStep:
    """The result of :meth:`RigSimulator.step` for n samples.

    ``counts`` int32 (n, 3P): converter counts in the order of ``channel_names``. ``pose`` (n, 3): true
    dX m, dY m, theta rad. ``dots`` (n, 2P): true x1 y1 x2 y2 ... on the plate, m.
    """

    counts: npt.NDArray[np.int32]
    pose: FloatArray
    dots: FloatArray


class ForwardModel:
    """The stages without noise and converter; keeps its state between calls.

    ``effects``: the active effects; by default those of the rig file. ``phase``: quantities are taken this
    long after each sample, s. ``steady``: the link comes to rest under each load before it is read. ``ahead``: of how
    many later samples one takes a reading; a history is then simulated at once.
    """

    def __init__(
        self, rig: Rig, effects: Sequence[ActiveEffect] | None = None, phase: float = 0.0, *, steady: bool = False
    ) -> None:
        self.effects = acting(effects_of_rig(rig) if effects is None else effects)
        self.physics = Physics.of(rig)
        self.physics.phase = phase
        self._rig = rig
        self._between: dict[tuple[int, float], ForwardModel] = {}
        self._asked: dict[tuple[int, float], FloatArray] = {}
        for active in self.effects:
            if active.effect.configure is not None:
                active.effect.configure(self.physics, active.values)
        p = self.physics
        ahead = [a.effect.ahead(p, a.values) for a in self.effects if a.effect.ahead is not None]
        # Between samples an effect asks for the readings of its own PSD alone.
        self.ahead = max(ahead, default=0) if phase == 0.0 else 0
        bending = mode_coefficients(p.bending_frequency, p.bending_damping_ratio, p.period, phase)
        torsion = mode_coefficients(p.torsion_frequency, p.torsion_damping_ratio, p.period, phase)
        self._at_rest = p.at_rest
        self._modes = (Filter(bending, self._at_rest[0]), Filter(bending, self._at_rest[1]), Filter(torsion))
        self._steady = steady
        self._states: list[State] = [{} for _ in self.effects]
        self._count = 0
        self._first_temperature: float | None = None

    @property
    def in_pieces(self) -> bool:
        """Whether a long history may be simulated piece after piece: no sample depends on later ones."""
        return not self.ahead and not any(active.effect.full for active in self.effects)

    @property
    def moving(self) -> list[ActiveEffect]:
        """The effects that decide where the dots fall on the plate: those of constants, loads, link and beams."""
        return [a for a in self.effects if a.effect.configure is not None or a.effect.point in BEFORE_PLATE]

    def run(
        self, loads: FloatArray, temperature: FloatArray | None = None, moved: SimulatedSamples | None = None
    ) -> SimulatedSamples:
        """The next n samples, up to the amplifier's volts: ``loads`` (n, 3) N, N, N m.

        ``temperature`` (n,), degrees Celsius; None is a steady one. ``moved``: these samples up to the dots on the
        plate, by a model of the same ``moving`` effects, which are then not simulated again. Raises ConfigError for a
        second call if an effect looks ahead.
        """
        if self.ahead and len(loads):
            if self._count:
                raise ConfigError(
                    'effects: a PSD that is early is simulated with all loads at once; a running rig has none'
                )
            n = len(loads)
            loads = np.concatenate((loads, np.repeat(loads[-1:], self.ahead, axis=0)))
            if temperature is not None:
                temperature = np.concatenate((temperature, np.repeat(temperature[-1:], self.ahead)))
            return self._read(self._moved(loads, temperature), loads, temperature).first(n)
        samples = self._moved(loads, temperature) if moved is None else moved.up_to_plate(self.physics)
        return self._read(samples, loads, temperature)

    def _moved(self, loads: FloatArray, temperature: FloatArray | None) -> SimulatedSamples:
        """Samples up to the dots on the plate."""
        n = len(loads)
        p = self.physics
        warmer = np.zeros(n)
        if temperature is not None and n:
            if self._first_temperature is None:
                self._first_temperature = float(temperature[0])
            warmer = temperature - self._first_temperature
        t = np.arange(self._count, self._count + n, dtype=np.float64) * p.period
        if p.phase > 0.0:
            t += p.phase
        self._count += n
        samples = SimulatedSamples(t, warmer, np.array(np.asarray(loads, dtype=np.float64).T, order='C'), p)
        self._at('load', samples)
        samples.static = np.empty((3, n))
        samples.static[0] = samples.loads[0] * p.force_compliance
        samples.static[1] = samples.loads[1] * p.force_compliance
        samples.static[2] = samples.loads[2] * p.torque_compliance
        self._at('static', samples)
        samples.pose = np.empty((3, n))
        for axis, mode in enumerate(self._modes):
            held = samples.static[axis] + self._at_rest[axis] if axis < 2 else samples.static[axis]
            samples.pose[axis] = held if self._steady else mode(held)
        self._at('pose', samples)
        samples.beams = np.broadcast_to(p.beams.reshape(-1, 1), (p.beams.size, n))
        if any(active.effect.point == 'beam' for active in self.effects):
            samples.beams = samples.beams.copy()
            self._at('beam', samples)
        samples.true_dots = dots_on_plate(samples.pose, samples.beams, p)
        return samples

    def _read(self, samples: SimulatedSamples, loads: FloatArray, temperature: FloatArray | None) -> SimulatedSamples:
        """From the dots on the plate to the volts."""
        n = len(loads)
        self._asked = {}
        p = self.physics
        samples.dots = samples.true_dots.copy()
        psds = len(p.centers)
        samples.sums = np.full((psds, n), p.sum_nominal)
        self._at('dots', samples)
        samples.volts = np.empty((3 * psds, n))
        samples.noise = np.zeros(3 * psds)
        for psd in range(psds):
            dots = samples.dots[2 * psd : 2 * psd + 2]
            np.divide(dots, p.sensitivity[psd, :, None], out=samples.volts[3 * psd : 3 * psd + 2])
            samples.volts[3 * psd + 2] = samples.sums[psd]
            if p.dark[psd, 2] > 0.0:
                _add_light(samples.volts[3 * psd : 3 * psd + 3], p.dark[psd])
        for i, active in enumerate(self.effects):
            if active.effect.point == 'volts':
                samples.between = partial(self._volts_between, i, samples, loads, temperature)
                self._apply(i, samples)
        # It holds the samples: a circle that would keep them in memory until Python looks for circles.
        samples.between = no_samples_between
        return samples

    def _volts_between(
        self, before: int, samples: SimulatedSamples, loads: FloatArray, temperature: FloatArray | None, phase: float
    ) -> FloatArray:
        """The volts (3P, n) ``phase`` s after each sample, by the effects before effect number ``before``."""
        if phase == self.physics.phase:
            return samples.volts.copy()
        key = (before, phase)
        if key not in self._between:
            self._between[key] = ForwardModel(self._rig, self.effects[:before], phase, steady=self._steady)
        if key not in self._asked:
            self._asked[key] = self._between[key].run(loads, temperature).volts
        return self._asked[key].copy()

    def finish(self, samples: SimulatedSamples) -> None:
        """Apply the effects that act on the noisy signal: clipping and coarse steps."""
        self._at('output', samples)

    def expect(
        self, loads: FloatArray, temperature: FloatArray | None = None, moved: SimulatedSamples | None = None
    ) -> SimulatedSamples:
        """Like :meth:`run`, then the mean of the output over the rig's noise.

        Values beyond the converter's range are limited to its ends, as in a recording.
        """
        samples = self.run(loads, temperature, moved)
        samples.noise = self.physics.noise
        self.finish(samples)
        full = self.physics.full_scale
        np.clip(samples.volts, -full, full - self.physics.volts_per_count, out=samples.volts)
        return samples

    def expect_in_pieces(
        self,
        loads: FloatArray,
        temperature: FloatArray | None = None,
        unit: int = 1,
        moved: Sequence[SimulatedSamples] = (),
    ) -> Iterator[tuple[slice, SimulatedSamples]]:
        """(which samples, these m samples) of a long history, piece after piece, each as by :meth:`expect`.

        A piece is a multiple of ``unit`` samples, but for the last, and so short that what is computed for it stays
        in the processor's cache. ``moved``: the pieces as by :meth:`run`.
        """
        n = len(loads)
        size = max(1, PIECE // unit) * unit if self.in_pieces else n
        for number, first in enumerate(range(0, n, max(1, size))):
            at = slice(first, min(first + size, n))
            warm = None if temperature is None else temperature[at]
            yield at, self.expect(loads[at], warm, moved[number] if moved else None)

    def _at(self, point: str, samples: SimulatedSamples) -> None:
        for i, active in enumerate(self.effects):
            if active.effect.point == point:
                self._apply(i, samples)

    def _apply(self, number: int, samples: SimulatedSamples) -> None:
        active = self.effects[number]
        if active.effect.apply is not None:
            active.effect.apply(samples, active.values, self._states[number])


class RigSimulator:
    """The rig with its noise and converter, sample after sample.

    The same ``rig`` and ``seed`` give the same samples however the loads are cut into steps. ``rig`` is the true one:
    its wiring says which channel a detector's volts really are on. Raises ConfigError if the rig contradicts itself
    about where the PSDs are. ``effects``, ``ahead``: as of :class:`ForwardModel`.
    """

    def __init__(self, rig: Rig, seed: int = 0, effects: Sequence[ActiveEffect] | None = None) -> None:
        check_arrangement(rig)
        self._model = ForwardModel(rig, effects)
        self._noise = np.random.default_rng(seed)
        self._wiring = Wiring.from_rig(rig)
        self.ahead = self._model.ahead

    def step(
        self, loads: FloatArray, temperature: FloatArray | None = None, noise: FloatArray | None = None
    ) -> SimulatedStep:
        """The next n samples: ``loads`` (n, 3) Fx N, Fy N, Tz N m at the tip centroid.

        ``temperature`` (n,), degrees Celsius, or None. ``noise`` (n, 3P): V, in place of the rig's.
        """
        samples = self._model.run(loads, temperature)
        p = self._model.physics
        if noise is None:
            noise = p.noise * self._noise.standard_normal((len(loads), len(p.noise)))
        samples.volts += noise.T
        self._model.finish(samples)
        limit = round(p.full_scale / p.volts_per_count)
        volts = self._wiring.to_device(samples.volts.T)
        counts = np.clip(np.rint(volts / p.volts_per_count), -limit, limit - 1).astype(np.int32)
        return SimulatedStep(
            np.ascontiguousarray(counts),
            np.ascontiguousarray(samples.pose.T),
            np.ascontiguousarray(samples.true_dots.T),
        )


def _add_light(volts: FloatArray, dark: FloatArray) -> None:
    """Add the light of ``dark`` (3,) V to ``volts`` (3, n), x y sum of a PSD. Currents add; x and y are quotients."""
    laser, level = volts[2].copy(), dark[2]
    volts[:2] = (laser * volts[:2] + level * dark[:2, None]) / (laser + level)
    volts[2] += level
