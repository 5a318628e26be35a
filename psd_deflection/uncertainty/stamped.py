"""The dots of one block at its stamp and how sure they are: by the rule that the rig asks for.

Joins what is measured of the noise (:mod:`psd_deflection.uncertainty.noise`), the fit through the block
(:mod:`psd_deflection.uncertainty.block_fit`) and the check of the four readings against each other
(:mod:`psd_deflection.uncertainty.consistency`), and tells what they remember.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from psd_deflection.calibration import dot_noise_variances
from psd_deflection.config import Rig
from psd_deflection.records import FloatArray, IntArray
from psd_deflection.uncertainty.block_fit import BlockFit, Fitted
from psd_deflection.uncertainty.consistency import LIMIT, NAMES, UNMEASURED, Checked, Consistency, Suspect
from psd_deflection.uncertainty.noise import StreamNoise

NOISE, FIT, HELD_RESIDUAL = 'state.noise', 'state.block_fit', 'state.residual'
"""Names under which :meth:`StampedDots.memory` tells what is remembered."""


class StampedDots:
    """Dots at the stamp of block after block.

    ``active``: whether it says more than the mean of the samples and the rig file's noise. ``contradictions``: blocks
    whose readings contradict each other. ``misfits``: blocks with motion that the fit cannot follow. ``chi_square``:
    of the last block's readings.
    """

    def __init__(self, rig: Rig, flat: bool = True) -> None:
        """``flat``: the PSDs are on the plate, and the base line between the dots keeps its length."""
        config = rig.estimator
        self.flat = flat
        poly = config.block_fit == 'poly'
        # What does not move with the link tells the noise.
        self._measures = flat and config.covariance != 'file'
        self.active = poly or self._measures
        self._beams = rig.centers + rig.zeros
        variances = dot_noise_variances(rig)
        steps = rig.converter.volts_per_count * rig.sensitivities.ravel()
        self.noise = StreamNoise(config.block_size, rig.centers, self._beams, variances, steps)
        self._stated_sd = np.sqrt(variances)
        self._fit = BlockFit(config.block_size, rig.centers, self._beams, poly)
        self._fit.set_noise(self.noise.gamma)
        self._consistency = Consistency()
        self._suspect = Suspect(rig.centers, self._beams)
        self._size = config.block_size
        self.contradictions = 0
        self.chi_square = 0.0
        self.misfits = 0
        (x1, y1), (x2, y2) = rig.centers.tolist()
        self._apart = (x1 - x2, y1 - y2)

    def set_zeros(self, rig: Rig) -> None:
        """Take the rig's zeros from now on."""
        self._beams = rig.centers + rig.zeros
        self.noise.set_geometry(rig.centers, self._beams)
        self._fit.set_geometry(rig.centers, self._beams)
        self._fit.set_noise(self.noise.gamma)
        self._suspect = Suspect(rig.centers, self._beams)
        self._consistency = Consistency()

    def fit(self, slots: IntArray, samples: FloatArray) -> Fitted:
        """The dots at the middle of a block. ``slots`` (n,): which samples are present; ``samples`` (n, 4), m."""
        fitted = self._fit.fit(slots, samples)
        self.misfits += fitted.misfit
        return fitted

    def mean_variances(self, present: int) -> tuple[float, ...]:
        """Variance (4,), m^2, of the mean of that many samples of each reading."""
        more = self._size / present
        return tuple(more * sd * sd for sd in self.noise.mean_sd().tolist())

    def check(self, dots: tuple[float, ...], residual: tuple[float, ...], covariance: FloatArray) -> Checked:
        """Hold the four readings of a block against each other."""
        x1, y1, x2, y2 = dots
        ax, ay = self._apart
        sure = self.noise.measured or not self._measures
        limit = LIMIT if sure else UNMEASURED * LIMIT
        checked = self._consistency.check((ax + x1 - x2, ay + y1 - y2), residual, covariance, limit=limit)
        self.contradictions += checked.contradict
        self.chi_square = checked.chi_square
        return checked

    def learn(self, index: int, slots: IntArray, samples: FloatArray) -> bool:
        """Take a good block into what is known of the noise; True if that changed.

        Nothing of this block's estimate waits for it.
        """
        if not (self._measures and self.noise.add(index, slots, samples)):
            return False
        self._fit.set_noise(self.noise.gamma)
        return True

    def suspect(self, index: int, dots: tuple[float, ...], checked: Checked) -> None:
        """Take a block into the search for a wrong reading: each that contradicts itself, of the others some."""
        if checked.contradict or index % 10 == 0:
            self._suspect.add(dots, checked.errors)

    def most_likely_wrong(self) -> str:
        """The reading that is most likely wrong and what is wrong with it, or '' if it cannot be told."""
        return self._suspect.most_likely(float(self.noise.mean_sd().max()))

    def noise_source(self) -> str:
        """Where the noise that covariances use comes from, in words."""
        if not self.noise.measured:
            return 'of the rig file until it is measured'
        return 'measured at rest' if self.noise.at_rest else 'measured in motion'

    def words(self) -> tuple[tuple[str, str], ...]:
        """For /diagnostics: the check of the readings, and the noise against the rig file's."""
        return (
            ('chi-square of the readings', f'{self.chi_square:.2f}'),
            # The survival function for one degree of freedom.
            ('p of that chi-square', f'{math.erfc(math.sqrt(0.5 * self.chi_square)):.2g}'),
            ('blocks whose readings contradict each other', str(self.contradictions)),
            ('blocks with motion that the fit cannot follow', str(self.misfits)),
            ('covariance from', f'noise {self.noise_source()}' if self._measures else 'noise of the rig file'),
            *(self.noise_words() if self._measures else ()),
        )

    def noise_words(self) -> tuple[tuple[str, str], ...]:
        """Of each reading, the noise of a sample and of a block's mean against the rig file's, um."""
        stated = self._stated_sd * 1e6
        rows = zip(NAMES, self.noise.sample_sd(), self.noise.mean_sd(), stated, stated / self._size**0.5, strict=True)
        return tuple(
            (
                f'noise of {name} (um)',
                f'{a * 1e6:.3f} a sample (rig file {file:.3f}), {b * 1e6:.3f} a block ({mean:.3f})',
            )
            for name, a, b, file, mean in rows
        )

    def memory(self) -> dict[str, tuple[float, ...]]:
        """What the next block depends on. The noise begins a new segment, here as where it is restored."""
        out: dict[str, tuple[float, ...]] = {}
        if self._measures:
            self.noise.forget_segment()
            out[NOISE] = self.noise.state()
        if self.active:
            out[FIT] = self._fit.state()
        if self._consistency.held > 0.0:
            out[HELD_RESIDUAL] = (self._consistency.held,)
        return out

    def restore(self, values: Mapping[str, tuple[float, ...]]) -> None:
        """Go on from another one's :meth:`memory`. Raises ValueError if it had another block size."""
        if NOISE in values:
            self.noise.set_state(values[NOISE])
            self._fit.set_noise(self.noise.gamma)
        if FIT in values:
            self._fit.set_state(values[FIT])
        if HELD_RESIDUAL in values:
            (self._consistency.held,) = values[HELD_RESIDUAL]
