"""ChArUco and AprilTag boards by OpenCV: corners -> pose of the board, with covariance from their residuals.

The board's middle is ``link_tip``'s origin; seen from its front, its columns run to the right. Corners are matched
by the numbers in the markers, so a board has no half turn, and may be partly hidden.
Needs OpenCV 4.7 or later (``cv2.aruco`` of ``objdetect``).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from psd_deflection.base.errors import ConfigError
from psd_deflection.camera.answer import NoPoseError, Status, TargetPose
from psd_deflection.camera.discs.rim_model import turned
from psd_deflection.camera.lens import Lens
from psd_deflection.camera.opencv import opencv
from psd_deflection.camera.refine_corners import LEAST_REACH, refined
from psd_deflection.camera.settings import CameraSettings
from psd_deflection.records import FloatArray

LEAST_CORNERS = 8
LEAST_SPREAD = 0.35
"""Smallest spread of the corners that are seen, in units of that of the whole board, along its narrower direction."""

WORST_CORNER = 1.5
"""Largest residual of a corner, px, with which it counts; and the share of the corners that must count is 3/4."""

MOST_BLUR = 0.4
"""Largest blur (sd) across an edge with an answer, in units of what is free around a corner."""

CORNER_FLOOR, BLUR_FLOOR = 0.004, 0.05
"""Error that all corners share and no residual shows, one sd in px; and the part of the motion's sd that adds to it."""

_STEPS = 20
_TAG_MODULES = 10


class Board:
    """Finds one board, frame by frame. Raises ConfigError if OpenCV or the dictionary is unknown."""

    def __init__(self, settings: CameraSettings) -> None:
        self.board = board_of(settings)
        cv2 = opencv()
        parameters = cv2.aruco.DetectorParameters()
        self._charuco: Any = None
        if settings.target == 'charuco':
            self._charuco = cv2.aruco.CharucoDetector(self.board)
        else:
            parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
            self._tags = cv2.aruco.ArucoDetector(self.board.getDictionary(), parameters)
            self._by_id = dict(zip(np.ravel(self.board.getIds()).tolist(), self.board.getObjPoints(), strict=True))
        # OpenCV's board: origin in the corner, x right, y down as it is seen. Ours: middle, y up.
        wide, high = board_size(settings)
        # Around a corner of the chessboard there is nothing up to the markers; a tag has a rim of one of its modules.
        charuco = settings.target == 'charuco'
        self._free = (settings.square - settings.marker) / 2 if charuco else settings.marker / _TAG_MODULES
        # From the corners of a tag (as OpenCV has them, clockwise from the upper left) to its inside, in our axes.
        self._inwards = np.array([[1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
        self._middle = np.array([wide / 2, high / 2])
        self._mirror = 1.0 if settings.view == 'outside' else -1.0
        self._inwards[:, 0] *= self._mirror
        self._spread = np.array([wide, high]) / math.sqrt(12.0)

    def set_rest(self, rest: TargetPose) -> None:
        """Nothing to remember: the numbers of the markers say it all."""

    def locate(self, image: Any, grey: Any, lens: Lens, full_scale: float) -> TargetPose:
        """The board in one image. Raises RefusedError."""
        plane, pixels = self.corners(grey)
        points = np.column_stack([plane, np.zeros(len(plane))])
        rotation, place = self._guess(plane, lens.rays(pixels))
        rotation, place, _, _ = _fitted(points, pixels, lens, rotation, place)
        pixels, shared_blur = self._refined(image, points, pixels, lens, rotation, place)
        kept = np.isfinite(pixels[:, 0])
        if kept.sum() < max(LEAST_CORNERS, 0.6 * len(points)):
            raise NoPoseError(Status.MISFIT)
        plane, points, pixels = plane[kept], points[kept], pixels[kept]
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
        """Corners by the grey levels around them, and the sd of the motion blur, px. Raises RefusedError."""
        step = 0.5 * self._free
        here = lens.project(points @ rotation.T + place)
        towards = np.sign(self._inwards) if self._charuco is None else np.ones((1, 2))
        towards = np.resize(towards, (len(points), 2))
        edges = []
        for axis in (0, 1):
            ahead = points.copy()
            ahead[:, axis] += step * towards[:, axis]
            vector = lens.project(ahead @ rotation.T + place) - here
            edges.append(vector / np.linalg.norm(vector, axis=1)[:, None])
        free = self._free * lens.focal / float(place[2])
        if free < LEAST_REACH:
            raise NoPoseError(Status.SMALL)
        found = refined(image, pixels, np.stack(edges, axis=1), 0.95 * free, self._charuco is not None)
        blur = np.sort(np.nanmedian(found.blur, axis=0))
        if blur[1] > MOST_BLUR * free:
            raise NoPoseError(Status.BLURRED)
        return found.pixels, math.sqrt(max(float(blur[1] ** 2 - blur[0] ** 2), 0.0))

    def corners(self, grey: Any) -> tuple[FloatArray, FloatArray]:
        """Corners on the plate (n, 2) m and in the image (n, 2) px. Raises RefusedError."""
        if self._charuco is not None:
            found, numbers, _, markers = self._charuco.detectBoard(grey)
            known = self.board.getChessboardCorners()
            flat = [] if numbers is None else np.ravel(numbers).tolist()
            at, pixels = np.array([known[i] for i in flat]), found
            if len(flat) and len(set(flat)) < len(flat):
                raise NoPoseError(Status.DOUBLED)
        else:
            corners, numbers, _ = self._tags.detectMarkers(grey)
            markers = numbers
            flat = [] if numbers is None else np.ravel(numbers).tolist()
            if len(set(flat)) < len(flat):
                raise NoPoseError(Status.DOUBLED)
            ours = [(self._by_id[i], c) for i, c in zip(flat, corners, strict=True) if i in self._by_id]
            at = np.concatenate([a for a, _ in ours]) if ours else np.zeros((0, 3))
            pixels = np.concatenate([np.reshape(c, (4, 2)) for _, c in ours]) if ours else None
        if markers is None or len(markers) == 0:
            raise NoPoseError(Status.MISSING)
        if len(at) < LEAST_CORNERS or pixels is None:
            raise NoPoseError(Status.HIDDEN)
        plane = np.asarray(at, dtype=float)[:, :2] - self._middle
        if np.min(plane.std(axis=0) / self._spread) < LEAST_SPREAD:
            raise NoPoseError(Status.HIDDEN)
        return plane * [self._mirror, -1.0], np.reshape(pixels, (-1, 2)).astype(float)

    def _guess(self, plane: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotation and place by the homography from the plane to the rays (Zhang 2000)."""
        scale = float(np.sqrt(np.mean(plane**2)))
        x, y = (plane / scale).T
        u, v = rays.T
        one, nil = np.ones_like(x), np.zeros_like(x)
        rows = np.concatenate(
            [
                np.column_stack([x, y, one, nil, nil, nil, -u * x, -u * y, -u]),
                np.column_stack([nil, nil, nil, x, y, one, -v * x, -v * y, -v]),
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
                lens.project(points @ (rotation @ turned(s * step[:3])).T + place + s * step[3:]) for s in (1.0, -1.0)
            ]
            columns.append((ends[0] - ends[1]).ravel() / (2 * scale[i]))
        jacobian = np.array(columns).T
        # A camera of unknown focal length does not see the tilt: hold it.
        stiff = np.diag([1e-6, 1e-6, 0.0, 0.0, 0.0, 0.0])
        inverse = np.linalg.inv(jacobian.T @ jacobian + stiff)
        step = inverse @ (jacobian.T @ residual.ravel())
        if not np.all(np.isfinite(step)) or np.linalg.norm(step[:3]) > 1.0:
            raise NoPoseError(Status.MISFIT)
        rotation, place = rotation @ turned(step[:3]), place + step[3:]
        if float(np.max(np.abs(jacobian @ step))) < 1e-4:
            break
    if place[2] <= 0.0:
        raise NoPoseError(Status.MISFIT)
    return rotation, place, inverse, residual


def board_size(settings: CameraSettings) -> tuple[float, float]:
    """Width and height of the board, m."""
    columns, rows = counts(settings)
    if settings.target == 'charuco':
        return columns * settings.square, rows * settings.square
    return tuple(n * settings.marker + (n - 1) * settings.gap for n in (columns, rows))  # type: ignore[return-value]


def counts(settings: CameraSettings) -> tuple[int, int]:
    """Columns and rows of a board."""
    usual = (7, 9) if settings.target == 'charuco' else (4, 6)
    return settings.columns or usual[0], settings.rows or usual[1]


def dictionary_of(settings: CameraSettings) -> str:
    """Name of the markers' dictionary in OpenCV."""
    return settings.dictionary or ('DICT_4X4_100' if settings.target == 'charuco' else 'DICT_APRILTAG_36h11')


def board_of(settings: CameraSettings) -> Any:
    """OpenCV's board. Raises ConfigError."""
    aruco = getattr(opencv(), 'aruco', None)
    if aruco is None or not hasattr(aruco, 'CharucoDetector'):
        raise ConfigError(
            f'OpenCV {opencv().__version__} has no boards; target.kind {settings.target} needs 4.7 or later: '
            '`pip install opencv-python-headless`, or use the target circles'
        )
    name = dictionary_of(settings)
    if not name.startswith('DICT_') or not hasattr(aruco, name):
        raise ConfigError(f'target.dictionary = {name}: no dictionary of OpenCV')
    dictionary = aruco.getPredefinedDictionary(getattr(aruco, name))
    columns, rows = counts(settings)
    if min(columns, rows) < 3 or max(columns, rows) > 50:
        raise ConfigError(f'target.columns, target.rows = {columns}, {rows}: must be 3 to 50')
    needed = columns * rows // 2 if settings.target == 'charuco' else columns * rows
    if needed > len(dictionary.bytesList):
        raise ConfigError(f'target.dictionary = {name}: has {len(dictionary.bytesList)} markers, {needed} are needed')
    if settings.target == 'charuco':
        return aruco.CharucoBoard((columns, rows), settings.square, settings.marker, dictionary)
    return aruco.GridBoard((columns, rows), settings.marker, settings.gap, dictionary)
