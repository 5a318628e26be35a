# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The mean over all subsets of the terms of a linear model, each weighed by how likely it is: spike and slab (George
and McCulloch 1993), by a tempered Gibbs sampler (Zanella and Roberts 2019)."""

import numpy as np
import numpy.typing as npt

from psd_deflection.records import BoolArray, FloatArray

WALK = (200, 8, 1000)
"""Steps of the sampler: at least, for each term, at most; a fifth of them is not counted."""
SLABS = np.geomspace(0.02, 20.0, 10)
"""Precisions of a size against that of the noise, terms being of unit rms; the sampler draws one."""
LEAST_LENGTH = 1e-6
"""A term that keeps less of its squared length beside what is always there is already explained."""


def averaged(
    f: FloatArray, g: FloatArray, energy: float, size: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Mean sizes (k,) of the terms over all subsets, and how likely each takes part (k,).

    ``f`` (k, k), ``g`` (k,), ``energy``: products of terms and target, of ``size`` independent values;
    terms of unit rms have ``f`` about ``size`` on the diagonal. Noise: Jeffreys' prior; each number of terms is as
    likely.
    """
    count = len(g)
    diagonal = np.diag(f).copy()
    usable = diagonal > LEAST_LENGTH * size
    if not usable.any() or energy <= 0.0:
        return np.zeros(count), np.zeros(count)
    inside = np.zeros(count, dtype=bool)
    slab = 1.0
    steps = min(max(WALK[0], WALK[1] * count), WALK[2])
    sizes, weights, total = np.zeros(count), np.zeros(count), 0.0
    for step in range(steps):
        odds, chosen, mean = _flips(f, g, energy, size, diagonal, inside, slab)
        odds[~usable] = -50.0
        flip = 1.0 / (1.0 + np.exp(-np.clip(odds, -500.0, 500.0)))
        member = np.where(inside, 1.0 - flip, flip)
        pull = (member + 0.5 / count) / np.maximum(1.0 - flip, 1e-12)
        weight = 1.0 / float(pull.sum())
        if step >= steps // 5:
            sizes[chosen] += weight * mean
            weights += weight * member
            total += weight
        if step % 5 == 4:
            slab = _slab(f, g, energy, size, chosen, rng)
        switched = int(rng.choice(count, p=pull * weight))
        inside[switched] = not inside[switched]
    return sizes / total, weights / total


def _flips(
    f: FloatArray, g: FloatArray, energy: float, size: float, diagonal: FloatArray, inside: BoolArray, slab: float
) -> tuple[FloatArray, npt.NDArray[np.intp], FloatArray]:
    """Logarithms (k,) of the odds for each term being turned on or off; the terms that are on, and their sizes."""
    chosen = np.flatnonzero(inside)
    n, count = len(chosen), len(g)
    residual_energy, room, pull = energy, diagonal + slab, g
    mean, deviation = np.zeros(0), np.zeros(0)
    if n:
        inverse = np.linalg.inv(f[np.ix_(chosen, chosen)] + slab * np.eye(n))
        mean, deviation = inverse @ g[chosen], np.diag(inverse)
        across = f[chosen]
        residual_energy = max(energy - float(mean @ g[chosen]), 1e-12 * energy)
        room = np.maximum(room - np.einsum('ij,ij->j', across, inverse @ across), slab)
        pull = g - mean @ across
    with_it = np.maximum(residual_energy - pull**2 / room, 1e-12 * energy)
    odds = (
        0.5 * np.log(slab / room)
        - 0.5 * size * np.log(with_it / residual_energy)
        + np.log((1.0 + n) / max(count - n, 1))
    )
    if n:
        without = residual_energy + mean**2 / deviation
        odds[chosen] = (
            -0.5 * np.log(slab * deviation)
            - 0.5 * size * np.log(without / residual_energy)
            - np.log(n / (count - n + 1.0))
        )
    return odds, chosen, mean


def _slab(
    f: FloatArray, g: FloatArray, energy: float, size: float, chosen: npt.NDArray[np.intp], rng: np.random.Generator
) -> float:
    """Return a precision of the sizes, drawn by how likely it is with the ``chosen`` terms."""
    if not len(chosen):
        return float(rng.choice(SLABS))
    values, vectors = np.linalg.eigh(f[np.ix_(chosen, chosen)])
    along = vectors.T @ g[chosen]
    room = values[None, :] + SLABS[:, None]
    residual_energy = np.maximum(energy - (along**2 / room).sum(axis=1), 1e-12 * energy)
    logs = 0.5 * np.log(SLABS[:, None] / room).sum(axis=1) - 0.5 * size * np.log(residual_energy)
    p = np.exp(logs - logs.max())
    return float(rng.choice(SLABS, p=p / p.sum()))
