# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Parts of the camera by themselves: frames, headers, pixel formats, sectors of a rim, bounds of a fit, words."""

import math
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from psd_deflection.base.errors import ConfigError, DeviceError, RecordingError
from psd_deflection.camera import discs, footage
from psd_deflection.camera.answer import NoPoseError, Status, TargetPose
from psd_deflection.camera.boards import Board
from psd_deflection.camera.discs import find_discs
from psd_deflection.camera.footage import Footage, decoded, of_ros_image, read_image, read_settings
from psd_deflection.camera.intrinsics import Intrinsics, calibrated
from psd_deflection.camera.lens import Lens
from psd_deflection.camera.opencv import check_size, checked, declared_size
from psd_deflection.camera.reference import CameraReference, mean_pose, relative, relative_covariance
from psd_deflection.camera.refine_corners import refined
from psd_deflection.camera.rim_classifier import RimClassifier, sectors_of
from psd_deflection.camera.rim_model import PosePrior, Shape, beforehand, expected, moved, rotation_matrix
from psd_deflection.camera.settings import CameraSettings, settings_from
from psd_deflection.camera.target import target_of
from psd_deflection.records import FloatArray


def segment(marker: int, body: bytes) -> bytes:
    return bytes((0xFF, marker)) + struct.pack('>H', len(body) + 2) + body


FRAME = struct.pack('>BHH', 8, 37, 53) + b'\x01\x01\x11\x00'


@pytest.mark.parametrize('frame', [*range(0xC0, 0xC4), *range(0xC5, 0xC8), *range(0xC9, 0xCC), *range(0xCD, 0xD0)])
def test_a_jpeg_has_the_size_of_its_frame_whatever_stands_before(frame: int) -> None:
    before = segment(0xE0, b'JFIF\0' + bytes(9)) + segment(0xC4, bytes(20)) + b'\xff' + segment(0xFE, b'\xff\xc0words')
    assert declared_size(b'\xff\xd8' + before + b'\xff\xd0' + segment(frame, FRAME)) == (53, 37)


@pytest.mark.parametrize('end', [0xD9, 0xDA])
def test_behind_its_data_a_jpeg_has_no_frame(end: int) -> None:
    assert declared_size(b'\xff\xd8' + segment(end, bytes(4)) + segment(0xC0, FRAME)) is None


ROWS, COLUMNS = 6, 8


@pytest.mark.parametrize(
    ('encoding', 'pixel', 'grey'),
    [
        *(('mono8', (200,), 200), ('8UC1', (200,), 200), ('bgr8', (0, 0, 200), 60), ('8UC3', (0, 0, 200), 60)),
        *(('rgb8', (200, 0, 0), 60), ('bgra8', (0, 200, 0, 9), 117), ('rgba8', (0, 0, 200, 9), 23)),
    ],
)
@pytest.mark.parametrize('padding', [0, 5])
def test_a_ros_image_is_grey_by_its_encoding(encoding: str, pixel: tuple[int, ...], grey: int, padding: int) -> None:
    row = bytes(pixel) * COLUMNS + bytes(padding)
    image = of_ros_image(ROWS, COLUMNS, encoding, False, len(row), row * ROWS)
    assert image.shape == (ROWS, COLUMNS)
    assert np.abs(image.astype(int) - grey).max() <= 1
    # A row less than it says, or rows that are too short.
    assert of_ros_image(ROWS, COLUMNS, encoding, False, len(row), row * (ROWS - 1)) is None
    assert of_ros_image(ROWS, COLUMNS + 6, encoding, False, len(row), row * ROWS) is None


@pytest.mark.parametrize(
    ('encoding', 'first', 'second'),
    [
        ('bayer_rggb8', 'RG', 'GB'),
        ('bayer_bggr8', 'BG', 'GR'),
        ('bayer_gbrg8', 'GB', 'RG'),
        ('bayer_grbg8', 'GR', 'BG'),
    ],
)
def test_a_mosaic_has_its_colours_where_its_name_says(encoding: str, first: str, second: str) -> None:
    image = np.zeros((ROWS, COLUMNS), dtype=np.uint8)
    for row, letters in enumerate((first, second)):
        for column, letter in enumerate(letters):
            image[row::2, column::2] = 200 if letter == 'R' else 0
    grey = of_ros_image(ROWS, COLUMNS, encoding, False, COLUMNS, image.tobytes())
    # A red that is the same everywhere: three tenths of it, in the middle.
    assert np.abs(grey[2:4, 2:6].astype(int) - 60).max() <= 2


def test_sixteen_bits_are_in_the_order_that_is_reported() -> None:
    image = np.array([[1, 2], [256, 65535]], dtype=np.uint16)
    assert np.array_equal(of_ros_image(2, 2, 'mono16', False, 4, image.astype('<u2').tobytes()), image)
    assert np.array_equal(of_ros_image(2, 2, '16UC1', True, 4, image.astype('>u2').tobytes()), image)
    assert of_ros_image(2, 2, 'yuv422', False, 4, bytes(8)) is None


@pytest.mark.parametrize('kind', range(1, 7))
def test_each_of_six_portable_formats_has_its_size(kind: int) -> None:
    assert declared_size(f'P{kind} 53 37 255 '.encode()) == (53, 37)


def test_a_rim_has_sixteen_parts_of_equal_angle() -> None:
    angle = (np.arange(1600) + 0.5) * 2.0 * math.pi / 1600
    side = (np.cos(angle).astype(np.float32), np.sin(angle).astype(np.float32))
    parts = sectors_of(side, cast(Any, SimpleNamespace(begin=np.array([0, 1600]))))
    assert np.bincount(parts).tolist() == [100] * 16
    # Each part is of one piece.
    assert np.count_nonzero(np.diff(parts)) == 15


@pytest.mark.parametrize('size', [0.0, 1e-10, 1e-8, 1.0])
def test_a_turn_is_that_of_its_vector_however_small(size: float) -> None:
    vector = size * np.array([0.6, -0.3, 0.2])
    want = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(rotation_matrix(vector), want, atol=1e-16 + 1e-15 * size)


def test_keystone_and_error_of_centres_turn_with_the_target() -> None:
    prior, c, s = PosePrior(rotation_matrix(np.array([0.0, 0.0, 0.7])), 0.1, np.array([0.3, -0.1])), 0.8, 0.6
    rotated = expected(prior, rotation_matrix(np.array([0.0, 0.0, 0.7 - math.atan2(s, c)])))
    assert rotated == pytest.approx([c * 0.3 + s * 0.1, s * 0.3 - c * 0.1])
    rotation = rotation_matrix(np.array([0.4, -0.3, 0.2]))
    shape = Shape(rotation, np.array([0.0, 0.0, 0.5]), 1.0, np.eye(2), np.zeros(4), np.zeros((3, 6)), np.zeros(2))
    classifier = RimClassifier(
        cast(Any, SimpleNamespace(focal=1000.0)), 100, np.array([[0.03, 0.0], [0.0, 0.04], [0.0, 0.0]])
    )
    # Both tilts are known to 0.1 rad.
    assert beforehand(shape, prior)[0][:2] == pytest.approx(100.0)
    covariance = classifier.moved_centres(shape, 2.0)
    # Two pixels are a millimetre at the target: in its plane, and about its normal.
    in_plane = np.eye(3) - np.outer(rotation[:, 2], rotation[:, 2])
    np.testing.assert_allclose(covariance[3:, 3:], 1e-6 * in_plane, atol=1e-20)
    assert covariance[2, 2] == pytest.approx(1e-6 / 0.05**2)


def test_a_fit_stays_within_its_bounds() -> None:
    shape = Shape(np.eye(3), np.array([0.0, 0.0, 1.0]), 1.0, np.eye(2), np.zeros(4), np.zeros((3, 6)), np.zeros(2))
    light, step = np.ones((3, 6)), np.zeros(16)
    step[3:7], step[7:10], step[10:] = (0.1, 0.2, 0.3, 0.9), (2000.0, 0.0, -5.0), (-2.0, -1.2, 1.2, 2.0, 0.3, 0.4)
    fitted = moved(shape, step, light)
    assert fitted.place == pytest.approx([0.1, 0.2, 1.3])
    assert fitted.swell == 1.4
    # A quarter of a pixel is as sharp as it gets, 30 pixels as wide.
    assert fitted.blur == pytest.approx(np.diag([900.0, 0.0625]))
    assert (fitted.skew.tolist(), fitted.keystone.tolist()) == ([-1.5, -1.2, 1.2, 1.5], [0.3, 0.4])
    assert moved(shape, -0.01 * np.ones(16), light).blur == pytest.approx(np.eye(2) - 0.01)
    assert moved(shape, -step, light).swell == 0.7


@pytest.mark.parametrize('view', ['outside', 'base'])
def test_exact_corners_give_the_pose_of_a_board_at_once(view: str) -> None:
    board = target_of(CameraSettings(target='charuco', view=view))
    assert isinstance(board, Board)
    plane = np.stack(np.meshgrid(np.linspace(-0.03, 0.03, 6), np.linspace(-0.04, 0.04, 8)), axis=-1).reshape(-1, 2)
    facing = np.diag([1.0, -1.0, -1.0]) if view == 'outside' else np.eye(3)
    true, at = facing @ rotation_matrix(np.array([0.2, -0.3, 0.4])), np.array([0.01, -0.02, 0.5])
    observed = np.column_stack([plane, np.zeros(len(plane))]) @ true.T + at
    rotation, place = board.first_pose(plane, observed[:, :2] / observed[:, 2:])
    assert rotation == pytest.approx(true, abs=1e-9)
    assert place == pytest.approx(at, abs=1e-9)


@pytest.mark.parametrize(
    ('crossing', 'sharp', 'off', 'there'),
    [(True, 1.0, 1.45, True), (False, 1.0, 0.3, True), (True, 1.0, 1.55, False), (False, 0.2, 0.3, False)],
)
def test_corners_of_the_model_are_found_exactly(crossing: bool, sharp: float, off: float, there: bool) -> None:
    """Two corners of edges at 75 degrees, one brighter on its inside, one darker on a board; one is at the border.
    None are found from more than a pixel and a half away, nor before the blur of a tag's corner has settled."""
    v, u = np.mgrid[:40, :70].astype(float)
    true, blur = np.array([[20.3, 17.6], [50.1, 21.8], [3.0, 20.0]]), np.array([0.9, 1.3]) / sharp
    first, second = np.array([math.cos(0.2), math.sin(0.2)]), np.array([math.cos(1.5), math.sin(1.5)])
    # Across each edge, to the side of the other.
    n1 = np.array([second[1], -second[0]])
    n2 = np.array([-first[1], first[0]])
    image = np.zeros((40, 70))
    for (x, y), contrast in zip(true[:2], (-60.0, 60.0 if crossing else -60.0), strict=True):
        a, b = (((u - x) * n[0] + (v - y) * n[1]) / s for n, s in zip((n1, n2), blur, strict=True))
        light = (2.0 * ndtr(a) - 1.0) * (2.0 * ndtr(b) - 1.0) if crossing else ndtr(a) * ndtr(b)
        image = np.where(np.abs(u - x) < 15.0, 120.0 + contrast * light, image)
    corners = refined(image, true + np.array([off, 0.0]), np.tile([first, second], (3, 1, 1)), 6.5, crossing)
    assert np.isfinite(corners.pixels).all(axis=1).tolist() == [there, there, False]
    if not there:
        return
    assert corners.pixels[:2] == pytest.approx(true[:2], abs=1e-4)
    assert corners.blur[:2] == pytest.approx(np.tile(blur, (2, 1)), abs=1e-3)
    assert corners.rms[:2] == pytest.approx(0.0, abs=1e-4)


def discs_at(*places: tuple[float, float, float, float]) -> Any:
    """White ellipses (x, y, half axes along x and y), px, on black: a grey level is a pixel's part in one."""
    v, u = np.mgrid[: 200 * 4, : 300 * 4] / 4.0 - 0.375
    white = np.any([((u - x) / a) ** 2 + ((v - y) / b) ** 2 < 1.0 for x, y, a, b in places], axis=0)
    return (20.0 + 200.0 * white.reshape(200, 4, 300, 4).mean(axis=(1, 3))).astype(np.uint8)


LINE = [(80.3, 60.1, 16.0, 20.0), (80.3, 110.1, 16.0, 20.0), (80.3, 160.1, 16.0, 20.0)]


def test_drawn_discs_have_their_places_and_axes() -> None:
    for x in (80.3, 281.3):
        line = [(x, y, a, b) for _, y, a, b in LINE]
        discs = find_discs(discs_at(*line, (150.0, 20.0, 3.0, 3.0)), 2.5)
        assert sorted(r.centre for r in discs) == [pytest.approx(disc[:2], abs=0.1) for disc in line]
        assert [r.axes for r in discs] == [pytest.approx((16.0, 20.0), abs=0.2)] * 3
        assert [r.shape for r in discs] == [pytest.approx((256.0, 0.0, 400.0), abs=9.0)] * 3


@pytest.mark.parametrize(('apart', 'alike'), [(29.0, 1.0), (31.0, 0.0)])
def test_covariance_has_a_second_tilt_that_is_as_likely(
    apart: float, alike: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of the antisymmetric part of a turn is its sine about its axis; by 30 the log likelihoods are told apart."""
    best = target(np.array([0.2, -0.1, 0.0]), np.array([0.01, 0.02, 0.5]), np.zeros(0), 1)._replace(residuals=100)
    best = best._replace(points=np.array([[80.3, 60.1], [80.3, 110.1], [80.3, 160.1]]))
    rotation, shift = np.array([0.3, -0.2, 0.1]), np.array([1e-3, 2e-3, -1e-3])
    other = shifted(best, np.concatenate([rotation, shift]))._replace(cost=apart / 100.0)
    fits = iter([other, best])
    monkeypatch.setattr(discs, 'Fitter', lambda *_: SimpleNamespace(fit=lambda *_: next(fits)))
    lens = Lens(np.array([[1000.0, 0.0, 150.0], [0.0, 1000.0, 100.0], [0.0, 0.0, 1.0]]), np.zeros(0))
    image = discs_at(*LINE)
    located = target_of(CameraSettings(spacing=0.025, radius=0.01)).locate(image, image, lens, 255.0)
    off = np.concatenate([np.sinc(np.linalg.norm(rotation) / math.pi) * rotation, shift])
    np.testing.assert_allclose(located.covariance, best.covariance + alike * np.outer(off, off), rtol=1e-9)


@pytest.mark.parametrize(
    ('more', 'status'),
    [
        # As high as a fifth of a disc, and less; far away; two lines.
        ((105.0, 110.0, 5.0, 5.0), Status.DOUBLED),
        ((105.0, 110.0, 3.0, 3.0), None),
        ((140.0, 110.0, 16.0, 20.0), None),
        ((80.3, 10.1, 16.0, 9.0), None),
    ],
)
def test_what_lights_a_rim_is_as_large_and_near(more: tuple[float, float, float, float], status: Status | None) -> None:
    if status is None:
        assert len(find_discs(discs_at(*LINE, more), 2.5)) == 3
        return
    with pytest.raises(NoPoseError) as rejected:
        find_discs(discs_at(*LINE, more), 2.5)
    assert rejected.value.status is status


@pytest.mark.parametrize(('x', 'y'), [(16.0, None), (283.0, None), (None, 20.0), (None, 179.0)])
def test_a_disc_at_the_border_is_none(x: float | None, y: float | None) -> None:
    """Its rim is half a pixel within the image, then a tenth of one out of it."""
    inwards = 1.0 if (x or y or 0.0) < 100.0 else -1.0
    for inside in (0.5, -0.1):
        to = inside * inwards
        line = [(80.3 if x is None else x + to, 60.0 + 50.0 * k, 16.0, 20.0) for k in range(3)]
        if y is not None:
            line = [(80.3, y + to + inwards * 50.0 * k, 16.0, 20.0) for k in range(3)]
        if inside > 0.0:
            assert len(find_discs(discs_at(*line), 2.5)) == 3
        else:
            with pytest.raises(NoPoseError):
                find_discs(discs_at(*line), 2.5)


def test_a_lens_is_reported_with_the_deviation_of_each_number() -> None:
    matrix = np.array([[1000.0, 0.0, 320.0], [0.0, 1001.0, 240.0], [0.0, 0.0, 1.0]])
    made = Intrinsics((640, 480), matrix, np.array([1.0, 2.0, 3.0, 4.0]), np.zeros(5), 0.1, 12, [])
    assert made.as_yaml('cam').startswith('image_width: 640\nimage_height: 480\ncamera_name: cam\ncamera_matrix:')
    assert made.lines() == ['focal length 1000.0 ± 1.0, 1001.0 ± 2.0 px', 'centre 320.0 ± 3.0, 240.0 ± 4.0 px']


def test_image_without_board_is_reported_with_reason() -> None:
    images = [('a', np.zeros((48, 64), np.uint8)), ('b', np.zeros((50, 60), np.uint8)), ('c', None)]
    with pytest.raises(ConfigError, match=r'0 images show the board') as caught:
        calibrated(CameraSettings(target='charuco'), images)
    message = str(caught.value)
    assert '; a: ' in message
    assert '; b: has 60 x 50 pixels, the first has 64 x 48; c: ' in message


@pytest.mark.parametrize(('columns', 'right'), [(0, True), (1000, True), (1001, False), (-1, False)])
def test_a_board_has_up_to_a_thousand_columns(columns: int, right: bool) -> None:
    if right:
        assert settings_from({'target.columns': columns}, 'x').columns == columns
    else:
        with pytest.raises(ConfigError, match=f'target.columns = {columns}'):
            settings_from({'target.columns': columns}, 'x')


@pytest.mark.parametrize(('thick', 'why'), [(1, Status.MISSING), (2, Status.OBLIQUE)])
def test_three_thin_scratches_are_no_oblique_target(thick: int, why: Status) -> None:
    """They have its spacing: 36 px, of half-widths of 10 to 12 px."""
    grey = np.full((40, 130), 20, dtype=np.uint8)
    for middle in (24, 60, 96):
        grey[20 : 20 + thick, middle - 7 : middle + 8] = 220
    with pytest.raises(NoPoseError) as caught:
        find_discs(grey, 25.0 / 8.0)
    assert caught.value.status is why


@pytest.mark.parametrize('bits', [8, 16])
def test_target_gets_grey_levels_up_to_255(bits: int) -> None:
    """Of an image of 16 rows at least, the fewest that are read."""
    got: list[tuple[Any, ...]] = []

    def locate(*of: Any) -> TargetPose:
        got.append(of)
        raise NoPoseError(Status.MISSING)

    for rows, status in ((16, Status.MISSING), (15, Status.UNREADABLE)):
        image = np.full((rows, 20), 100 if bits == 8 else 100 * 257, f'u{bits // 8}')
        reference = CameraReference(CameraSettings(), lambda _: cast(Any, SimpleNamespace(locate=locate)))
        assert [a.status for a in reference.take(0, image)] == [status]
    ((image, grey, lens, full_scale),) = got
    assert {*image.ravel(), *grey.ravel()} == {100}
    assert (grey.dtype, full_scale) == (np.uint8, 255.0)
    # A lens that is not known looks at the middle from so far away that there is no perspective.
    assert lens.matrix.tolist() == [[20e3, 0.0, 9.5], [0.0, 20e3, 7.5], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize(('rest_frames', 'last'), [(0, 400), (30, 400), (300, 600)])
def test_camera_rest_is_given_up_after_bounded_frames(rest_frames: int, last: int) -> None:
    """Frames of which one is good, and twenty or as many as are asked for would be a rest."""
    rotated = Rotation.from_euler('ZX', [0.3, math.pi]).as_matrix()
    still = TargetPose(rotated, np.array([0.0, 0.0, 1.0]), 1e-12 * np.eye(6), 0.0, 10, np.zeros((3, 2)))
    target = SimpleNamespace(locate=lambda *_: still, set_rest=lambda _: None)
    reference = CameraReference(CameraSettings(rest_frames=rest_frames), lambda _: cast(Any, target))
    assert reference.take(0, np.zeros((20, 20), dtype=np.uint8)) == []
    assert [reference.take(i, NoPoseError(Status.HIDDEN)) for i in range(1, last)] == [[]] * (last - 1)
    assert reference.rest is None
    answers = reference.take(last, NoPoseError(Status.HIDDEN))
    assert [a.t_ns for a in answers] == list(range(last + 1))
    assert [a.status for a in answers] == [Status.OK] + [Status.HIDDEN] * last
    assert reference.rotation == pytest.approx(0.3)


def target(rotvec: FloatArray, place: FloatArray, keystone: FloatArray, seed: int) -> TargetPose:
    """A target with a covariance that ties all of its numbers, of about 1 mrad, 0.1 mm, 1e-3 /m."""
    sizes = np.array([*[1e-3] * 3, *[1e-4] * 3, *[1e-3] * len(keystone)])
    root = sizes[:, None] * np.random.default_rng(seed).normal(size=(len(sizes), 2 * len(sizes)))
    rotation = Rotation.from_rotvec(rotvec).as_matrix()
    return TargetPose(
        rotation, place, root @ root.T, 0.0, 0, np.zeros((0, 2)), planar=keystone.size > 0, keystone=keystone
    )


def shifted(pose: TargetPose, step: FloatArray) -> TargetPose:
    """The pose after a small turn about its own axes, a shift, and a change of its keystone."""
    rotation = pose.rotation @ Rotation.from_rotvec(step[:3]).as_matrix()
    return pose._replace(rotation=rotation, place=pose.place + step[3:6], keystone=pose.keystone + step[6:])


@pytest.mark.parametrize('keystone', [[], [0.2, -0.1]], ids=['with a lens', 'without'])
def test_covariance_is_that_of_small_changes_of_rest_and_pose(keystone: list[float]) -> None:
    """A rest that is tilted, so that its tilts turn theta; every reading tied to every other one."""
    perspective = np.array(keystone)
    rest = target(np.array([0.35, -0.25, 0.5]), np.array([0.02, -0.03, 0.6]), perspective, 1)
    # In the plane of the rest to 1 sd: what leaves it widens the covariance of a camera without a lens beyond this.
    pose = target(np.array([0.1, 0.4, 0.6]), 1.001 * rest.plane @ [0.004, 0.003, 1.0], 0.5 * perspective, 2)

    def changed(of: str, i: int, size: float) -> FloatArray:
        step = np.zeros(6 + perspective.size)
        step[i] = size
        return relative(shifted(rest, step), pose)[:3] if of == 'rest' else relative(rest, shifted(pose, step))[:3]

    expected = np.zeros((3, 3))
    for of, target_pose in (('rest', rest), ('pose', pose)):
        slopes = [(changed(of, i, 1e-6) - changed(of, i, -1e-6)) / 2e-6 for i in range(6 + perspective.size)]
        jacobian = np.column_stack(slopes)
        expected += jacobian @ target_pose.covariance @ jacobian.T
    sd = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        relative_covariance(rest, pose) / np.outer(sd, sd), expected / np.outer(sd, sd), atol=1e-4
    )


def test_mean_pose_has_frame_covariance_over_count() -> None:
    frames = [target(np.full(3, 0.01 * i), np.array([0.0, 0.0, 0.5 + 0.001 * i]), np.zeros(0), i) for i in range(4)]
    mean = mean_pose(frames)
    np.testing.assert_allclose(mean.covariance, sum(f.covariance for f in frames) / 16.0, rtol=1e-12)
    np.testing.assert_allclose(mean.place, [0.0, 0.0, 0.5015])
    np.testing.assert_allclose(Rotation.from_matrix(mean.rotation).as_rotvec(), np.full(3, 0.015), atol=1e-9)
    assert np.linalg.det(mean.rotation) == pytest.approx(1.0)


def test_turns_and_tilts_are_those_of_one_rotation_in_its_order() -> None:
    """Of a rest that is turned itself: R = Ry(omega) Rx(phi) Rz(theta), moved along the axes of the rest."""
    rest = target(np.array([0.2, -0.3, 0.4]), np.array([0.01, 0.02, 0.7]), np.zeros(0), 1)
    relative_rotation = Rotation.from_euler('YXZ', [0.05, -0.04, 0.3]).as_matrix()
    place = rest.place + rest.rotation @ [1e-3, -2e-3, 3e-3]
    pose = relative(rest, rest._replace(rotation=rest.rotation @ relative_rotation, place=place))
    np.testing.assert_allclose(pose, [1e-3, -2e-3, 0.3, -0.04, 0.05], atol=1e-12)


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
        ('file,t,exposure\na.png,0,0\nb.png,1,0\nc.png,1,0\n', 'frames.csv:4: t does not increase'),
        ('file,t,exposure\n../a.png,0,0\n', 'must be the name of an image'),
        ('file,t,exposure\n', 'lists no frame'),
    ],
)
def test_a_wrong_table_is_rejected_by_line(tmp_path: Path, table: str, complaint: str) -> None:
    with pytest.raises(RecordingError, match=complaint):
        Footage(folder(tmp_path / 'f', table), 0.0)


def test_what_is_no_source_is_rejected(tmp_path: Path) -> None:
    (tmp_path / 'text.avi').write_text('no video')
    for name, words in (('text.avi', 'not a video'), ('nothing', 'no such video'), ('', 'has no frames')):
        with pytest.raises(RecordingError, match=words):
            Footage(str(tmp_path / name), 0.0)
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
        ('camera.exposure: -0.5\n', 'must be at least'),
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
    rejected = decoded(LARGE[name], Cv2)
    assert isinstance(rejected, NoPoseError)
    assert str(rejected) == 'image too large (32767 x 32767 px)'
    check_size(10_000, 5_000)
    with pytest.raises(NoPoseError):
        check_size(50_001, 1_000)


def test_opencv_has_the_same_bound_for_what_is_not_known_here() -> None:
    code = 'from psd_deflection.camera.opencv import opencv; opencv(); import os; print(os.environ[NAME])'
    code = code.replace('NAME', repr('OPENCV_IO_MAX_IMAGE_PIXELS'))
    reported = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True).stdout
    assert int(reported) == 50_000_000
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
    # Zeros that nobody writes take no memory.
    longest = np.zeros(400_000_001, np.uint8)
    checked(longest[1:].data)
    with pytest.raises(NoPoseError, match='a file of 400 MB'):
        checked(longest.data)
    monkeypatch.setattr(footage, 'MOST_BYTES', 1000)
    monkeypatch.setattr('psd_deflection.camera.opencv.MOST_BYTES', 1000)
    path = tmp_path / 'long.png'
    with path.open('wb') as stream:
        stream.truncate(400_000_001)
    rejected = read_image(path)
    assert isinstance(rejected, NoPoseError)
    assert rejected.status is Status.TOO_LARGE


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


@pytest.mark.parametrize(('stripes', 'status'), [(480, Status.MISSING), (530, Status.CLUTTERED)])
def test_too_many_outlines_are_a_reason(stripes: int, status: Status) -> None:
    stripe = np.repeat(np.arange(stripes, dtype=np.uint8) % 2 * np.uint8(255), 5)
    with pytest.raises(NoPoseError) as rejected:
        find_discs(np.tile(stripe, (2000, 1)), 3.0)
    assert rejected.value.status is status


@pytest.mark.parametrize('text', ['-1_0', '٣'])
def test_a_time_of_a_frame_that_is_no_number_is_rejected(text: str, tmp_path: Path) -> None:
    (tmp_path / 'frames.csv').write_text(f'file,t,exposure\na.png,{text},0\n')
    with pytest.raises(RecordingError, match=r"column t holds '.*', which is not a number"):
        Footage(str(tmp_path), 0.0)
