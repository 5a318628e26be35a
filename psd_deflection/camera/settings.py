# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The parameters of the camera and of its target: ``CAMERA.yaml``, or the parameters of the node."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from psd_deflection.base.errors import ConfigError
from psd_deflection.camera.lens import Lens
from psd_deflection.rig.parameters import Section, parameter

TARGETS: Mapping[str, str] = {
    'circles': 'psd_deflection.camera.discs:Discs',
    'charuco': 'psd_deflection.camera.boards:Charuco',
    'apriltag': 'psd_deflection.camera.boards:AprilTags',
}
"""``target.kind`` to module and class, the default first."""


def target_class(kind: str) -> Any:
    """The class of that ``target.kind``, derived from :class:`.target.Target`, which needs the settings first."""
    module, name = TARGETS[kind].split(':')
    return getattr(importlib.import_module(module), name)


VIEWS = ('outside', 'base')
_LENGTH: Mapping[str, Any] = {'minimum': 1e-6, 'maximum': 100.0, 'live': True}
_COUNT: Mapping[str, Any] = {'minimum': 0, 'maximum': 1000, 'live': True}


@dataclass(frozen=True)
class CameraSettings:
    """What the camera sees and how. Lengths in m, angles in rad.

    The camera looks at the tip's outer face (``view`` ``outside``: image right is +X, up is +Y) or from the base.
    """

    target: str = parameter('circles', '', 'kind of the target', name='target.kind', choices=tuple(TARGETS), live=True)
    spacing: float = parameter(
        0.025, 'm', 'between the centres of neighbouring discs', name='target.spacing', **_LENGTH
    )
    radius: float = parameter(0.008, 'm', 'radius of a disc', name='target.radius', **_LENGTH)
    columns: int = parameter(
        0, '', 'squares or tags along X of a board; 0: the usual number', name='target.columns', **_COUNT
    )
    rows: int = parameter(
        0, '', 'squares or tags along Y of a board; 0: the usual number', name='target.rows', **_COUNT
    )
    square: float = parameter(0.010, 'm', 'side of a square of a ChArUco board', name='target.square', **_LENGTH)
    marker: float = parameter(0.007, 'm', 'side of a marker or tag', name='target.marker', **_LENGTH)
    gap: float = parameter(0.0045, 'm', 'space between neighbouring tags', name='target.gap', **_LENGTH)
    dictionary: str = parameter(
        '', '', 'dictionary of the markers, by its name in OpenCV', name='target.dictionary', live=True
    )
    matrix: tuple[float, ...] = parameter(
        (), 'px', 'camera matrix, row by row; empty: not known', name='camera.matrix', live=True
    )
    distortion: tuple[float, ...] = parameter(
        (), '', "distortion in OpenCV's order; empty: none", name='camera.distortion', live=True
    )
    view: str = parameter(
        'outside', '', 'from where the camera sees the plate', name='camera.view', choices=VIEWS, live=True
    )
    rotation: float = parameter(
        0.0,
        'rad',
        'about how far the image of the plate is turned clockwise',
        name='camera.rotation',
        minimum=-10.0,
        maximum=10.0,
        live=True,
    )
    exposure: float = parameter(
        0.0,
        's',
        'of each frame, if the source does not say it',
        name='camera.exposure',
        minimum=0.0,
        maximum=3600.0,
        live=True,
    )
    rest_frames: int = parameter(
        0,
        '',
        'first good frames whose mean is the rest; 0: as many as do not move',
        name='rest.frames',
        minimum=0,
        maximum=100_000,
        live=True,
    )

    frame_prefix: str = parameter('', '', 'of the rig: put before link_tip_rest, the frame of the reference on ROS')

    def lens(self, shape: tuple[int, int]) -> Lens:
        """Return the lens for images of ``shape`` (rows, columns). Raises ConfigError."""
        if not self.matrix:
            return Lens.unknown(shape)
        return Lens(np.array(self.matrix).reshape(3, 3), np.array(self.distortion, dtype=float))

    def of_kind(self, target: str) -> CameraSettings:
        """Return the same with another kind of target. Raises ConfigError."""
        return replace(self, target=target)

    def __post_init__(self) -> None:
        if len(self.matrix) not in (0, 9):
            raise ConfigError(f'camera.matrix has {len(self.matrix)} numbers: must be nine, row by row')
        if self.distortion and not self.matrix:
            raise ConfigError('camera.distortion is given without camera.matrix: give both')
        target_class(self.target).check(self)
        if self.matrix:
            self.lens((1, 1))


SETTINGS = Section(CameraSettings)
MATRIX = 'camera.matrix'


def settings_from(values: Mapping[str, object], where: str) -> CameraSettings:
    """Return the settings of flat ``values`` (``target.spacing`` …); the matrix may be in rows. Raises ConfigError.

    ``where``: for messages.
    """
    rows = values.get(MATRIX)
    if isinstance(rows, Sequence) and rows and all(isinstance(row, list | tuple) for row in rows):
        values = {**values, MATRIX: [number for row in rows for number in row]}
    return SETTINGS.read(values, where)
