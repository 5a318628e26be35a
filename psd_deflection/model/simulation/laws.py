"""Empirical effects: a law written as a YAML file, which a person can read and edit.

``discover`` writes one where no effect of the catalogue fits. A law adds a sum of terms to one quantity of the chain::

    name: stop_y2
    stage: psd
    acts_on: y2
    kind: static
    summary: what was seen
    terms:
      - {form: above, of: [load_fy], coefficient: 2.0e-07, threshold: 10.0}

A term is ``coefficient`` times a form of the product of the variables in ``of``; a variable that is listed twice is
squared. In a folder of effects the file is an effect like those written in Python: coefficients are ``c1``, ``c2`` ...
and shapes ``threshold1`` ... in the order of the terms.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import yaml
from scipy.signal import lfilter

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.foreign_yaml import tree_of_file
from psd_deflection.base.spelling import did_you_mean
from psd_deflection.model.simulation.declaration import (
    STAGES,
    Effect,
    EffectParameter,
    Point,
    Reading,
    Stage,
    State,
    Use,
    Values,
)
from psd_deflection.model.simulation.hysteresis import play
from psd_deflection.model.simulation.modes import mode_coefficients
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.records import FloatArray
from psd_deflection.rig.parameters import Parameter, check_value

Kind = Literal['static', 'switched', 'rate', 'history', 'resonance', 'variance']

VARIABLES: Mapping[str, str] = {
    'load_fx': 'N',
    'load_fy': 'N',
    'load_tz': 'N m',
    'dx': 'm',
    'dy': 'm',
    'theta': 'rad',
    'x1': 'm',
    'y1': 'm',
    'x2': 'm',
    'y2': 'm',
    'temperature': 'K',
    'time': 's',
}
"""What a law may depend on, with its unit. ``temperature``: above the first one; ``time``: since the first sample."""

_LOADS, _POSE, _DOTS = ('load_fx', 'load_fy', 'load_tz'), ('dx', 'dy', 'theta'), ('x1', 'y1', 'x2', 'y2')


@dataclass(frozen=True, slots=True)
class LawTarget:
    """A quantity that a law adds to: row ``row`` of the samples at ``point``. ``variables``: what is known there."""

    stage: Stage
    point: Point
    row: int
    unit: str
    variables: tuple[str, ...]


_ALWAYS = ('temperature', 'time')
TARGETS: Mapping[str, LawTarget] = {
    **{n: LawTarget('load', 'load', i, VARIABLES[n], (*_LOADS, *_ALWAYS)) for i, n in enumerate(_LOADS)},
    **{f'static_{n}': LawTarget('link', 'static', i, VARIABLES[n], (*_LOADS, *_ALWAYS)) for i, n in enumerate(_POSE)},
    **{n: LawTarget('link', 'pose', i, VARIABLES[n], (*_LOADS, *_POSE, *_ALWAYS)) for i, n in enumerate(_POSE)},
    **{f'beam_{n}': LawTarget('optics', 'dots', i, 'm', tuple(VARIABLES)) for i, n in enumerate(_DOTS)},
    **{n: LawTarget('psd', 'dots', i, 'm', tuple(VARIABLES)) for i, n in enumerate(_DOTS)},
    **{f'sum{i + 1}': LawTarget('psd', 'dots', 4 + i, 'V', tuple(VARIABLES)) for i in range(2)},
}
"""What a law may act on. ``static_dx`` is what the link swings towards, ``dx`` where it is; ``beam_x1`` moves a laser's
beam sideways."""


def _above(v: FloatArray, shapes: Values) -> FloatArray:
    return np.maximum(v - shapes['threshold'], 0.0)


def _below(v: FloatArray, shapes: Values) -> FloatArray:
    return np.maximum(shapes['threshold'] - v, 0.0)


def _beyond(v: FloatArray, shapes: Values) -> FloatArray:
    return np.sign(v) * np.maximum(np.abs(v) - shapes['threshold'], 0.0)


def _within(v: FloatArray, shapes: Values) -> FloatArray:
    return np.clip(v, -shapes['threshold'], shapes['threshold'])


def _over(v: FloatArray, shapes: Values) -> FloatArray:
    return (v > shapes['threshold']).astype(np.float64)


def _under(v: FloatArray, shapes: Values) -> FloatArray:
    return (v < shapes['threshold']).astype(np.float64)


def _wave(v: FloatArray, shapes: Values) -> FloatArray:
    return np.sin(2.0 * math.pi * v / shapes['period'] + shapes['phase'])


def _rate(v: FloatArray, shapes: Values, period: float, state: State) -> FloatArray:
    # Backward, second order: what comes later is not known.
    before = state.get('v', np.full(2, v[0]))
    whole = np.concatenate((before, v))
    state['v'] = whole[-2:]
    return (1.5 * whole[2:] - 2.0 * whole[1:-1] + 0.5 * whole[:-2]) / period


def _rate_absolute(v: FloatArray, shapes: Values, period: float, state: State) -> FloatArray:
    return np.abs(_rate(v, shapes, period, state))


def _drag(v: FloatArray, shapes: Values, period: float, state: State) -> FloatArray:
    rate = _rate(v, shapes, period, state)
    return rate * np.abs(rate)


def _direction(v: FloatArray, shapes: Values, period: float, state: State) -> FloatArray:
    change = np.sign(np.diff(v, prepend=state.get('v', v[0])))
    at = np.maximum.accumulate(np.where(change != 0.0, np.arange(1, len(v) + 1), 0))
    out = np.concatenate(([state.get('way', 0.0)], change))[at]
    state['v'], state['way'] = v[-1], out[-1]
    return np.asarray(out)


def _relaxed(v: FloatArray, shapes: Values, period: float, state: State) -> FloatArray:
    # The input counts from one sample to the next as a straight line.
    a = period / shapes['tau']
    kept = math.exp(-a)
    ahead = 1.0 - (1.0 - kept) / a
    b = np.array([ahead, 1.0 - kept - ahead])
    # Relaxed at zero before the first sample.
    y, state['y'] = lfilter(b, [1.0, -kept], v, zi=state.get('y', np.array([b[1] * v[0]])))
    return np.asarray(y)


def _resonance(v: FloatArray, shapes: Values, period: float, state: State) -> FloatArray:
    b, a = mode_coefficients(shapes['natural_frequency'], shapes['zeta'], period)
    y, state['y'] = lfilter(b, a, v, zi=state.get('y', np.zeros(2)))
    return np.asarray(y)


def _play(v: FloatArray, shapes: Values, period: float, state: State) -> FloatArray:
    held = play(v, shapes['half_width'], state.get('held', v[0]))
    state['held'] = float(held[-1])
    return held - v


@dataclass(frozen=True, slots=True)
class Form:
    """A form of a variable v. ``apart``: of no memory, (v, shapes); ``following``: also (period s, state).

    ``fitted`` and ``fixed``: its shapes, with the power of v's unit; those fixed are not improved by a refit because
    the form jumps there. ``unit_of_v``: the power of v's unit in the form's own unit. ``words``: with ``{v}``.
    """

    kind: Kind
    words: str
    apart: Callable[[FloatArray, Values], FloatArray] | None = None
    following: Callable[[FloatArray, Values, float, State], FloatArray] | None = None
    fitted: Mapping[str, tuple[str, float, float]] = field(default_factory=dict)
    fixed: tuple[str, ...] = ()
    unit_of_v: int = 1
    per_second: int = 0


_FREE = (-math.inf, math.inf)
_ANY, _POSITIVE = (-1e12, 1e12), (1e-12, 1e12)
FORMS: Mapping[str, Form] = {
    'product': Form('static', '{v}', apart=lambda v, _: v),
    'absolute': Form('static', '|{v}|', apart=lambda v, _: np.abs(v)),
    'signed_square': Form('static', '{v} |{v}|', apart=lambda v, _: v * np.abs(v), unit_of_v=2),
    'above': Form('static', 'max({v} - {threshold}, 0)', apart=_above, fitted={'threshold': ('v', *_ANY)}),
    'below': Form('static', 'max({threshold} - {v}, 0)', apart=_below, fitted={'threshold': ('v', *_ANY)}),
    'beyond': Form(
        'static', 'sign({v}) max(|{v}| - {threshold}, 0)', apart=_beyond, fitted={'threshold': ('v', *_POSITIVE)}
    ),
    'within': Form('static', '{v} within ±{threshold}', apart=_within, fitted={'threshold': ('v', *_POSITIVE)}),
    'wave': Form(
        'static',
        'sin(2 pi {v} / {period} + {phase})',
        apart=_wave,
        fitted={'period': ('v', *_POSITIVE), 'phase': ('rad', -1e3, 1e3)},
        unit_of_v=0,
    ),
    'over': Form('switched', '[1 if {v} > {threshold}]', apart=_over, fixed=('threshold',), unit_of_v=0),
    'under': Form('switched', '[1 if {v} < {threshold}]', apart=_under, fixed=('threshold',), unit_of_v=0),
    'switched': Form('switched', '{v} [between {times}]'),
    'rate': Form('rate', 'd({v})/dt', following=_rate, per_second=1),
    'rate_absolute': Form('rate', '|d({v})/dt|', following=_rate_absolute, per_second=1),
    'drag': Form('rate', 'd({v})/dt |d({v})/dt|', following=_drag, unit_of_v=2, per_second=2),
    'direction': Form('history', 'sign of the last change of {v}', following=_direction, unit_of_v=0),
    'relaxed': Form(
        'history',
        '{v} through a lag of {tau}',
        following=_relaxed,
        fitted={'tau': ('s', 1e-4, 1e5)},
    ),
    'play': Form('history', 'play({v}, {half_width}) - {v}', following=_play, fitted={'half_width': ('v', *_POSITIVE)}),
    'resonance': Form(
        'resonance',
        '{v} through a mode of {natural_frequency} and damping ratio {zeta}',
        following=_resonance,
        fitted={'natural_frequency': ('Hz', 0.01, 1e4), 'zeta': ('', 1e-4, 0.99)},
    ),
    'jitter': Form('variance', 'noise of rms {v}'),
}


@dataclass(frozen=True, slots=True)
class LawTerm:
    """``coefficient`` times a form of the product of the variables ``of``; ``sd``: of coefficient and shapes.

    ``times``: when a ``switched`` term goes on, off, on ..., s.
    """

    form: str
    of: tuple[str, ...]
    coefficient: float = 0.0
    shapes: Mapping[str, float] = field(default_factory=dict)
    times: tuple[float, ...] = ()
    sd: Mapping[str, float] = field(default_factory=dict)

    @property
    def variable(self) -> str:
        """The product, for people: ``load_fx^2 temperature``."""
        counts = {name: self.of.count(name) for name in dict.fromkeys(self.of)}
        return ' '.join(n if k == 1 else f'{n}^{k}' for n, k in counts.items()) or '1'

    @property
    def depends_on(self) -> tuple[str, ...]:
        """Its variables, each once."""
        return tuple(dict.fromkeys((*self.of, *(('time',) if self.times else ()))))

    @property
    def kind(self) -> Kind:
        """A wave in time is a line, which is a resonance."""
        return 'resonance' if self.form == 'wave' and self.of == ('time',) else FORMS[self.form].kind

    def evaluate(self, given: Callable[[str], FloatArray], n: int, period: float, state: State) -> FloatArray:
        """The form (n,), without its coefficient; ``given`` gives a variable's next samples."""
        if n == 0:
            return np.empty(0)
        v = np.ones(n)
        for name in self.of:
            v = v * given(name)
        if self.form == 'switched':
            on = np.searchsorted(np.asarray(self.times) - 1e-9, given('time'), side='right') % 2
            return np.asarray(v * on)
        form = FORMS[self.form]
        if form.apart is not None:
            return form.apart(v, self.shapes)
        if form.following is not None:
            return form.following(v, self.shapes, period, state)
        return v

    def shape_unit(self, name: str) -> str:
        """The unit of a shape."""
        given = FORMS[self.form].fitted[name][0] if name in FORMS[self.form].fitted else 'v'
        return unit_of(self.of) if given == 'v' else given

    def unit(self, target: str) -> str:
        """The unit of the coefficient if the term acts on ``target``."""
        form, top = FORMS[self.form], TARGETS[target].unit
        below = unit_of(self.of * form.unit_of_v)
        if form.per_second:
            top += ' s' if form.per_second == 1 else f' s^{form.per_second}'
        if not below:
            return top
        if below == top:
            return '1'
        return f'{top}/({below})' if ' ' in below else f'{top}/{below}'

    def words(self) -> str:
        """The form, with numbers: ``max(load_fy - 10, 0)``."""
        numbers = {k: f'{self._shape(k)} {self.shape_unit(k)}'.rstrip() for k in self.shapes}
        times = ', '.join(f'{t:.3f}' for t in self.times) + ' s'
        return FORMS[self.form].words.format(v=self.variable, times=times, **numbers)

    def _shape(self, name: str) -> str:
        value = f'{self.shapes[name]:.4g}'
        known = name in FORMS[self.form].fixed and self.sd.get(name)
        return f'({value} ± {self.sd[name]:.1g})' if known else value


def unit_of(variables: Sequence[str]) -> str:
    """The unit of a product of variables: ``(N m)^2 K``."""
    units = [VARIABLES[v] for v in variables]
    out = []
    for u in dict.fromkeys(units):
        k = units.count(u)
        out.append(u if k == 1 else f'({u})^{k}' if ' ' in u else f'{u}^{k}')
    return ' '.join(out)


@dataclass(frozen=True, slots=True)
class Law:
    """``acts_on``: one of ``TARGETS``, to which the sum of ``terms`` is added."""

    name: str
    stage: Stage
    acts_on: str
    terms: tuple[LawTerm, ...]
    summary: str = ''

    @property
    def kind(self) -> Kind:
        """The kind of its first term, which explains most."""
        return self.terms[0].kind

    @property
    def variables(self) -> tuple[str, ...]:
        """What it depends on."""
        return tuple(dict.fromkeys(v for t in self.terms for v in t.depends_on))

    @property
    def expression(self) -> str:
        """For people, with units: ``y2 += 2e-07 m/N max(load_fy - 10 N, 0)``."""
        parts = []
        for t in self.terms:
            sd = f' ± {t.sd["coefficient"]:.1g}' if t.sd.get('coefficient') else ''
            number = f'({t.coefficient:.4g}{sd})' if sd else f'{t.coefficient:.4g}'
            parts.append(f'{number} {t.unit(self.acts_on)} · {t.words()}')
        return f'{self.acts_on} += ' + ' + '.join(parts)


def known(samples: SimulatedSamples, name: str) -> FloatArray:
    """A variable of ``VARIABLES`` (n,) of samples that have passed the stage where it is made."""
    if name == 'time':
        return samples.t
    if name == 'temperature':
        return samples.warmer
    if name in _LOADS:
        return np.asarray(samples.loads[_LOADS.index(name)])
    rows = samples.pose[_POSE.index(name)] if name in _POSE else samples.dots[_DOTS.index(name)]
    return np.asarray(rows)


def _with_values(terms: Sequence[LawTerm], values: Values) -> list[LawTerm]:
    """The terms with the coefficients and shapes of a rig file."""
    return [
        LawTerm(t.form, t.of, values[f'c{i}'], {k: values[f'{k}{i}'] for k in t.shapes}, t.times)
        for i, t in enumerate(terms, 1)
    ]


def _apply(law: Law, samples: SimulatedSamples, values: Values, state: State) -> None:
    target, n = TARGETS[law.acts_on], len(samples.t)
    added = np.zeros(n)
    for i, term in enumerate(_with_values(law.terms, values)):
        own = state.setdefault(str(i), {})
        grown = term.coefficient * term.evaluate(partial(known, samples), n, samples.physics.period, own)
        added += grown
    if law.acts_on.startswith('beam_'):
        # A beam that moves sideways moves the dot in the plate's own axes.
        x, y = samples.dots[target.row & ~1], samples.dots[target.row | 1]
        c, s = np.cos(samples.pose[2]), np.sin(samples.pose[2])
        x += added * (s if target.row & 1 else c)
        y += added * (c if target.row & 1 else -s)
        return
    if target.point == 'dots':
        rows = samples.dots if target.row < 4 else samples.sums
        rows[target.row % 4] += added
        return
    {'load': samples.loads, 'static': samples.static, 'pose': samples.pose}[target.point][target.row] += added


def _jitter(law: Law, samples: SimulatedSamples, values: Values, state: State) -> None:
    """Noise whose rms is the sum of the terms. Its mean is zero, so an expectation has none of it."""
    if np.any(samples.noise):
        return
    target, n = TARGETS[law.acts_on], len(samples.t)
    rms = np.zeros(n)
    for term in _with_values(law.terms, values):
        rms += np.abs(term.coefficient * term.evaluate(partial(known, samples), n, samples.physics.period, {}))
    rng = state.setdefault('noise', np.random.default_rng(zlib.crc32(law.name.encode())))
    hiss = rms * rng.standard_normal(n)
    if target.row < 4:
        psd, axis = divmod(target.row, 2)
        samples.volts[3 * psd + axis] += hiss / samples.physics.sensitivity[psd, axis]
    else:
        samples.volts[3 * (target.row - 4) + 2] += hiss


_PASSES = 6


def _correct(law: Law, reading: Reading, values: Values) -> None:
    """The reading without the law, which is a function of what is read: a fixed point."""
    terms, row = _with_values(law.terms, values), TARGETS[law.acts_on].row
    place = reading.dots[row] if row < 4 else reading.sums[row - 4]
    read, n = place.copy(), len(place)

    def read_as(name: str) -> FloatArray:
        if name == 'time':
            return reading.t
        return reading.warmer if name == 'temperature' else reading.dots[_DOTS.index(name)]

    for _ in range(_PASSES):
        place[:] = read - sum(t.coefficient * t.evaluate(read_as, n, 0.0, {}) for t in terms)


def _correctable(law: Law) -> bool:
    seen = {*_DOTS, 'temperature', 'time'}
    apart = all(t.form == 'switched' or FORMS[t.form].apart is not None for t in law.terms)
    return TARGETS[law.acts_on].point == 'dots' and apart and set(law.variables) <= seen


def _parameters(law: Law) -> list[EffectParameter]:
    out = []
    for i, t in enumerate(law.terms, 1):
        size = abs(t.coefficient) or 1.0
        unit = t.unit(law.acts_on)
        unit = '' if unit == '1' else unit
        out.append(EffectParameter(f'c{i}', unit, -1e30, 1e30, 0.1 * size, f'coefficient of {t.words()}'))
        for name, value in t.shapes.items():
            _, low, high = FORMS[t.form].fitted.get(name, ('v', *_ANY))
            if name not in FORMS[t.form].fitted:
                low = high = value
            scale = 0.05 * (abs(value) or 1.0) if name != 'phase' else 0.1
            out.append(
                EffectParameter(
                    f'{name}{i}',
                    t.shape_unit(name),
                    low,
                    high,
                    scale,
                    f'{name} of term {i}',
                    value,
                    'shape',
                    grid=(value,),
                )
            )
    return out


def effect_of(law: Law) -> Effect:
    """The law as an effect of the simulation; its values are those of the law unless a rig file says others."""
    variance = law.kind == 'variance'
    uses = cast('frozenset[Use]', frozenset(law.variables) & frozenset(('time', 'temperature')))
    correctable = _correctable(law) and not variance
    return Effect(
        name=law.name,
        stage=law.stage,
        summary=law.summary or f'an empirical law on {law.acts_on}',
        equation=law.expression,
        source='empirical: found by psd-deflection discover',
        needs=', '.join(law.variables) or 'time',
        parameters=tuple(_parameters(law)),
        point='output' if variance else TARGETS[law.acts_on].point,
        apply=partial(_jitter if variance else _apply, law),
        correct=partial(_correct, law) if correctable else None,
        uses=uses if correctable else frozenset(),
        order=50,
    )


def values_of(law: Law) -> dict[str, float]:
    """The values of the effect's parameters as the law has them."""
    out = {}
    for i, t in enumerate(law.terms, 1):
        out[f'c{i}'] = t.coefficient
        out.update({f'{k}{i}': v for k, v in t.shapes.items()})
    return out


def law_text(law: Law, comment: Sequence[str] = ()) -> str:
    """The law as a YAML file; :func:`read_law` reads it again."""
    terms = []
    for t in law.terms:
        body: dict[str, Any] = {'form': t.form, 'of': list(t.of), 'coefficient': float(t.coefficient)}
        body['unit'] = t.unit(law.acts_on)
        body.update({k: float(v) for k, v in t.shapes.items()})
        if t.times:
            body['times'] = [float(v) for v in t.times]
        if t.sd:
            body['sd'] = {k: float(f'{v:.3g}') for k, v in t.sd.items()}
        terms.append(body)
    tree = {
        'name': law.name,
        'stage': law.stage,
        'acts_on': law.acts_on,
        'kind': law.kind,
        'summary': law.summary,
        'expression': law.expression,
        'terms': terms,
    }
    head = ''.join(f'# {line}\n' for line in comment)
    return head + yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, width=1000)


def read_law(path: Path) -> Law:
    """The law of a file. Raises ConfigError naming file, key, value and what is allowed."""
    tree = tree_of_file(path, 'law')
    if not isinstance(tree, dict):
        raise ConfigError(f'{path}: must be a map with name, stage, acts_on and terms')
    for key in ('name', 'acts_on', 'terms'):
        if key not in tree:
            raise ConfigError(f'{path}: {key} is missing')
    acts_on = _one_of(path, 'acts_on', tree['acts_on'], TARGETS)
    stage = _one_of(path, 'stage', tree.get('stage', TARGETS[acts_on].stage), STAGES)
    listed = tree['terms']
    if not isinstance(listed, list) or not listed:
        raise ConfigError(f'{path}: terms = {listed!r}: must be a list of at least one term')
    terms = tuple(_term(path, f'terms[{i}]', body, acts_on) for i, body in enumerate(listed))
    if len({t.kind == 'variance' for t in terms}) > 1:
        raise ConfigError(f'{path}: terms: jitter stands alone; write a law of its own for the other terms')
    if terms[0].kind == 'variance' and acts_on not in (*_DOTS, 'sum1', 'sum2'):
        raise ConfigError(f'{path}: acts_on = {acts_on!r}: jitter acts on x1, y1, sum1, x2, y2 or sum2')
    return Law(str(tree['name']), cast(Stage, stage), acts_on, terms, str(tree.get('summary', '')))


def _one_of(path: Path, key: str, value: object, allowed: Mapping[str, object] | Sequence[str]) -> str:
    if not isinstance(value, str) or value not in allowed:
        hint = did_you_mean(str(value), list(allowed)) or f'; it may be {", ".join(allowed)}'
        raise ConfigError(f'{path}: {key} = {value!r}: unknown{hint}')
    return value


def _number(
    path: Path, key: str, body: Mapping[str, object], default: float | None = None, within: tuple[float, float] = _FREE
) -> float:
    declared = Parameter(key, 'double', default, '', '', *within)
    return cast(float, check_value(declared, body.get(key.rpartition('.')[2], default), str(path)))


def _term(path: Path, at: str, body: object, acts_on: str) -> LawTerm:
    if not isinstance(body, dict):
        raise ConfigError(f'{path}: {at} = {body!r}: must be a map with form, of and coefficient')
    name = _one_of(path, f'{at}.form', body.get('form'), FORMS)
    form, of = FORMS[name], body.get('of', [])
    if not isinstance(of, list) or (not of and name != 'switched'):
        raise ConfigError(f'{path}: {at}.of = {of!r}: must be a list of variables')
    for variable in of:
        _one_of(path, f'{at}.of', variable, TARGETS[acts_on].variables)
    declared = Parameter(f'{at}.times', 'double_array', [], 's', '')
    times = cast(list[float], check_value(declared, body.get('times', []), str(path)))
    if times != sorted(times):
        raise ConfigError(f'{path}: {at}.times = {times!r}: must be a list of rising times, s')
    if bool(times) != (name == 'switched'):
        raise ConfigError(f'{path}: {at}.times = {times!r}: a switched term, and no other, has times')
    shapes = {}
    for key in (*form.fitted, *form.fixed):
        _, low, high = form.fitted.get(key, ('v', *_ANY))
        shapes[key] = _number(path, f'{at}.{key}', body, within=(low, high))
    listed = body.get('sd', {})
    sd = {k: _number(path, f'{at}.sd.{k}', listed) for k in listed} if isinstance(listed, dict) else {}
    return LawTerm(name, tuple(of), _number(path, f'{at}.coefficient', body), shapes, tuple(times), sd)
