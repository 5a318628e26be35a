# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The lens from images of a ChArUco board, by OpenCV's calibration (Zhang 2000), as ROS's ``camera_info`` YAML."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from psd_deflection.base.errors import ConfigError
from psd_deflection.camera.answer import NoPoseError, Status
from psd_deflection.camera.boards import Board
from psd_deflection.camera.opencv import opencv
from psd_deflection.camera.settings import CameraSettings
from psd_deflection.camera.target import target_of
from psd_deflection.records import FloatArray

LEAST_IMAGES = 5
_MOST_RMS = 2.0


class Intrinsics(NamedTuple):
    """Size (width, height), matrix (3, 3), its sd (fx, fy, cx, cy), distortion (5), rms px; images used, left out."""

    size: tuple[int, int]
    matrix: FloatArray
    deviation: FloatArray
    distortion: FloatArray
    rms: float
    used: int
    excluded: list[tuple[str, str]]

    def as_yaml(self, name: str) -> str:
        """Return the text of a ``camera_info`` file, which ``--params-file`` of ``camera`` reads too."""
        projection = np.column_stack([self.matrix, np.zeros(3)])
        head = f'image_width: {self.size[0]}\nimage_height: {self.size[1]}\ncamera_name: {name}\n'
        return (
            head
            + _matrix('camera_matrix', self.matrix)
            + 'distortion_model: plumb_bob\n'
            + _matrix('distortion_coefficients', self.distortion[None])
            + _matrix('rectification_matrix', np.eye(3))
            + _matrix('projection_matrix', projection)
        )

    def summary(self) -> dict[str, object]:
        """For JSON."""
        return {
            'matrix': self.matrix.ravel().tolist(),
            'distortion': self.distortion.tolist(),
            'sd': self.deviation.tolist(),
            'rms': self.rms,
            'used': self.used,
            'left_out': dict(self.excluded),
        }

    def lines(self) -> list[str]:
        """For a person."""
        m, sd = self.matrix, self.deviation
        return [
            f'focal length {m[0, 0]:.1f} ± {sd[0]:.1f}, {m[1, 1]:.1f} ± {sd[1]:.1f} px',
            f'centre {m[0, 2]:.1f} ± {sd[2]:.1f}, {m[1, 2]:.1f} ± {sd[3]:.1f} px',
        ]


def _matrix(name: str, values: FloatArray) -> str:
    rows, columns = values.shape
    data = ', '.join(f'{v:.10g}' for v in values.ravel())
    return f'{name}:\n  rows: {rows}\n  cols: {columns}\n  data: [{data}]\n'


def calibrated(settings: CameraSettings, images: Iterable[tuple[str, Any]]) -> Intrinsics:
    """Return the lens by named grey images of one size (None or a NoPoseError: unreadable).

    Raises ConfigError if they do not determine it.
    """
    board = target_of(settings)
    if not isinstance(board, Board):
        raise ConfigError(f'target.kind = {settings.target}: the lens is found by a board: charuco or apriltag')
    points, pixels, excluded = [], [], []
    size: tuple[int, int] | None = None
    for name, image in images:
        try:
            if image is None or isinstance(image, NoPoseError):
                raise NoPoseError(Status.UNREADABLE) if image is None else image
            shape = (int(image.shape[1]), int(image.shape[0]))
            size = size or shape
            if shape != size:
                excluded.append((name, f'has {shape[0]} x {shape[1]} pixels, the first has {size[0]} x {size[1]}'))
                continue
            plane, corners = board.corners(image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8))
        except NoPoseError as error:
            excluded.append((name, str(error)))
            continue
        points.append(np.column_stack([plane, np.zeros(len(plane))]).astype(np.float32))
        pixels.append(corners.astype(np.float32))
    if size is None or len(points) < LEAST_IMAGES:
        why = ''.join(f'; {name}: {reason}' for name, reason in excluded[:3])
        raise ConfigError(
            f'{len(points)} images show the board, at least {LEAST_IMAGES} are needed, tilted in all directions{why}'
        )
    cv2 = opencv()
    # Without the third radial term: it is only distinguished from the second by what lies in the corners of the image.
    rms, matrix, distortion, _, _, deviation, _, _ = cv2.calibrateCameraExtended(
        points, pixels, size, None, None, flags=cv2.CALIB_FIX_K3
    )
    deviations = np.ravel(deviation)[:4]
    if not (rms < _MOST_RMS and np.all(np.isfinite(matrix)) and np.all(deviations < 0.05 * matrix[0, 0])):
        raise ConfigError(
            f'the images do not determine the lens (rms {rms:.2f} px, focal length ± {deviations[0]:.0f} px): '
            'take ten or more with the board tilted by 20 to 40 degrees in all directions, up to the corners'
        )
    return Intrinsics(size, np.asarray(matrix), deviations, np.ravel(distortion)[:5], float(rms), len(points), excluded)
