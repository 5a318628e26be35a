# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What docs/mechanics.md, docs/budget.md and docs/audit.md quote is what the commands print."""

from __future__ import annotations

from pathlib import Path

import pytest

from psd_deflection.cli.main import main

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
RIG = str(ROOT / 'config' / 'thesis_rig.yaml')


@pytest.mark.parametrize(
    ('page', 'arguments'),
    [
        ('mechanics.md', ['design', '--params-file', RIG, '--sigma', '2e-6']),
        ('budget.md', ['budget', '--params-file', RIG, '--monte-carlo', '20000']),
    ],
)
def test_the_quoted_tables_are_the_printed_ones(
    page: str, arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 0
    printed = capsys.readouterr().out.rstrip()
    assert f'```\n{printed}\n```' in (ROOT / 'docs' / page).read_text(encoding='utf-8')


def test_the_errata_of_appendix_b_are_the_printed_ones(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['design']) == 0
    errata = capsys.readouterr().out.partition('Errata:\n')[2].rstrip()
    assert f'```\nErrata:\n{errata}\n```' in (ROOT / 'docs' / 'audit.md').read_text(encoding='utf-8')
    assert 'E-glass/epoxy +-45' in errata


@pytest.mark.parametrize(
    ('arguments', 'quoted'),
    [
        (['--method', 'wls'], '29.826 | 5.017 | 0.042'),
        (['--method', 'thesis_iteration'], '66.025 | 0.000 | 52.375'),
        (
            [
                *('--set', 'rotation_tolerance=1e-3', '--set', 'center_tolerance=1e-4'),
                *('--set', 'height_tolerance=2e-4', '--set', 'pointing_drift=2e-6'),
            ],
            '2.992 µm, 5.048 µm and 2.723 mdeg',
        ),
    ],
)
def test_the_quoted_figures_are_the_printed_ones(
    arguments: list[str], quoted: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(['budget', '--params-file', RIG, '--out', str(tmp_path / 'chart.png'), *arguments]) == 0
    out = capsys.readouterr().out
    assert quoted in (ROOT / 'docs' / 'budget.md').read_text(encoding='utf-8')
    name = 'computation' if '--method' in arguments else 'total'
    line = next(line.split() for line in out.splitlines() if line.startswith(name))
    figures = line[6:9] if name == 'computation' else line[1:4]
    # 'computation  E_C  known bias  B  ∞  ΔX ΔY θ ...'
    assert [w for w in quoted.replace('|', ' ').split() if w[0].isdigit()] == figures
