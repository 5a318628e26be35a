# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Machines that others measured, as plants for ``discover_in``: a linear drive, a flexible arm, a telescope, a boom."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from psd_deflection.model.simulation.declaration import Effect, EffectParameter
from psd_deflection.records import FloatArray, IntArray
from psd_deflection.studies.discover.plants import Model, Plant, plant_effect


def _table(path: Path) -> FloatArray:
    """The rows of a CSV file below its head."""
    return np.loadtxt(path, delimiter=',', skiprows=1, ndmin=2)


def _of(model: Model, name: str, parameter: str) -> float:
    """A parameter of an effect; 0 of one that the model lacks."""
    return model[name][parameter] if name in model else 0.0


MASS, VISCOUS, COULOMB, OFFSET, GAIN = 95.1089, 203.5034, 20.3935, -3.1648, 35.15065
"""kg, N s/m, N, N, N/V, as published."""
RATE = 1000.0
STEP = 2  # Samples a step of the simulation.
KEPT = 10  # Every tenth sample of the position is compared.
SEGMENT_S = 2.0


def _scale(name: str, words: str) -> Effect:
    return plant_effect(name, EffectParameter('scale', '', -0.9, 4.0, 0.02, words))


LIBRARY = (
    plant_effect('coulomb_friction', EffectParameter('force', 'N', 0.0, 100.0, 1.0, 'against the motion')),
    plant_effect('force_offset', EffectParameter('force', 'N', -30.0, 30.0, 0.5, 'always the same way')),
    plant_effect('quadratic_drag', EffectParameter('drag', 'N s^2/m^2', 0.0, 5e3, 20.0, 'grows with speed squared')),
    plant_effect('spring', EffectParameter('stiffness', 'N/m', -500.0, 500.0, 5.0, 'towards zero')),
    plant_effect('position_offset', EffectParameter('shift', 'm', -0.01, 0.01, 1e-4, 'of the reading')),
    plant_effect('position_gain', EffectParameter('scale', '', -0.5, 0.5, 0.002, 'of the reading')),
    plant_effect('input_delay', EffectParameter('delay', 's', 0.0, 0.05, 0.002, 'of the voltage')),
    _scale('viscous_friction', 'relative change of Fv'),
    _scale('mass', 'relative change of M'),
    _scale('drive_gain', 'relative change of the gain'),
)


class Emps(Plant):
    """``without``: published terms that the model lacks, ``coulomb_friction`` or ``force_offset``."""

    channels = ('position',)
    units = ('m',)
    library: tuple[Effect, ...] = LIBRARY
    period = KEPT / RATE

    def __init__(self, without: Sequence[str], folder: Path) -> None:
        """Raises OSError if ``folder`` has no ``emps.csv``."""
        rows = _table(folder / 'emps.csv')
        n = round(SEGMENT_S * RATE)
        count = len(rows) // n
        position = rows[: count * n, 1].reshape(count, n)
        self._voltage = rows[: count * n, 2].reshape(count, n)
        # Speed at the start of each segment, from a polynomial through 80 ms on either side.
        speed, reach = np.zeros(count), 80
        for i in range(1, count):
            around = rows[i * n - reach : i * n + reach + 1, 1]
            speed[i] = np.polyfit(np.arange(-reach, reach + 1) / RATE, around, 4)[3]
        self._start = np.stack([position[:, 0], speed])
        self._measured = [row[None, ::KEPT] for row in position]
        self.cases = tuple(f'{SEGMENT_S * i:.0f} s' for i in range(count))
        self._terms = (0.0 if 'coulomb_friction' in without else COULOMB, 0.0 if 'force_offset' in without else OFFSET)

    def measured(self) -> list[FloatArray]:
        """Position, m."""
        return self._measured

    def inputs(self) -> Mapping[str, Sequence[FloatArray]]:
        """Voltage, V."""
        return {'voltage': list(self._voltage[:, ::KEPT])}

    def simulate(self, model: Model) -> list[FloatArray]:
        """Return all segments at once, semi-implicit Euler at the sample rate."""
        mass = MASS * (1.0 + _of(model, 'mass', 'scale'))
        viscous = VISCOUS * (1.0 + _of(model, 'viscous_friction', 'scale'))
        coulomb = self._terms[0] + _of(model, 'coulomb_friction', 'force')
        offset = self._terms[1] + _of(model, 'force_offset', 'force')
        drag, spring = _of(model, 'quadratic_drag', 'drag'), _of(model, 'spring', 'stiffness')
        n = self._voltage.shape[1]
        at = np.clip(np.arange(n) - _of(model, 'input_delay', 'delay') * RATE, 0.0, n - 1.0)
        low = np.minimum(at.astype(np.int64), n - 2)
        voltage = self._voltage[:, low] + (at - low) * (self._voltage[:, low + 1] - self._voltage[:, low])
        means = voltage.reshape(len(voltage), -1, STEP).mean(axis=2)
        force = (GAIN * (1.0 + _of(model, 'drive_gain', 'scale')) * means - offset).T
        q, v = self._start[0].copy(), self._start[1].copy()
        out = np.empty((len(force), len(q)))
        # With the force held over a step, viscous friction is exact.
        h = STEP / RATE
        fade = np.exp(-h * viscous / mass)
        gain = (1.0 - fade) / viscous
        for i, given in enumerate(force):
            out[i] = q
            push = given - spring * q
            if drag:
                push = push - drag * v * np.abs(v)
            free = fade * v + gain * push
            # Friction holds what would turn round within the step.
            after = np.sign(free) * np.maximum(np.abs(free) - gain * coulomb, 0.0)
            q = q + 0.5 * h * (v + after)
            v = after
        gain, shift = 1.0 + _of(model, 'position_gain', 'scale'), _of(model, 'position_offset', 'shift')
        return [row[None, :] for row in out[:: KEPT // STEP].T * gain + shift]


ARCSECONDS = 3600.0 * 180.0 / np.pi
HIGHEST = 8  # Order of a harmonic, at most.
PHYSICAL = ('CA', 'NPAE', 'AN', 'AW', 'TF', 'TX')


def _term(name: str) -> Effect:
    return plant_effect(name, EffectParameter('size', 'arcsec', -2000.0, 2000.0, 20.0, 'of the term'))


def _harmonics() -> list[str]:
    named = itertools.product('AES', 'SC', 'AE', range(1, HIGHEST + 1))
    words = [f'H{what}{wave}{of}{order if order > 1 else ""}' for what, wave, of, order in named]
    # The tilt of the azimuth axis and the flexure have names of their own.
    return [w for w in words if w not in ('HESA', 'HECA', 'HECE', 'HSSE', 'HSCE')]


class AuxTel(Plant):
    """``known``: physical terms that the model has."""

    channels = ('across', 'up')
    units = ('arcsec', 'arcsec')
    cases = ('night',)

    def __init__(self, path: Path, known: Sequence[str] = ()) -> None:
        """Raises OSError if there is no file."""
        rows = np.radians(np.loadtxt(path))
        self.azimuth, self.elevation = rows[:, 0], rows[:, 1]
        rotated = np.mod(rows[:, 2] - rows[:, 0] + np.pi, 2.0 * np.pi) - np.pi
        self._observed = ARCSECONDS * np.stack([rotated * np.cos(self.elevation), rows[:, 3] - self.elevation])
        self.nuisance = tuple(_term(name) for name in ('IA', 'IE', *known))
        names = [*PHYSICAL, *_harmonics()]
        self.library = tuple(_term(name) for name in names if name not in known)

    def measured(self) -> list[FloatArray]:
        """How far across and up, arcsec on the sky, each star was from where it was commanded."""
        return [self._observed]

    def inputs(self) -> Mapping[str, Sequence[FloatArray]]:
        """Azimuth and elevation, rad."""
        return {'azimuth': [self.azimuth], 'elevation': [self.elevation]}

    def variables(self) -> Mapping[str, Sequence[FloatArray]]:
        """Elevation, which the tube hangs by, and the place on the sky, as a direction: azimuth has no ends."""
        a, e = self.azimuth, self.elevation
        place = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        return {'elevation': [e], 'place on the sky': [place]}

    def parts(self) -> Sequence[IntArray]:
        """Each star is left out by itself."""
        return [np.arange(len(self.azimuth))]

    def simulate(self, model: Model) -> list[FloatArray]:
        out = np.zeros_like(self._observed)
        for name, values in model.items():
            out += values['size'] * self._picture(name)
        return [out]

    def _picture(self, name: str) -> FloatArray:
        """(2, n): what 1 arcsec of a term does across and up."""
        a, e = self.azimuth, self.elevation
        none, ones = np.zeros_like(a), np.ones_like(a)
        physical: dict[str, tuple[FloatArray, FloatArray]] = {
            'IA': (np.cos(e), none),
            'IE': (none, ones),
            'CA': (ones, none),
            'NPAE': (np.sin(e), none),
            'AN': (np.sin(a) * np.sin(e), np.cos(a)),
            'AW': (np.cos(a) * np.sin(e), -np.sin(a)),
            'TF': (none, np.cos(e)),
            'TX': (none, 1.0 / np.tan(e)),
        }
        if name in physical:
            return np.stack(physical[name])
        what, wave, of, order = name[1], name[2], name[3], float(name[4:] or 1)
        angle = order * (a if of == 'A' else e)
        value = np.sin(angle) if wave == 'S' else np.cos(angle)
        if what == 'E':
            return np.stack([none, value])
        return np.stack([value * np.cos(e) if what == 'A' else value, none])


EI = 91.0  # N m^2, fitted by those who measured.
READING = 5e-4  # m rms, of a ruler with millimetres.
STIFFNESS = plant_effect(
    'bending_compliance',
    EffectParameter('scale', '', -0.9, 3.0, 0.1, 'relative change of 1/EI'),
    equation='1/EI *= 1 + scale',
)
SELF_WEIGHT = plant_effect(
    'self_weight', EffectParameter('weight', 'N/m', 0.0, 20.0, 0.2, 'per length'), equation='w L^4/(8 EI)'
)
TIP_FORCE = plant_effect(
    'tip_force', EffectParameter('force', 'N', -5.0, 5.0, 0.2, 'at the tip, always'), equation='F += force'
)
CLAMP = plant_effect(
    'clamp_compliance',
    EffectParameter('compliance', 'rad/(N m)', 0.0, 0.02, 2e-4, 'turn of the root per moment'),
    equation='slope at the root = compliance M',
)
ROOT = plant_effect(
    'root_length', EffectParameter('longer', 'm', -0.2, 0.5, 0.02, 'of the bending part'), equation='L += longer'
)
TILT = plant_effect('mount_tilt', EffectParameter('angle', 'rad', -0.1, 0.1, 2e-3, 'of the root'), equation='angle L')


class Boom(Plant):
    """``weighed``: the weight of the boom, N/m, and of its end cap, N, as the scales say, belong to the model."""

    channels = ('deflection',)
    units = ('m',)
    nuisance = (STIFFNESS,)
    noise = (READING,)

    def __init__(self, folder: Path, weighed: bool = False) -> None:
        """Raises OSError if ``folder`` has no ``readings.csv``."""
        rows = _table(folder / 'readings.csv') * [1e-3, 1.0, 1e-3, 1e-3]
        self.lengths = np.unique(rows[:, 0])
        self.cases = tuple(f'{1e3 * v:.0f} mm' for v in self.lengths)
        self._rows = [rows[rows[:, 0] == v] for v in self.lengths]
        self._weighed = (0.188 * 9.81, 0.25) if weighed else (0.0, 0.0)
        self.library = (*(() if weighed else (SELF_WEIGHT,)), TIP_FORCE, CLAMP, ROOT, TILT)

    def measured(self) -> list[FloatArray]:
        """Return the deflection, m, of each reading, length by length."""
        return [r[:, 3][None, :] for r in self._rows]

    def inputs(self) -> Mapping[str, list[FloatArray]]:
        """Force, N, and length, m."""
        return {'force': [r[:, 1] for r in self._rows], 'length': [r[:, 0] for r in self._rows]}

    def simulate(self, model: Model) -> list[FloatArray]:
        """Euler's beam with a root that gives way."""
        weight, cap = self._weighed
        weight += _of(model, 'self_weight', 'weight')
        cap += _of(model, 'tip_force', 'force')
        give = (1.0 + _of(model, 'bending_compliance', 'scale')) / EI

        def tip(length: FloatArray, force: FloatArray) -> FloatArray:
            at = length + _of(model, 'root_length', 'longer')
            moment = (force + cap) * at + 0.5 * weight * at**2
            bent = give * ((force + cap) * at**3 / 3.0 + weight * at**4 / 8.0)
            angle = _of(model, 'clamp_compliance', 'compliance') * moment + _of(model, 'mount_tilt', 'angle')
            return np.asarray(bent + angle * at)

        start = tip(self.lengths[:1], np.zeros(1))
        return [(tip(r[:, 0], r[:, 1]) - start)[None, :] for r in self._rows]


GEAR = 0.75 * 0.119 * 100.0  # N m/A at the load shaft: efficiency, torque constant, ratio.
HUB, TIP, HUB_VISCOUS = 6.28e-6 * 100.0**2 + 7.3616e-4, 0.18028257 - 1.578 * 0.079**2, 4.0  # kg m^2 twice; N m s/rad
BEAM = 2.068427e11 * 0.0762 * 0.00127**3 / (4.0 * 0.202)  # N m/rad
READ_S, ARM_STEPS, ARM_PIECE = 0.01, 2, 50  # s between readings; steps between two; readings simulated in one piece.
ARM_SCALES = ('hub_viscous', 'stiffness', 'torque_gain', 'hub_inertia', 'tip_inertia', 'tip_gain')
ARM = (
    plant_effect('coulomb_friction', EffectParameter('torque', 'N m', 0.0, 20.0, 0.3, 'at the hub')),
    plant_effect('tip_damping', EffectParameter('damping', 'N m s/rad', 0.0, 5.0, 0.02, 'in the beam')),
    plant_effect('current_offset', EffectParameter('current', 'A', -1.0, 1.0, 0.01, 'always the same way')),
    plant_effect('input_delay', EffectParameter('delay', 's', 0.0, 0.05, 0.002, 'of the current')),
    plant_effect('tip_offset', EffectParameter('angle', 'rad', -0.05, 0.05, 5e-4, 'of the reading')),
    *(_scale(name, 'relative change') for name in ARM_SCALES),
)


class TwoLinkArm(Plant):
    """Stage 1 of a flexible arm. Its maker's model lacks Coulomb friction and damping of the tip."""

    channels = ('hub', 'tip')
    units = ('rad', 'rad')
    library: tuple[Effect, ...] = ARM
    period = READ_S

    def __init__(self, folder: Path) -> None:
        """Raises OSError if ``folder`` has no ``excerpt.csv``."""
        rows = np.genfromtxt(folder / 'excerpt.csv', delimiter=',', skip_header=1, dtype=str)
        runs = tuple(dict.fromkeys(rows[:, 0].tolist()))
        values = np.where(rows[:, 1:] == '', 'nan', rows[:, 1:]).astype(np.float64)
        tables = [values[rows[:, 0] == run] for run in runs]
        n, starts = ARM_PIECE, list[FloatArray]()
        pieces = [t[i : i + n] for t in tables for i in range(0, len(t) - n + 1, n)]
        for t in tables:
            starts.append(t[0, 2:6])
            # Angles and rates from cubics through 80 ms on either side.
            for i in range(n, len(t) - n + 1, n):
                cubic = np.polyfit(np.arange(-8, 9) * READ_S, t[i - 8 : i + 9, 2:4], 3)
                starts.append(np.concatenate((cubic[3], cubic[2])))
        self._current, hub, tip = (np.array([t[:, i] for t in pieces]) for i in (1, 2, 3))
        self.cases = tuple(f'{run} {k}' for run, t in zip(runs, tables, strict=True) for k in range(len(t) // n))
        self._measured = [np.stack(pair) for pair in zip(hub, tip, strict=True)]
        self._start = np.array(starts).T

    def measured(self) -> list[FloatArray]:
        """Angle of the hub and of the tip against it, rad."""
        return self._measured

    def inputs(self) -> Mapping[str, Sequence[FloatArray]]:
        """Current, A."""
        return {'current': list(self._current)}

    def simulate(self, model: Model) -> list[FloatArray]:
        """Return all segments at once, semi-implicit Euler; viscous friction of the hub is exact over a step."""
        scale = {name: 1.0 + _of(model, name, 'scale') for name in ARM_SCALES}
        hub, tip, spring = HUB * scale['hub_inertia'], TIP * scale['tip_inertia'], BEAM * scale['stiffness']
        viscous, damping = HUB_VISCOUS * scale['hub_viscous'], _of(model, 'tip_damping', 'damping')
        coulomb = _of(model, 'coulomb_friction', 'torque')
        h = READ_S / ARM_STEPS
        at = np.clip(np.arange(self._current.shape[1]) - _of(model, 'input_delay', 'delay') / READ_S, 0.0, None)
        low = np.minimum(at.astype(np.int64), len(at) - 2)
        current = self._current[:, low] + (at - low) * (self._current[:, low + 1] - self._current[:, low])
        torque = GEAR * scale['torque_gain'] * (current.T + _of(model, 'current_offset', 'current'))
        fade = np.exp(-h * viscous / hub)
        gain = (1.0 - fade) / viscous
        q, bent, v, w = self._start
        w = w + v  # Of the tip, against the ground.
        out = np.empty((len(torque), 2, len(q)))
        for i, given in enumerate(torque):
            out[i] = q, bent
            for _ in range(ARM_STEPS):
                couple = spring * bent + damping * (w - v)
                free = fade * v + gain * (given + couple)
                v = np.sign(free) * np.maximum(np.abs(free) - gain * coulomb, 0.0)
                w = w - h / tip * couple
                q, bent = q + h * v, bent + h * (w - v)
        offset = _of(model, 'tip_offset', 'angle')
        return [np.stack((r[:, 0], scale['tip_gain'] * r[:, 1] + offset)) for r in np.moveaxis(out, 2, 0)]
