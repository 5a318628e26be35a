# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The target that the settings name."""

from __future__ import annotations

from psd_deflection.camera.kinds import target_class
from psd_deflection.camera.settings import CameraSettings
from psd_deflection.camera.target import Target


def target_of(settings: CameraSettings) -> Target:
    """Return the finder of the target that ``settings`` name. Raises ConfigError."""
    target: Target = target_class(settings.target)(settings)
    return target
