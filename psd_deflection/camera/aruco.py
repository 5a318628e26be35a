# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Markers and their boards by OpenCV's ``cv2.aruco``: one way to ask for what 4.7 and 4.6 have under other names.

4.6 (Ubuntu 24.04's) has them only where opencv_contrib was built with it, as Ubuntu does. Older ones have other axes.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from psd_deflection.camera.opencv import opencv

Corners = Any
"""Corners of markers in the image, px, four by four, or of the chessboard, as OpenCV has them."""


def has_boards() -> bool:
    """Return whether this OpenCV makes and finds boards."""
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

        def found(grey: Any) -> tuple[Corners, Any, bool]:
            pixels, numbers, _, markers = detector.detectBoard(grey)
            return pixels, numbers, markers is not None and len(markers) > 0

        return found

    def found_by_46(grey: Any) -> tuple[Corners, Any, bool]:
        corners, markers, _ = aruco.detectMarkers(grey, dictionary)
        if markers is None:
            return None, None, False
        _, pixels, numbers = aruco.interpolateCornersCharuco(corners, markers, grey, board)
        return pixels, numbers, True

    return found_by_46
