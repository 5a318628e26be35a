# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Columns with units, as text, a pandas DataFrame, an xarray Dataset or the HTML that a notebook shows."""

from __future__ import annotations

import html
import importlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.text import did_you_mean, sanitize

if TYPE_CHECKING:
    import pandas
    import xarray

LONGEST_CELL = 200
"""Characters of one cell of :func:`html_table`, which may hold words of a file."""


class Column(NamedTuple):
    """``values`` (n,), its ``unit`` ('' if it has none) and what it is."""

    name: str
    values: npt.NDArray[Any]
    unit: str
    description: str


def columns_of(
    values: npt.NDArray[Any], names: Sequence[str], units: Sequence[str], descriptions: Sequence[str]
) -> list[Column]:
    """One column for each of the (n, m) ``values``."""
    return [Column(n, values[:, i], u, d) for i, (n, u, d) in enumerate(zip(names, units, descriptions, strict=True))]


def text_column(name: str, values: Sequence[object], description: str) -> Column:
    """A column of words, or of whatever else there is."""
    cells = np.empty(len(values), dtype=object)
    # One by one: an array of tuples would have two dimensions.
    for i, value in enumerate(values):
        cells[i] = value
    return Column(name, cells, '', description)


@dataclass(frozen=True)
class Table:
    """Columns of one length over ``index``. ``attributes``: of the whole."""

    index: Column
    columns: Sequence[Column]
    attributes: Mapping[str, object] = field(default_factory=dict)

    def column(self, name: str) -> npt.NDArray[Any]:
        """The values of a column, or of the index. Raises KeyError with the names that there are."""
        for column in (self.index, *self.columns):
            if column.name == name:
                return column.values
        names = [column.name for column in (self.index, *self.columns)]
        raise KeyError(f'no column {name!r}{did_you_mean(name, names)}; there are {", ".join(names)}')

    def to_pandas(self, *, clock: bool = False) -> pandas.DataFrame:
        """The columns over the index; ``.attrs['units']`` has the unit of each by name.

        ``clock``: over the times of the column ``t_ns`` (UTC) instead.
        Raises ConfigError if pandas is not installed.
        """
        pd = _library('pandas')
        if clock:
            times = pd.to_datetime(self.column('t_ns'), unit='ns', utc=True).rename('time')
            return self.to_pandas().set_index(times)
        frame = pd.DataFrame(
            {c.name: np.ascontiguousarray(c.values) for c in self.columns},
            index=pd.Index(self.index.values, name=self.index.name),
        )
        frame.attrs.update(self.attributes)
        frame.attrs['units'] = {c.name: c.unit for c in (self.index, *self.columns)}
        return frame

    def to_xarray(self) -> xarray.Dataset:
        """One variable a column; each has ``units`` and ``long_name`` in its attributes.

        Raises ConfigError if xarray is not installed.
        """
        xr = _library('xarray')
        variables = {c.name: self._variable(c) for c in self.columns}
        return xr.Dataset(variables, {self.index.name: self._variable(self.index)}, dict(self.attributes))

    def _variable(self, column: Column) -> tuple[str, npt.NDArray[Any], dict[str, str]]:
        values = np.ascontiguousarray(column.values)
        return self.index.name, values, {'units': column.unit or '1', 'long_name': column.description}


def _library(name: str) -> Any:
    return optional_library(name, f'to_{name}', name, 'pandas')


def optional_library(module: str, what: str, package: str, extra: str) -> Any:
    """Return ``module``, which ``what`` needs. Raises ConfigError with the lines of pip if ``package`` is missing."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise ConfigError(
            f"{what} needs {package}: `pip install 'psd_deflection[{extra}]'` or `pip install {package}`"
        ) from None


def html_table(caption: str, rows: Iterable[tuple[str, object]]) -> str:
    """Two columns with ``caption`` above; every word is escaped."""
    cells = ''.join(
        f'<tr><th style="text-align:left">{_cell(name)}</th><td style="text-align:left">{_cell(value)}</td></tr>'
        for name, value in rows
    )
    return f'<table><caption style="text-align:left">{_cell(caption)}</caption>{cells}</table>'


def _cell(value: object) -> str:
    return html.escape(sanitize(str(value), LONGEST_CELL))


def columns(rows: Sequence[Sequence[str]], align_left: int = 1) -> str:
    """``rows`` (the first is the head) as text: the first ``align_left`` columns flush left, the rest right."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [c.ljust(w) if i < align_left else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))]
        lines.append('  '.join(cells).rstrip())
    lines.insert(1, '  '.join('-' * w for w in widths))
    return '\n'.join(lines)
