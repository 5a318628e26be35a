# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""ChArUco and AprilTag boards by OpenCV: corners -> pose of the board, with covariance from their residuals.

The board's middle is ``link_tip``'s origin; seen from its front, its columns run to the right. Corners are matched
by the numbers in the markers, so a board has no half turn, and may be partly hidden.
"""

import abc
import math
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from psd_deflection.base.errors import ConfigError
from psd_deflection.camera.answer import NoPoseError, Status, TargetPose
from psd_deflection.camera.lens import Lens
from psd_deflection.camera.opencv import opencv
from psd_deflection.camera.refine_corners import LEAST_REACH, refined
from psd_deflection.camera.rim_model import rotation_matrix
from psd_deflection.camera.settings import CameraSettings
from psd_deflection.camera.target import Drawing, Target
from psd_deflection.records import FloatArray

Corners = Any
"""Corners of markers in the image, px, four by four, or of the chessboard, as OpenCV has them."""


def has_boards() -> bool:
    """Return whether this OpenCV makes and finds boards.

    4.6 (Ubuntu 24.04's) has them only where opencv_contrib was built with it, as Ubuntu does. Older ones have other
    axes.
    """
    aruco = getattr(opencv(), 'aruco', None)
    return hasattr(aruco, 'CharucoDetector') or (hasattr(aruco, 'CharucoBoard_create') and _version() >= (4, 6))


def _version() -> tuple[int, ...]:
    return tuple(int(n) for n in re.findall(r'\d+', opencv().__version__)[:2])


def _old() -> bool:
    return not hasattr(opencv().aruco, 'CharucoDetector')


def charuco_board(columns: int, rows: int, square: float, marker: float, dictionary: Any) -> Any:
    """OpenCV's chessboard with markers; ``square``, ``marker``: sides, m."""
    aruco = opencv().aruco
    if _old():
        return aruco.CharucoBoard_create(columns, rows, square, marker, dictionary)
    return aruco.CharucoBoard((columns, rows), square, marker, dictionary)


def tag_board(columns: int, rows: int, marker: float, gap: float, dictionary: Any) -> Any:
    """OpenCV's grid of markers; ``marker``: side, ``gap``: between two of them, m."""
    aruco = opencv().aruco
    if _old():
        return aruco.GridBoard_create(columns, rows, marker, gap, dictionary)
    return aruco.GridBoard((columns, rows), marker, gap, dictionary)


def picture(board: Any, pixels: tuple[int, int]) -> Any:
    """Return the board as OpenCV draws it, (height, width) grey; ``pixels``: width and height."""
    draw = board.draw if _old() else board.generateImage
    return draw(pixels, None, 0, 1)


def chessboard_corners(board: Any) -> Any:
    """(n, 3): inner corners of the chessboard by number, m, in OpenCV's axes."""
    return board.chessboardCorners if _old() else board.getChessboardCorners()


def tag_corners(board: Any) -> dict[int, Any]:
    """(4, 3): corners of each tag by its number, m, in OpenCV's axes."""
    numbers, corners = (board.ids, board.objPoints) if _old() else (board.getIds(), board.getObjPoints())
    return {int(number): at for number, at in zip(numbers.ravel(), corners, strict=True)}


def tag_finder(dictionary: Any) -> Callable[[Any], tuple[Corners, Any]]:
    """Takes a grey image; gives the corners of the markers in it and their numbers (None if there are none)."""
    aruco = opencv().aruco
    if _old():
        old = aruco.DetectorParameters_create()
        old.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
        return lambda grey: aruco.detectMarkers(grey, dictionary, parameters=old)[:2]
    parameters = aruco.DetectorParameters()
    parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
    detector = aruco.ArucoDetector(dictionary, parameters)
    return lambda grey: detector.detectMarkers(grey)[:2]


def corner_finder(board: Any, dictionary: Any) -> Callable[[Any], tuple[Corners, Any, bool]]:
    """Takes a grey image; gives corners of the chessboard, their numbers (None: none are seen), if a marker is seen."""
    aruco = opencv().aruco
    if not _old():
        detector = aruco.CharucoDetector(board)

        def detect(grey: Any) -> tuple[Corners, Any, bool]:
            pixels, numbers, _, markers = detector.detectBoard(grey)
            return pixels, numbers, markers is not None and len(markers) > 0

        return detect

    def detect_by_46(grey: Any) -> tuple[Corners, Any, bool]:
        corners, markers, _ = aruco.detectMarkers(grey, dictionary)
        if markers is None:
            return None, None, False
        _, pixels, numbers = aruco.interpolateCornersCharuco(corners, markers, grey, board)
        return pixels, numbers, True

    return detect_by_46


LEAST_CORNERS = 8
LEAST_RATIO = 0.35
"""Smallest spread of the corners that are seen, in units of that of the whole board, along its narrower direction."""

WORST_CORNER = 1.5
"""Largest residual of a corner, px, with which it counts; and the share of the corners that must count is 3/4."""

MOST_BLUR = 0.4
"""Largest blur (sd) across an edge with an answer, in units of what is free around a corner."""

CORNER_FLOOR, BLUR_FLOOR = 0.004, 0.05
"""Error that all corners share and no residual shows, one sd in px; and the part of the motion's sd that adds to it."""

_STEPS = 20
_TAG_MODULES = 10
_PIXELS_A_COLUMN = 320
"""Of a drawing: a multiple of the modules of a marker, so that their edges are sharp."""


class Board(Target):
    """Finds one board, frame by frame. Raises ConfigError if OpenCV or the dictionary is unknown.

    ``board``: OpenCV's. ``size``: width and height, m.
    """

    usual: ClassVar[tuple[int, int]]
    """Columns and rows, if the settings do not say them."""
    usual_dictionary: ClassVar[str]
    crossings: ClassVar[bool]
    """Whether a corner is where two edges cross, as on a chessboard, or that of one dark square."""

    def __init__(self, settings: CameraSettings) -> None:
        usual = self.usual
        settings = replace(
            settings,
            columns=settings.columns or usual[0],
            rows=settings.rows or usual[1],
            dictionary=settings.dictionary or self.usual_dictionary,
        )
        super().__init__(settings)
        self._dictionary = _dictionary(settings, self._needed(settings))
        self.board = self._made()
        wide, high = self.size = self._size()
        # OpenCV's board: origin in the corner, x right, y down as it is seen. Ours: middle, y up.
        self._middle = np.array([wide / 2, high / 2])
        self._mirror = 1.0 if settings.view == 'outside' else -1.0
        self._even_sd = np.array([wide, high]) / math.sqrt(12.0)

    @abc.abstractmethod
    def _needed(self, settings: CameraSettings) -> int:
        """Number of markers."""

    @abc.abstractmethod
    def _made(self) -> Any:
        """OpenCV's board."""

    @abc.abstractmethod
    def _size(self) -> tuple[float, float]:
        """Width and height, m."""

    @property
    @abc.abstractmethod
    def _free(self) -> float:
        """Around a corner there is nothing else up to this distance, m."""

    @abc.abstractmethod
    def _inwards(self) -> FloatArray:
        """(k, 2): from corner to the inside of what it belongs to, in the board's axes; of k corners in turn."""

    @abc.abstractmethod
    def _detected(self, grey: Any) -> tuple[list[int], FloatArray, Any, bool]:
        """Numbers of what is seen, corners in OpenCV's axes (n, 2) m and in the image px, and if any marker is seen."""

    def drawing(self) -> Drawing:
        """Return the board as OpenCV draws it."""
        wide, high = self.size
        across = self.settings.columns * _PIXELS_A_COLUMN
        pixels = (across, round(across * high / wide))
        return Drawing(self.size, picture=np.asarray(picture(self.board, pixels)))

    def locate(self, image: Any, grey: Any, lens: Lens, full_scale: float) -> TargetPose:
        """See :class:`Target`."""
        plane, pixels = self.corners(grey)
        points = np.column_stack([plane, np.zeros(len(plane))])
        rotation, place = self.first_pose(plane, lens.rays(pixels))
        rotation, place, _, _ = _fitted(points, pixels, lens, rotation, place)
        pixels, shared_blur = self._refined(image, points, pixels, lens, rotation, place)
        finite = np.isfinite(pixels[:, 0])
        if finite.sum() < max(LEAST_CORNERS, 0.6 * len(points)):
            raise NoPoseError(Status.MISFIT)
        plane, points, pixels = plane[finite], points[finite], pixels[finite]
        good = np.ones(len(points), dtype=bool)
        for _ in range(3):
            rotation, place, inverse, residual = _fitted(points[good], pixels[good], lens, rotation, place)
            off = np.linalg.norm(lens.project(points @ rotation.T + place) - pixels, axis=1)
            keep = off < min(WORST_CORNER, max(5.0 * float(np.median(off)), 0.05))
            if np.array_equal(keep, good):
                break
            good = keep
            if good.sum() < max(LEAST_CORNERS, 0.75 * len(points)):
                raise NoPoseError(Status.MISFIT)
        variance = float(np.sum(residual**2)) / (residual.size - 6)
        # Corners near each other have errors in common; an error of all of them shows in no residual.
        covariance = 2.0 * variance * inverse
        metre = float(place[2]) / lens.focal
        shared = (math.hypot(CORNER_FLOOR, BLUR_FLOOR * shared_blur) * metre) ** 2
        covariance[3:, 3:] += rotation @ np.diag([shared, shared, 0.0]) @ rotation.T
        covariance[2, 2] += shared / float(np.sum(plane.var(axis=0))) / 10
        return TargetPose(
            rotation,
            place,
            covariance,
            math.log(max(variance, 1e-12)),
            residual.size,
            pixels,
            noise=math.sqrt(variance),
            planar=not lens.known,
        )

    def _refined(
        self, image: Any, points: FloatArray, pixels: FloatArray, lens: Lens, rotation: FloatArray, place: FloatArray
    ) -> tuple[FloatArray, float]:
        """Corners by the grey levels around them, and the sd of the motion blur, px. Raises NoPoseError."""
        step = 0.5 * self._free
        here = lens.project(points @ rotation.T + place)
        towards = np.resize(self._inwards(), (len(points), 2))
        edges = []
        for axis in (0, 1):
            ahead = points.copy()
            ahead[:, axis] += step * towards[:, axis]
            vector = lens.project(ahead @ rotation.T + place) - here
            edges.append(vector / np.linalg.norm(vector, axis=1)[:, None])
        free = self._free * lens.focal / float(place[2])
        if free < LEAST_REACH:
            raise NoPoseError(Status.SMALL)
        corners = refined(image, pixels, np.stack(edges, axis=1), 0.95 * free, self.crossings)
        blur = np.sort(np.nanmedian(corners.blur, axis=0))
        if blur[1] > MOST_BLUR * free:
            raise NoPoseError(Status.BLURRED)
        return corners.pixels, math.sqrt(max(float(blur[1] ** 2 - blur[0] ** 2), 0.0))

    def corners(self, grey: Any) -> tuple[FloatArray, FloatArray]:
        """Corners on the plate (n, 2) m and in the image (n, 2) px. Raises NoPoseError."""
        numbers, at, pixels, any_marker = self._detected(grey)
        if len(set(numbers)) < len(numbers):
            raise NoPoseError(Status.DOUBLED)
        if not any_marker:
            raise NoPoseError(Status.MISSING)
        if len(at) < LEAST_CORNERS or pixels is None:
            raise NoPoseError(Status.HIDDEN)
        plane = at - self._middle
        if np.min(plane.std(axis=0) / self._even_sd) < LEAST_RATIO:
            raise NoPoseError(Status.HIDDEN)
        return plane * [self._mirror, -1.0], np.reshape(pixels, (-1, 2)).astype(float)

    def first_pose(self, plane: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotation and place by the homography from the plane to the rays (Zhang 2000)."""
        scale = float(np.sqrt(np.mean(plane**2)))
        x, y = (plane / scale).T
        u, v = rays.T
        ones, zeros = np.ones_like(x), np.zeros_like(x)
        rows = np.concatenate(
            [
                np.column_stack([x, y, ones, zeros, zeros, zeros, -u * x, -u * y, -u]),
                np.column_stack([zeros, zeros, zeros, x, y, ones, -v * x, -v * y, -v]),
            ]
        )
        h = np.linalg.svd(rows)[2][-1].reshape(3, 3)
        h[:, :2] /= scale
        h /= np.linalg.norm(h[:, 0]) ** 0.5 * np.linalg.norm(h[:, 1]) ** 0.5 * (1.0 if h[2, 2] > 0 else -1.0)
        u_, _, vt = np.linalg.svd(np.column_stack([h[:, 0], h[:, 1], np.cross(h[:, 0], h[:, 1])]))
        rotation = u_ @ np.diag([1.0, 1.0, np.linalg.det(u_ @ vt)]) @ vt
        if float(np.sign(rotation[2, 2])) != -self._mirror or h[2, 2] <= 0.0:
            raise NoPoseError(Status.MISFIT)
        return rotation, h[:, 2]


def _fitted(
    points: FloatArray, pixels: FloatArray, lens: Lens, rotation: FloatArray, place: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Pose of least reprojection error, inverse (6, 6) of its normal matrix, residuals (n, 2) px."""
    inverse, residual = np.eye(6), np.zeros((1, 2))
    scale = np.array([1e-4] * 3 + [1e-4 * float(place[2])] * 3)
    for _ in range(_STEPS):
        residual = pixels - lens.project(points @ rotation.T + place)
        columns = []
        for i in range(6):
            step = np.zeros(6)
            step[i] = scale[i]
            ends = [
                lens.project(points @ (rotation @ rotation_matrix(s * step[:3])).T + place + s * step[3:])
                for s in (1.0, -1.0)
            ]
            columns.append((ends[0] - ends[1]).ravel() / (2 * scale[i]))
        jacobian = np.array(columns).T
        # A camera of unknown focal length does not see the tilt: hold it.
        stiff = np.diag([1e-6, 1e-6, 0.0, 0.0, 0.0, 0.0])
        inverse = np.linalg.inv(jacobian.T @ jacobian + stiff)
        step = inverse @ (jacobian.T @ residual.ravel())
        if not np.all(np.isfinite(step)) or np.linalg.norm(step[:3]) > 1.0:
            raise NoPoseError(Status.MISFIT)
        rotation, place = rotation @ rotation_matrix(step[:3]), place + step[3:]
        if float(np.max(np.abs(jacobian @ step))) < 1e-4:
            break
    if place[2] <= 0.0:
        raise NoPoseError(Status.MISFIT)
    return rotation, place, inverse, residual


def _dictionary(settings: CameraSettings, needed: int) -> Any:
    """OpenCV's dictionary, of at least ``needed`` markers. Raises ConfigError."""
    if not has_boards():
        raise ConfigError(
            f'OpenCV {opencv().__version__} has no boards; target.kind {settings.target} needs 4.7 or later, or '
            "Ubuntu's 4.6: `pip install 'psd_deflection[camera]'` in a virtual environment (Ubuntu's own pip rejects "
            'it; see docs/camera.md), or use the target circles'
        )
    name = settings.dictionary
    if not name.startswith('DICT_') or not hasattr(opencv().aruco, name):
        raise ConfigError(f'target.dictionary = {name}: no dictionary of OpenCV')
    dictionary = opencv().aruco.getPredefinedDictionary(getattr(opencv().aruco, name))
    columns, rows = settings.columns, settings.rows
    if min(columns, rows) < 3 or max(columns, rows) > 50:
        raise ConfigError(f'target.columns, target.rows = {columns}, {rows}: must be 3 to 50')
    if needed > len(dictionary.bytesList):
        raise ConfigError(f'target.dictionary = {name}: has {len(dictionary.bytesList)} markers, {needed} are needed')
    return dictionary


class Charuco(Board):
    """A chessboard with a marker in each white square."""

    kind = 'charuco'
    fields = ('columns', 'rows', 'square', 'marker', 'dictionary')
    usual, usual_dictionary = (7, 9), 'DICT_4X4_100'
    crossings = True

    @classmethod
    def check(cls, settings: CameraSettings) -> None:
        """See :class:`Target`."""
        marker, square = settings.marker, settings.square
        if not marker < square:
            raise ConfigError(f'target.marker = {marker:g} m: must be less than target.square ({square:g} m)')

    def __init__(self, settings: CameraSettings) -> None:
        super().__init__(settings)
        self._corners = chessboard_corners(self.board)
        self._find = corner_finder(self.board, self._dictionary)

    def _needed(self, settings: CameraSettings) -> int:
        return settings.columns * settings.rows // 2

    def _made(self) -> Any:
        s = self.settings
        return charuco_board(s.columns, s.rows, s.square, s.marker, self._dictionary)

    def _size(self) -> tuple[float, float]:
        s = self.settings
        return s.columns * s.square, s.rows * s.square

    @property
    def _free(self) -> float:
        return (self.settings.square - self.settings.marker) / 2

    def _inwards(self) -> FloatArray:
        # A crossing has no inside.
        return np.ones((1, 2))

    def _detected(self, grey: Any) -> tuple[list[int], FloatArray, Any, bool]:
        pixels, numbers, any_marker = self._find(grey)
        flat = [] if numbers is None else np.ravel(numbers).tolist()
        at = np.array([self._corners[i] for i in flat], dtype=float).reshape(-1, 3)[:, :2]
        return flat, at, pixels, any_marker


class AprilTags(Board):
    """A grid of tags."""

    kind = 'apriltag'
    fields = ('columns', 'rows', 'marker', 'gap', 'dictionary')
    usual, usual_dictionary = (4, 6), 'DICT_APRILTAG_36h11'
    crossings = False

    def __init__(self, settings: CameraSettings) -> None:
        super().__init__(settings)
        self._find = tag_finder(self._dictionary)
        self._by_id = tag_corners(self.board)

    def _needed(self, settings: CameraSettings) -> int:
        return settings.columns * settings.rows

    def _made(self) -> Any:
        s = self.settings
        return tag_board(s.columns, s.rows, s.marker, s.gap, self._dictionary)

    def _size(self) -> tuple[float, float]:
        s = self.settings
        wide, high = (n * s.marker + (n - 1) * s.gap for n in (s.columns, s.rows))
        return wide, high

    @property
    def _free(self) -> float:
        # A tag has a rim of one of its modules.
        return self.settings.marker / _TAG_MODULES

    def _inwards(self) -> FloatArray:
        # As OpenCV has the corners of a tag: clockwise from the upper left.
        corners = [[1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]]
        return np.array(corners) * [self._mirror, 1.0]

    def _detected(self, grey: Any) -> tuple[list[int], FloatArray, Any, bool]:
        corners, numbers = self._find(grey)
        flat = [] if numbers is None else np.ravel(numbers).tolist()
        ours = [(self._by_id[i], c) for i, c in zip(flat, corners, strict=True) if i in self._by_id]
        at = np.concatenate([a for a, _ in ours])[:, :2] if ours else np.zeros((0, 2))
        pixels = np.concatenate([np.reshape(c, (4, 2)) for _, c in ours]) if ours else None
        return flat, np.asarray(at, dtype=float), pixels, bool(flat)
