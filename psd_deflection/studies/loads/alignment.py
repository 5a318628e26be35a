# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""PSDs whose readings are later or earlier than the others': found by their motion, and put on one clock before
anything else is judged."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from psd_deflection.model.simulation.catalogue import effects_of_rig
from psd_deflection.recordings.time_shift import TimeShift, time_shift
from psd_deflection.records import FloatArray, dot_channels
from psd_deflection.rig.config import Rig
from psd_deflection.studies.loads.steps import link_motion
from psd_deflection.studies.loads.thresholds import BRIEF_S, DISTINCT_SD, REACH_S

SKEW = 'channel_skew'
"""The effect of the catalogue that makes one PSD late."""


@dataclass(frozen=True, slots=True)
class LatePsd:
    """``psd`` (from 1) is ``seconds`` later than PSD ``reference``, beside what the rig file says; ``sd``: s.

    ``rows``: by so many samples its readings were moved. ``evidence``: twice the log-likelihood ratio for it.
    """

    psd: int
    reference: int
    seconds: float
    sd: float
    rows: int
    evidence: float

    @property
    def where(self) -> str:
        """``psd_2``."""
        return f'psd_{self.psd}'

    def words(self, name: str) -> str:
        """What is wrong, and what to do; ``name``: of the recording."""
        n, direction = self.psd, 'later' if self.seconds > 0.0 else 'earlier'
        way = 'up' if self.rows > 0 else 'down'
        return (
            f"PSD {n}'s readings in {name} are {in_ms(self.seconds, self.sd)} {direction} than PSD {self.reference}'s: "
            f'two clocks, or a logger that holds one back. Sample both at once, or move the columns '
            f'x{n}, y{n}, sum{n} {abs(self.rows)} rows {way}; the rest is judged with them moved'
        )

    def tree(self) -> dict[str, object]:
        """As JSON has it."""
        return asdict(self)


def in_ms(value: float, sd: float) -> str:
    """``40.00 ms ± 0.03 ms``: the size of ``value`` with the digits that ``sd`` leaves, both s."""
    digits = max(0, 1 - int(np.floor(np.log10(max(1e3 * sd, 1e-4)))))
    return f'{abs(1e3 * value):.{digits}f} ms ± {1e3 * sd:.{digits}f} ms'


def aligned(rig: Rig, volts: FloatArray, loads: FloatArray) -> tuple[FloatArray, tuple[LatePsd, ...]]:
    """Return ``volts`` (n, 3P) with all PSDs on one clock, to the nearest sample, and those that were late or early.

    ``volts`` of the PSDs, V, NaN if a sample is lost; ``loads`` (n, 3) N, N, N m, held: which PSD is in time is the one
    that agrees with them, the first PSD if they do not tell. A delay that the rig file lists stays.
    """
    psds, period = len(rig.psds), 1.0 / rig.converter.sample_rate_hz
    dots = volts[:, dot_channels(psds)].reshape(len(volts), psds, 2)
    listed = _listed_delays(rig)
    shifts = [TimeShift(0.0, 0.0)]
    for k in range(1, psds):
        shifts.append(time_shift(dots[:, 0], dots[:, k], period, REACH_S, listed[k] - listed[0]))
    later = [f.seconds - listed[k] + listed[0] if f.evidence else 0.0 for k, f in enumerate(shifts)]
    rows = [round(late / period) for late in later]
    if not any(rows):
        return volts, ()
    on_first = _moved(volts, rows)
    notes = time_shift(link_motion(rig, loads), on_first[:, dot_channels(psds)], period, REACH_S)

    if notes.unknown and max(map(abs, later)) > BRIEF_S:
        return volts, ()

    def off(k: int) -> tuple[int, float]:
        """PSDs that are not on the clock of PSD ``k``, and s by which the others then lag behind the loads."""
        lag = 0.0 if notes.unknown else notes.seconds
        return sum(r != rows[k] for r in rows), abs(lag + later[k]) + (DISTINCT_SD * notes.sd if k else 0.0)

    r = min(range(psds), key=off)
    moved = [n - rows[r] for n in rows]
    late = [
        LatePsd(k + 1, r + 1, later[k] - later[r], max(shifts[k].sd, shifts[r].sd), moved[k], _largest(shifts, k, r))
        for k in range(psds)
        if moved[k]
    ]
    return _moved(volts, moved), tuple(late)


def _listed_delays(rig: Rig) -> list[float]:
    """How late each PSD is by the effects of the rig file, s."""
    out = [0.0] * len(rig.psds)
    for active in effects_of_rig(rig):
        if active.effect.name == SKEW:
            out[int(active.values['psd']) - 1] += active.values['delay']
    return out


def _largest(shifts: Sequence[TimeShift], *psds: int) -> float:
    return max(shifts[k].evidence for k in psds)


def _moved(volts: FloatArray, rows: Sequence[int]) -> FloatArray:
    """``volts`` (n, 3P) with the readings of each PSD so many ``rows`` earlier; NaN where there are none."""
    out = np.full_like(volts, np.nan)
    for k, offset in enumerate(rows):
        psd = slice(3 * k, 3 * k + 3)
        here = volts[max(offset, 0) : len(volts) + min(offset, 0), psd]
        out[max(-offset, 0) : max(-offset, 0) + len(here), psd] = here
    return out
