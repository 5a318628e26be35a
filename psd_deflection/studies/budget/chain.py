# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The measuring chain with its imperfections, exact: from a pose of the tip to readings and stored zeros.

Theory of operation. A sensor is at C = (c + error, h + error) on the plate, its axes turned and
tilted by R_s = Ry Rx Rz. Its beam was set so that the dot lies at m_0 before load: it passes through
C + R_s (m_0, 0) and runs along (u_x, u_y, 1). Under load the plate is at d + R(.), with the tilts of
a cantilever, so the dot is where the beam meets the plane through d + R C with normal R R_s e_z.
Nothing is linearised: every error of the budget is a field of :class:`MeasuringChain`, and its effect is
computed exactly. Changes after the zero was stored (``..._shift``) act on the loaded reading only.

Arrays have a leading axis of n trials or of 1, then P sensors, then x and y.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from psd_deflection.model.detector.clipping import cut_by_edges
from psd_deflection.model.detector.response import grown, pulled, scaled
from psd_deflection.model.plate.plate import tied_pose
from psd_deflection.model.plate.rays import hit, lifted, rotation
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig


def _none(*shape: int) -> FloatArray:
    return np.zeros(shape)


@dataclass(frozen=True, slots=True, eq=False)
class MeasuringChain:
    """A rig as its parameter file describes it (first group of fields), and its errors.

    ``centers`` (P, 2), ``heights`` (P,), ``zeros`` (P, 2), ``half_area`` (P, 2), ``link_length``: m.
    ``slope_ratio`` (n,): the true k of the link. The errors follow, all 0 for the nominal rig:
    """

    centers: FloatArray
    heights: FloatArray
    zeros: FloatArray
    half_area: FloatArray
    link_length: float
    slope_ratio: FloatArray

    center_error: FloatArray = field(default_factory=lambda: _none(1, 1, 2))
    """m, true centre minus stated."""
    height_error: FloatArray = field(default_factory=lambda: _none(1, 1))
    """m."""
    rotation: FloatArray = field(default_factory=lambda: _none(1, 1))
    """rad, the sensor's axes about +Z of the plate."""
    tilt: FloatArray = field(default_factory=lambda: _none(1, 1, 2))
    """rad, the sensor's surface about X and Y of the plate."""
    beam_slope: FloatArray = field(default_factory=lambda: _none(1, 1, 2))
    """dx/dz, dy/dz of the beam."""
    center_shift: FloatArray = field(default_factory=lambda: _none(1, 1, 2))
    """m, movement of the centre since the zero was stored."""
    beam_shift: FloatArray = field(default_factory=lambda: _none(1, 1, 2))
    """m, movement of the dot with the beam since the zero was stored."""
    spot_diameter: FloatArray = field(default_factory=lambda: _none(1, 1))
    """m, 1/e^2 diameter; 0 is a point, which is never clipped."""
    nonlinearity: FloatArray = field(default_factory=lambda: _none(1, 1))
    """1/m^2: r becomes r (1 + k r^2)."""
    background: FloatArray = field(default_factory=lambda: _none(1, 1))
    """Background current, centred, divided by the spot's current."""
    gain: FloatArray = field(default_factory=lambda: _none(1, 1, 2))
    """Scale error."""
    reading_shift: FloatArray = field(default_factory=lambda: _none(1, 1, 2))
    """m, added to the loaded reading: drift and noise."""
    zero_shift: FloatArray = field(default_factory=lambda: _none(1, 1, 2))
    """m, added to the stored zero."""

    @classmethod
    def of(cls, rig: Rig) -> MeasuringChain:
        """Return the nominal rig."""
        half_area = np.array([p.active_area for p in rig.psds]) / 2.0
        slope_ratio = np.array([rig.link.slope_ratio])
        return cls(rig.centers, rig.heights, rig.zeros, half_area, rig.link.length, slope_ratio)


def dots(chain: MeasuringChain, pose: FloatArray, dz: float = 0.0) -> FloatArray:
    """(n, P, 2), m: the dots in each sensor's own axes at ``pose`` (3,): dX, dY, theta.

    ``dz``: the tip's shortening, m; it affects inclined beams only.
    """
    tilted = tied_pose(pose, chain.slope_ratio, chain.link_length)
    plate = rotation(tilted[..., 2], tilted[..., 3], tilted[..., 4])[:, None]
    own = rotation(chain.rotation, chain.tilt[..., 0], chain.tilt[..., 1])
    centre = lifted(chain.centers + chain.center_error, chain.heights + chain.height_error)
    start = centre + np.einsum('...ij,...j->...i', own[..., :2], chain.zeros)
    start = start + lifted(chain.beam_shift, 0.0)
    moved = centre + lifted(chain.center_shift, 0.0)
    origin = np.einsum('...ij,...j->...i', plate, moved) + np.array([pose[0], pose[1], dz])
    return hit(start, lifted(chain.beam_slope, 1.0), origin, plate @ own)


def _read(chain: MeasuringChain, places: FloatArray) -> FloatArray:
    if np.any(chain.spot_diameter > 0.0):
        _, moved = cut_by_edges(places, chain.half_area, np.maximum(chain.spot_diameter[..., None] / 2.0, 1e-12))
        places = places + moved
    # Other light is centred.
    places = pulled(places, 1.0, chain.background[..., None], 0.0)
    x, y = grown(places[..., 0], places[..., 1], chain.nonlinearity)
    return np.stack(scaled(x, y, chain.gain[..., 0], chain.gain[..., 1]), axis=-1)


def measure(chain: MeasuringChain, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Readings and stored zeros, (n, P, 2) each, m, at ``pose`` (3,)."""
    readings = _read(chain, dots(chain, pose)) + chain.reading_shift
    zeros = _read(chain, chain.zeros[None]) + chain.zero_shift
    shape = np.broadcast_shapes(readings.shape, zeros.shape)
    return np.broadcast_to(readings, shape), np.broadcast_to(zeros, shape)
