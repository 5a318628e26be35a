"""What remains without a name, as one smooth function of named variables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit
from psd_deflection.studies.discover.search.hold_out import unseen_gap
from psd_deflection.studies.discover.search.localise import Localisation

STRONG_P = 1e-3
"""Largest library-wide p of a regressor that takes part."""
MOST_REGRESSORS = 24
"""Regressors, over all channels, that take part at most: the strongest."""

Table = Sequence[tuple[str, Mapping[str, Sequence[FloatArray]]]]
"""Of each channel its name and its regressors (n,) of each recording, by name."""


@dataclass(frozen=True, slots=True)
class Remainder:
    """``depends_on``: names of variables. ``rms``: what a polynomial of them explains, beyond what then is left;
    ``heldout``: the gap that it leaves on unseen load cases. In the unit of the gap.
    """

    depends_on: tuple[str, ...]
    rms: float
    heldout: float


def remainder_of(ws: Comparison, fit: Fit, left: Localisation, table: Table) -> Remainder | None:
    """What ``fit`` leaves as a sum of those terms of ``table`` that ``left`` found strong.

    None if there are none, or if they predict nothing on unseen load cases.
    """
    strong = [d for d in left.dependences if d.p < STRONG_P][:MOST_REGRESSORS]
    if not strong:
        return None
    columns = [fit.jacobian[:, j] for j, name in enumerate(fit.free) if name not in fit.at_bound]
    channels = [name for name, _ in table]
    for d in strong:
        c = channels.index(d.channel)
        columns.append(_as_vector(ws, c, ws.row(c, table[c][1][d.regressor])))
    heldout = unseen_gap(ws, fit, np.column_stack(columns))
    before = ws.gap(fit.difference)
    if heldout >= before:
        return None
    names = tuple(dict.fromkeys(d.regressor for d in strong))
    return Remainder(names, float(np.sqrt(before**2 - heldout**2)), heldout)


def _as_vector(ws: Comparison, channel: int, row: FloatArray) -> FloatArray:
    """The vector (D,) that is ``row``, whitened, on one channel and 0 on the others."""
    parts = ws.split(np.zeros(sum(m.size for m in ws.measured)))
    at = 0
    for part in parts:
        n = part.shape[1]
        part[channel] = row[at : at + n]
        at += n
    return np.concatenate([part.ravel() for part in parts])
