# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Which channel of the device carries which axis of which PSD, and with which sign.

The samples that are recorded and published stay as the device sends them. Everything that judges or solves them
takes them through the wiring of the rig file first: here, live and in replay alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from psd_deflection.rig.config import Rig

Number = TypeVar('Number', np.float32, np.float64)


@dataclass(frozen=True, slots=True)
class Wiring:
    """``exchanged``: the device's x1 y1 sum1 come from PSD 2, its x2 y2 sum2 from PSD 1.

    ``axes``: for each PSD which channels of the device are its x and its y, with their signs: ``('-y', 'x')``.
    ``crossed``: two other PSDs (from 1), each on the input of the other; no parameter says that, so no rig has it.
    """

    exchanged: bool = False
    axes: tuple[tuple[str, str], ...] = (('x', 'y'), ('x', 'y'))
    crossed: tuple[int, ...] = ()

    @classmethod
    def from_rig(cls, rig: Rig) -> Wiring:
        """The wiring of the rig's parameters, which are checked."""
        return cls(rig.acquisition.psds_exchanged, tuple(psd.axes for psd in rig.psds))

    @property
    def nominal(self) -> bool:
        """Whether every PSD is wired as the channels are named."""
        return not self.exchanged and not self.crossed and self.axes == (('x', 'y'),) * len(self.axes)

    def input_of(self, psd: int) -> int:
        """Of a PSD (from 1), the input of the device that it is wired to: 1 is x1 y1 sum1, 2 is x2 y2 sum2 ..."""
        if psd in self.crossed:
            psd = sum(self.crossed) - psd
        return 3 - psd if self.exchanged and psd <= 2 else psd

    @property
    def columns(self) -> tuple[int, ...]:
        """The device's column of x, y and sum of each PSD in turn."""
        out: list[int] = []
        for psd, axes in enumerate(self.axes, start=1):
            first = 3 * (self.input_of(psd) - 1)
            out += [first + ('x', 'y').index(axis[-1]) for axis in axes] + [first + 2]
        return tuple(out)

    @property
    def signs(self) -> tuple[float, ...]:
        """The sign of x, y and sum of each PSD in turn."""
        out: list[float] = []
        for axes in self.axes:
            out += [-1.0 if axis.startswith('-') else 1.0 for axis in axes] + [1.0]
        return tuple(out)

    def to_psds(self, volts: npt.NDArray[Number]) -> npt.NDArray[Number]:
        """Volts of the PSDs (n, 3P), x y sum of each, from those of the device's channels (n, 3P)."""
        if self.nominal:
            return volts
        return volts[:, self.columns] * np.array(self.signs, volts.dtype)

    def to_device(self, volts: npt.NDArray[Number]) -> npt.NDArray[Number]:
        """Volts on the device's channels (n, 3P) from those of the PSDs (n, 3P), x y sum of each."""
        if self.nominal:
            return volts
        out = np.empty_like(volts)
        out[:, self.columns] = volts * np.array(self.signs, volts.dtype)
        return out
