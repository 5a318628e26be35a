# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Dark levels: what each PSD reads with its laser off, and the share of the light that is not the laser's.

Photocurrents add, and an amplifier that divides shows quotients. With laser light S at v_laser and other light b,

    sum W = S + b,    v = (S v_laser + b v_dark)/W,    with the laser off:  W = b,  v = v_dark.

So x, y and sum of a recording with the laser off are all that :class:`psd_deflection.model.detector.VoltsToDots` needs
to take the other light off, and x and y alone must not be subtracted. A constant offset o of the x output is in both
readings, v + o and v_dark + o, and stays: v_laser + o. It is taken off with the zero. An offset of the sum's own
output is taken for light: a share o/S of the gains, which a reference finds as such.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import norm
from scipy.stats import t as student

from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.measure.uncertainty.noise import undithered
from psd_deflection.model.detector import VoltsToDots
from psd_deflection.model.misalignment.rig import is_calibrated, vector_of_rig
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.studies.calibrate.fit import Mask, fewer
from psd_deflection.studies.calibrate.observation import CalibrationRun
from psd_deflection.studies.study import named

PIECES = 20
"""Means that the standard error comes from."""
LEAST = 4.0
"""s without laser that are needed: pieces of ten periods of the mains."""
GUARD = 0.1
"""s after a laser went off, and before it comes on, that are not used."""
DRIFTS = 5.0
"""Standard deviations of a drift."""
MATTERS = 0.5e-6
"""m. Drift and saturation that move no dot by more are no matter."""
CHANNEL_WORDS = ('x', 'y', 'sum')


class DarkLevel(NamedTuple):
    """One PSD with its laser off. ``psd``: its number, from 1. ``volts``, ``sd`` (3,): x, y, sum, V.

    ``before`` (3,): as in the rig file, V. ``lit_sum``: the sum with its laser on, V. ``place`` (2,): where the other
    light pulls to, m. ``half``: half the length of the active area, m. ``seconds``, ``recording``, ``digest``: of what
    it was measured from.
    """

    psd: int
    volts: FloatArray
    sd: FloatArray
    before: tuple[float, float, float]
    lit_sum: float
    place: FloatArray
    half: float
    seconds: float
    recording: str
    digest: str

    @property
    def share(self) -> float:
        """Part of the light that is not the laser's, by which dots move less."""
        return max(float(self.volts[2]), 0.0) / self.lit_sum

    @property
    def share_sd(self) -> float:
        """Its standard deviation."""
        return float(self.sd[2]) / self.lit_sum

    @property
    def residual(self) -> float:
        """What its uncertainty does to a dot at the edge of the active area, m."""
        return self.share_sd * self.half


def dark_levels(runs: Sequence[CalibrationRun], rig: Rig, lit: Sequence[CalibrationRun] = ()) -> list[DarkLevel]:
    """Return the dark level of each PSD, from the longest time in ``runs`` in which its laser is off.

    ``lit``: recordings with the lasers on, for the share; without them it is that of amplifier.sum_nominal. Raises
    RecordingError if a laser is never off for ``LEAST``, if x or y is saturated or a level drifts so that it matters;
    ConfigError if the rig file has the other light already, in an effect or in the gains of a calibration.
    """
    _check(rig)
    return [_level(runs, rig, psd, _lit(lit, rig, psd)) for psd in range(len(rig.psds))]


def values_of_levels(levels: Sequence[DarkLevel]) -> dict[str, object]:
    """Flat values of a rig file."""
    return {f'psd_{level.psd}.dark': [float(f'{v:.6g}') for v in level.volts] for level in levels}


def result_of_levels(levels: Sequence[DarkLevel]) -> dict[str, Any]:
    """As JSON, by PSD."""
    return {
        f'psd_{level.psd}': {
            **{
                name: {'value': float(v), 'sd': float(sd), 'unit': 'V', 'file': before}
                for name, v, sd, before in zip(CHANNEL_WORDS, level.volts, level.sd, level.before, strict=True)
            },
            'share': {'value': level.share, 'sd': level.share_sd, 'unit': ''},
            'place': {'value': level.place.tolist(), 'unit': 'm'},
            'seconds': level.seconds,
            'recording': {'name': level.recording, 'sha256': level.digest},
        }
        for level in levels
    }


def source_of_levels(levels: Sequence[DarkLevel]) -> str:
    """Return the recordings, in words."""
    return ', '.join(dict.fromkeys(named(level.recording, level.digest) for level in levels))


def words_of_level(level: DarkLevel) -> str:
    """Return one PSD in a sentence."""
    sums = f'psd_{level.psd} with its laser off: sum {level.volts[2]:.5f} ± {level.sd[2]:.1g} V'
    if level.volts[2] <= 0.0:
        return f'{sums}: no other light'
    x, y = level.place * 1e3
    return (
        f'{sums} (file {level.before[2]:g} V): {level.share:.3%} of the light pulls to ({x:+.2f}, {y:+.2f}) mm; '
        f'what is left of it moves a dot at the edge by {level.residual * 1e6:.2g} µm'
    )


def check_effects(rig: Rig) -> None:
    """Raise ConfigError if the rig file corrects all readings for an effect that is no parameter of a calibration.

    A calibration reads the detectors without it, so it would be counted twice.
    """
    for active in vector_of_rig(rig).other_effects:
        if any(part.effect.correct is not None and not part.effect.uses for part in active.parts):
            raise ConfigError(
                f'effects: {active.label}: a calibration reads the detectors without it and would count it twice; '
                f"take it out of the file (light that is not the lasers' is measured with --dark)"
            )


def _check(rig: Rig) -> None:
    check_effects(rig)
    if is_calibrated(rig):
        for number, psd in enumerate(rig.psds, start=1):
            if not any(psd.dark):
                raise ConfigError(
                    f'psd_{number}.dark: this rig file was calibrated without it, so its gains hold the other light '
                    f'of that day; give --dark with the recordings of the calibration and the file from before it'
                )


def _limit(rig: Rig) -> float:
    """Return the sum, V, below which the daemon takes a laser for lost."""
    return rig.estimator.sum_min * (0.5 if rig.estimator.splitter else 1.0)


def _lit(lit: Sequence[CalibrationRun], rig: Rig, psd: int) -> float | None:
    """Return the sum with the laser on, V; None if nothing tells."""
    sums = np.concatenate([np.empty(0), *(run.volts[:, 3 * psd + 2] for run in lit)])
    on = sums[sums >= _limit(rig)]
    return float(np.median(on)) if len(on) else None


def longest(off: Mask) -> slice:
    """Return the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], off, [False])).astype(np.int8)))
    starts, ends = edges[::2], edges[1::2]
    if not len(starts):
        return slice(0, 0)
    best = int(np.argmax(ends - starts))
    return slice(int(starts[best]), int(ends[best]))


def _dark_part(run: CalibrationRun, rig: Rig, psd: int) -> slice:
    """Return the longest time without this laser; a lost sample does not end it."""
    with np.errstate(invalid='ignore'):
        lit = run.volts[:, 3 * psd + 2] >= _limit(rig)
    part = longest(~lit)
    guard = round(GUARD * rig.converter.sample_rate_hz)
    first = part.start + (guard if part.start > 0 else 0)
    last = part.stop - (guard if part.stop < len(lit) else 0)
    return slice(first, max(first, last))


def _level(runs: Sequence[CalibrationRun], rig: Rig, psd: int, lit: float | None) -> DarkLevel:
    rate = rig.converter.sample_rate_hz
    columns = slice(3 * psd, 3 * psd + 3)
    parts = [run.volts[_dark_part(run, rig, psd), columns] for run in runs]
    counts = [int(np.isfinite(part).all(axis=1).sum()) for part in parts]
    best = int(np.argmax(counts))
    run, part, seconds = runs[best], parts[best], counts[best] / rate
    if seconds < LEAST:
        sums = run.volts[:, 3 * psd + 2]
        raise RecordingError(
            f'{", ".join(r.name for r in runs)}: the laser of psd_{psd + 1} is off for {seconds:.1f} s; '
            f'a dark level needs {LEAST:g} s with sum{psd + 1} below {_limit(rig):g} V (sum_min), '
            f'and its median is {float(np.nanmedian(sums)):.3f} V'
        )
    mean, sd, drift, drift_sd = mean_and_drift(part, rig.converter.volts_per_count)
    half = 0.5 * max(rig.psds[psd].active_area)
    level = max(float(mean[2]), 0.0)
    lit_sum = rig.amplifier.sum_nominal + level if lit is None else lit
    share = level / lit_sum
    # What a volt of x, of y and of the sum does to a dot: at the edge, where a sum does most.
    moves = np.array([*(share * rig.sensitivities[psd]), half / lit_sum])
    names = [f'{name}{psd + 1}' for name in CHANNEL_WORDS]
    full = rig.converter.full_scale
    for name, values, move in zip(names, part.T, moves, strict=True):
        highest = float(np.nanmax(np.abs(values)))
        if highest >= 0.99 * full and move * full > MATTERS:
            raise RecordingError(
                f'{run.name}: {name} is saturated with the laser off: {highest:.3f} V, converter.full_scale is '
                f'{full:g} V; where the other light falls is not known'
            )
    for name, change, drift_limit, move in zip(names, drift, drift_sd, moves, strict=True):
        if abs(change) > DRIFTS * drift_limit and abs(change) * move > MATTERS:
            raise RecordingError(
                f'{run.name}: {name} drifts with the laser off: by {change * 1e3:+.2f} mV in {seconds:.1f} s, noise '
                f'explains {drift_limit * 1e3:.2f} mV; wait until lamps and daylight are steady'
            )
    zero = np.zeros((1, 3 * len(rig.psds)), dtype=np.float32)
    zero[0, columns] = mean
    place = replace(VoltsToDots.from_rig(rig), dark=()).dots(zero)[0, 2 * psd : 2 * psd + 2]
    return DarkLevel(psd + 1, mean, sd, rig.psds[psd].dark, lit_sum, place, half, seconds, run.name, run.digest)


def mean_and_drift(part: FloatArray, step: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Mean (3,) of ``part`` (n, 3), its standard error, the drift over all of it, and that of noise alone.

    From means of ``PIECES`` pieces, which colour shorter than they are does not correlate, and fewer of them if they
    are correlated all the same (:func:`psd_deflection.studies.calibrate.fit.fewer`). They are few: the standard error
    is as much larger as makes 1.96 of it Student's interval of 95 %. ``step``: of the converter, V.
    """
    pieces = [piece[np.isfinite(piece).all(axis=1)] for piece in np.array_split(part, PIECES)]
    means = np.array([piece.mean(axis=0) for piece in pieces if len(piece)])
    mean = np.nanmean(part, axis=0)
    n = len(means)
    at = (np.arange(n) - (n - 1) / 2.0) / n
    slope = at @ means / float(at @ at)
    same = np.zeros(n, dtype=np.int64)
    sd, drift_sd = np.empty(3), np.empty(3)
    few = float(student.ppf(0.975, n - 1) / norm.ppf(0.975))
    for i in range(3):
        away = means[:, i] - means[:, i].mean()
        residual = away - slope[i] * at
        rounding = undithered(float(np.nanvar(part[:, i])), step)
        sd[i] = (few**2 * float(away @ away) / (n - 1) / n * fewer(away[:, None], same) + rounding) ** 0.5
        drift_sd[i] = (
            float(residual @ residual) / (n - 2) / float(at @ at) * fewer(residual[:, None], same) + rounding
        ) ** 0.5
    return mean, sd, slope, drift_sd
