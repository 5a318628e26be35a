# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a recording shows over time, declared: its samples, and a series of estimates."""

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from psd_deflection.base.axes import SHOWN, SHOWN_UNITS, SYMBOLS
from psd_deflection.base.charts import Chart, Colour, Panel, Series, TimeAxis, gaps_of
from psd_deflection.records import FloatArray, Mark, Moment, channel_names

TONES: tuple[Colour, ...] = ('blue', 'orange', 'green')
FROM_FIRST = 'from the first sample'


def moments(marks: Iterable[Mark], start_ns: int) -> tuple[Moment, ...]:
    """Marks on an axis that is 0 at ``start_ns``."""
    return tuple(Moment((mark.t_ns - start_ns) / 1e9, mark.text) for mark in marks)


def samples_chart(samples: npt.NDArray[np.void], psds: int, marks: Sequence[Moment]) -> Chart:
    """x, y and sum of each PSD, V, over time, with the marks. ``samples``: of ``Recording.samples``."""
    along = TimeAxis(FROM_FIRST, marks)
    after_gap = np.diff(samples['seq'], prepend=samples['seq'][:1]) > 1
    if len(samples) > 1:
        after_gap[1:] |= gaps_of(np.diff(samples['t']))
    panels = []
    for i, name in enumerate(channel_names(psds)):
        values = samples[name].astype(np.float64)
        curve = Series('', samples['t'], values, TONES[i // 3 % len(TONES)], after_gap=after_gap)
        panels.append(Panel((curve,), along, f'{name} / V'))
    return Chart('samples', panels)


def estimates_chart(
    t: FloatArray, pose: FloatArray, sd: FloatArray | None, topic: str, marks: Sequence[Moment]
) -> Chart:
    """Deflections with their 95 % intervals. ``t`` (n,), s; ``pose`` and ``sd`` (n, 3), m, m, rad."""
    along = TimeAxis(FROM_FIRST, marks)
    panels = []
    for i, (symbol, unit, scale, tone) in enumerate(zip(SYMBOLS, SHOWN_UNITS, SHOWN, TONES, strict=True)):
        half_width = None if sd is None else 1.96 * scale * sd[:, i]
        panels.append(
            Panel((Series('', t, scale * pose[:, i], tone, half_width=half_width),), along, f'{symbol} / {unit}')
        )
    return Chart(topic, panels)
