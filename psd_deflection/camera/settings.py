"""The parameters of the camera and of its target: ``CAMERA.yaml``, or the parameters of the node."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from psd_deflection.base.errors import ConfigError, did_you_mean
from psd_deflection.camera.lens import Lens

TARGETS = ('circles', 'charuco', 'apriltag')
VIEWS = ('outside', 'base')


def _parameter(name: str, help_: str, default: Any, unit: str = '', least: float = -math.inf) -> Any:
    known = {'name': name, 'help': help_, 'unit': unit, 'least': least}
    return field(default=default, metadata=known)


@dataclass(frozen=True)
class CameraSettings:
    """What the camera sees and how. Lengths in m, angles in rad.

    The camera looks at the tip's outer face (``view`` ``outside``: image right is +X, up is +Y) or from the base.
    """

    target: str = _parameter('target.kind', 'circles, charuco or apriltag', 'circles')
    spacing: float = _parameter('target.spacing', 'between the centres of neighbouring discs', 0.025, 'm', 1e-6)
    radius: float = _parameter('target.radius', 'radius of a disc', 0.008, 'm', 1e-6)
    columns: int = _parameter('target.columns', 'squares or tags along X of a board', 0, '', 0)
    rows: int = _parameter('target.rows', 'squares or tags along Y of a board', 0, '', 0)
    square: float = _parameter('target.square', 'side of a square of a ChArUco board', 0.010, 'm', 1e-6)
    marker: float = _parameter('target.marker', 'side of a marker or tag', 0.007, 'm', 1e-6)
    gap: float = _parameter('target.gap', 'space between neighbouring tags', 0.0045, 'm', 1e-6)
    dictionary: str = _parameter('target.dictionary', 'dictionary of the markers, by its name in OpenCV', '')
    matrix: tuple[float, ...] = _parameter('camera.matrix', 'camera matrix, row by row; empty: not known', (), 'px')
    distortion: tuple[float, ...] = _parameter('camera.distortion', "distortion in OpenCV's order; empty: none", ())
    view: str = _parameter('camera.view', 'outside or base', 'outside')
    turn: float = _parameter('camera.turn', 'about how far the image of the plate is turned clockwise', 0.0, 'rad')
    exposure: float = _parameter('camera.exposure', 'of each frame, if the source does not say it', 0.0, 's', 0.0)
    rest_frames: int = _parameter(
        'rest.frames', 'first good frames whose mean is the rest; 0: as many as do not move', 0, '', 0
    )

    def lens(self, shape: tuple[int, int]) -> Lens:
        """The lens for images of ``shape`` (rows, columns). Raises ConfigError."""
        if not self.matrix:
            return Lens.unknown(shape)
        return Lens(np.array(self.matrix).reshape(3, 3), np.array(self.distortion, dtype=float))

    def of_kind(self, target: str) -> CameraSettings:
        """The same with another kind of target. Raises ConfigError."""
        return replace(self, target=target)

    def __post_init__(self) -> None:
        for name, value, choices in (
            ('target.kind', self.target, TARGETS),
            ('camera.view', self.view, VIEWS),
        ):
            if value not in choices:
                raise ConfigError(f'{name} = {value}: must be one of {", ".join(choices)}')
        if len(self.matrix) not in (0, 9):
            raise ConfigError(f'camera.matrix has {len(self.matrix)} numbers: must be nine, row by row')
        if self.distortion and not self.matrix:
            raise ConfigError('camera.distortion is given without camera.matrix: give both')
        if self.target == 'circles' and not 2.05 * self.radius < self.spacing:
            raise ConfigError(
                f'target.spacing = {self.spacing:g} m: must be more than twice target.radius ({self.radius:g} m)'
            )
        if self.target == 'charuco' and not self.marker < self.square:
            raise ConfigError(f'target.marker = {self.marker:g} m: must be less than target.square ({self.square:g} m)')
        if self.matrix:
            self.lens((1, 1))


PARAMETERS: Mapping[str, Any] = {f.metadata['name']: f for f in fields(CameraSettings)}
"""Name of a parameter to its field of :class:`CameraSettings`."""


def settings_from(values: Mapping[str, object], where: str) -> CameraSettings:
    """The settings of flat ``values`` (``target.spacing`` …). ``where``: for messages. Raises ConfigError."""
    known: dict[str, Any] = {}
    for name, value in values.items():
        found = PARAMETERS.get(name)
        if found is None:
            raise ConfigError(f'{where}: no parameter {name}{did_you_mean(name, PARAMETERS)}')
        known[found.name] = _checked(name, value, found, where)
    try:
        return CameraSettings(**known)
    except ConfigError as error:
        raise ConfigError(f'{where}: {error}') from None


def _checked(name: str, value: object, declared: Any, where: str) -> object:
    """``value`` as the type of its field."""
    default, least, unit = declared.default, declared.metadata['least'], declared.metadata['unit']
    if isinstance(default, str):
        if isinstance(value, str):
            return value
        raise ConfigError(f'{where}: {name} = {value!r}: must be text')
    if isinstance(default, tuple):
        flat = _flat(value)
        if flat is None:
            raise ConfigError(f'{where}: {name}: must be a list of numbers')
        return flat
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConfigError(f'{where}: {name} = {value!r}: must be a number')
    if isinstance(default, int) and value != int(value):
        raise ConfigError(f'{where}: {name} = {value!r}: must be a whole number')
    if value < least:
        raise ConfigError(f'{where}: {name} = {value:g} {unit}: must be at least {least:g}'.replace('  ', ' '))
    return int(value) if isinstance(default, int) else float(value)


def _flat(value: object) -> tuple[float, ...] | None:
    """A list of numbers, or of lists of numbers (a matrix in rows)."""
    if not isinstance(value, Sequence) or isinstance(value, str):
        return None
    flat: list[float] = []
    for item in value:
        if isinstance(item, Sequence) and not isinstance(item, str):
            inner = _flat(item)
            if inner is None:
                return None
            flat += inner
        elif isinstance(item, bool) or not isinstance(item, int | float) or not math.isfinite(item):
            return None
        else:
            flat.append(float(item))
    return tuple(flat)
