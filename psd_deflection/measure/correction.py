# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Corrects the dots for known errors of sensors and optics, so that the estimate improves too.

A solver assumes the nominal rig. If the rig file lists effects of the detectors and the optics,
each reading is corrected in two steps. First the effects of the detectors are inverted (background
light, gain, cross-talk, non-linearity, rotation, temperature). Then the pose is computed from these
dots, and the difference between the true and the nominal optics at that pose is subtracted (places
of PSDs and beams, wandering beams, tilt). The result is the dots that a nominal, flat, perfectly
placed rig would have shown.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from psd_deflection.base.arithmetic import FIXED
from psd_deflection.base.errors import ConfigError
from psd_deflection.measure.state import State, Value, mismatch
from psd_deflection.model.plate.plate import flat_poses
from psd_deflection.model.simulation.catalogue import acting, effects_of_rig
from psd_deflection.model.simulation.declaration import ActiveEffect, Reading, Use, Values
from psd_deflection.model.simulation.physics import Physics, dots_on_plate
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.records import ENVIRONMENT, FloatArray, IntArray
from psd_deflection.rig.config import Rig

PASSES = 3
"""Fixed-point passes for the pose; each reduces the error by the relative size of the effect (< 1
%).
"""
OPTICS = ('centers', 'beams', 'slopes', 'heights', 'slope_ratio')
"""The constants that decide where the beams meet the plate (fields of :class:`Physics`)."""


START, FIRST_TEMPERATURE, TEMPERATURE = ENVIRONMENT


class Surroundings:
    """What corrections depend on besides the samples: when they began, how warm it was then and is now.

    ``known``: the values by name, as far as they are known (:data:`psd_deflection.records.ENVIRONMENT`).
    """

    part = 'what is known of the surroundings'
    prefixes = ENVIRONMENT

    def __init__(self) -> None:
        self.known: dict[str, float] = {}  # Bound: our own names.

    @property
    def warmer(self) -> float:
        """K above the first temperature; 0 while none is known."""
        return self.known.get(TEMPERATURE, 0.0) - self.known.get(FIRST_TEMPERATURE, 0.0)

    def seconds(self, t_ns: IntArray) -> FloatArray:
        """Time (n,) s since the first sample, of the times ``t_ns`` (n,)."""
        since: FloatArray = (t_ns - self.known.get(START, float(t_ns[0]))) * np.float64(1e-9)
        return since

    def state_dict(self) -> State:
        """What is known."""
        return dict(self.known)

    def load_state_dict(self, values: Mapping[str, Value]) -> None:
        """Take what another one knew. Raises ValueError if one of ``values`` is no number."""
        for name, value in values.items():
            if not isinstance(value, (int, float)):
                raise mismatch(name, value, 'a number')
            self.known[name] = float(value)


class Correction:
    """Corrects dots for the effects that a rig file lists. Make it with :meth:`from_rig`.

    Raises ConfigError if an effect fails on a reading, or reads time or temperature without
    declaring it.
    """

    def __init__(self, rig: Rig, effects: Sequence[ActiveEffect]) -> None:
        self._nominal, self._true = Physics.of(rig), Physics.of(rig)
        self._xp = self._nominal.xp = self._true.xp = FIXED
        # The solvers take every beam as parallel to Z.
        self._nominal.slopes = np.zeros_like(self._nominal.slopes)
        self._psds = len(rig.psds)
        self._sensors: list[tuple[Callable[[Reading, Values], None], Values]] = []  # Bound: the rig: at most six.
        self._beams: list[ActiveEffect] = []  # Bound: the rig: at most six.
        self._moves_optics = bool(self._true.slopes.any())
        if self._moves_optics and self._true.psds_at_base:
            raise ConfigError('beam_N.angle: a beam that leans is not corrected for PSDs at the base; set it to 0')
        uses: set[Use] = set()
        for active in acting(effects):
            try:
                corrects = self._add(active)
            except ConfigError:
                raise
            except Exception as error:
                # The effect may be a user's own file. Fail here, not at the first block of a run.
                raise ConfigError(
                    f'effects: {active.label}: fails on a reading ({type(error).__name__}: {error}); '
                    f'an effect that reads t or warmer must declare it in uses'
                ) from error
            uses |= active.effect.uses if corrects else frozenset()
        self.uses_time = 'time' in uses
        """Whether a corrected effect depends on time."""
        self.uses_temperature = 'temperature' in uses
        """Whether a corrected effect depends on temperature."""

    @classmethod
    def from_rig(cls, rig: Rig) -> Correction:
        """The correction for the effects of ``rig``; raises ConfigError if they are malformed."""
        return cls(rig, effects_of_rig(rig))

    @property
    def active(self) -> bool:
        """Whether there is anything to correct."""
        return bool(self._sensors) or self._moves_optics

    def _add(self, active: ActiveEffect) -> bool:
        """Add an effect; returns whether it needs a correction.

        The effect is run on two samples. If it does not declare time or temperature, they are
        missing here, because in a run they would silently be zeros.
        """
        effect, before = active.effect, _optics(self._true)
        t, warmer = (np.zeros(2 if use in effect.uses else 0) for use in ('time', 'temperature'))
        if effect.configure is not None:
            effect.configure(self._true, active.values)
        if effect.point == 'beam':
            self._wandered([active], t, warmer, 2)
            self._beams.append(active)
        if effect.correct is not None:
            sums = np.full((self._psds, 2), self._nominal.sum_nominal)
            effect.correct(Reading(np.full((2 * self._psds, 2), 1e-3), sums, warmer, t, self._xp), active.values)
            self._sensors.insert(0, (effect.correct, active.values))
        moves = effect.point == 'beam' or _optics(self._true) != before
        if moves and self._nominal.psds_at_base:
            raise ConfigError(f'effects: {active.label}: moves the optics, which is not corrected for PSDs at the base')
        self._moves_optics |= moves
        return moves or effect.correct is not None

    def _wandered(self, effects: Sequence[ActiveEffect], t: FloatArray, warmer: FloatArray, n: int) -> FloatArray:
        """The true beams (2P, n), m."""
        samples = SimulatedSamples(t, warmer, np.empty((3, n)), self._true)
        samples.beams = np.repeat(self._true.beams.reshape(-1, 1), n, axis=1)
        for active in effects:
            if active.effect.apply is not None:
                active.effect.apply(samples, active.values, {})
        return samples.beams

    def apply(
        self,
        dots: FloatArray,
        sums: FloatArray | None = None,
        warmer: FloatArray | float = 0.0,
        t: FloatArray | float = 0.0,
    ) -> FloatArray:
        """Corrected dots (n, 2P), m, of measured ``dots`` (n, 2P), m.

        ``sums`` (n, P) V, nominal if None; ``warmer`` (n,) K above the recording's first
        temperature; ``t`` (n,) s since its first sample.
        """
        n = len(dots)
        given = (
            np.full((self._psds, n), self._nominal.sum_nominal) if sums is None else np.array(sums.T, dtype=np.float64)
        )
        reading = Reading(
            np.array(np.asarray(dots, dtype=np.float64).T, order='C'),
            given,
            np.broadcast_to(np.asarray(warmer, dtype=np.float64), (n,)),
            np.broadcast_to(np.asarray(t, dtype=np.float64), (n,)),
            self._xp,
        )
        for correct, values in self._sensors:
            correct(reading, values)
        if not self._moves_optics:
            return np.ascontiguousarray(reading.dots.T)
        nominal_beams = np.repeat(self._nominal.beams.reshape(-1, 1), n, axis=1)
        beams = self._wandered(self._beams, reading.t, reading.warmer, n)
        corrected = reading.dots.copy()
        for _ in range(PASSES):
            pose = _flat_pose(corrected, nominal_beams, self._nominal)
            shown = dots_on_plate(pose, beams, self._true)
            wanted = dots_on_plate(pose, nominal_beams, self._nominal)
            corrected = reading.dots - (shown - wanted)
        return np.ascontiguousarray(corrected.T)


def _optics(physics: Physics) -> list[object]:
    return [np.array(getattr(physics, name)).tolist() for name in OPTICS]


def _flat_pose(dots: FloatArray, beams: FloatArray, physics: Physics) -> FloatArray:
    """Pose (3, n) of a flat plate from dots (2P, n)."""
    n = dots.shape[1]
    return flat_poses(dots.T.reshape(n, -1, 2) + physics.centers, beams.T.reshape(n, -1, 2), physics.xp).T
