# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A kind of target: how it is found in an image, how it is drawn on paper, and what describes it."""

import abc
from typing import Any, ClassVar, NamedTuple

from psd_deflection.camera.answer import TargetPose
from psd_deflection.camera.lens import Lens
from psd_deflection.camera.settings import SETTINGS, CameraSettings, target_class


class Drawing(NamedTuple):
    """A picture about the middle of the target: either discs (x, y, radius) m, white on a black
    rectangle of ``size`` (m), or a grey ``picture`` (rows, columns) of uint8 that has this size.
    """

    size: tuple[float, float]
    discs: tuple[tuple[float, float, float], ...] = ()
    picture: Any = None


class Target(abc.ABC):
    """One kind of target, with the sizes that the settings say.

    ``kind``: its name, as ``target.kind`` has it. ``fields``: the fields of the settings that are its own.
    """

    kind: ClassVar[str]
    fields: ClassVar[tuple[str, ...]]

    def __init__(self, settings: CameraSettings) -> None:
        self.settings = settings
        self._rest: TargetPose | None = None

    @classmethod  # noqa: B027 - not every kind has such sizes
    def check(cls, settings: CameraSettings) -> None:
        """Raises ConfigError if sizes contradict each other."""

    @abc.abstractmethod
    def locate(self, image: Any, grey: Any, lens: Lens, full_scale: float) -> TargetPose:
        """Return the target in one image; ``grey`` is its 8-bit form. Raises NoPoseError."""

    @abc.abstractmethod
    def drawing(self) -> Drawing:
        """Return the picture to print."""

    def set_rest(self, rest: TargetPose) -> None:
        """Remember where the target is at rest."""
        self._rest = rest

    def rest_words(self, rest: TargetPose) -> list[str]:
        """Lines for a person about the target at rest."""
        return []

    def describe(self) -> list[str]:
        """Return the lines of ``CAMERA.yaml`` that describe it."""
        lines = [
            f'{SETTINGS.parameters[name].name}: {_setting_words(getattr(self.settings, name))}' for name in self.fields
        ]
        return [f'target.kind: {self.kind}', *lines]


def _setting_words(value: object) -> str:
    return f'{value:g}' if isinstance(value, float) else str(value)


def target_of(settings: CameraSettings) -> Target:
    """Return the finder of the target that ``settings`` name. Raises ConfigError."""
    target: Target = target_class(settings.target)(settings)
    return target
