# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``psd-deflection camera``: a folder of frames to CSV and to a bag."""

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest

from blind.render import Pose, Scene, photograph
from psd_deflection.cli.main import main

POSES = [Pose(), Pose(), Pose(1e-3, -2e-3, 0.02), Pose(-2e-3, 1e-3, -0.01)]


@pytest.fixture(scope='module')
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder ``frames`` with one frame that shows nothing, and ``camera.yaml``."""
    folder, scene, rng = tmp_path_factory.mktemp('film'), Scene(roll=0.1), np.random.default_rng(0)
    (folder / 'frames').mkdir()
    images = [photograph(scene, [pose], rng) for pose in POSES]
    images.insert(3, np.full((480, 640), 30, np.uint8))
    for number, image in enumerate(images):
        cv2.imwrite(str(folder / 'frames' / f'{number}.png'), image)
    rows = [f'{i}.png,{i / 30:.6f},0.004' for i in range(len(images))]
    (folder / 'frames' / 'frames.csv').write_text('\n'.join(['file,t,exposure', *rows]) + '\n')
    (folder / 'camera.yaml').write_text(f'target: {{spacing: 0.025, radius: 0.008}}\ncamera.matrix: {scene.matrix}\n')
    return folder


def test_the_table_has_each_frame_with_its_answer_or_reason(
    filmed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / 'reference.csv'
    assert (
        main(['camera', str(filmed / 'frames'), '--params-file', str(filmed / 'camera.yaml'), '--out', str(out)]) == 0
    )
    output = capsys.readouterr().out
    assert '4 of 5 frames have an answer' in output
    assert '1 rejected: no target' in output
    rows = list(csv.DictReader(out.read_text().splitlines()))
    assert list(rows[0]) == ['t', 'dx', 'dy', 'theta', 'sd_dx', 'sd_dy', 'sd_theta', 'status']
    assert [r['t'] for r in rows[:2]] == ['0.002000000', '0.035333000']
    assert [r['status'] for r in rows] == ['ok', 'ok', 'ok', 'no target', 'ok']
    assert [rows[3][k] for k in ('dx', 'dy', 'theta', 'sd_dx', 'sd_dy', 'sd_theta')] == [''] * 6
    for row, pose in zip((r for r in rows if r['status'] == 'ok'), POSES, strict=True):
        for name in ('dx', 'dy', 'theta'):
            assert abs(float(row[name]) - getattr(pose, name)) < 5 * float(row[f'sd_{name}'])


@pytest.mark.parametrize(
    ('words', 'status', 'complaint'),
    [
        (['frames', '--out', 'x.txt'], 2, '.txt cannot be written'),
        (['frames'], 2, '--out is missing'),
        (['a', 'b', '--out', 'x.csv'], 2, 'one IN at a time'),
        (['target', '--out', 'x.doc'], 2, 'must end in'),
        (['intrinsics', '--out', 'x.yaml'], 2, 'name the images'),
        (['nothing', '--out', 'x.csv'], 4, 'no such video'),
    ],
)
def test_a_mistake_is_reported_before_anything_is_written(
    words: list[str],
    status: int,
    complaint: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(['camera', *words]) == status
    assert complaint in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_target_is_printed_with_the_sizes_to_type_in(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / 'target.svg'
    assert main(['camera', 'target', '--out', str(out)]) == 0
    assert 'target.spacing: 0.025' in capsys.readouterr().out
    assert '<svg' in out.read_text()
