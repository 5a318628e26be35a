# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Dots in space: beams that are not parallel to Z, surfaces that are turned and tilted on the plate.

``plate`` is the solvers' model, with parallel beams and surfaces parallel to the plate. This module covers,
without approximation, what that model leaves out: inclined beams and tilted sensors.
"""

import numpy as np

from psd_deflection.records import FloatArray


def rotation(theta: FloatArray | float, phi: FloatArray | float, omega: FloatArray | float) -> FloatArray:
    """R = Ry(omega) Rx(phi) Rz(theta), (..., 3, 3), of angles (...,) in rad."""
    theta, phi, omega = np.broadcast_arrays(theta, phi, omega)
    ct, st, cp, sp, co, so = (f(angle) for angle in (theta, phi, omega) for f in (np.cos, np.sin))
    rows = [
        [co * ct + so * sp * st, so * sp * ct - co * st, so * cp],
        [cp * st, cp * ct, -sp],
        [co * sp * st - so * ct, co * sp * ct + so * st, co * cp],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def lifted(across: FloatArray, z: FloatArray | float) -> FloatArray:
    """(..., 3) from (..., 2) and z (...)."""
    shape = np.broadcast_shapes(across.shape[:-1], np.shape(z))
    return np.concatenate(
        [np.broadcast_to(across, (*shape, 2)), np.broadcast_to(z, shape)[..., None]], axis=-1, dtype=np.float64
    )


def hit(start: FloatArray, along: FloatArray, origin: FloatArray, axes: FloatArray) -> FloatArray:
    """Where a ray meets a surface, in the surface's own axes, (..., 2) m.

    The ray leaves ``start`` (..., 3) m in the direction ``along`` (..., 3). The surface contains ``origin``
    (..., 3) m; the columns of ``axes`` (..., 3, 3) are its x, its y and its normal.
    """
    normal = axes[..., 2]
    reach = np.sum(normal * (origin - start), axis=-1) / np.sum(normal * along, axis=-1)
    place = start + reach[..., None] * along - origin
    return np.asarray(np.einsum('...ji,...j->...i', axes, place)[..., :2])
