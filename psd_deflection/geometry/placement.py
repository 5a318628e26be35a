"""Which sensor placement conditions the measurement best, and by how much.

At rest the dots move by A (dX, dY, theta), A the design matrix (``linear``). For readings of equal
deviation sigma and two PSDs at c1, c2 with midpoint m and distance b = |c1 - c2|::

    var theta = 2 sigma^2/b^2
    var dX    = sigma^2/2 + m_y^2 var theta       var dY = sigma^2/2 + m_x^2 var theta

so the best pair stands diametrically opposite, as far out as there is room. The condition number
of A mixes metres and radians: it says something only with its units stated. Here theta is scaled by
a length (0.1 m: a twist counts as the way of a point 0.1 m out), so that cond = 1 for +-100 mm.

Tilts phi, omega need more: two coplanar PSDs do not see them (the Jacobian's rank is 4 of 5 at most,
and 3 at rest), three see them once their surfaces stand at different heights.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from psd_deflection.errors import ConfigError
from psd_deflection.geometry.plate import crossings, tie_matrix, tied_pose
from psd_deflection.records import FloatArray

SCALE = 0.1
"""m: the length by which theta is scaled when a condition number or a single cost is formed."""


class Spread(NamedTuple):
    """Standard deviations of an estimate: m, m, rad."""

    dx: float
    dy: float
    theta: float


def spread_of_pair(centers: FloatArray, sigma: float) -> Spread:
    """Of (dX, dY, theta) at rest for two PSDs whose readings have equal deviation ``sigma`` (m).

    The closed form of the module's text.
    """
    distance = math.hypot(*(centers[0] - centers[1]))
    middle_x, middle_y = (centers[0] + centers[1]) / 2.0
    theta = math.sqrt(2.0) * sigma / distance
    return Spread(
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


def pose_spread(pose: FloatArray, centers: FloatArray, heights: FloatArray, sigma: float) -> FloatArray:
    """Deviations (5,) of dX, dY m, theta, phi, omega rad, all five free, at ``pose`` (5,).

    What the readings do not determine is infinite: both tilts at rest, and always one of the five
    for two PSDs.
    """
    jacobian = crossings(pose, centers, heights)[1].reshape(-1, 5)
    return _deviations(jacobian, sigma)


def slope_ratio_spread(
    pose: FloatArray, slope_ratio: float, link_length: float, centers: FloatArray, heights: FloatArray, sigma: float
) -> FloatArray:
    """Deviations (4,) of dX, dY, theta and k when the tilts are tied, phi = -k dY/L, omega = +k dX/L.

    ``pose`` (3,): dX, dY, theta; it must be deflected, for at rest k does nothing.
    """
    full = tied_pose(pose, slope_ratio, link_length)
    jacobian = crossings(full, centers, heights)[1].reshape(-1, 5)
    tie = np.zeros((5, 4))
    tie[:, :3] = tie_matrix(slope_ratio, link_length)
    tie[3, 3], tie[4, 3] = -pose[1] / link_length, pose[0] / link_length
    return _deviations(jacobian @ tie, sigma)


def _deviations(jacobian: FloatArray, sigma: float) -> FloatArray:
    # Columns of unit length first: metres and radians must not decide what counts as singular.
    scale = np.linalg.norm(jacobian, axis=0)
    scale[scale == 0.0] = 1.0
    _, values, rows = np.linalg.svd(jacobian / scale, full_matrices=True)
    count = jacobian.shape[1]
    values = np.concatenate([values, np.zeros(count - len(values))])
    seen = values > 1e-12
    out = sigma / scale * np.sqrt(np.sum((rows[seen] / values[seen, None]) ** 2, axis=0))
    # A direction that no reading sees leaves every unknown that has a part in it undetermined.
    out[np.any(np.abs(rows[~seen]) > 1e-9, axis=0)] = math.inf
    return np.asarray(out)


@dataclass(frozen=True, slots=True)
class Room:
    """Where sensor centres may stand: a disc of ``radius`` (m), outside ``keep_out`` (m), inside ``box``.

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
        # A hair of slack, or rounding would cut the rim off.
        inside = (reach <= self.radius * (1.0 + 1e-12)) & (reach >= self.keep_out * (1.0 - 1e-12))
        if self.box is not None:
            x_min, y_min, x_max, y_max = self.box
            inside &= (points[..., 0] >= x_min) & (points[..., 0] <= x_max)
            inside &= (points[..., 1] >= y_min) & (points[..., 1] <= y_max)
        return np.asarray(inside)

    def candidates(self, count: int = 24) -> FloatArray:
        """(n, 2): points on a grid, on the rim and on the edges and corners of the box that are inside."""
        turn = 2.0 * math.pi * np.arange(8 * count) / (8 * count)
        circle = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        x_min, y_min, x_max, y_max = self.box or (-self.radius, -self.radius, self.radius, self.radius)
        across, up = np.linspace(x_min, x_max, count), np.linspace(y_min, y_max, count)
        grid = np.stack(np.meshgrid(across, up), axis=-1).reshape(-1, 2)
        points = np.concatenate([grid, self.radius * circle, self.keep_out * circle])
        return np.asarray(np.unique(points[self.holds(points)], axis=0))


def cost(spreads: FloatArray) -> FloatArray:
    """(...,): root of var dX + var dY + (0.1 m)^2 var theta, m, of (..., 3) deviations."""
    return np.asarray(np.sqrt(np.sum((spreads * np.array([1.0, 1.0, SCALE])) ** 2, axis=-1)))


def _pair_costs(first: FloatArray, second: FloatArray) -> FloatArray:
    """``cost`` of pairs for sigma = 1, by the closed form; coinciding pairs cost infinity."""
    square = np.sum((first - second) ** 2, axis=-1)
    with np.errstate(divide='ignore'):
        twist = 2.0 / square
    middle = np.sum(((first + second) / 2.0) ** 2, axis=-1)
    return np.asarray(np.sqrt(1.0 + (middle + SCALE**2) * twist))


def best_pair(room: Room) -> FloatArray:
    """(2, 2): the two places in ``room`` of least ``cost``; the first is the higher one.

    All pairs of candidates, then a pattern search around the best: deterministic, and the cost is
    smooth away from coinciding sensors. Raises ConfigError when the room holds no two places.
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
        # An improvement in the last digit would walk along a flat optimum for ever.
        if value[at] < least * (1.0 - 1e-12):
            best, least = trial[at], float(value[at])
        else:
            step /= 2.0
    return best[np.lexsort((best[:, 0], -best[:, 1]))]
