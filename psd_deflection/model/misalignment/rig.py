# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The parameters of a rig file as a vector with its uncertainty, and the values of a rig file from such a vector."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from psd_deflection.base.arithmetic import FIXED, Arithmetic
from psd_deflection.base.errors import ConfigError
from psd_deflection.base.text import did_you_mean
from psd_deflection.model.misalignment.model import (
    ALL,
    INDEX,
    SLOPE,
    TOLERANCES,
    ZERO,
    by_parameters,
    readings,
    response_of,
)
from psd_deflection.model.simulation.catalogue import effects_of_rig, make_active, our_effects, sort_effects
from psd_deflection.model.simulation.declaration import CALIBRATED_OF_LINK, PSD, ActiveEffect, Effect
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, check_two_psds
from psd_deflection.rig.declarations import BY_NAME

_SLOPE = 'link.slope_ratio'
CLAMP = tuple(name for name in CALIBRATED_OF_LINK if name != _SLOPE)
"""Compliances, rad/(N m): parameters of a calibration that no reading depends on by itself."""
_AIMED = 'aimed'
"""Whether the laser was aimed at the true centre: a choice, no number that a calibration finds."""
NOT_CALIBRATED = ('none',)


class RigVector(NamedTuple):
    """``values`` (COUNT,). ``clamp``: compliances by name, rad/(N m). ``other_effects``: those that are no parameters.

    ``listed``: names of the effects that are. ``tilts``: whether one of them says that the plate tilts; otherwise the
    estimates are those of a plate that stays parallel, and ``values`` has the k that the link has.
    """

    values: FloatArray
    clamp: dict[str, float]
    other_effects: list[ActiveEffect]
    listed: frozenset[str]
    tilts: bool

    @property
    def as_used(self) -> FloatArray:
        """``values`` as the pipeline takes them: k is 0 if nothing says that the plate tilts."""
        out = self.values.copy()
        if not self.tilts:
            out[SLOPE] = 0.0
        return out


def vector_of_rig(rig: Rig, effects: Sequence[ActiveEffect] | None = None) -> RigVector:
    """The parameters as ``rig`` has them; ``effects``: its effects, if they are known.

    Raises ConfigError if an effect is listed twice, or if two effects are the same parameter.
    """
    check_two_psds(rig, 'a calibration')
    v = np.zeros(len(ALL))
    clamp = dict.fromkeys(CLAMP, 0.0)
    other_effects: list[ActiveEffect] = []
    observed: dict[str, str] = {}
    listed: set[str] = set()
    tilts = False
    v[SLOPE] = rig.link.slope_ratio
    aimed = np.ones(2)
    for i, psd in enumerate(rig.psds):
        v[INDEX[f'psd_{i + 1}.center_x']], v[INDEX[f'psd_{i + 1}.center_y']] = psd.center
        v[INDEX[f'psd_{i + 1}.height']] = psd.height
        for axis, angle in zip('xy', rig.beams[i].angle, strict=True):
            v[INDEX[f'beam_{i + 1}.angle_{axis}']] = angle
    for active in effects_of_rig(rig) if effects is None else effects:
        called = active.effect.calibrated_as
        if not called:
            other_effects.append(active)
            continue
        for key, name in called.items():
            # Of one PSD an effect counts once, whatever its other choices are.
            full = f'psd_{active.values[PSD.name]:.0f}.{name}' if PSD in active.effect.parameters else name
            if active.values[key] != active.effect.parameter(key).nominal or name == _AIMED:
                _claim(observed, full, active)
            if name in clamp:
                clamp[name] = active.values[key]
            elif name == _SLOPE:
                v[SLOPE] = active.values[key]
            elif name == _AIMED:
                aimed[int(active.values[PSD.name]) - 1] = active.values[key]
            else:
                v[INDEX[full]] += active.values[key]
        listed.add(active.effect.name)
        tilts = tilts or _SLOPE in called.values()
    for i, psd in enumerate(rig.psds):
        center = v[INDEX[f'psd_{i + 1}.center_x']], v[INDEX[f'psd_{i + 1}.center_y']]
        # A laser that was not aimed at the true centre stands where the rig file has it.
        x, y = (z - (1.0 - aimed[i]) * (c - f) for z, c, f in zip(psd.zero, center, psd.center, strict=True))
        xp = FIXED
        v[ZERO + 2 * i : ZERO + 2 * i + 2] = response_of(v, i).reading(np.array(x), np.array(y), xp)
    return RigVector(v, clamp, other_effects, frozenset(listed), tilts)


def _claim(claimed: dict[str, str], name: str, active: ActiveEffect) -> None:
    """Note that ``active`` gives the parameter ``name``. Raises ConfigError if another effect gives it already."""
    before = claimed.get(name)
    if before == active.label:
        raise ConfigError(f'effects: {before}: listed twice; a calibration takes one of them')
    if before is not None:
        raise ConfigError(f'effects: {before} and {active.label}: both give {name}; a calibration takes one of them')
    claimed[name] = active.label


class Known(NamedTuple):
    """``covariance`` (COUNT, COUNT) of the parameters. ``calibrated``: whether a calibration gave it."""

    covariance: FloatArray
    calibrated: bool


def is_calibrated(rig: Rig) -> bool:
    """Whether the rig file says what a calibration left open."""
    return rig.calibration.names != NOT_CALIBRATED


def stated_sd(rig: Rig) -> dict[str, float]:
    """Standard deviations that the rig file states, by name. Raises ConfigError as :func:`known_of_rig` does."""
    names, sds = rig.calibration.names, rig.calibration.sds
    if not is_calibrated(rig):
        return {}
    for name in names:
        if name not in INDEX and name not in CLAMP:
            known = (*INDEX, *CLAMP)
            raise ConfigError(f'calibration.names: {name}: no parameter of a calibration{did_you_mean(name, known)}')
    if len(set(names)) < len(names):
        raise ConfigError('calibration.names: a name is there twice')
    if len(sds) != len(names):
        raise ConfigError(f'calibration.sds: {len(sds)} values for {len(names)} calibration.names; give one for each')
    return dict(zip(names, sds, strict=True))


def known_of_rig(rig: Rig) -> Known:
    """What the rig file says of the parameters' uncertainty; of those that it does not name, the tolerances.

    Raises ConfigError if names, standard deviations and correlations do not fit together.
    """
    stated = stated_sd(rig)
    covariance = np.diag(TOLERANCES**2)
    if not stated:
        return Known(covariance, False)
    names, sds, given = rig.calibration.names, np.array(rig.calibration.sds), np.array(rig.calibration.correlations)
    n = len(names)
    correlation = np.eye(n)
    if given.any():
        if len(given) != n * (n - 1) // 2:
            raise ConfigError(
                f'calibration.correlations: {len(given)} values for {n} names; must be {n * (n - 1) // 2}'
            )
        below = np.tril_indices(n, -1)
        correlation[below] = given
        correlation.T[below] = given
        xp = FIXED
        values, vectors = xp.eigen(correlation)
        if values[0] < -1e-6 * n:
            raise ConfigError('calibration.correlations: contradict each other; take them from a calibration unchanged')
        # Rounding in the file leaves values a little below zero.
        correlation = xp.product(vectors * np.maximum(values, 0.0), vectors.T)
    rows = [i for i, name in enumerate(names) if name in INDEX]
    at = np.array([INDEX[names[i]] for i in rows], dtype=np.intp)
    joint = correlation * np.outer(sds, sds)
    covariance[np.ix_(at, at)] = joint[np.ix_(rows, rows)]
    return Known(covariance, True)


def rig_values(
    vector: RigVector, p: FloatArray, clamp: Mapping[str, float]
) -> tuple[dict[str, object], list[ActiveEffect]]:
    """Flat values and effects of a rig file with the parameters ``p`` (COUNT,) and ``clamp``.

    ``vector``: of the rig file that is changed; its other effects are kept.
    """
    # Editors of YAML keep twelve digits of a number with an exponent, not all of them sixteen.
    p = np.array([float(f'{v:.12g}') for v in p])
    # Hardly determined, it may come out below what it can be.
    p[SLOPE] = max(p[SLOPE], BY_NAME[_SLOPE].minimum or 0.0)
    values: dict[str, object] = {'link.slope_ratio': float(p[SLOPE])}
    effects = list(vector.other_effects)
    for n in (1, 2):
        psd_values = {name: float(p[INDEX[name]]) for name in INDEX if name.startswith((f'psd_{n}.', f'beam_{n}.'))}
        values[f'psd_{n}.center'] = [psd_values[f'psd_{n}.center_x'], psd_values[f'psd_{n}.center_y']]
        values[f'psd_{n}.height'] = psd_values[f'psd_{n}.height']
        values[f'beam_{n}.angle'] = [psd_values[f'beam_{n}.angle_x'], psd_values[f'beam_{n}.angle_y']]
        place = response_of(p, n - 1).place(p[ZERO + 2 * n - 2], p[ZERO + 2 * n - 1])
        values[f'psd_{n}.zero'] = [float(f'{x:.12g}') for x in place]
    # A clamp that gives less than nothing is the link's stiffness, not the clamp.
    full = {name: max(float(f'{clamp[name]:.12g}'), 0.0) for name in CLAMP} | {_SLOPE: float(p[SLOPE])}
    for effect, called in _written(vector.listed):
        if PSD not in effect.parameters:
            _add(effects, effect, {key: full[name] for key, name in called.items()})
            continue
        for n in (1, 2):
            effect_values = {key: float(p[INDEX[f'psd_{n}.{name}']]) for key, name in called.items()}
            _add(effects, effect, effect_values, {PSD.name: float(n)})
    return values, sort_effects(effects)


def _written(listed: frozenset[str]) -> Iterator[tuple[Effect, dict[str, str]]]:
    """The effects that a calibrated rig file has, each with those of its parameters that go into it.

    Of several effects for one parameter: that which the rig file listed, otherwise the package's own.
    """
    known = [e for e in our_effects(*listed).values() if e.calibrated_as and not e.is_placed]
    taken: set[str] = set()
    for effect in sorted(known, key=lambda e: e.name not in listed):
        if called := {key: name for key, name in effect.calibrated_as.items() if name not in taken}:
            taken.update(called.values())
            yield effect, called


def _add(
    effects: list[ActiveEffect], effect: Effect, sizes: Mapping[str, float], choices: Mapping[str, float] | None = None
) -> None:
    if any(sizes.values()):
        effects.append(make_active(effect.name, {**(choices or {}), **sizes}, 'calibration'))


RANGE: FloatArray = np.array([0.006, 0.006, 0.06])
"""Poses (m, m, rad) within which the quartic is fitted: about what detectors of 10 mm see."""
LEVELS = 5


class ParameterCovariance:
    """The spread of the dots that the calibration of one rig file leaves. Make it with :meth:`from_rig`.

    The readings are r = f(pose; p). The pipeline takes the effects of p off the dots, so an error of p moves the
    corrected dots by -S^-1 (df/dp) dp, S = d(reading)/d(place on the detector). With the covariance P of p and a
    solver's gain K (:meth:`psd_deflection.model.solvers.interface.Solver.gain`) the estimate's covariance grows by

        K B B^T K^T,    B = S^-1 (df/dp) P^(1/2).

    P holds the unloaded reading too. A zero that is taken by the running daemon replaces its part: its own noise,
    independent of the rest.
    """

    def __init__(self, values: FloatArray, covariance: FloatArray, length: float, xp: Arithmetic = FIXED) -> None:
        """``values`` (COUNT,), ``covariance`` (COUNT, COUNT): as the readings' model has them; ``length``: L, m."""
        self._xp = xp
        scale = _scale(covariance)
        size, vectors = xp.eigen(covariance / np.outer(scale, scale))
        significant = size > 1e-14
        root = scale[:, None] * vectors[:, significant] * np.sqrt(size[significant])
        levels = np.linspace(-1.0, 1.0, LEVELS)
        points = np.stack(np.meshgrid(levels, levels, levels), axis=0).reshape(3, -1)
        slopes = xp.product(dots_by_parameters(values, points * RANGE[:, None], length, xp), root)
        basis = np.stack([_terms(*point) for point in points.T.tolist()])
        self._shape = (4, root.shape[1])
        # Smooth as they are, a quartic gives them to 1e-4; a block has no time for differences.
        self._quartic = xp.least_squares(basis, slopes.reshape(len(basis), -1))

    @classmethod
    def from_rig(
        cls, rig: Rig, zero_variances: tuple[float, ...] = (), effects: Sequence[ActiveEffect] | None = None
    ) -> ParameterCovariance | None:
        """None if the rig was not calibrated or its covariances are not to be total.

        ``zero_variances`` (4,) m^2: of a zero that was taken after the calibration. ``effects``: those of the rig, if
        they are known. Raises ConfigError.
        """
        if rig.estimator.covariance != 'total' or not is_calibrated(rig):
            return None
        check_two_psds(rig, 'a calibration (calibration.names)')
        covariance = known_of_rig(rig).covariance
        if zero_variances:
            covariance[ZERO:] = covariance[:, ZERO:] = 0.0
            covariance[ZERO:, ZERO:] = np.diag(zero_variances)
        xp = FIXED
        return cls(vector_of_rig(rig, effects).as_used, covariance, rig.link.length, xp)

    def factor(self, dx: float, dy: float, theta: float) -> FloatArray:
        """B (4, k), m, at a pose (m, m, rad): the corrected dots spread by B B^T."""
        across, twist = float(RANGE[0]), float(RANGE[2])
        terms = np.array(_terms(dx / across, dy / across, theta / twist))
        return self._xp.einsum('t,ti->i', terms, self._quartic).reshape(self._shape)


def _pairs() -> list[tuple[int, int]]:
    """Which products of two make the products of four, each once."""
    second = [(i, j) for i in range(4) for j in range(i, 4)]
    pairs: dict[tuple[int, ...], tuple[int, int]] = {}
    for a, row in enumerate(second):
        for b, right in enumerate(second):
            pairs.setdefault(tuple(sorted(row + right)), (a, b))
    return list(pairs.values())


_PAIRS = _pairs()


def _terms(x: float, y: float, t: float) -> list[float]:
    """The 35 products of up to four factors."""
    first = (1.0, x, y, t)
    second = [a * b for i, a in enumerate(first) for b in first[i:]]
    return [second[a] * second[b] for a, b in _PAIRS]


def dots_by_parameters(p: FloatArray, pose: FloatArray, length: float, xp: Arithmetic = FIXED) -> FloatArray:
    """S^-1 (df/dp), (n, 4, COUNT), at poses (3, n)."""
    slopes = by_parameters(p, pose, length, xp).transpose(2, 0, 1).copy()
    read = readings(p, pose, length, xp)
    for psd in range(2):
        rows = slice(2 * psd, 2 * psd + 2)
        response = response_of(p, psd)
        x, y = response.place(read[2 * psd], read[2 * psd + 1], xp)
        rotated = response.slopes(x, y, xp).transpose(2, 0, 1)
        slopes[:, rows] = xp.solve(rotated, slopes[:, rows])
    return slopes


def _scale(covariance: FloatArray) -> FloatArray:
    """Standard deviations, 1 where there is none, so that units do not decide what counts as zero."""
    sd = np.sqrt(np.diag(covariance))
    sd[sd == 0.0] = 1.0
    return sd
