# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Which sensor placement conditions the measurement best, and by how much.

At rest the dots move by A (dX, dY, theta), A the design matrix (``linear``). For readings of equal
deviation sigma and two PSDs at c1, c2 with midpoint m and distance b = |c1 - c2|::

    var theta = 2 sigma^2/b^2
    var dX    = sigma^2/2 + m_y^2 var theta       var dY = sigma^2/2 + m_x^2 var theta

so the best pair is diametrically opposite, as far out as the space allows. The condition number of
A mixes metres and radians and is meaningless without its units. Here theta is scaled by a length
(0.1 m: a twist counts as the displacement of a point 0.1 m from the centre), so cond = 1 for +-100
mm.

Tilts phi and omega need more. Two coplanar PSDs do not see them (the Jacobian's rank is at most 4 of
5, and 3 at rest). Three PSDs see them if their surfaces are at different heights.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from psd_deflection.base.errors import ConfigError
from psd_deflection.model.plate.plate import crossings, tie_matrix, tied_pose
from psd_deflection.records import FloatArray

SCALE = 0.1
"""m: the length that scales theta in a condition number or in the cost."""


class PoseDeviations(NamedTuple):
    """Standard deviations of an estimate: m, m, rad."""

    dx: float
    dy: float
    theta: float


def deviations_of_pair(centers: FloatArray, sigma: float) -> PoseDeviations:
    """Deviations of (dX, dY, theta) at rest for two PSDs whose readings have deviation ``sigma``
    (m).

    It is the closed form in the module's docstring.
    """
    distance = math.hypot(*(centers[0] - centers[1]))
    middle_x, middle_y = (centers[0] + centers[1]) / 2.0
    theta = math.sqrt(2.0) * sigma / distance
    return PoseDeviations(
        math.hypot(sigma / math.sqrt(2.0), middle_y * theta),
        math.hypot(sigma / math.sqrt(2.0), middle_x * theta),
        theta,
    )


def opposite(radius: float, azimuth: float = math.pi / 2.0) -> FloatArray:
    """(2, 2): two PSDs diametrically opposite at ``radius`` (m), the first at ``azimuth`` (rad)."""
    first = radius * np.array([math.cos(azimuth), math.sin(azimuth)])
    return np.stack([first, -first])


def ring(count: int, radius: float, azimuth: float = math.pi / 2.0) -> FloatArray:
    """(count, 2): PSDs evenly on a circle of ``radius`` (m)."""
    angles = azimuth + 2.0 * math.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def pose_deviations(pose: FloatArray, centers: FloatArray, heights: FloatArray, sigma: float) -> FloatArray:
    """Deviations (5,) of dX, dY m, theta, phi, omega rad, all five free, at ``pose`` (5,).

    Unknowns that the readings do not determine get infinity: both tilts at rest and, with two PSDs,
    always one of the five.
    """
    jacobian = crossings(pose, centers, heights)[1].reshape(-1, 5)
    return _deviations(jacobian, sigma)


def slope_ratio_deviations(
    pose: FloatArray, slope_ratio: float, link_length: float, centers: FloatArray, heights: FloatArray, sigma: float
) -> FloatArray:
    """Deviations (4,) of dX, dY, theta and k when the tilts are tied, phi = -k dY/L, omega = +k dX/L.

    ``pose`` (3,): dX, dY, theta; it must be deflected, because at rest k has no effect.
    """
    full = tied_pose(pose, slope_ratio, link_length)
    jacobian = crossings(full, centers, heights)[1].reshape(-1, 5)
    tie = np.zeros((5, 4))
    tie[:, :3] = tie_matrix(slope_ratio, link_length)
    tie[3, 3], tie[4, 3] = -pose[1] / link_length, pose[0] / link_length
    return _deviations(jacobian @ tie, sigma)


def _deviations(jacobian: FloatArray, sigma: float) -> FloatArray:
    # Scale the columns to unit length, so that the units do not decide what counts as singular.
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0.0] = 1.0
    _, values, rows = np.linalg.svd(jacobian / scale, full_matrices=True)
    count = jacobian.shape[1]
    values = np.concatenate([values, np.zeros(count - len(values))])
    observed = values > 1e-12
    out = sigma / scale * np.sqrt(np.sum((rows[observed] / values[observed, None]) ** 2, axis=0))
    # Every unknown with a component along an unseen direction is undetermined.
    out[np.any(np.abs(rows[~observed]) > 1e-9, axis=0)] = math.inf
    return np.asarray(out)


@dataclass(frozen=True, slots=True)
class Room:
    """The allowed places of sensor centres: a disc of ``radius`` (m), outside ``keep_out`` (m), inside
    ``box``.

    ``box``: (x_min, y_min, x_max, y_max), m, or None.
    """

    radius: float
    keep_out: float = 0.0
    box: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        if not self.radius > 0.0 or not math.isfinite(self.radius):
            raise ConfigError(f'radius = {self.radius} m: must be above 0')
        if not 0.0 <= self.keep_out <= self.radius:
            raise ConfigError(f'keep_out = {self.keep_out} m: must be at least 0 and at most radius = {self.radius} m')
        if self.box is not None:
            x_min, y_min, x_max, y_max = self.box
            if not (x_min < x_max and y_min < y_max):
                raise ConfigError(
                    f'box = {self.box} m: must be x_min, y_min, x_max, y_max, each minimum below its maximum'
                )

    def holds(self, points: FloatArray) -> FloatArray:
        """Mask (...,) of ``points`` (..., 2)."""
        reach = np.hypot(points[..., 0], points[..., 1])
        # A little slack, because rounding would exclude the rim.
        inside = (reach <= self.radius * (1.0 + 1e-12)) & (reach >= self.keep_out * (1.0 - 1e-12))
        if self.box is not None:
            x_min, y_min, x_max, y_max = self.box
            inside &= (points[..., 0] >= x_min) & (points[..., 0] <= x_max)
            inside &= (points[..., 1] >= y_min) & (points[..., 1] <= y_max)
        return np.asarray(inside)

    def candidates(self, count: int = 24) -> FloatArray:
        """(n, 2): points on a grid, on the rim and on the edges and corners of the box that are inside."""
        angles = 2.0 * math.pi * np.arange(8 * count) / (8 * count)
        circle = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        x_min, y_min, x_max, y_max = self.box or (-self.radius, -self.radius, self.radius, self.radius)
        across, up = np.linspace(x_min, x_max, count), np.linspace(y_min, y_max, count)
        grid = np.stack(np.meshgrid(across, up), axis=-1).reshape(-1, 2)
        points = np.concatenate([grid, self.radius * circle, self.keep_out * circle])
        return np.asarray(np.unique(points[self.holds(points)], axis=0))


def cost(deviations: FloatArray) -> FloatArray:
    """(...,): root of var dX + var dY + (0.1 m)^2 var theta, m, of (..., 3) deviations."""
    return np.asarray(np.sqrt(np.sum((deviations * np.array([1.0, 1.0, SCALE])) ** 2, axis=-1)))


def _pair_costs(first: FloatArray, second: FloatArray) -> FloatArray:
    """``cost`` of pairs for sigma = 1, by the closed form; coinciding pairs cost infinity."""
    square = np.sum((first - second) ** 2, axis=-1)
    with np.errstate(divide='ignore'):
        twist = 2.0 / square
    middle = np.sum(((first + second) / 2.0) ** 2, axis=-1)
    return np.asarray(np.sqrt(1.0 + (middle + SCALE**2) * twist))


def best_pair(room: Room) -> FloatArray:
    """(2, 2): the two places in ``room`` of least ``cost``; the first is the higher one.

    It compares all pairs of candidates, then runs a pattern search around the best. The search is
    deterministic, and the cost is smooth except at coinciding sensors. Raises ConfigError if
    ``room`` has no two places.
    """
    points = room.candidates()
    if len(points) < 2:
        raise ConfigError(
            f'radius = {room.radius} m, keep_out = {room.keep_out} m, box = {room.box} m: no room for two sensors: '
            'widen one of them'
        )
    costs = np.stack([_pair_costs(p, points) for p in points])
    i, j = np.unravel_index(int(np.argmin(costs)), costs.shape)
    best, least = np.stack([points[i], points[j]]), float(costs[i, j])
    step = room.radius / 8.0
    moves = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 4), axis=-1).reshape(-1, 2, 2)
    while step > 1e-9 * room.radius:
        trial = best + step * moves
        trial = trial[np.all(room.holds(trial), axis=-1)]
        value = _pair_costs(trial[:, 0], trial[:, 1])
        at = int(np.argmin(value))
        # Ignore improvements in the last digit: on a flat optimum the search would not end.
        if value[at] < least * (1.0 - 1e-12):
            best, least = trial[at], float(value[at])
        else:
            step /= 2.0
    return best[np.lexsort((best[:, 0], -best[:, 1]))]
