# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Pictures: a frame with what was found in it (where the camera looks, why a frame has no answer), and the target on
paper, to scale: PDF, SVG or PNG."""

import io
import math
from typing import Any

import numpy as np

from psd_deflection.camera.answer import FrameAnswer, Status
from psd_deflection.camera.opencv import opencv
from psd_deflection.camera.target import Target

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


MARGIN = 0.012
"""White around a board, black around the discs, m."""

_CAPTION = 0.012
_INCH = 0.0254
_DOTS_PER_INCH = 600


def printed(target: Target, kind: str) -> bytes:
    """Return the target as a file of ``kind`` (pdf, svg, png), with a scale of 50 mm to check the printer by."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle, Rectangle

    drawing = target.drawing()
    wide, high = drawing.size
    width, height = max(wide + 2 * MARGIN, 0.075), high + 2 * MARGIN + 2 * _CAPTION
    figure = Figure(figsize=(width / _INCH, height / _INCH), dpi=_DOTS_PER_INCH)
    FigureCanvasAgg(figure)
    axes: Any = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.axis('off')
    if drawing.discs:
        axes.add_patch(Rectangle((-wide / 2, -high / 2), wide, high, color='black', linewidth=0))
    for x, y, radius in drawing.discs:
        axes.add_patch(Circle((x, y), radius, color='white', linewidth=0))
    if drawing.picture is not None:
        axes.imshow(
            drawing.picture,
            cmap='gray',
            vmin=0,
            vmax=255,
            extent=(-wide / 2, wide / 2, -high / 2, high / 2),
            interpolation='none',
        )
    axes.set(xlim=(-width / 2, width / 2), ylim=(-height / 2 - _CAPTION / 2, height / 2 - _CAPTION / 2))
    below = -high / 2 - MARGIN
    axes.plot([-0.025, 0.025], [below, below], color='black', linewidth=0.8)
    for x in (-0.025, 0.025):
        axes.plot([x, x], [below - 0.0015, below + 0.0015], color='black', linewidth=0.8)
    axes.text(0.0, below - 0.002, '50 mm: print at 100 %, measure this line', ha='center', va='top', fontsize=6)
    description = target.describe()
    lines = ['; '.join(description[i : i + 2]) for i in range(0, len(description), 2)]
    axes.text(0.0, below - 0.0055, '\n'.join(lines), ha='center', va='top', fontsize=5)
    out = io.BytesIO()
    figure.savefig(out, format=kind, dpi=_DOTS_PER_INCH, metadata={'Date': None} if kind == 'svg' else None)
    return out.getvalue()
