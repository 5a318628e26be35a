# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""OpenCV, imported when it is first needed: everything else of this package runs without it."""

from __future__ import annotations

import functools
import os
from typing import Any

from psd_deflection.base.errors import ConfigError
from psd_deflection.camera.image_size import MOST_PIXELS


@functools.cache
def opencv() -> Any:
    """Return the module ``cv2``. Raises ConfigError, with the fix, if it is not installed."""
    # OpenCV reads it once, when it is imported; its own bound is 2^30.
    os.environ.setdefault('OPENCV_IO_MAX_IMAGE_PIXELS', str(MOST_PIXELS))
    try:
        import cv2
    except ImportError:
        raise ConfigError(
            'the camera needs OpenCV: on Ubuntu and ROS `apt install python3-opencv`, in a virtual environment '
            "`pip install 'psd_deflection[camera]'`"
        ) from None
    return cv2
