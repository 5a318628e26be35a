"""Undo what is known to be wrong with sensors and optics, so that the estimate gets better too.

A solver takes the rig at its word. Where the rig file lists effects of the detectors and the
optics, a measured reading is first walked back through them (background light, gain, cross-talk,
non-linearity, rotation, temperature); then, with the pose these dots imply, the difference between
the true and the nominal optics (places of PSDs and beams, wandering beams, tilt) is taken off. What
remains are the dots that the nominal, flat, perfectly placed rig would have shown.
"""

from __future__ import annotations

import numpy as np

from psd_deflection.config import Rig
from psd_deflection.geometry.plate import flat_poses
from psd_deflection.records import FloatArray
from psd_deflection.simulation.catalogue import ActiveEffect, Reading, effects_of_rig
from psd_deflection.simulation.chunk import Chunk
from psd_deflection.simulation.optics import dots_on_plate
from psd_deflection.simulation.physics import Physics

PASSES = 3
"""Fixed-point passes for the pose; each gains the relative size of the optics effect (< 1 %)."""


class Correction:
    """Corrects dots for the effects that a rig file lists. Make it with :meth:`from_rig`."""

    def __init__(self, rig: Rig, effects: list[ActiveEffect]) -> None:
        self._nominal = Physics.of(rig)
        self._true = Physics.of(rig)
        self._optics = [a for a in effects if a.effect.point == 'beam' and a.effect.apply is not None]
        for active in effects:
            if active.effect.stage in ('optics', 'psd') and active.effect.configure is not None:
                active.effect.configure(self._true, active.values)
        self._sensors = [a for a in reversed(effects) if a.effect.correct is not None]
        same = (
            np.array_equal(self._true.centers, self._nominal.centers)
            and np.array_equal(self._true.beams, self._nominal.beams)
            and self._true.slope_ratio == self._nominal.slope_ratio
        )
        self._moves_optics = bool(self._optics) or not same
        self.names: tuple[str, ...] = tuple(
            a.effect.name
            for a in effects
            if a.effect.correct is not None or a.effect.stage == 'optics' or a.effect.name == 'sensor_position'
        )

    @classmethod
    def from_rig(cls, rig: Rig) -> Correction:
        """The correction for the effects of ``rig``; raises ConfigError where they are malformed."""
        return cls(rig, effects_of_rig(rig))

    @property
    def active(self) -> bool:
        """Whether there is anything to correct."""
        return bool(self._sensors) or self._moves_optics

    @property
    def uses_time(self) -> bool:
        """Whether a corrected effect goes on with time."""
        return 'laser_pointing_drift' in self.names

    @property
    def uses_temperature(self) -> bool:
        """Whether a corrected effect goes with temperature."""
        return bool({'thermal_drift', 'refraction'} & set(self.names))

    def apply(
        self,
        dots: FloatArray,
        sums: FloatArray | None = None,
        warmer: FloatArray | float = 0.0,
        t: FloatArray | float = 0.0,
    ) -> FloatArray:
        """Corrected dots (n, 4), m, of measured ``dots`` (n, 4), m.

        ``sums`` (n, 2) V, nominal where None; ``warmer`` (n,) K above the recording's first
        temperature; ``t`` (n,) s since its first sample.
        """
        n = len(dots)
        given = np.full((2, n), self._nominal.sum_nominal) if sums is None else np.array(sums.T, dtype=np.float64)
        reading = Reading(
            np.array(np.asarray(dots, dtype=np.float64).T, order='C'),
            given,
            np.broadcast_to(np.asarray(warmer, dtype=np.float64), (n,)),
            np.broadcast_to(np.asarray(t, dtype=np.float64), (n,)),
        )
        for active in self._sensors:
            assert active.effect.correct is not None  # chosen so in __init__
            active.effect.correct(reading, active.values)
        if not self._moves_optics:
            return np.ascontiguousarray(reading.dots.T)
        nominal_beams = np.repeat(self._nominal.beams.reshape(4, 1), n, axis=1)
        chunk = Chunk(reading.t, reading.warmer, np.empty((3, n)), self._true)
        chunk.beams = np.repeat(self._true.beams.reshape(4, 1), n, axis=1)
        for active in self._optics:
            assert active.effect.apply is not None
            active.effect.apply(chunk, active.values, {})
        corrected = reading.dots.copy()
        for _ in range(PASSES):
            pose = _flat_pose(corrected, nominal_beams, self._nominal)
            shown = dots_on_plate(pose, chunk.beams, self._true)
            wanted = dots_on_plate(pose, nominal_beams, self._nominal)
            corrected = reading.dots - (shown - wanted)
        return np.ascontiguousarray(corrected.T)


def _flat_pose(dots: FloatArray, beams: FloatArray, physics: Physics) -> FloatArray:
    """Pose (3, n) of a flat plate from dots (4, n)."""
    n = dots.shape[1]
    return flat_poses(dots.T.reshape(n, 2, 2) + physics.centers, beams.T.reshape(n, 2, 2)).T
