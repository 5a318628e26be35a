# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The kinds of targets by their names; the module of a kind is imported when it is needed."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

TARGETS: Mapping[str, str] = {
    'circles': 'psd_deflection.camera.discs.discs:Discs',
    'charuco': 'psd_deflection.camera.boards:Charuco',
    'apriltag': 'psd_deflection.camera.boards:AprilTags',
}
"""``target.kind`` to module and class, the default first."""


def target_class(kind: str) -> Any:
    """The class of that ``target.kind``, derived from :class:`.target.Target`, which needs the settings first."""
    module, name = TARGETS[kind].split(':')
    return getattr(importlib.import_module(module), name)
