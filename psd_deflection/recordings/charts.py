"""What a recording shows over time, declared: its samples, and a series of estimates."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from psd_deflection.base.charts import Chart, Colour, Panel, Rule, Series
from psd_deflection.records import FloatArray, Mark, channel_names

TONES: tuple[Colour, ...] = ('blue', 'orange', 'green')
ALONG = 'time / s from the first sample'


def samples_chart(samples: npt.NDArray[np.void], psds: int, marks: Sequence[Mark]) -> Chart:
    """x, y and sum of each PSD, V, over time, with the marks. ``samples``: of ``Recording.samples``."""
    start = int(samples['t_ns'][0])
    rules = [Rule((mark.t_ns - start) / 1e9, mark.text) for mark in marks]
    panels = []
    for i, name in enumerate(channel_names(psds)):
        curve = Series('', samples['t'], samples[name].astype(np.float64), TONES[i // 3 % len(TONES)])
        panels.append(Panel((curve,), ALONG, f'{name} / V', rules=rules))
    return Chart('samples', panels)


def estimates_chart(t: FloatArray, pose: FloatArray, sd: FloatArray | None, topic: str) -> Chart:
    """Deflections with their 95 % intervals. ``t`` (n,), s; ``pose`` and ``sd`` (n, 3), m, m, rad."""
    shown = (('ΔX / µm', 1e6), ('ΔY / µm', 1e6), ('θ / mdeg', float(np.degrees(1e3))))
    panels = []
    for i, ((label, scale), tone) in enumerate(zip(shown, TONES, strict=True)):
        spread = None if sd is None else 1.96 * scale * sd[:, i]
        panels.append(Panel((Series('', t, scale * pose[:, i], tone, spread=spread),), ALONG, label))
    return Chart(topic, panels)
