# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Laws that no catalogue has, drawn by chance over stage, variable and form; formulas of their own."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

Array = npt.NDArray[np.float64]
Spec = Mapping[str, Any]
LOADS = ('load_fx', 'load_fy', 'load_tz')
DOTS = ('x1', 'y1', 'x2', 'y2')
FULL = {'load_fx': 30.0, 'load_fy': 50.0, 'load_tz': 29.0, 'temperature': 3.5, **dict.fromkeys(DOTS, 2e-3)}
"""About the largest value of each variable in the experiment, in which the shapes are drawn."""
STATIC = ('square', 'cube', 'stop', 'dead_band', 'saturation', 'product', 'hop', 'magnitude')
OF_STAGE: Mapping[str, tuple[str, ...]] = {
    'load': ('square', 'cube', 'stop', 'dead_band', 'saturation', 'product', 'hop', 'events', 'fading_square'),
    'link': ('square', 'cube', 'stop', 'dead_band', 'hop', 'events', 'fading_square', 'resonance'),
    'optics': ('square', 'stop', 'hop', 'events', 'product'),
    'psd': (
        *('square', 'cube', 'stop', 'dead_band', 'saturation', 'product', 'hop', 'magnitude', 'rate', 'drag'),
        'stick',
    ),
    'electronics': ('dead_band', 'saturation', 'events', 'gain_events', 'rate', 'fading_square', 'jitter'),
}
KIND_OF = dict.fromkeys(STATIC, 'static') | dict.fromkeys(('hop', 'events', 'gain_events'), 'switched')
KIND_OF |= dict.fromkeys(('rate', 'drag'), 'rate') | dict.fromkeys(('fading_square', 'stick'), 'history')
KIND_OF |= {'resonance': 'resonance', 'jitter': 'variance'}


def draw(seed: int, stage: str, form: str) -> dict[str, Any]:
    """Return a law without its size: where it acts, on what it depends, its shapes."""
    rng = np.random.default_rng((seed, len(stage), len(form)))
    where = str(rng.choice(LOADS if stage in ('load', 'link') else DOTS))
    if stage in ('load', 'link'):
        of = [str(rng.choice(LOADS))]
    elif stage == 'optics':
        of = ['temperature'] if rng.random() < 0.5 else [str(rng.choice(LOADS))]
    else:
        # The other axis of the same PSD, or the same one.
        of = [where if rng.random() < 0.5 else DOTS[DOTS.index(where) ^ 1]]
    if form == 'resonance':
        # The mode of a load's own direction is in the catalogue.
        of = [str(rng.choice([n for n in LOADS if n != where]))]
    if form in ('dead_band', 'saturation', 'jitter') and stage in ('psd', 'electronics'):
        of = [where]
    if form == 'rate':
        # A delay of one's own reading is in the catalogue.
        of = [DOTS[DOTS.index(where) ^ 1]]
    if form == 'product':
        candidates = [n for n in ((*LOADS, 'temperature') if stage in ('load', 'optics') else DOTS) if n not in of]
        of.append(str(rng.choice(candidates)))
    if form == 'events':
        of = []
    times = np.sort(rng.uniform(2.0, 22.0, int(rng.integers(1, 5)))).tolist() if 'events' in form else []
    out: dict[str, Any] = {'name': f'law_{stage}', 'form': form, 'where': where, 'of': of}
    out |= {'at': float(rng.uniform(0.15, 0.6)), 'sign': float(rng.choice((-1.0, 1.0)))}
    out['time_constant'] = float(np.exp(rng.uniform(math.log(0.2), math.log(4.0))))
    return {**out, 'frequency': float(rng.uniform(30.0, 70.0)), 'times': [round(t, 3) for t in times]}


def truth_of(law: Spec) -> dict[str, Any]:
    """What an answer must say: stage, what it acts on, variables, kind."""
    form, where, variables = law['form'], law['where'], {*law['of'], *(['time'] if law['times'] else [])}
    of = {'stage': law['name'].removeprefix('law_'), 'where': where, 'variables': sorted(variables)}
    return {**of, 'kind': KIND_OF[form], 'form': form}


def lag(u: Array, tau: float, step: float) -> Array:
    """What follows ``u`` (n,) with the time constant ``tau``, from 0, each input held for a step."""
    decay = math.exp(-step / tau)
    return np.asarray(lfilter([0.0, 1.0 - decay], [1.0, -decay], u))


def _mode(u: Array, frequency: float, step: float) -> Array:
    """Return a resonance of damping ratio 0.02, by small steps of a rotation that fades."""
    w, zeta = 2.0 * math.pi * frequency, 0.02
    pole = np.exp(step * (-zeta * w + 1j * w * math.sqrt(1.0 - zeta**2)))
    out = np.empty(len(u))
    z, before = 0j, 0.0
    lean = zeta / math.sqrt(1.0 - zeta**2)
    for i, v in enumerate(u.tolist()):
        # A step of the input starts a free vibration about the new place.
        z -= (v - before) * (1.0 - 1j * lean)
        before = v
        out[i] = v + z.real
        z *= pole
    return out


def _stuck(v: Array, half: float) -> Array:
    """What a loop of friction adds to v: it is dragged behind."""
    held, out = float(v[0]), np.empty_like(v)
    for i, x in enumerate(v.tolist()):
        held = x - half if x - held > half else x + half if held - x > half else held
        out[i] = held - x
    return out


def _between(t: Array, times: Sequence[float]) -> Array:
    on = np.zeros(len(t))
    for k, at in enumerate(times):
        on[t >= at - 1e-9] = (k + 1) % 2
    return on


OF_NOW: Mapping[str, Callable[[Array, float, float], Array]] = {
    'square': lambda u, b, sign: u**2,
    'cube': lambda u, b, sign: u**3,
    'stop': lambda u, b, sign: np.clip(sign * u - b, 0.0, None),
    'dead_band': lambda u, b, sign: -np.clip(u, -b, b),
    'saturation': lambda u, b, sign: b * np.tanh(u / b) - u,
    'magnitude': lambda u, b, sign: np.sqrt(u**2),
    'hop': lambda u, b, sign: np.where(sign * u > b, 1.0, 0.0),
    'stick': lambda u, b, sign: _stuck(u, 0.1 * b),
    'product': lambda u, b, sign: u,
}


def added(law: Spec, known: Mapping[str, Array], t: Array, step: float) -> Array:
    """What the law adds (n,), in units of its size; ``known``: the variables on the grid ``t``."""
    form = law['form']
    scaled = [known[n] / FULL[n] for n in law['of']]
    u = np.prod(scaled, axis=0) if scaled else np.ones(len(t))
    if form in OF_NOW:
        return np.asarray(OF_NOW[form](u, law['at'], law['sign']))
    if form in ('events', 'gain_events'):
        return np.asarray(u * _between(t, law['times']))
    if form in ('rate', 'drag'):
        speed = np.gradient(u, step)
        return np.asarray(speed * np.abs(speed) if form == 'drag' else speed)
    return lag(u**2, law['time_constant'], step) if form == 'fading_square' else _mode(u, law['frequency'], step)
