# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What remains without a name, by the named variables that it follows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit
from psd_deflection.studies.discover.search.hold_out import unseen_gap
from psd_deflection.studies.discover.search.localise import Localisation
from psd_deflection.studies.discover.search.smooth import Smooth
from psd_deflection.studies.discover.search.weighing import Unknown

STRONG_P = 1e-3
"""Largest library-wide p of a regressor that takes part."""
MOST_REGRESSORS = 24
"""Regressors, over all channels, that take part at most: the strongest."""

Table = Sequence[tuple[str, Mapping[str, Sequence[FloatArray]]]]
"""Of each channel its name and its regressors (n,) of each recording, by name."""


@dataclass(frozen=True, slots=True)
class Remainder:
    """``depends_on``: names of variables. ``rms``: what a polynomial of them explains, beyond what then is left;
    ``heldout``: the gap that it leaves on unseen load cases. In the unit of the gap. ``function``: it, if that is one
    smooth function.
    """

    depends_on: tuple[str, ...]
    rms: float
    heldout: float
    function: Smooth | None = None

    @classmethod
    def of(cls, function: Smooth) -> Remainder:
        """Return a smooth function."""
        rms = float(np.sqrt(function.before**2 - function.heldout**2))
        return cls(function.variables, rms, function.heldout, function)

    def tree(self) -> dict[str, Any]:
        """As JSON has it."""
        return {'depends_on': list(self.depends_on), 'rms': self.rms, 'heldout': self.heldout}

    def unknown(self, ws: Comparison, share: float) -> Unknown:
        """In words; ``share``: of the gap's energy that it explains."""
        names = ' and '.join(self.depends_on)
        words = f'a smooth function of {names} that has no name, {ws.worded(self.rms)} rms; '
        words += f'with it {ws.worded(self.heldout)} remain on unseen cases'
        return Unknown(words, self.depends_on, share, rms=self.rms)


def remainder_of(ws: Comparison, fit: Fit, residual: Localisation, table: Table) -> Remainder | None:
    """What ``fit`` leaves as a sum of those terms of ``table`` that ``residual`` found strong.

    None if there are none, or if they predict nothing on unseen load cases.
    """
    strong = [d for d in residual.dependences if d.p < STRONG_P][:MOST_REGRESSORS]
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
    """Return the vector (D,) that is ``row``, whitened, on one channel and 0 on the others."""
    parts = ws.split(np.zeros(sum(m.size for m in ws.measured)))
    at = 0
    for part in parts:
        n = part.shape[1]
        part[channel] = row[at : at + n]
        at += n
    return np.concatenate([part.ravel() for part in parts])
