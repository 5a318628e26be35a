# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The target on paper, to scale: PDF, SVG or PNG."""

import io
from typing import Any

from psd_deflection.camera.target import Target

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
