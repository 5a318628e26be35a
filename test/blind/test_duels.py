# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The duels: a made Silverbox whose spring is known, the measures by hand, the rows of what is not there."""

from __future__ import annotations

import math
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from blind import balls, silverbox
from blind.boom import Boom
from blind.duel_peers import best_subset
from blind.measured import DATA
from blind.silverbox import RATE, Silverbox, rmse
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.plant_search import discover_in

pytestmark = pytest.mark.slow

COUNT, CUBIC = 2700, 4.0


def oscillator(folder: Path) -> FloatArray:
    """A file of an oscillator of 70 Hz, damping 0.05, whose spring stiffens by 4 y^3; its output.

    By scipy's integrator, with an input that is a sum of sines, in its second period: nothing of the plant.
    """
    rng = np.random.default_rng(5)
    periods = np.arange(40, 800, 8)
    phases = rng.uniform(0.0, 2.0 * math.pi, len(periods))
    w = 2.0 * math.pi * 70.0

    def force(t: float | FloatArray) -> FloatArray:
        turn = 2.0 * math.pi * periods * RATE / COUNT
        return np.asarray(0.005 * np.sin(np.multiply.outer(np.asarray(t), turn) + phases).sum(axis=-1))

    def rate(t: float, state: FloatArray) -> list[float]:
        y, v = state
        return [v, w**2 * (float(force(t)) - y - CUBIC * y**3) - 2.0 * 0.05 * w * v]

    times = np.arange(COUNT) / RATE
    later = times + COUNT / RATE
    y = np.asarray(solve_ivp(rate, (0.0, later[-1]), [0.0, 0.0], t_eval=later, rtol=1e-8, atol=1e-10).y[0])
    y = y + 1e-4 * rng.standard_normal(COUNT)
    rows = [f'{u:.9g},{v:.9g},' for u, v in zip(force(times), y, strict=True)]
    (folder / silverbox.FILE).write_text('\n'.join(['"V1","V2",', *rows, '', '']))
    return y


def test_the_cubic_spring_of_a_made_silverbox_is_found_with_its_size(tmp_path: Path) -> None:
    y = oscillator(tmp_path)
    plant = Silverbox(tmp_path, train=(0, COUNT), shape=(4, 6))
    np.testing.assert_allclose(plant.y, y, atol=1e-9)
    # The pieces of a case follow each other without a gap.
    np.testing.assert_array_equal(np.concatenate(plant.measured(), axis=1)[0], plant.y[50:2450])
    plant.library = tuple(e for e in plant.library if e.name in ('cubic_spring', 'quadratic_drag', 'force_offset'))
    found = discover_in(plant)
    (spring,) = found.effects
    assert spring.active.effect.name == 'cubic_spring'
    assert spring.active.values['stiffening'] == pytest.approx(CUBIC, rel=0.05)
    # The noise that was added, and little more, is left.
    assert 0.9e-4 < found.gap_after < 2e-4


def made_drops(path: Path, drag: float) -> None:
    """Two drops of each ball from 47 m, falling as v = -u tanh(g t / u), in the file's form; u by mass and radius."""
    sheet = '<worksheet xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"><sheetData>'
    sheets = []
    with ZipFile(path, 'w') as book:
        for number, (name, (ounces, around)) in enumerate(balls.BALLS.items(), start=1):
            area = math.pi * (0.01 * around / (2.0 * math.pi)) ** 2
            last = math.sqrt(2.0 * balls.OUNCE * ounces * 9.81 / (1.2 * area * drag))
            t = np.arange(40) / 15.0
            h = 47.0 - last**2 / 9.81 * np.log(np.cosh(9.81 * t / last))
            rows = [(d, *pair) for d in (1, 2) for pair in zip(t.tolist(), h.tolist(), strict=True)]
            text = ''.join(
                '<row>' + ''.join(f'<c><v>{v!r}</v></c>' for v in row) + '</row>' for row in [(0, 0, 0), *rows]
            )
            book.writestr(f'xl/worksheets/sheet{number}.xml', f'{sheet}{text}</sheetData></worksheet>')
            sheets.append(f'<sheet name="{name}"/>')
        head = '<workbook xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"><sheets>'
        book.writestr('xl/workbook.xml', f'{head}{"".join(sheets)}</sheets></workbook>')


def test_the_drag_of_made_drops_is_found_with_its_size(tmp_path: Path) -> None:
    """By the closed form of a fall with drag that grows with the square of speed."""
    made_drops(tmp_path / balls.FILE, 0.45)
    (drag,) = discover_in(balls.Balls(tmp_path)).effects
    assert drag.active.effect.name == 'quadratic_drag'
    assert drag.active.values['coefficient'] == pytest.approx(0.45, rel=0.05)


@pytest.mark.skipif(not (DATA / 'boom').is_dir(), reason='the readings of the boom are not here')
def test_of_the_boom_every_subset_of_three_is_asked() -> None:
    subset = best_subset(Boom())
    assert set(subset.names) == {'self_weight', 'tip_force', 'root_length'}
    assert 1e3 * subset.gap == pytest.approx(1.58, abs=0.02)
    assert subset.gap < subset.unseen < 3e-3


@pytest.mark.skipif(not (DATA / 'silverbox').is_dir(), reason='the data of the Silverbox are not here')
def test_the_fitted_silverbox_is_simulated_to_half_a_percent() -> None:
    """The search itself takes minutes: python -m blind.duels --only silverbox."""
    plant = Silverbox(DATA / 'silverbox')
    model = {
        'cubic_spring': {'stiffening': 3.944},
        'quadratic_drag': {'drag': 0.0192},
        'quadratic_spring': {'bend': -0.1003},
        'reading_offset': {'shift': -0.005515},
        'frequency': {'scale': -0.017107},
        'damping': {'scale': -0.00165},
        'gain': {'scale': 0.02988},
    }
    first, last = silverbox.TESTS['multisine']
    residual, share = rmse(plant.y[first:last], plant.run(model, np.array([first]), last - first)[:, 0])
    assert 1e3 * residual < 0.25
    assert share < 0.005
