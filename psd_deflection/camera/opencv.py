"""OpenCV, imported when it is first needed: everything else of this package runs without it."""

from __future__ import annotations

import functools
from typing import Any

from psd_deflection.base.errors import ConfigError


@functools.cache
def opencv() -> Any:
    """The module ``cv2``. Raises ConfigError, with the fix, if it is not installed."""
    try:
        import cv2
    except ImportError:
        raise ConfigError(
            "the camera needs OpenCV: `pip install opencv-python-headless`, `pip install 'psd_deflection[camera]'`, "
            'or on ROS `apt install python3-opencv`'
        ) from None
    return cv2
