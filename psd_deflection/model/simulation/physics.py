# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The constants of one simulation: from the rig file, changed by effects."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from psd_deflection.base.arithmetic import LIBRARY, Arithmetic
from psd_deflection.model.link import LinkStatics
from psd_deflection.model.plate.landing import landings
from psd_deflection.model.plate.plate import points_under, points_under_leaning
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig


@dataclass(slots=True)
class Physics:
    """SI throughout; arrays are (2,) per axis or (P, 2) per PSD and axis.

    ``bending_stiffness`` EI, ``torsional_stiffness`` GJ, N m^2. ``clamp_bending`` and
    ``clamp_torsion``: clamp rotation per moment, rad/(N m). ``static_offset``: (dX, dY) of the
    link without load, m, besides that by ``weight_per_length``, N/m, and by ``constant_force``
    (x, y), N, at the tip. ``slope_ratio``: k of phi = -k dY/L; 0 is the nominal, parallel planes.
    ``beams``: l_i, on the plate if ``psds_at_base``; ``slopes``: how much each goes sideways along Z.
    ``half_area``: half width and height of the active areas. ``noise`` (3P,), V rms of each channel.
    ``dark`` (P, 3): x, y and sum of each PSD with its laser off, V.
    ``xp``: what computes; the simulator's is the libraries'.
    ``phase``: how long after each sample the quantities are taken, below ``period``, s.
    """

    period: float
    length: float
    bending_stiffness: float
    torsional_stiffness: float
    clamp_bending: float
    clamp_torsion: float
    static_offset: FloatArray
    bending_frequency: float
    bending_damping_ratio: float
    torsion_frequency: float
    torsion_damping_ratio: float
    slope_ratio: float
    centers: FloatArray
    beams: FloatArray
    slopes: FloatArray
    heights: FloatArray
    half_area: FloatArray
    sensitivity: FloatArray
    sum_nominal: float
    noise: FloatArray
    volts_per_count: float
    full_scale: float
    dark: FloatArray
    phase: float = 0.0
    psds_at_base: bool = False
    weight_per_length: float = 0.0
    constant_force: FloatArray = field(default_factory=lambda: np.zeros(2))
    xp: Arithmetic = LIBRARY

    @classmethod
    def of(cls, rig: Rig) -> Physics:
        """The nominal constants of a rig file, without effects."""
        at_base = rig.psds_at_base
        return cls(
            period=1.0 / rig.converter.sample_rate_hz,
            length=rig.link.length,
            bending_stiffness=rig.link.bending_stiffness,
            torsional_stiffness=rig.link.torsional_stiffness,
            clamp_bending=0.0,
            clamp_torsion=0.0,
            static_offset=np.zeros(2),
            bending_frequency=rig.dynamics.bending_frequency,
            bending_damping_ratio=rig.dynamics.bending_damping_ratio,
            torsion_frequency=rig.dynamics.torsion_frequency,
            torsion_damping_ratio=rig.dynamics.torsion_damping_ratio,
            # PSDs at the base see little but the tilt.
            slope_ratio=rig.link.slope_ratio if at_base else 0.0,
            centers=rig.centers,
            beams=rig.centers + rig.zeros,
            slopes=rig.beam_slopes,
            heights=rig.heights,
            half_area=0.5 * np.array([p.active_area for p in rig.psds], dtype=np.float64),
            sensitivity=rig.sensitivities,
            sum_nominal=rig.amplifier.sum_nominal,
            noise=rig.noises.ravel(),
            volts_per_count=rig.converter.volts_per_count,
            full_scale=rig.converter.full_scale,
            dark=np.array([p.dark for p in rig.psds], dtype=np.float64),
            psds_at_base=at_base,
        )

    @property
    def psds(self) -> int:
        """How many PSDs the rig has."""
        return len(self.centers)

    @property
    def statics(self) -> LinkStatics:
        """The link with these constants."""
        stiffness, clamp = (self.bending_stiffness, self.torsional_stiffness), (self.clamp_bending, self.clamp_torsion)
        return LinkStatics(self.length, *stiffness, *clamp, self.xp)

    @property
    def at_rest(self) -> tuple[float, float]:
        """(dX, dY) of the link without load, m."""
        x, y = (self.constant_force * self.force_compliance).tolist()
        sag = self.statics.sag(self.weight_per_length)
        return float(self.static_offset[0]) + x, float(self.static_offset[1]) - sag + y

    @property
    def force_compliance(self) -> float:
        """Tip deflection per force at the tip, m/N."""
        return self.statics.deflection(1.0, 0.0, 0.0)[0]

    @property
    def torque_compliance(self) -> float:
        """Twist per torque, rad/(N m)."""
        return self.statics.deflection(0.0, 0.0, 1.0)[2]


def dots_on_plate(pose: FloatArray, beams: FloatArray, physics: Physics) -> FloatArray:
    """Dots x1 y1 x2 y2 ... (2P, n), m, from the PSD centres; ``pose`` (3, n), ``beams`` (2P, n).

    The tilts are those of a cantilever, phi = -k dY/L and omega = k dX/L; k = 0 is a plate that stays parallel.
    """
    k = physics.slope_ratio / physics.length
    phi, omega = (-k * pose[1], k * pose[0]) if k != 0.0 else (np.zeros(1), np.zeros(1))
    places = beams[0::2], beams[1::2], physics.heights[:, None]
    moved = pose[0], pose[1], pose[2], phi, omega
    if physics.slopes.any() and not physics.psds_at_base:
        slopes = physics.slopes[:, :1], physics.slopes[:, 1:]
        qx, qy = points_under_leaning(places, slopes, moved, physics.xp)
    else:
        fall = landings if physics.psds_at_base else points_under
        qx, qy = fall(places, moved, physics.xp)
    dots = np.empty(beams.shape)
    np.subtract(qx, physics.centers[:, :1], out=dots[0::2])
    np.subtract(qy, physics.centers[:, 1:], out=dots[1::2])
    return dots
