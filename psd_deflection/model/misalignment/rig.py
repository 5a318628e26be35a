"""The parameters of a rig file as a vector with its uncertainty, and the values of a rig file from such a vector."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from psd_deflection.base.arithmetic import ARITHMETICS
from psd_deflection.base.errors import ConfigError, did_you_mean
from psd_deflection.model.misalignment.model import (
    ALL,
    INDEX,
    SLOPE,
    TOLERANCES,
    ZERO,
    place_of_reading,
    reading_of_place,
)
from psd_deflection.model.simulation.catalogue import effects_of_rig, make_active, sort_effects
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, check_two_psds

_OF_PSD = {
    'sensor_rotation': {'angle': 'rotation'},
    'sensor_gain': {'x': 'gain_x', 'y': 'gain_y'},
    'axis_crosstalk': {'xy': 'crosstalk_xy', 'yx': 'crosstalk_yx'},
    'sensor_nonlinearity': {'k': 'nonlinearity'},
    'sensor_position': {'x': 'center_x', 'y': 'center_y'},
}
"""Effects of one detector: their parameters, and what these are called here."""
TILT = 'plane_tilt'
CLAMP = {
    'clamp_bending_compliance': 'clamp.bending_compliance',
    'clamp_torsional_compliance': 'clamp.torsional_compliance',
}
NOT_CALIBRATED = ('none',)


class RigVector(NamedTuple):
    """``values`` (COUNT,). ``clamp``: compliances by name, rad/(N m). ``others``: effects that are no parameters here.

    ``tilts``: whether the rig file says that the plate tilts (an effect); otherwise its estimates are those of a
    plate that stays parallel, and ``values`` has the k that the link has.
    """

    values: FloatArray
    clamp: dict[str, float]
    others: list[ActiveEffect]
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

    Raises ConfigError if an effect is listed twice.
    """
    check_two_psds(rig, 'a calibration')
    v = np.zeros(len(ALL))
    clamp = dict.fromkeys(CLAMP.values(), 0.0)
    others: list[ActiveEffect] = []
    seen: set[str] = set()
    v[SLOPE] = rig.link.slope_ratio
    aimed = np.ones(2)
    for i, psd in enumerate(rig.psds):
        v[INDEX[f'psd_{i + 1}.center_x']], v[INDEX[f'psd_{i + 1}.center_y']] = psd.center
        v[INDEX[f'psd_{i + 1}.height']] = psd.height
        for axis, angle in zip('xy', rig.beams[i].angle, strict=True):
            v[INDEX[f'beam_{i + 1}.angle_{axis}']] = angle
    for active in effects_of_rig(rig) if effects is None else effects:
        name = active.effect.name
        if name not in (*_OF_PSD, *CLAMP, TILT):
            others.append(active)
            continue
        if active.label in seen:
            raise ConfigError(f'effects: {active.label}: listed twice; a calibration takes one of them')
        seen.add(active.label.split(',')[0])
        if name == TILT:
            v[SLOPE] = active.values['slope_ratio']
        elif name in CLAMP:
            clamp[CLAMP[name]] = active.values['compliance']
        else:
            psd_number = int(active.values['psd'])
            for own, called in _OF_PSD[name].items():
                v[INDEX[f'psd_{psd_number}.{called}']] += active.values[own]
            if name == 'sensor_position':
                aimed[psd_number - 1] = active.values['aimed']
    for i, psd in enumerate(rig.psds):
        center = v[INDEX[f'psd_{i + 1}.center_x']], v[INDEX[f'psd_{i + 1}.center_y']]
        # A laser that was not aimed at the true centre stands where the rig file has it.
        x, y = (z - (1.0 - aimed[i]) * (c - f) for z, c, f in zip(psd.zero, center, psd.center, strict=True))
        v[ZERO + 2 * i : ZERO + 2 * i + 2] = reading_of_place(
            v, i, np.array(x), np.array(y), ARITHMETICS[rig.estimator.arithmetic]
        )
    return RigVector(v, clamp, others, any(label.startswith(TILT) for label in seen))


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
        if name not in INDEX and name not in CLAMP.values():
            known = (*INDEX, *CLAMP.values())
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
    if n > 1 and given.any():
        if len(given) != n * (n - 1) // 2:
            raise ConfigError(
                f'calibration.correlations: {len(given)} values for {n} names; must be {n * (n - 1) // 2}'
            )
        below = np.tril_indices(n, -1)
        correlation[below] = given
        correlation.T[below] = given
        by = ARITHMETICS[rig.estimator.arithmetic]
        values, vectors = by.eigen(correlation)
        if values[0] < -1e-6 * n:
            raise ConfigError('calibration.correlations: contradict each other; take them from a calibration unchanged')
        # Rounding in the file leaves values a little below zero.
        correlation = by.product(vectors * np.maximum(values, 0.0), vectors.T)
    own = [i for i, name in enumerate(names) if name in INDEX]
    at = np.array([INDEX[names[i]] for i in own], dtype=np.intp)
    joint = correlation * np.outer(sds, sds)
    covariance[np.ix_(at, at)] = joint[np.ix_(own, own)]
    return Known(covariance, True)


def rig_values(
    vector: RigVector, p: FloatArray, clamp: Mapping[str, float]
) -> tuple[dict[str, object], list[ActiveEffect]]:
    """Flat values and effects of a rig file with the parameters ``p`` (COUNT,) and ``clamp``.

    ``vector``: of the rig file that is changed; its other effects are kept.
    """
    # Editors of YAML keep twelve digits of a number with an exponent, not all of them sixteen.
    p = np.array([float(f'{v:.12g}') for v in p])
    values: dict[str, object] = {'link.slope_ratio': float(p[SLOPE])}
    effects = list(vector.others)

    def add(name: str, parameters: dict[str, float]) -> None:
        if any(v for key, v in parameters.items() if key != 'psd'):
            effects.append(make_active(name, parameters, 'calibration'))

    for n in (1, 2):
        own = {name: float(p[INDEX[name]]) for name in INDEX if name.startswith((f'psd_{n}.', f'beam_{n}.'))}
        values[f'psd_{n}.center'] = [own[f'psd_{n}.center_x'], own[f'psd_{n}.center_y']]
        values[f'psd_{n}.height'] = own[f'psd_{n}.height']
        values[f'beam_{n}.angle'] = [own[f'beam_{n}.angle_x'], own[f'beam_{n}.angle_y']]
        place = place_of_reading(p, n - 1, p[ZERO + 2 * n - 2], p[ZERO + 2 * n - 1])
        values[f'psd_{n}.zero'] = [float(f'{x:.12g}') for x in place]
        for name, called in _OF_PSD.items():
            if name != 'sensor_position':
                add(name, {'psd': float(n), **{key: own[f'psd_{n}.{to}'] for key, to in called.items()}})
    add(TILT, {'slope_ratio': float(p[SLOPE])})
    for name, clamp_name in CLAMP.items():
        # A clamp that gives less than nothing is the link's stiffness, not the clamp.
        add(name, {'compliance': max(float(f'{clamp[clamp_name]:.12g}'), 0.0)})
    return values, sort_effects(effects)
