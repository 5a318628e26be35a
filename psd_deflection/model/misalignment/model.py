# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Parameters of a rig and a pose -> the four readings; the one model that calibration fits and propagates.

Of PSD i with centre c and height h: the beam crosses the plate at q (:mod:`psd_deflection.model.plate.plate`, tilts
phi = -k dY/L and omega = k dX/L, leaning beams), m = q - c, and the detector reads S(m)
(:class:`psd_deflection.model.detector.response.DetectorResponse`). ``zero`` is the reading (x, y) of the unloaded link,
as the detector gives it: what is known of the beam's place. m_0 = S^-1(zero), and l = c + m_0. So a zero that is taken
anew is independent of all other parameters.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from psd_deflection.base.arithmetic import LIBRARY, Arithmetic
from psd_deflection.model.detector.response import DetectorResponse
from psd_deflection.model.plate.plate import points_under_leaning
from psd_deflection.records import FloatArray


@dataclass(frozen=True, slots=True)
class Described:
    """One parameter. ``tolerance``: its standard deviation if a rig file does not give one; ``words``: for people."""

    name: str
    unit: str
    tolerance: float
    words: str
    group: str


def _of_psd(n: int) -> tuple[Described, ...]:
    p = f'psd_{n}'
    return (
        Described(f'{p}.rotation', 'rad', 0.010, f'turn of PSD {n} in its plane', f'{p}.rotation'),
        Described(f'{p}.gain_x', '', 0.01, f'gain x of PSD {n}', f'{p}.gain'),
        Described(f'{p}.gain_y', '', 0.01, f'gain y of PSD {n}', f'{p}.gain'),
        Described(f'{p}.crosstalk_xy', '', 0.005, f'share of y in x of PSD {n}', f'{p}.crosstalk'),
        Described(f'{p}.crosstalk_yx', '', 0.005, f'share of x in y of PSD {n}', f'{p}.crosstalk'),
        Described(f'{p}.center_x', 'm', 0.3e-3, f'centre x of PSD {n}', f'{p}.center'),
        Described(f'{p}.center_y', 'm', 0.3e-3, f'centre y of PSD {n}', f'{p}.center'),
        Described(f'{p}.height', 'm', 2e-3, f'height of PSD {n}', f'{p}.height'),
        Described(f'{p}.nonlinearity', '1/m^2', 300.0, f'non-linearity of PSD {n}', f'{p}.nonlinearity'),
    )


PARAMETERS: tuple[Described, ...] = (
    *_of_psd(1),
    *_of_psd(2),
    *(
        Described(f'beam_{n}.angle_{axis}', 'rad', 0.003, f'lean of beam {n} towards {axis.upper()}', f'beam_{n}.angle')
        for n in (1, 2)
        for axis in 'xy'
    ),
    Described('link.slope_ratio', '', 0.2, 'slope ratio k', 'link.slope_ratio'),
)
"""What the readings depend on besides the zero."""
ZERO_PARAMETERS: tuple[Described, ...] = tuple(
    Described(f'psd_{n}.zero_{axis}', 'm', 0.5e-3, f'unloaded reading {axis} of PSD {n}', 'zero')
    for n in (1, 2)
    for axis in 'xy'
)
ALL: tuple[Described, ...] = (*PARAMETERS, *ZERO_PARAMETERS)
INDEX = {p.name: i for i, p in enumerate(ALL)}
COUNT = len(ALL)
ZERO = len(PARAMETERS)
"""Index of the first parameter of the zero."""
SLOPE = INDEX['link.slope_ratio']
TOLERANCES: FloatArray = np.array([p.tolerance for p in ALL])

_PER_PSD, _CENTER, _HEIGHT, _CUBIC = 9, 5, 7, 8
_BEAMS = 2 * _PER_PSD


def response_of(p: FloatArray, psd: int) -> DetectorResponse:
    """What PSD ``psd`` (0, 1) does to the place of a dot; ``p`` (COUNT,)."""
    first = _PER_PSD * psd
    rotation, gain_x, gain_y, xy, yx = p[first : first + _CENTER]
    return DetectorResponse(rotation, gain_x, gain_y, xy, yx, p[first + _CUBIC])


def readings(p: FloatArray, pose: FloatArray, length: float, xp: Arithmetic = LIBRARY) -> FloatArray:
    """x1 y1 x2 y2, m, (4, n). ``p`` (COUNT,); ``pose`` (3, n): dX m, dY m, theta rad; ``length`` L, m."""
    out = np.empty((4, pose.shape[1]))
    for psd in range(2):
        center = p[_PER_PSD * psd + _CENTER : _PER_PSD * psd + _CENTER + 2]
        response = response_of(p, psd)
        m0 = response.place(p[ZERO + 2 * psd], p[ZERO + 2 * psd + 1], xp)
        place = _points(p, psd, center + m0, pose, length, xp) - center[:, None]
        out[2 * psd : 2 * psd + 2] = response.reading(place[0], place[1], xp)
    return out


def _points(
    p: FloatArray, psd: int, beam: FloatArray, pose: FloatArray, length: float, xp: Arithmetic = LIBRARY
) -> FloatArray:
    """Plate points (2, n) under the beam that is at ``beam`` (2,) on the plate at rest."""
    dx, dy, theta = pose
    k = p[SLOPE] / length
    slopes = xp.tan_many(p[_BEAMS + 2 * psd : _BEAMS + 2 * psd + 2])
    height = p[_PER_PSD * psd + _HEIGHT]
    place = beam[0], beam[1], height
    return np.stack(points_under_leaning(place, (slopes[0], slopes[1]), (dx, dy, theta, -k * dy, k * dx), xp))


def by_parameters(p: FloatArray, pose: FloatArray, length: float, xp: Arithmetic = LIBRARY) -> FloatArray:
    """Derivatives of the readings (4, COUNT, n) at ``p`` (COUNT,) and ``pose`` (3, n), by central differences."""
    out = np.zeros((4, COUNT, pose.shape[1]))
    for psd in range(2):
        _psd_by_parameters(out[2 * psd : 2 * psd + 2], p, psd, pose, length, xp)
    return out


def _psd_by_parameters(
    out: FloatArray, p: FloatArray, psd: int, pose: FloatArray, length: float, xp: Arithmetic
) -> None:
    """The rows ``out`` (2, COUNT, n) of one PSD.

    By parts, r = S(q - c) with q under l = c + m_0 and m_0 = S^-1(r_0), so that each is moved by itself.
    """
    first = _PER_PSD * psd
    at, zero = slice(first + _CENTER, first + _CENTER + 2), slice(ZERO + 2 * psd, ZERO + 2 * psd + 2)
    response = response_of(p, psd)
    m0 = np.array(response.place(p[zero][0], p[zero][1], xp))
    beam = p[at] + m0
    place = _points(p, psd, beam, pose, length, xp) - p[at, None]
    rotated = response.slopes(place[0], place[1], xp)

    def moved_beam(d: FloatArray) -> FloatArray:
        return _points(p, psd, beam + d, pose, length, xp)

    def read_there(d: FloatArray) -> FloatArray:
        return np.stack(response_of(p + d, psd).reading(place[0], place[1], xp))

    def rest_place(d: FloatArray) -> FloatArray:
        return np.array(response_of(p + d, psd).place(p[zero][0], p[zero][1], xp))

    def point(d: FloatArray) -> FloatArray:
        return _points(p + d, psd, beam, pose, length, xp)

    # How the dot goes with the beam, and its reading with the beam.
    under = np.stack([_difference(moved_beam, 1e-6 * unit) for unit in np.eye(2)], axis=1)
    read = xp.einsum('ijn,jkn->ikn', rotated, under)
    out[:, at] = read - rotated
    out[:, zero] = xp.einsum('ijn,jk->ikn', read, xp.inverse_of(response.slopes(m0[0], m0[1], xp)))
    for i in (*range(first, first + _CENTER), first + _CUBIC):
        away = xp.einsum('ijn,j->in', read, _difference(rest_place, _step(i)))
        out[:, i] = _difference(read_there, _step(i)) + away
    for i in (first + _HEIGHT, _BEAMS + 2 * psd, _BEAMS + 2 * psd + 1, SLOPE):
        out[:, i] = xp.einsum('ijn,jn->in', rotated, _difference(point, _step(i)))


def _step(index: int) -> FloatArray:
    out = np.zeros(COUNT)
    out[index] = 1e-3 * TOLERANCES[index]
    return out


def _difference(of: Callable[[FloatArray], FloatArray], step: FloatArray) -> FloatArray:
    """The derivative of ``of`` along ``step``, which has one part that is not 0."""
    return np.asarray((of(step) - of(-step)) / (2.0 * step.max()))


def by_pose(p: FloatArray, pose: FloatArray, length: float) -> FloatArray:
    """Derivatives of the readings (4, 3, n) by dX, dY (m/m) and theta (m/rad)."""
    step = np.array([1e-6, 1e-6, 1e-5])
    out = [
        (readings(p, pose + d[:, None], length) - readings(p, pose - d[:, None], length)) / (2.0 * s)
        for d, s in zip(np.diag(step), step, strict=True)
    ]
    return np.stack(out, axis=1)
