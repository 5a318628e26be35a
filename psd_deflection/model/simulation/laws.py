# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Empirical effects: a law written as a YAML file, which a person can read and edit.

``discover`` writes one where no effect of the catalogue fits. A law adds a sum of terms to one
quantity of the chain::

    name: stop_y2
    stage: psd
    acts_on: y2
    kind: static
    summary: what was seen
    terms:
      - {form: above, of: [load_fy], coefficient: 2.0e-07, threshold: 10.0}

A term is ``coefficient`` times a form of the product of the variables in ``of``; a variable that is
listed twice is squared. In a folder of effects the file is an effect like those written in Python:
coefficients are ``c1``, ``c2`` ... and shapes ``threshold1`` ... in the order of the terms.
"""

from __future__ import annotations

import dataclasses
import itertools
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, cast

import numpy as np
import yaml

from psd_deflection.model.simulation import law_forms
from psd_deflection.model.simulation.declaration import (
    Effect,
    EffectParameter,
    Point,
    Reading,
    Stage,
    State,
    Use,
    Values,
)
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.records import MOST_PSDS, FloatArray, dot_names

Kind = Literal['static', 'switched', 'rate', 'history', 'resonance', 'variance']

VARIABLES: Mapping[str, str] = {
    'load_fx': 'N',
    'load_fy': 'N',
    'load_tz': 'N m',
    'dx': 'm',
    'dy': 'm',
    'theta': 'rad',
    **dict.fromkeys(dot_names(MOST_PSDS), 'm'),
    'temperature': 'K',
    'time': 's',
}
"""What a law may depend on, with its unit, on a rig with that PSD. ``temperature``: above the first one;
``time``: since the first sample."""

_LOADS, _POSE, DOTS = ('load_fx', 'load_fy', 'load_tz'), ('dx', 'dy', 'theta'), dot_names(MOST_PSDS)
SUMS = tuple(f'sum{n}' for n in range(1, MOST_PSDS + 1))


def variables_of(psds: int) -> tuple[str, ...]:
    """Those of ``VARIABLES`` that a rig of so many PSDs has."""
    return tuple(n for n in VARIABLES if n not in DOTS or n in dot_names(psds))


@dataclass(frozen=True, slots=True)
class LawTarget:
    """A quantity that a law adds to: row ``row`` of the samples at ``point``, of the sums if ``of_sums``.
    ``variables``: what is known there.
    """

    stage: Stage
    point: Point
    row: int
    unit: str
    variables: tuple[str, ...]
    of_sums: bool = False


_ALWAYS = ('temperature', 'time')
TARGETS: Mapping[str, LawTarget] = {
    **{n: LawTarget('load', 'load', i, VARIABLES[n], (*_LOADS, *_ALWAYS)) for i, n in enumerate(_LOADS)},
    **{f'static_{n}': LawTarget('link', 'static', i, VARIABLES[n], (*_LOADS, *_ALWAYS)) for i, n in enumerate(_POSE)},
    **{n: LawTarget('link', 'pose', i, VARIABLES[n], (*_LOADS, *_POSE, *_ALWAYS)) for i, n in enumerate(_POSE)},
    **{f'beam_{n}': LawTarget('optics', 'dots', i, 'm', tuple(VARIABLES)) for i, n in enumerate(DOTS)},
    **{n: LawTarget('psd', 'dots', i, 'm', tuple(VARIABLES)) for i, n in enumerate(DOTS)},
    **{n: LawTarget('psd', 'dots', i, 'V', tuple(VARIABLES), of_sums=True) for i, n in enumerate(SUMS)},
}
"""What a law may act on. ``static_dx`` is what the link swings towards, ``dx`` where it is;
``beam_x1`` moves a laser's beam sideways."""


@dataclass(frozen=True, slots=True)
class Form:
    """A form of a variable v. ``apart``: of no memory, (v, shapes); ``following``: also (period s, state).

    ``fitted`` and ``fixed``: its shapes, with the power of v's unit; those fixed are not improved
    by a refit because the form jumps there. ``unit_of_v``: the power of v's unit in the form's own
    unit. ``words``: with ``{v}``.
    """

    kind: Kind
    words: str
    apart: Callable[[FloatArray, Values], FloatArray] | None = None
    following: Callable[[FloatArray, Values, float, State], FloatArray] | None = None
    fitted: Mapping[str, tuple[str, float, float]] = field(default_factory=dict)
    fixed: tuple[str, ...] = ()
    unit_of_v: int = 1
    per_second: int = 0


ANY, _POSITIVE = (-1e12, 1e12), (1e-12, 1e12)
FORMS: Mapping[str, Form] = {
    'product': Form('static', '{v}', apart=lambda v, _: v),
    'absolute': Form('static', '|{v}|', apart=lambda v, _: np.abs(v)),
    'signed_square': Form('static', '{v} |{v}|', apart=lambda v, _: v * np.abs(v), unit_of_v=2),
    'above': Form('static', 'max({v} - {threshold}, 0)', apart=law_forms.above, fitted={'threshold': ('v', *ANY)}),
    'below': Form('static', 'max({threshold} - {v}, 0)', apart=law_forms.below, fitted={'threshold': ('v', *ANY)}),
    'excess': Form(
        'static',
        'sign({v}) max(|{v}| - {threshold}, 0)',
        apart=law_forms.excess,
        fitted={'threshold': ('v', *_POSITIVE)},
    ),
    'within': Form(
        'static', '{v} within ±{threshold}', apart=law_forms.within, fitted={'threshold': ('v', *_POSITIVE)}
    ),
    'wave': Form(
        'static',
        'sin(2 pi {v} / {period} + {phase})',
        apart=law_forms.wave,
        fitted={'period': ('v', *_POSITIVE), 'phase': ('rad', -1e3, 1e3)},
        unit_of_v=0,
    ),
    'over': Form('switched', '[1 if {v} > {threshold}]', apart=law_forms.over, fixed=('threshold',), unit_of_v=0),
    'under': Form('switched', '[1 if {v} < {threshold}]', apart=law_forms.under, fixed=('threshold',), unit_of_v=0),
    'switched': Form('switched', '{v} [between {times}]'),
    'rate': Form('rate', 'd({v})/dt', following=law_forms.rate, per_second=1),
    'rate_absolute': Form('rate', '|d({v})/dt|', following=law_forms.rate_absolute, per_second=1),
    'drag': Form('rate', 'd({v})/dt |d({v})/dt|', following=law_forms.drag, unit_of_v=2, per_second=2),
    'direction': Form('history', 'sign of the last change of {v}', following=law_forms.direction, unit_of_v=0),
    'relaxed': Form(
        'history', '{v} through a lag of {tau}', following=law_forms.relaxed, fitted={'tau': ('s', 1e-4, 1e5)}
    ),
    'play': Form(
        'history', 'play({v}, {half_width}) - {v}', following=law_forms.played, fitted={'half_width': ('v', *_POSITIVE)}
    ),
    'resonance': Form(
        'resonance',
        '{v} through a mode of {natural_frequency} and damping ratio {zeta}',
        following=law_forms.resonance,
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
    """``acts_on``: one of ``TARGETS``, to which the sum of ``terms`` is added. ``further``: what the same cause adds to
    other targets; their terms are counted on.
    """

    name: str
    stage: Stage
    acts_on: str
    terms: tuple[LawTerm, ...]
    summary: str = ''
    further: tuple[Law, ...] = ()

    @property
    def parts(self) -> tuple[Law, ...]:
        """It, and what it does to each further target."""
        return (self, *self.further)

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
    rows = samples.pose[_POSE.index(name)] if name in _POSE else samples.dots[DOTS.index(name)]
    return np.asarray(rows)


def _with_values(terms: Sequence[LawTerm], first: int, values: Values) -> list[LawTerm]:
    """The terms, the first of which is number ``first``, with the coefficients and shapes of a rig file."""
    return [
        LawTerm(t.form, t.of, values[f'c{i}'], {k: values[f'{k}{i}'] for k in t.shapes}, t.times)
        for i, t in enumerate(terms, first)
    ]


def _apply(law: Law, first: int, samples: SimulatedSamples, values: Values, state: State) -> None:
    target, n = TARGETS[law.acts_on], len(samples.t)
    added = np.zeros(n)
    for i, term in enumerate(_with_values(law.terms, first, values)):
        term_state = state.setdefault(str(i), {})
        grown = term.coefficient * term.evaluate(partial(known, samples), n, samples.physics.period, term_state)
        added += grown
    if law.acts_on.startswith('beam_'):
        # A beam that moves sideways moves the dot in the plate's own axes.
        x, y = samples.dots[target.row & ~1], samples.dots[target.row | 1]
        c, s = np.cos(samples.pose[2]), np.sin(samples.pose[2])
        x += added * (s if target.row & 1 else c)
        y += added * (c if target.row & 1 else -s)
        return
    if target.point == 'dots':
        rows = samples.sums if target.of_sums else samples.dots
        rows[target.row] += added
        return
    {'load': samples.loads, 'static': samples.static, 'pose': samples.pose}[target.point][target.row] += added


def _jitter(law: Law, first: int, samples: SimulatedSamples, values: Values, state: State) -> None:
    """Noise whose rms is the sum of the terms. Its mean is zero, so an expectation has none of it."""
    if np.any(samples.noise):
        return
    target, n = TARGETS[law.acts_on], len(samples.t)
    rms = np.zeros(n)
    for term in _with_values(law.terms, first, values):
        rms += np.abs(term.coefficient * term.evaluate(partial(known, samples), n, samples.physics.period, {}))
    rng = state.setdefault('noise', np.random.default_rng(zlib.crc32(law.name.encode())))
    hiss = rms * rng.standard_normal(n)
    if target.of_sums:
        samples.volts[3 * target.row + 2] += hiss
    else:
        psd, axis = divmod(target.row, 2)
        samples.volts[3 * psd + axis] += hiss / samples.physics.sensitivity[psd, axis]


_PASSES = 6


def _correct(law: Law, first: int, reading: Reading, values: Values) -> None:
    """The reading without the law, which is a function of what is read: a fixed point."""
    terms, target = _with_values(law.terms, first, values), TARGETS[law.acts_on]
    place = (reading.sums if target.of_sums else reading.dots)[target.row]
    read, n = place.copy(), len(place)

    def read_as(name: str) -> FloatArray:
        if name == 'time':
            return reading.t
        return reading.warmer if name == 'temperature' else reading.dots[DOTS.index(name)]

    for _ in range(_PASSES):
        place[:] = read - sum(t.coefficient * t.evaluate(read_as, n, 0.0, {}) for t in terms)


def _correctable(law: Law) -> bool:
    observed = {*DOTS, 'temperature', 'time'}
    apart = all(t.form == 'switched' or FORMS[t.form].apart is not None for t in law.terms)
    return TARGETS[law.acts_on].point == 'dots' and apart and set(law.variables) <= observed


def _parameters(law: Law, first: int) -> list[EffectParameter]:
    out = []
    for i, t in enumerate(law.terms, first):
        size = abs(t.coefficient) or 1.0
        unit = t.unit(law.acts_on)
        unit = '' if unit == '1' else unit
        out.append(EffectParameter(f'c{i}', unit, -1e30, 1e30, 0.1 * size, f'coefficient of {t.words()}'))
        for name, value in t.shapes.items():
            _, low, high = FORMS[t.form].fitted.get(name, ('v', *ANY))
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


def _least_psds(law: Law) -> int:
    named = [law.acts_on.removeprefix('beam_'), *law.variables]
    return max([2, *(int(n[-1]) for n in named if n in DOTS or n in SUMS)])


def effect_of(law: Law) -> Effect:
    """The law as an effect of the simulation; its values are those of the law unless a rig file says others."""
    firsts = itertools.accumulate((len(part.terms) for part in law.parts), initial=1)
    first, *further = [_part(law, part, number) for part, number in zip(law.parts, firsts, strict=False)]
    parts = (first, *further)
    return dataclasses.replace(
        first,
        parameters=tuple(p for part in parts for p in part.parameters),
        equation='; '.join(part.equation for part in parts),
        needs=', '.join(dict.fromkeys(v for part in law.parts for v in part.variables)) or 'time',
        least_psds=max(part.least_psds for part in parts),
        law=_in_yaml(law, line=True).strip(),
        further=tuple(further),
    )


def _part(full: Law, law: Law, first: int) -> Effect:
    """What ``law``, whose terms are counted from ``first``, does of the ``full``."""
    variance = law.kind == 'variance'
    uses = cast('frozenset[Use]', frozenset(law.variables) & frozenset(('time', 'temperature')))
    correctable = _correctable(law) and not variance
    return Effect(
        name=full.name,
        stage=law.stage,
        summary=full.summary or f'an empirical law on {", ".join(part.acts_on for part in full.parts)}',
        equation=law.expression,
        source='empirical: found by psd-deflection discover',
        needs='',
        parameters=tuple(_parameters(law, first)),
        point='output' if variance else TARGETS[law.acts_on].point,
        apply=partial(_jitter if variance else _apply, law, first),
        correct=partial(_correct, law, first) if correctable else None,
        uses=uses if correctable else frozenset(),
        order=50,
        least_psds=_least_psds(law),
    )


def values_of(law: Law) -> dict[str, float]:
    """The values of the effect's parameters as the law has them."""
    out = {}
    for i, t in enumerate((t for part in law.parts for t in part.terms), 1):
        out[f'c{i}'] = t.coefficient
        out.update({f'{k}{i}': v for k, v in t.shapes.items()})
    return out


def law_text(law: Law, comment: Sequence[str] = ()) -> str:
    """The law as a YAML file; :func:`~psd_deflection.model.simulation.law_files.read_law` reads it again."""
    return ''.join(f'# {line}\n' for line in comment) + _in_yaml(law)


def _in_yaml(law: Law, *, line: bool = False) -> str:
    """The law in YAML; in one ``line``."""
    tree = {'name': law.name, 'summary': law.summary, **_tree(law)}
    if law.further:
        tree['further'] = [_tree(part) for part in law.further]
    width = 10**9 if line else 1000
    return yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, width=width, default_flow_style=line)


def _tree(law: Law) -> dict[str, Any]:
    """What it does to its target."""
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
    return {'stage': law.stage, 'acts_on': law.acts_on, 'kind': law.kind, 'expression': law.expression, 'terms': terms}
