# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Times in which loads were hung and taken off, and none was noted: somebody stopped, or a file has zeros there.

A load or two are found one by one (:mod:`.plateaus`). Where many are missing, nobody knows what hung: that time is left
out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from psd_deflection.records import FloatArray
from psd_deflection.studies.loads.plateaus import PLATE, PLATE_M, SHARE, STANDS_OUT, TOLERANCE, PlateauLoads

MANY = 3
"""Changes that nobody noted, during one annotated load."""


@dataclass(frozen=True, slots=True)
class UnannotatedTime:
    """Samples ``first`` to ``last`` of ``samples``, in which ``changes`` of the load were not noted. ``period``: s from
    one sample to the next.
    """

    first: int
    last: int
    samples: int
    changes: int
    period: float

    @property
    def name(self) -> str:
        """Of the finding."""
        return 'load_coverage'

    @property
    def where(self) -> str:
        """The loads."""
        return 'load_fx load_fy load_tz'

    @property
    def value(self) -> float:
        """Share of the recording."""
        return (self.last - self.first) / self.samples

    @property
    def size(self) -> float:
        """The same."""
        return self.value

    def words(self, name: str) -> str:
        """What was wrong, and what to do; ``name``: of the recording."""
        end = 'the end' if self.last == self.samples else f'{self.last * self.period:.3f} s'
        return (
            f'{name}: from {self.first * self.period:.3f} s to {end} the load changed {self.changes} times, and nobody '
            'noted it: note each change; this time is left out'
        )


def unannotated_times(implied: PlateauLoads, samples: int, period: float) -> list[UnannotatedTime]:
    """Those of a recording of so many ``samples``; none if no annotated load would be left. ``period``: s from one
    sample to the next.

    A change counts if the plate moves with it by what no effect does to the annotated load.
    """
    allowed = STANDS_OUT * (TOLERANCE + SHARE * np.abs(implied.annotated).max(initial=0.0))
    out = []
    numbered = groupby(range(len(implied.plateaus)), key=lambda k: implied.plateaus[k].number)
    for _, group in numbered:
        in_group = list(group)
        more = implied.more[in_group]
        steps = np.abs(np.diff(more, axis=0)).max(axis=1) > allowed
        alone = [
            k for k, stepped in zip(in_group[1:], steps, strict=True) if stepped and implied.plateaus[k].unannotated
        ]
        as_plate = np.abs(implied.across[in_group]).max() <= PLATE * float(implied.sizes[in_group].max()) + PLATE_M
        if len(alone) >= MANY and as_plate:
            first, last = implied.plateaus[alone[0]].first, implied.plateaus[in_group[-1]].last
            out.append(UnannotatedTime(first, last, samples, len(alone), period))
    remaining = [
        p for p in implied.plateaus if not any(u.first <= p.first < u.last for u in out) and np.any(p.annotated != 0.0)
    ]
    return out if remaining else []


def without_times(volts: FloatArray, times: Sequence[UnannotatedTime]) -> FloatArray:
    """``volts`` (n, 3P) without these."""
    out = volts.copy()
    for u in times:
        out[u.first : u.last] = np.nan
    return out
