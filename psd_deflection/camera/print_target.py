"""The target on paper, to scale: PDF, SVG or PNG."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from psd_deflection.camera.boards import board_of, board_size, counts, dictionary_of
from psd_deflection.camera.settings import CameraSettings

MARGIN = 0.012
"""White around a board, black around the discs, m."""

_CAPTION = 0.012
_INCH = 0.0254
_DOTS_PER_INCH = 600
_PIXELS_A_MODULE = 40


def printed(settings: CameraSettings, kind: str) -> bytes:
    """The target as a file of ``kind`` (pdf, svg, png), with a scale of 50 mm to check the printer by.

    Raises ConfigError for a board that OpenCV does not make.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle, Rectangle

    wide, high = _size(settings)
    width, height = max(wide + 2 * MARGIN, 0.075), high + 2 * MARGIN + 2 * _CAPTION
    figure = Figure(figsize=(width / _INCH, height / _INCH), dpi=_DOTS_PER_INCH)
    FigureCanvasAgg(figure)
    axes: Any = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(-width / 2, width / 2), ylim=(-height / 2 - _CAPTION / 2, height / 2 - _CAPTION / 2))
    axes.axis('off')
    if settings.target == 'circles':
        axes.add_patch(Rectangle((-wide / 2, -high / 2), wide, high, color='black', linewidth=0))
        for y in (-settings.spacing, 0.0, settings.spacing):
            axes.add_patch(Circle((0.0, y), settings.radius, color='white', linewidth=0))
    else:
        columns, rows = counts(settings)
        size = (columns * _PIXELS_A_MODULE * 8, rows * _PIXELS_A_MODULE * 8)
        if settings.target == 'apriltag':
            size = tuple(round(n * s / wide) for n, s in zip((size[0], size[0]), (wide, high), strict=True))  # type: ignore[assignment]
        image = np.asarray(board_of(settings).generateImage(size, None, 0, 1))
        axes.imshow(
            image,
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
    said = sizes(settings)
    lines = ['; '.join(said[i : i + 2]) for i in range(0, len(said), 2)]
    axes.text(0.0, below - 0.0055, '\n'.join(lines), ha='center', va='top', fontsize=5)
    out = io.BytesIO()
    figure.savefig(out, format=kind, dpi=_DOTS_PER_INCH, metadata={'Date': None} if kind == 'svg' else None)
    return out.getvalue()


def _size(settings: CameraSettings) -> tuple[float, float]:
    if settings.target == 'circles':
        around = 1.2 * settings.radius
        return 2 * (settings.radius + around), 2 * (settings.spacing + settings.radius + around)
    return board_size(settings)


def sizes(settings: CameraSettings) -> list[str]:
    """The lines of ``CAMERA.yaml`` that describe the target."""
    if settings.target == 'circles':
        return [f'target.spacing: {settings.spacing:g}', f'target.radius: {settings.radius:g}']
    columns, rows = counts(settings)
    lines = [f'target.kind: {settings.target}', f'target.columns: {columns}', f'target.rows: {rows}']
    lines += [f'target.square: {settings.square:g}'] if settings.target == 'charuco' else []
    lines += [f'target.marker: {settings.marker:g}']
    lines += [f'target.gap: {settings.gap:g}'] if settings.target == 'apriltag' else []
    return [*lines, f'target.dictionary: {dictionary_of(settings)}']
