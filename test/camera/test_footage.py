# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Frames from folders, videos and ROS images: their sizes before anything is unpacked, and the work one causes."""

import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from psd_deflection.base.errors import ConfigError, DeviceError, RecordingError
from psd_deflection.camera import footage
from psd_deflection.camera.answer import NoPoseError, Status
from psd_deflection.camera.discs import find_discs
from psd_deflection.camera.footage import Footage, decoded, read_image, read_settings
from psd_deflection.camera.opencv import MOST_BYTES, MOST_PIXELS, declared_size
from psd_deflection.camera.reference import CameraReference
from psd_deflection.camera.settings import CameraSettings
from psd_deflection.camera.target import target_of


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


WIDE = np.arange(37 * 53 * 3, dtype=np.uint8).reshape(37, 53, 3)


@pytest.mark.parametrize('ending', ['.png', '.jpg', '.bmp', '.tif', '.webp', '.gif', '.ppm', '.pgm'])
def test_the_declared_size_is_the_decoded_one(ending: str) -> None:
    if not cv2.haveImageWriter(f'x{ending}'):
        pytest.skip(f'this OpenCV does not write {ending}')
    image = WIDE[:, :, 0] if ending == '.pgm' else WIDE
    content = cv2.imencode(ending, image)[1].tobytes()
    assert declared_size(content) == (53, 37)
    assert decoded(content, cv2).shape == (37, 53)
    # Cut anywhere, it is not of a size, or of the same.
    assert {declared_size(content[:n]) for n in range(100)} <= {None, (53, 37)}


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack('>I', len(body)) + kind + body + struct.pack('>I', zlib.crc32(kind + body))


def png(columns: int, rows: int, bits: int, colour: int) -> bytes:
    head = chunk(b'IHDR', struct.pack('>IIBBBBB', columns, rows, bits, colour, 0, 0, 0))
    return b'\x89PNG\r\n\x1a\n' + head + chunk(b'IDAT', zlib.compress(bytes(1000))) + chunk(b'IEND', b'')


def tiff(order: str, columns: int, rows: int, *, big: bool) -> bytes:
    mark = b'II' if order == '<' else b'MM'
    if big:
        head = mark + struct.pack(order + 'HHHQQ', 43, 8, 0, 16, 2)
        return head + b''.join(struct.pack(order + 'HHQQ', t, 16, 1, n) for t, n in ((256, columns), (257, rows)))
    head = mark + struct.pack(order + 'HIH', 42, 8, 2)
    return head + b''.join(struct.pack(order + 'HHII', t, 4, 1, n) for t, n in ((256, columns), (257, rows)))


LARGE = {
    'PNG of 1 bit': png(32767, 32767, 1, 0),
    'PNG of 64 bits': png(32767, 32767, 16, 6),
    'JPEG': b'\xff\xd8\xff\xe0\0\x04ab\xff\xff\xc2\0\x0b\x08' + struct.pack('>HH', 32767, 32767) + b'\x01\x01\x11\0',
    'BMP': b'BM' + bytes(12) + struct.pack('<Iii', 40, 32767, -32767) + bytes(28),
    'old BMP': b'BM' + bytes(12) + struct.pack('<IHH', 12, 32767, 32767) + bytes(28),
    'TIFF': tiff('<', 32767, 32767, big=False),
    'TIFF of the other order': tiff('>', 32767, 32767, big=False),
    'BigTIFF': tiff('<', 32767, 32767, big=True),
    'WebP': b'RIFF\0\0\0\0WEBPVP8X' + bytes(8) + (32766).to_bytes(3, 'little') * 2,
    'GIF': b'GIF89a' + struct.pack('<HH', 32767, 32767) + bytes(10),
    'PNM': b'P4 # a comment\n32767 # another\n 32767\n',
}


@pytest.mark.parametrize('name', LARGE)
def test_nothing_is_unpacked_of_an_image_that_is_too_large(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def unpacked(*_: Any) -> None:
        raise AssertionError('it was unpacked')

    class Cv2:
        error = cv2.error
        IMREAD_UNCHANGED = cv2.IMREAD_UNCHANGED
        imdecode = unpacked

    assert declared_size(LARGE[name]) == (32767, 32767)
    found = decoded(LARGE[name], Cv2)
    assert isinstance(found, NoPoseError)
    assert str(found) == 'image too large (32767 x 32767 px)'


def test_opencv_has_the_same_bound_for_what_is_not_known_here() -> None:
    code = 'from psd_deflection.camera.opencv import opencv; opencv(); import os; print(os.environ[NAME])'
    code = code.replace('NAME', repr('OPENCV_IO_MAX_IMAGE_PIXELS'))
    reported = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True).stdout
    assert int(reported) == MOST_PIXELS
    # A Sun raster, which is not read here.
    head = struct.pack('>8I', 0x59A66A95, 32767, 32767, 1, 32767 * 4096, 1, 0, 0)
    code = (
        'from psd_deflection.camera.footage import decoded\n'
        'from psd_deflection.camera.opencv import opencv\n'
        f'print(decoded({head!r} + bytes(10_000), opencv()))\n'
        "print(open('/proc/self/status').read().split('VmHWM:')[1].split()[0])"
    )
    # VmHWM is of this program alone: ru_maxrss keeps the peak of the process that started it.
    reported = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True).stdout
    assert reported.split()[0] == 'None'
    assert int(reported.split()[1]) < 600_000


def test_a_file_that_is_too_long_is_not_read_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(footage, 'MOST_BYTES', 1000)
    monkeypatch.setattr('psd_deflection.camera.opencv.MOST_BYTES', 1000)
    path = tmp_path / 'long.png'
    with path.open('wb') as stream:
        stream.truncate(MOST_BYTES)
    found = read_image(path)
    assert isinstance(found, NoPoseError)
    assert found.status is Status.TOO_LARGE


def test_an_image_of_another_size_says_both() -> None:
    reference = CameraReference(CameraSettings(), target_of)
    reference.take(0, np.zeros((480, 640), np.uint8))
    (answer,) = reference.take(1, np.zeros((720, 1280), np.uint8))
    assert answer.status is Status.OTHER_SIZE
    assert answer.words == 'not of the size of the first image (1280 x 720 px instead of 640 x 480)'


def test_a_frame_without_a_target_does_not_wait_for_the_rest() -> None:
    reference = CameraReference(CameraSettings(), target_of)
    for n in range(1000):
        (answer,) = reference.take(n, None)
        assert (answer.t_ns, answer.words) == (n, 'unreadable image')
    assert reference.finish() == []


@pytest.mark.slow
@pytest.mark.parametrize('square', [1, 2, 3, 5])
def test_a_board_of_tiny_squares_costs_a_bounded_time(square: int) -> None:
    y, x = np.mgrid[:1400, :1400]
    board = ((x // square + y // square) % 2 * 255).astype(np.uint8)
    began = time.process_time()
    with pytest.raises(NoPoseError):
        find_discs(board, 3.0)
    assert time.process_time() - began < 4.0


def test_too_many_outlines_are_a_reason() -> None:
    blocks = np.random.default_rng(1).integers(0, 2, (1000, 1500), np.uint8) * np.uint8(255)
    with pytest.raises(NoPoseError) as rejected:
        find_discs(np.kron(blocks, np.ones((3, 3), np.uint8)), 3.0)
    assert rejected.value.status is Status.CLUTTERED


@pytest.mark.parametrize('text', ['-1_0', '٣'])
def test_a_time_of_a_frame_that_is_no_number_is_rejected(text: str, tmp_path: Path) -> None:
    (tmp_path / 'frames.csv').write_text(f'file,t,exposure\na.png,{text},0\n')
    with pytest.raises(RecordingError, match=r"column t holds '.*', which is not a number"):
        Footage(str(tmp_path), 0.0)
