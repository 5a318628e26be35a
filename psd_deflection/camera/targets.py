"""The kinds of targets by their names."""

from __future__ import annotations

from psd_deflection.camera.boards import Board
from psd_deflection.camera.discs.discs import Discs
from psd_deflection.camera.reference import Target
from psd_deflection.camera.settings import CameraSettings


def target_of(settings: CameraSettings) -> Target:
    """The finder of the target that ``settings`` name. Raises ConfigError."""
    return Discs(settings) if settings.target == 'circles' else Board(settings)
