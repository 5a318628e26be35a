# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Frames from folders, videos and ROS images; the camera's parameter file."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from psd_deflection.base.errors import ConfigError, DeviceError, RecordingError
from psd_deflection.camera.footage import Footage, read_settings


def folder(path: Path, table: str) -> str:
    path.mkdir()
    cv2.imwrite(str(path / 'a.png'), np.full((20, 30), 7, np.uint8))
    cv2.imwrite(str(path / 'b.png'), np.full((20, 30, 3), 9, np.uint8))
    (path / 'c.png').write_bytes(b'no image')
    (path / 'frames.csv').write_text(table)
    return str(path)


def test_a_folder_gives_the_middles_of_its_exposures(tmp_path: Path) -> None:
    table = 'file,t,exposure\na.png,1700000000.123456789,0.002\nb.png,1700000000.2,0.01\nc.png,1700000000.3,0\n'
    table += 'gone.png,1700000000.4,0\n'
    frames = list(Footage(folder(tmp_path / 'f', table), 0.0))
    assert [f.t_ns for f in frames] == [
        1_700_000_000_124_456_789,
        1_700_000_000_205_000_000,
        1_700_000_000_300_000_000,
        1_700_000_000_400_000_000,
    ]
    assert [None if f.image is None else int(f.image[3, 3]) for f in frames] == [7, 9, None, None]


@pytest.mark.parametrize(
    ('table', 'complaint'),
    [
        ('file,t\na.png,0\n', 'the header lacks exposure'),
        ('file,t,exposure\na.png,x,0\n', "frames.csv:2: column t holds 'x'"),
        ('file,t,exposure\na.png,0,nan\n', 'column exposure'),
        ('file,t,exposure\na.png,0,-1\n', 'exposure is negative'),
        ('file,t,exposure\na.png,1,0\nb.png,1,0\n', 'frames.csv:3: t does not increase'),
        ('file,t,exposure\n../a.png,0,0\n', 'must be the name of an image'),
        ('file,t,exposure\n', 'lists no frame'),
    ],
)
def test_a_wrong_table_is_rejected_by_line(tmp_path: Path, table: str, complaint: str) -> None:
    with pytest.raises(RecordingError, match=complaint):
        Footage(folder(tmp_path / 'f', table), 0.0)


def test_what_is_no_source_is_rejected(tmp_path: Path) -> None:
    (tmp_path / 'text.avi').write_text('no video')
    with pytest.raises(RecordingError, match='not a video'):
        Footage(str(tmp_path / 'text.avi'), 0.0)
    with pytest.raises(RecordingError, match='no such video'):
        Footage(str(tmp_path / 'nothing'), 0.0)
    with pytest.raises(RecordingError, match='has no frames'):
        Footage(str(tmp_path), 0.0)
    with pytest.raises(DeviceError, match='no camera'):
        Footage('/dev/null', 0.0)


def test_a_video_is_stamped_by_its_frames(tmp_path: Path) -> None:
    path = str(tmp_path / 'v.avi')
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*'MJPG'), 25.0, (64, 48))
    for level in (10, 100, 200):
        writer.write(np.full((48, 64, 3), level, np.uint8))
    writer.release()
    frames = list(Footage(path, 0.01))
    assert [f.t_ns for f in frames] == [5_000_000, 45_000_000, 85_000_000]
    assert [round(f.image.mean(), -1) for f in frames] == [10.0, 100.0, 200.0]


@pytest.mark.parametrize(
    'text',
    [
        'target.spacing: 0.03\ncamera.matrix: [9, 0, 1, 0, 9, 2, 0, 0, 1]\n',
        'target: {spacing: 0.03}\ncamera:\n  matrix: [[9, 0, 1], [0, 9, 2], [0, 0, 1]]\n',
        '/**:\n  ros__parameters:\n    target: {spacing: 0.03}\n'
        '    camera.matrix: [9.0, 0.0, 1.0, 0.0, 9.0, 2.0, 0.0, 0.0, 1.0]\n',
        'camera_matrix: {rows: 3, cols: 3, data: [9, 0, 1, 0, 9, 2, 0, 0, 1]}\n'
        'distortion_coefficients: {data: []}\ntarget.spacing: 0.03\n',
    ],
)
def test_the_parameter_file_may_have_any_of_its_forms(tmp_path: Path, text: str) -> None:
    path = tmp_path / 'camera.yaml'
    path.write_text(text)
    settings = read_settings(path)
    assert (settings.spacing, settings.matrix) == (0.03, (9.0, 0.0, 1.0, 0.0, 9.0, 2.0, 0.0, 0.0, 1.0))


@pytest.mark.parametrize(
    ('text', 'complaint'),
    [
        ('target.spaceing: 1\n', 'did you mean target.spacing'),
        ('target.spacing: wide\n', 'must be a number'),
        ('target.radius: -1\n', 'must be at least'),
        ('target.radius: 0.02\n', 'more than twice target.radius'),
        ('camera.view: above\n', 'must be one of outside, base'),
        ('camera.matrix: [1, 2]\n', 'must be nine'),
        ('camera.distortion: [1, 0, 0, 0]\n', 'without camera.matrix'),
        ('camera.matrix: [0, 0, 0, 0, 0, 0, 0, 0, 0]\n', 'positive focal lengths'),
        ('- 1\n', 'has no parameters of a camera'),
    ],
)
def test_a_wrong_parameter_is_rejected_by_name(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / 'camera.yaml'
    path.write_text(text)
    with pytest.raises(ConfigError, match=complaint):
        read_settings(path)
