# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Columns with units, as pandas, xarray and HTML."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.tables import Column, Table, columns_of, html_table, text_column

T = Column('t', np.arange(3) * 0.5, 's', 'time')
TABLE = Table(T, columns_of(np.arange(6.0).reshape(3, 2), ('a', 'b'), ('m', ''), ('one', 'two')), {'path': 'somewhere'})


def test_pandas_has_the_units() -> None:
    pytest.importorskip('pandas')
    frame = TABLE.to_pandas()
    assert list(frame.index) == [0.0, 0.5, 1.0]
    assert frame['b'].tolist() == [1.0, 3.0, 5.0]
    assert frame.attrs == {'path': 'somewhere', 'units': {'t': 's', 'a': 'm', 'b': ''}}


def test_a_column_may_have_words_numbers_and_none() -> None:
    values = text_column('value', [(1.0, 2.0), -1.0, None], 'of anything').values
    assert values.tolist() == [(1.0, 2.0), -1.0, None]


@pytest.mark.slow
def test_xarray_has_the_units() -> None:
    pytest.importorskip('xarray')
    data = TABLE.to_xarray()
    assert data['a'].values.tolist() == [0.0, 2.0, 4.0]
    assert data['a'].attrs == {'units': 'm', 'long_name': 'one'}
    # A number without a unit has the unit 1, as the CF conventions have it.
    assert data['b'].attrs['units'] == '1'
    assert data['t'].attrs == {'units': 's', 'long_name': 'time'}
    assert data.attrs == {'path': 'somewhere'}


@pytest.mark.parametrize('name', ['pandas', 'xarray'])
def test_a_missing_library_is_named(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ConfigError, match=rf"to_{name} needs {name}: `pip install 'psd_deflection\[pandas\]'`"):
        getattr(TABLE, f'to_{name}')()


def test_words_of_a_file_are_text_in_html() -> None:
    page = html_table('<b>', [('a & b', '\x1b[2J<script>'), ('long', 'x' * 1000)])
    assert '<b>' not in page
    assert '<script>' not in page
    assert '\x1b' not in page
    assert 'a &amp; b' in page
    assert len(page) < 700
