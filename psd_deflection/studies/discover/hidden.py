# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the search adjusts besides the catalogue's effects, each declared as one: mistakes of the set-up, which become
lines for the rig file, free loads, and how the link moved before the first sample."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csc_array, csr_array, vstack

from psd_deflection.model.simulation.declaration import ActiveEffect, Effect, EffectParameter, Stage, State, Values
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.records import FloatArray, dot_channels, dot_names

AXES = ('dx', 'dy', 'theta')
NEXT_TO_NOTHING = 1e-7
"""Relative size of what a load does long after it changed, below which it is not stored."""


def only_in(effects: Sequence[ActiveEffect], recording: int) -> list[ActiveEffect]:
    """Those of ``effects`` that act in this recording, counted from 0."""
    return [a for a in effects if a.values.get('recording', recording + 1) == recording + 1]


def _of_recording(count: int) -> EffectParameter:
    choices = tuple(range(1, count + 1))
    return EffectParameter(
        'recording', '', 1, count, 1, 'which recording', nominal=1, kind='choice', choices=choices, each=True
    )


def _amplitude(name: str, unit: str, least: float, most: float, scale: float, words: str) -> EffectParameter:
    return EffectParameter(name, unit, least, most, scale, words)


def beginning(starts: Sequence[float]) -> Effect:
    """Free ringing of the link's modes from ``starts`` on, s, one for each recording: it was not at rest there."""

    def ring(chunk: SimulatedSamples, values: Values, state: State) -> None:
        p = chunk.physics
        t = chunk.t - starts[int(values['recording']) - 1]
        after = t >= 0.0
        modes = [(p.bending_frequency, p.bending_damping_ratio)] * 2 + [(p.torsion_frequency, p.torsion_damping_ratio)]
        for axis, (name, (frequency, ratio)) in enumerate(zip(AXES, modes, strict=True)):
            w = 2.0 * math.pi * frequency
            wd = w * math.sqrt(1.0 - ratio**2)
            fade = np.exp(-ratio * w * np.where(after, t, 0.0))
            wave = values[f'cos_{name}'] * np.cos(wd * t) + values[f'sin_{name}'] * np.sin(wd * t)
            chunk.pose[axis] += np.where(after, fade * wave, 0.0)

    sizes = [
        _amplitude(f'{wave}_{name}', unit, -1.0, 1.0, 1e-6, f'ringing of {name} at the start')
        for name, unit in zip(AXES, ('m', 'm', 'rad'), strict=True)
        for wave in ('cos', 'sin')
    ]
    return Effect(
        name=BEGINNING,
        stage='link',
        summary='the link is not at rest at the first sample',
        equation='q += exp(-ζωt) (a cos ωt + b sin ωt)',
        source='free motion of a damped mode',
        needs='nothing',
        parameters=(_of_recording(len(starts)), *sizes),
        point='pose',
        apply=ring,
        order=99,
    )


def _sensitivity(physics: Physics, values: Values) -> None:
    physics.sensitivity = physics.sensitivity * (1.0 + values['error'])


def _length(physics: Physics, values: Values) -> None:
    physics.length *= 1.0 + values['error']


def _rate(physics: Physics, values: Values) -> None:
    physics.period /= 1.0 + values['error']


def _bending(physics: Physics, values: Values) -> None:
    physics.bending_frequency *= 1.0 + values['error']


def _torsion(physics: Physics, values: Values) -> None:
    physics.torsion_frequency *= 1.0 + values['error']


def _delay(chunk: SimulatedSamples, values: Values, state: State) -> None:
    at = np.arange(chunk.loads.shape[1]) + values['late_by'] / chunk.physics.period
    samples = np.arange(chunk.loads.shape[1])
    for row in range(3):
        chunk.loads[row] = np.interp(at, samples, chunk.loads[row])


def zero_moved(values: Values, psds: int) -> FloatArray:
    """By how much the unloaded dots of so many PSDs are elsewhere, (P, 2), m, by ``values`` of the mistake ``zero``."""
    return np.array([values[name] for name in dot_names(psds)]).reshape(-1, 2)


def _zero(physics: Physics, values: Values) -> None:
    moved = zero_moved(values, len(physics.centers))
    if values['of_reading']:
        # A constant added to the reading, as by an amplifier's offset.
        physics.centers = physics.centers - moved
    else:
        physics.beams = physics.beams + moved


def _jump(chunk: SimulatedSamples, values: Values, state: State) -> None:
    i = 2 * (int(values['psd']) - 1)
    # Half a microsecond early: the sample's own time is rounded.
    after = chunk.t >= 1e-6 * values['time_us'] - 5e-7
    chunk.dots[i] += values['jump_x'] * after
    chunk.dots[i + 1] += values['jump_y'] * after


def _only(name: str, value: int) -> EffectParameter:
    return EffectParameter(name, '', value, value, 1, '', value, 'choice', choices=(value,), each=name != 'time_us')


def _factor(name: str, configure: Callable[[Physics, Values], None], stage: Stage, words: str) -> Effect:
    scale = _amplitude('error', '', -0.95, 20.0, 1e-3, words)
    return Effect(name, stage, words, '', '', '', (scale,), 'configure', configure=configure, order=98)


def mistakes(
    recordings: int, delays: Sequence[float], jumps: Sequence[tuple[int, int, float]], psds: int = 2
) -> list[Effect]:
    """Return the mistakes of the set-up of a rig of so many ``psds`` that have a size.

    ``delays``: by how much the loads may be noted late, s. ``jumps``: recording, PSD, time, s, of steps that the
    readings seem to have.
    """
    out = [
        _factor('sensitivity', _sensitivity, 'electronics', 'sensitivity of the amplifier, all channels'),
        _factor('link_length', _length, 'link', 'length of the link'),
        _factor('sample_rate', _rate, 'electronics', 'sample rate'),
        _factor('bending_frequency', _bending, 'link', 'natural frequency of the bending'),
        _factor('torsion_frequency', _torsion, 'link', 'natural frequency of the torsion'),
    ]
    if delays:
        delay = EffectParameter('late_by', 's', -2.0, 2.0, 1e-3, 'delay of the recorded load times', grid=tuple(delays))
        late_loads = Effect(
            'load_delay',
            'load',
            'late loads',
            '',
            '',
            '',
            (delay,),
            'load',
            apply=_delay,
            order=-1,
            finite=True,
            full=True,
        )
        out.append(late_loads)
    if recordings > 1:
        places = [_amplitude(n, 'm', -0.02, 0.02, 1e-5, 'unloaded dot') for n in dot_names(psds)]
        of_reading = EffectParameter('of_reading', '', 0, 1, 1, '0: beam, 1: reading', kind='choice', choices=(0, 1))
        parameters = (_of_recording(recordings), of_reading, *places)
        out.append(Effect('zero', 'optics', 'zero', '', '', '', parameters, 'configure', configure=_zero, order=98))
    for recording, psd, time in jumps:
        parameters = (
            _only('recording', recording),
            _only('psd', psd),
            _only('time_us', round(1e6 * time)),
            _amplitude('jump_x', 'm', -0.02, 0.02, 1e-6, 'jump of the reading'),
            _amplitude('jump_y', 'm', -0.02, 0.02, 1e-6, 'jump of the reading'),
        )
        out.append(Effect('jump', 'psd', 'jump', '', '', '', parameters, 'dots', apply=_jump, order=98))
    return out


BEGINNING = 'beginning'
RIG_NUMBERS = {'bending_frequency': 'dynamics.bending_frequency', 'torsion_frequency': 'dynamics.torsion_frequency'}
"""Mistakes that are reported as effects, as the schema of result.json knows no name for them: keys of the rig file."""
FIRST = frozenset(('sensitivity', 'link_length', 'sample_rate', 'load_delay', *RIG_NUMBERS))
"""Those that touch every channel: beside an effect a small one would stand in for what no effect explains, so they are
only looked for before any effect is found."""
SETUP = frozenset((*FIRST, 'zero', 'jump'))
"""Names of the effects that are mistakes of the set-up."""


@dataclass(frozen=True, slots=True, eq=False)
class LoadDirection:
    """A change of the loads that nobody knows: ``change`` (n, 3) N, N, N m of ``recording``, 0 in most samples, times a
    number of standard deviation ``sd``.

    ``of``: what it belongs to; ``axis``: which of its numbers it is. ``exact``: the change (n, 3) by all of these
    numbers, if it is not in proportion; ``sizes``: the numbers that the loads have already.
    """

    recording: int
    change: csc_array
    sd: float
    of: object
    axis: int
    exact: Callable[[Sequence[float]], FloatArray] | None = None
    sizes: tuple[float, ...] = ()
    swings: bool = False


@dataclass(frozen=True, slots=True)
class ZeroDirection:
    """The error of a zero that was taken in ``recording``: a constant of ``axis`` (from 0: x1, y1, x2 ...), known to
    ``sd``, m.
    """

    recording: int
    axis: int
    sd: float

    def table(self, like: Sequence[FloatArray], sensitivities: FloatArray) -> list[FloatArray]:
        """One standard deviation, V, in tables as ``like`` (3P, m) of each recording. ``sensitivities`` (P, 2) m/V."""
        out = [np.zeros_like(t) for t in like]
        out[self.recording][dot_channels(len(sensitivities))[self.axis]] = self.sd / sensitivities.ravel()[self.axis]
        return out


Direction = LoadDirection | ZeroDirection


def added(more: Sequence[tuple[Direction, float]]) -> list[tuple[int, FloatArray, bool]]:
    """Recordings, what so much ``more`` adds to the loads (n, 3) of each, and whether that is a motion nobody noted."""
    sizes, out = _sizes(more), []
    for d, size in more:
        if isinstance(d, LoadDirection):
            if d.exact is None:
                out.append((d.recording, size * d.change.toarray(), d.swings))
            elif (now := sizes.pop(id(d.of), None)) is not None:
                # The end of a ramp moves by its start and by its time: the two are no sum.
                out.append((d.recording, d.exact(now) - d.exact(d.sizes), d.swings))
    return out


def moved(more: Sequence[tuple[Direction, float]]) -> tuple[Direction, ...]:
    """Return the directions, with the sizes that the loads have after so much ``more``."""
    sizes = _sizes(more)
    return tuple(
        dataclasses.replace(d, sizes=sizes.get(id(d.of), d.sizes)) if isinstance(d, LoadDirection) else d
        for d, _ in more
    )


def _sizes(more: Sequence[tuple[Direction, float]]) -> dict[int, tuple[float, ...]]:
    """Return all numbers after so much ``more``, by the id of what they belong to."""
    out: dict[int, tuple[float, ...]] = {}
    for d, size in more:
        if isinstance(d, LoadDirection) and d.exact is not None:
            sizes = list(out.get(id(d.of), d.sizes))
            sizes[d.axis] += size
            out[id(d.of)] = tuple(sizes)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Free:
    """``tables`` (p, D): what each of the ``directions`` changes, V, at its standard deviation; ``white`` (p, D): the
    same whitened. ``mix`` (p, k): orthonormal sums of these, of variance ``energy`` (k,) against that of the noise;
    ``back`` (p, k): from there to the numbers.
    """

    directions: tuple[Direction, ...]
    tables: csr_array
    white: csr_array
    mix: FloatArray
    energy: FloatArray
    back: FloatArray

    def shares(self, white: npt.NDArray[np.floating]) -> FloatArray:
        """Return the shares (k,) of the sums in a whitened vector (D,)."""
        return np.asarray(self.mix.T @ (self.white @ white))

    def sum(self, shares: FloatArray) -> FloatArray:
        """Return the vector (D,) with these ``shares`` (k,) of the sums."""
        return np.asarray((self.mix @ shares) @ self.white)

    def beside(self, white: FloatArray) -> FloatArray:
        """Return what the sums leave of a whitened vector (D,)."""
        return white - self.sum(self.shares(white))


def sparse_rows(vectors: Iterable[FloatArray]) -> csr_array:
    """Return the ``vectors`` (D,) as rows, without values below ``NEXT_TO_NOTHING`` of the largest of each."""
    rows = []
    for v in vectors:
        size = np.abs(v)
        rows.append(csr_array(np.where(size > NEXT_TO_NOTHING * size.max(initial=0.0), v, 0.0)[None, :]))
    return csr_array(vstack(rows))
