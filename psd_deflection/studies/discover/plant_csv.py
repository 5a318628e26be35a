# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Any CSV table as a plant without a model: outputs as sums of terms of the inputs."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from psd_deflection.base.csv_table import CsvTable
from psd_deflection.base.errors import ConfigError
from psd_deflection.model.simulation.declaration import EffectParameter
from psd_deflection.records import FloatArray, IntArray
from psd_deflection.studies.discover.plants import Model, Plant, plant_effect
from psd_deflection.studies.discover.thresholds import FOLDS, RANGE

KINDS = ('number', 'degrees', 'radians', 'sign')
"""Of an input: terms of its powers, of sine and cosine, or of its sign beside its powers."""

_UNIT = re.compile(r'[\[(]([^\])]*)[\])]\s*$')


class _Term(NamedTuple):
    """``values`` (n,), and ``unit``, '' for a number without one."""

    values: FloatArray
    unit: str


class CsvPlant(Plant):
    """A table: ``outputs`` as an offset plus terms of the ``inputs``.

    A number u has the terms u, u^2 and u^3; u counts from a round number in the middle of its range, which the term
    names, "(u - 20)^2", if 0 is not near it. An angle has the terms sin, cos, sin 2u, cos 2u; a sign has sgn(u).
    Products of two inputs' first terms are terms too. Units are in brackets in the header: "el [deg]".
    """

    cases = ('table',)

    def __init__(
        self,
        path: str | Path,
        inputs: Sequence[str],
        outputs: Sequence[str],
        parts: str = '',
        kinds: Mapping[str, str] | None = None,
        noise: Sequence[float] = (),
        middles: Mapping[str, float] | None = None,
    ) -> None:
        """``parts``: a column; rows with the same text in it are left out of the fit together. ``kinds``: of an input,
        one of ``KINDS``; a unit of deg or rad is recognised. ``noise``: rms of each output, if it is known.

        Raises ConfigError for a name that the table lacks, RecordingError for a cell that is no number; an output's
        cell may be empty.
        """
        table = CsvTable(Path(path))
        # Of a table that is predicted, the inputs are enough.
        fitted = middles is None
        table.require(
            (*inputs, *((*outputs, *filter(None, [parts])) if fitted else ())), 'a table of inputs and outputs'
        )
        rows = list(table.table_rows())
        if not inputs or not outputs or len(rows) < (FOLDS if fitted else 1):
            raise ConfigError(f'{path}: {len(rows)} rows: needs inputs, outputs and at least {FOLDS} rows')
        self.channels, self.noise = tuple(map(_bare, outputs)), tuple(noise)
        self.units = tuple(_unit(name) for name in outputs)
        self._arguments = (tuple(inputs), tuple(outputs), parts, dict(kinds or {}), tuple(noise))
        self._inputs = {_bare(name): np.array([row.number(name) for row in rows]) for name in inputs}
        there = [name if name in table.columns else '' for name in outputs]
        self._outputs = np.array([[row.number(n) if n and row.text(n) else math.nan for row in rows] for n in there])
        texts = [str(i * FOLDS // len(rows)) for i in range(len(rows))]
        if parts and fitted:
            texts = [row.text(parts) for row in rows]
        order = list(dict.fromkeys(texts))
        self._parts: IntArray = np.array([order.index(text) for text in texts])
        self._fitted = fitted
        self._middles = dict(middles or {name: _middle(u) for name, u in self._inputs.items()})
        self._units = {_bare(n): _unit(n) for n in inputs}
        self._terms = self._terms_of({_bare(n): (kinds or {}).get(n) or _kind(n) for n in inputs})
        sd = (
            np.array([row[np.isfinite(row)].std() if np.isfinite(row).any() else 1.0 for row in self._outputs]) + 1e-300
        )
        effects: dict[str, EffectParameter] = {}
        for output, unit, of_output in zip(self.channels, self.units, sd.tolist(), strict=True):
            for name, term in {'offset': _Term(np.ones(1), ''), **self._terms}.items():
                scale = of_output / float(np.sqrt(np.mean(term.values**2)) + 1e-300)
                full_unit = f'{unit or 1}/{term.unit}' if term.unit else unit
                words = f'{name} in {output}'
                parameter = EffectParameter('size', full_unit, -RANGE[1] * scale, RANGE[1] * scale, scale, words)
                effects[f'{output}: {name}'] = parameter
        self.library = tuple(plant_effect(n, p) for n, p in effects.items() if not n.endswith(': offset'))
        self.nuisance = tuple(plant_effect(n, p) for n, p in effects.items() if n.endswith(': offset'))

    def like(self, path: str | Path) -> CsvPlant:
        """Return another table with the columns and the terms of this one."""
        return CsvPlant(path, *self._arguments, middles=self._middles)

    def measured(self) -> Sequence[FloatArray]:
        """Return the outputs."""
        return [self._outputs]

    def inputs(self) -> Mapping[str, Sequence[FloatArray]]:
        """Return the inputs."""
        return {name: [values] for name, values in self._inputs.items()}

    def parts(self) -> Sequence[IntArray]:
        """Return the part of each row."""
        return [self._parts]

    def simulate(self, model: Model) -> Sequence[FloatArray]:
        """Return the sum of the terms of ``model`` for each output."""
        out = np.zeros((len(self.channels), len(self._parts)))
        for name, values in model.items():
            output, term = name.split(': ')
            out[self.channels.index(output)] += values['size'] * (1.0 if term == 'offset' else self._terms[term].values)
        return [out]

    def _terms_of(self, kinds: Mapping[str, str]) -> dict[str, _Term]:
        first, further = dict[str, dict[str, _Term]](), dict[str, _Term]()
        for name, kind in kinds.items():
            u, middle, unit = self._inputs[name], self._middles[name], self._units[name]
            if kind not in KINDS:
                raise ConfigError(f'kinds: {name} = {kind!r}: must be one of {", ".join(KINDS)}')
            if self._fitted and np.ptp(u) == 0.0:
                continue  # A constant is in the offset.
            if kind in ('degrees', 'radians'):
                angle = np.radians(u) if kind == 'degrees' else u
                first[name] = {f'sin {name}': _Term(np.sin(angle), ''), f'cos {name}': _Term(np.cos(angle), '')}
                further[f'sin 2 {name}'] = _Term(np.sin(2.0 * angle), '')
                further[f'cos 2 {name}'] = _Term(np.cos(2.0 * angle), '')
                continue
            v, label = u - middle, f'({name} - {middle:g})' if middle else name
            first[name] = {label: _Term(v, unit)}
            further |= {f'{label}^{k}': _Term(v**k, f'{unit}^{k}' if unit else '') for k in (2, 3)}
            if kind == 'sign':
                further[f'sign {name}'] = _Term(np.sign(u), '')
        products = {
            f'{a} * {b}': _Term(x.values * y.values, _product(x.unit, y.unit))
            for left_terms, right_terms in itertools.combinations(first.values(), 2)
            for (a, x), (b, y) in itertools.product(left_terms.items(), right_terms.items())
        }
        return {k: v for terms in first.values() for k, v in terms.items()} | further | products


def _product(a: str, b: str) -> str:
    return f'({a} {b})' if a and b else a or b


def _middle(u: FloatArray) -> float:
    """Return a round number in the middle of the range of ``u``; 0 if that is within a tenth of it."""
    half = float(np.ptp(u)) / 2.0
    middle = float(u.min()) + half
    if abs(middle) <= 0.2 * half:
        return 0.0
    digit = 10.0 ** math.floor(math.log10(half)) if half else 1.0
    return round(middle / digit) * digit


def _unit(name: str) -> str:
    match = _UNIT.search(name)
    return match[1].strip() if match else ''


def _bare(name: str) -> str:
    return _UNIT.sub('', name).strip()


def _kind(name: str) -> str:
    return {'deg': 'degrees', '°': 'degrees', 'rad': 'radians'}.get(_unit(name), 'number')
