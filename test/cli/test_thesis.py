# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``psd-deflection thesis compare-methods``: the tables, the figures, and that the page on methods has them all."""

from pathlib import Path

import pytest

from psd_deflection.cli.main import main
from psd_deflection.studies.thesis.comparison import CAUSES, methods
from psd_deflection.studies.thesis.figures import FIGURES

pytestmark = pytest.mark.slow


def test_tables_and_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['thesis', 'compare-methods', '--out', str(tmp_path / 'new' / 'figures')]) == 0
    output = capsys.readouterr().out
    written = sorted((tmp_path / 'new' / 'figures').iterdir())
    assert [p.name for p in written] == sorted(f'{name}.png' for name in FIGURES)
    for path in written:
        assert f'wrote {path}' in output
        assert path.read_bytes().startswith(b'\x89PNG')
        assert 5_000 < path.stat().st_size < 150_000
    lines = [line for line in output.splitlines() if not line.startswith('wrote ')]
    assert max(len(line) for line in lines) <= 120
    end = next(i for i, line in enumerate(lines) if line.startswith('Section 2.3'))
    rows = {m.label: [line for line in lines[:end] if line.startswith(m.label + '  ')] for m in methods()}
    assert all(len(cells) == 2 for cells in rows.values())
    rms, largest = rows['exact (default)']
    assert '0 / 0 / 0' in rms
    assert '3.34 / 2.67 / 1.83' in rms
    assert '8.98 / 6.3 / 3.32' in largest
    assert rows['Appendix D iterative'][0].endswith('5.25 to 5.83 %')
    squeezed = [' '.join(line.split()) for line in lines[end:]]
    for output in (
        *('2.36 ΔY, µm 2000 -2000 -2000', '2.38 DT, µm imaginary 100006 100006'),
        *('exact, ols, wls 1.63 / 1.83 / 1.33', 'wls, thesis weights, sidebar 2.00 / 2.00 / 1.55'),
        *('wls, thesis weights, direct 2.00 / 1.93 / 2.31', 'Appendix D weighted, direct -0.995 mdeg'),
        *('A in mm 149.53 (122.07)', '4.33, mm and rad in one norm 3.868'),
    ):
        assert output in squeezed
    for cause in CAUSES:
        assert sum(line.startswith(cause.label + ' ') for line in lines) == 1
    (alone,) = (line for line in lines if line.startswith('the algorithms alone'))
    assert alone.split()[3:] == ['-8.6', '84.9', '0.0', '|', '-0.4', '19.2', '-0.5']


def test_a_folder_that_cannot_be_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'taken').write_text('')
    assert main(['thesis', 'compare-methods', '--out', str(tmp_path / 'taken')]) == 4
    assert 'taken: cannot be made a folder' in capsys.readouterr().err


def test_a_figure_that_cannot_be_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'comparison.png').mkdir()
    assert main(['thesis', 'compare-methods', '--out', str(tmp_path)]) == 4
    assert f'--out {tmp_path / "comparison.png"}: cannot be written' in capsys.readouterr().err
