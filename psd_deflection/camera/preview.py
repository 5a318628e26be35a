# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A frame with what was found in it, as a picture: where the camera looks, and why a frame has no answer."""

import math
from typing import Any

import numpy as np

from psd_deflection.camera.answer import FrameAnswer, Status
from psd_deflection.camera.opencv import opencv

FOUND, REJECTED = (80, 200, 60), (60, 60, 230)
"""Blue, green, red."""
ARM = 12
"""Half the size of a cross, px."""


def preview(image: Any, answer: FrameAnswer) -> bytes:
    """PNG of the frame: a cross at each disc or corner that was found, and the answer or the reason in words.

    ``image`` (rows, columns): grey, uint8 or uint16; one that could not be read is black.
    """
    cv2 = opencv()
    grey = image if isinstance(image, np.ndarray) else np.zeros((240, 320), np.uint8)
    if grey.dtype != np.uint8:
        grey = (grey >> 8).astype(np.uint8)
    drawn = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    good = answer.status is Status.OK
    color = FOUND if good else REJECTED
    if answer.target is not None:
        for u, v in np.rint(answer.target.points).astype(int).tolist():
            cv2.line(drawn, (u - ARM, v), (u + ARM, v), color, 1)
            cv2.line(drawn, (u, v - ARM), (u, v + ARM), color, 1)
    # OpenCV's letters are ASCII.
    pose = f'dX {1e3 * answer.dx:+.3f} mm  dY {1e3 * answer.dy:+.3f} mm  theta {math.degrees(answer.theta):+.3f} deg'
    words = pose if good else f'no answer: {answer.words}'
    cv2.putText(drawn, words, (10, drawn.shape[0] - 12), cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, 1, cv2.LINE_AA)
    return bytes(cv2.imencode('.png', drawn)[1].tobytes())
