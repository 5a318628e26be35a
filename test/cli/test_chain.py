# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``chain`` without ROS, and what ``chain`` and ``compensator`` reject."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from psd_deflection.cli.main import main

CONFIG = Path(__file__).parents[2] / 'config'
EXAMPLE = str(CONFIG / 'two_links.yaml')
URDF = str(CONFIG / 'two_links.urdf')


def test_two_simulated_links_as_json_and_csv(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / 'end.csv'
    assert main(['chain', EXAMPLE, '--no-ros', '--json', '--count', '5', '--out', str(out)]) == 0
    blocks = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    rows = list(csv.DictReader(out.read_text(encoding='utf-8').splitlines()))
    assert len(blocks) == len(rows) == 5
    composed = [(b, r) for b, r in zip(blocks, rows, strict=True) if b['deflection']]
    assert composed
    for block, row in composed:
        for axis, value in block['deflection'].items():
            assert float(row[axis]) == value
        deviations = np.sqrt(np.diag(block['covariance']))
        assert [float(row[f'sd_{axis}']) for axis in block['deflection']] == pytest.approx(deviations)
        assert float(row['t']) == pytest.approx(block['t'], abs=1e-6)
    # With both joints turned the arm leans out.
    assert composed[0][0]['pose']['position'] == pytest.approx([1.2589, 0.0, 0.1745], abs=1e-2)


@pytest.mark.parametrize(
    ('argv', 'status', 'message'),
    [
        (['chain', EXAMPLE, '--json'], 2, '--out, --json and --count need --no-ros'),
        (['chain', EXAMPLE, '--no-ros', '--out', 'x.txt'], 2, 'must end in .csv'),
        (['chain', EXAMPLE, '--no-ros', '--out', 'gone/x.csv'], 4, 'there is no folder gone'),
        (['chain', 'gone.yaml', '--no-ros'], 3, 'gone.yaml: no such chain file'),
        (['compensator', '--urdf', URDF, '--tip', 'tol'], 3, 'tip: no link tol; did you mean tool?'),
        (['compensator', '--tip', 'tool', '--axes', 'x,u'], 2, "--axes = ['x', 'u']: each must be one of"),
        (['compensator', '--urdf', URDF], 3, 'tip: the link of the end effector must be named'),
        (['compensator', '--drive'], 3, 'tip: the link of the end effector must be named'),
        (['compensator', '--urdf', URDF, '--tip', 'tool', '--stale', 'nan'], 2, '--stale = nan s: must be finite'),
        (['compensator', '--urdf', 'gone.urdf', '--tip', 'tool'], 3, 'gone.urdf: no such URDF file'),
    ],
)
def test_rejected(argv: list[str], status: int, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(argv) == status
    output = capsys.readouterr().err
    assert message in output
    assert output.count('\n') == 1
