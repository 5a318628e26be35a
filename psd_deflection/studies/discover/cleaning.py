# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What of a recording is no measurement: outliers, a detector that is stuck, time before the first known load.

These samples become NaN and cost precision, nothing else. What a person should know of them is a :class:`Finding`.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import maximum_filter1d, median_filter

from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.recordings.observation import Observation
from psd_deflection.records import BoolArray, FloatArray, channel_names, dot_channels
from psd_deflection.studies.check.result import Finding
from psd_deflection.studies.check.wirings import line
from psd_deflection.studies.discover.search.proposals import coarse_step
from psd_deflection.studies.discover.thresholds import PASSES, STUCK_S
from psd_deflection.studies.loads.annotated_times import CorrectedLoads, correct_loads
from psd_deflection.studies.loads.thresholds import OUTLIER_SD, SLIGHT

_TO_SD = 1.4826


def outliers(residual: FloatArray, least: float) -> BoolArray:
    """(n, 3P): samples of ``residual`` (n, 3P), measured minus simulated, V, that stand out from their neighbours.

    Each is held against the cubic through the two samples before it and the two after it, so that a movement, hum and
    ringing are none. ``least``: V, smallest standard deviation assumed.
    """
    out = np.zeros(residual.shape, dtype=bool)
    at = np.arange(len(residual))
    for c in range(residual.shape[1]):
        lost = ~np.isfinite(residual[:, c])
        x = residual[:, c].copy()
        # An outlier spoils its neighbours' cubics: of five only the farthest from the median goes, then all are looked
        # at again.
        for _ in range(PASSES):
            gone = out[:, c] | lost
            if np.count_nonzero(~gone) < 8:
                break
            if gone.any():
                x[gone] = CubicSpline(at[~gone], residual[~gone, c])(at[gone])
            apart = _from_cubic(x)
            limit = OUTLIER_SD * max(_TO_SD * float(np.median(apart)), least)
            candidate = maximum_filter1d(apart, 5) > limit
            distance = np.where(candidate & ~gone, np.abs(x - median_filter(x, 5)), 0.0)
            worst = (distance > 0.5 * limit) & (distance >= maximum_filter1d(distance, 5))
            if not worst.any():
                break
            out[worst, c] = True
    return out


def _from_cubic(x: FloatArray) -> FloatArray:
    """Distance of each sample (n,) from the cubic through two on either side; at the ends from the median of five."""
    apart = np.empty_like(x)
    apart[2:-2] = np.abs(x[2:-2] - (4.0 * (x[1:-3] + x[3:-1]) - x[:-4] - x[4:]) / 6.0)
    for ends, five in ((slice(0, 2), x[:5]), (slice(-2, None), x[-5:])):
        # Movement between samples is no outlier.
        moved = 3.0 * float(np.median(np.abs(np.diff(five))))
        apart[ends] = np.maximum(np.abs(x[ends] - np.median(five)) - moved, 0.0)
    return apart


def stuck(volts: FloatArray, period: float, noise: FloatArray, step: float) -> BoolArray:
    """(n, 3P): where a channel keeps one value for ``STUCK_S``, as noise never lets it.

    At its greatest or least value it may be limited. A channel with less ``noise`` (3P,) V than the converter's
    ``step`` V may rest.
    """
    out = np.zeros(volts.shape, dtype=bool)
    shortest = max(8, round(STUCK_S / period))
    for c in range(volts.shape[1]):
        values = volts[:, c]
        finite = values[np.isfinite(values)]
        if len(finite) < 2 or noise[c] <= step:
            continue
        moved = np.concatenate(([True], values[1:] != values[:-1], [True]))
        edges = np.flatnonzero(moved)
        lengths = np.diff(edges)
        long = lengths >= shortest
        if long.all() and len(lengths) == 1:
            out[:, c] = True
            continue
        low, high = float(finite.min()), float(finite.max())
        for a, n in zip(edges[:-1][long].tolist(), lengths[long].tolist(), strict=True):
            if low < values[a] < high:
                out[a : a + n, c] = True
    return out


def clean(observation: Observation, base: Sequence[ActiveEffect]) -> tuple[Observation, list[Finding]]:
    """Return the recording without what is no measurement, and what was found. ``base``: effects of the rig file."""
    o = observation
    step = o.rig.converter.volts_per_count
    findings = []
    volts = o.volts.copy()
    coarse, names = coarse_step(o), channel_names(o.psds)
    # Coarse steps keep their value for long, and jump for a single sample.
    still = stuck(volts, o.period, o.rig.noises.ravel(), step)
    if coarse is not None:
        still[:, list(range(len(names)) if coarse.sums else dot_channels(o.psds))] = False
    least = max(step if coarse is None else coarse.step, 0.25 * float(o.rig.noises.min()))
    for c in np.flatnonzero(still.any(axis=0)).tolist():
        first = int(np.argmax(still[:, c]))
        seconds = float(still[:, c].sum()) * o.period
        findings.append(
            Finding(
                'stuck_channel',
                names[c],
                first * o.period,
                f'{names[c]} of {o.name} keeps one value from {first * o.period:.3f} s on, {seconds:.3f} s in all: '
                'look at its cable; these samples are left out',
                seconds / o.duration,
            )
        )
    volts[still] = np.nan
    simulated = ForwardModel(o.rig, base).expect(o.loads, o.temperature).volts.T
    rough, beside_model = outliers(volts, least), outliers(volts - simulated, least)
    # Loads in a wrong unit make the simulation rougher than the readings; else it explains their steps.
    volts[rough if beside_model.sum() > 2 * rough.sum() else beside_model] = np.nan
    if o.stated_rate_hz:
        rate = o.rig.converter.sample_rate_hz
        factor = rate / o.stated_rate_hz
        fix = line('converter.sample_rate_hz', rate)
        findings.append(Finding('sample_rate', 'converter.sample_rate_hz', factor, fix, abs(math.log(factor))))
    before, after = o.unknown_load
    volts[:before] = np.nan
    volts[len(volts) - after :] = np.nan
    share = (before + after) / len(volts)
    if share > SLIGHT:
        ends = [f'{name} {k * o.period:.2f} s' for name, k in (('first', before), ('last', after)) if k]
        findings.append(
            Finding(
                'load_coverage',
                'load_fx load_fy load_tz',
                share,
                f'{o.name}: no load is noted in its {" and its ".join(ends)}: note it all the time; '
                'these samples are left out',
                share,
            )
        )
    if np.array_equal(volts, o.volts, equal_nan=True):
        return o, findings
    return dataclasses.replace(o, volts=volts, digest=o.digest or o.hashed()), findings


def time_loads(observation: Observation) -> tuple[Observation, CorrectedLoads | None]:
    """The recording with its loads at the times at which they acted, by the motion, and what was noted otherwise."""
    o = observation
    corrected = correct_loads(o.rig, o.volts[:, dot_channels(o.psds)] * o.rig.sensitivities.ravel(), o.loads)
    if corrected is None:
        return o, None
    volts = o.volts.copy()
    volts[corrected.unused] = np.nan
    return dataclasses.replace(o, volts=volts, loads=corrected.loads, digest=o.digest or o.hashed()), corrected
