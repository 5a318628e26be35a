# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Checks lasers and detectors from a block's samples before it is solved: a fault makes one detector unreliable, a
finding is a warning. One count goes on: blocks in a row in which a detector's values did not change."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import gt, neg

import numpy as np

from psd_deflection.base.arithmetic import FIXED
from psd_deflection.base.errors import ConfigError
from psd_deflection.measure.averaging import BlockMeasures
from psd_deflection.measure.state import State, Value, mismatch, numbers
from psd_deflection.records import FLAG_OVER_RANGE, BlockStatus, SampleBlock, channel_names, dot_names
from psd_deflection.rig.config import Rig

FROZEN_BLOCKS = 5
"""Blocks in a row in which x, y and sum do not change by one bit, which noise would prevent."""

NOISY = 5.0
"""Times the noise of the rig file."""

FROZEN = 'state.frozen_blocks'
"""Name under which the counts of :class:`Stillness` are recorded."""

LOUD = 'state.noisy'
"""Name under which what :class:`Loudness` has is recorded."""

LOUD_BLOCKS = 50
"""Blocks over which the noise of a noisy detector is averaged: one block tells it within 25 %, so many within 3 %."""

QUIET_BLOCKS = 10
"""Blocks in a row without it after which a noise is over."""

HALF_LIGHT = (0.35, 0.65)
"""Fraction of ``sum_nominal`` on all detectors if one of the splitter's two lasers fails."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """``faulty``: the faulty detector (from 1), 0 if it is none or several. ``faults``: all faulty detectors.

    ``sound``: the others (from 0), if there are faulty ones and samples enough to go on without them.
    ``half_light``: the splitter works with one of its two lasers.
    """

    status: BlockStatus
    reason: str
    faulty: int
    findings: tuple[str, ...] = ()
    half_light: bool = False
    faults: frozenset[int] = frozenset()
    sound: tuple[int, ...] = ()


def _long(frozen: tuple[int, ...]) -> list[tuple[int, str]]:
    """(PSD, message) for each PSD whose values have not changed for too long."""
    return [
        (psd, f'psd_{psd} stands still: no bit has moved for {blocks} blocks')
        for psd, blocks in enumerate(frozen, start=1)
        if blocks >= FROZEN_BLOCKS
    ]


def _first_of_each(faults: Iterable[tuple[int, BlockStatus, str]]) -> dict[int, tuple[BlockStatus, str]]:
    """Return the first fault of each PSD."""
    out: dict[int, tuple[BlockStatus, str]] = {}
    for psd, status, reason in faults:
        out.setdefault(psd, (status, reason))
    return out


class Stillness:
    """``blocks`` (P,): for how many blocks in a row each detector's values have not changed."""

    part = 'the count of blocks whose values do not change'
    prefixes = (FROZEN,)

    def __init__(self, psds: int) -> None:
        self.blocks: tuple[int, ...] = (0,) * psds

    def state_dict(self) -> State:
        """The counts, if there are any."""
        return {FROZEN: self.blocks} if any(self.blocks) else {}

    def load_state_dict(self, values: Mapping[str, Value]) -> None:
        """Take the counts. Raises ValueError if they are of another number of PSDs."""
        row = numbers(values, FROZEN, 'one count for each PSD', len(self.blocks))
        if row is not None:
            self.blocks = tuple(map(int, row))


class Loudness:
    """How noisy the noisy detectors are: x, y and sum of each, averaged since it became so. Nothing of the others."""

    part = 'the noise of noisy detectors'
    prefixes = (LOUD,)

    def __init__(self) -> None:
        # By PSD: blocks that were averaged, blocks in a row that were quiet, mean squares of x, y and sum, V^2.
        self._noises: dict[int, tuple[float, ...]] = {}  # Bound: the rig: at most six.

    def take(self, psd: int, level: Sequence[float], noisy: bool) -> list[float]:
        """Take a block of detector ``psd`` (from 1): rms of x, y, sum, V; return those of the last blocks, V."""
        if not noisy and psd not in self._noises:
            return list(level)
        blocks, quiet, *squares = self._noises.get(psd, (0.0, 0.0, 0.0, 0.0, 0.0))
        quiet = 0.0 if noisy else quiet + 1.0
        if not noisy and (blocks == 0.0 or quiet > QUIET_BLOCKS):
            self._noises.pop(psd, None)
            return list(level)
        blocks = min(blocks + 1.0, float(LOUD_BLOCKS))
        squares = [old + (new * new - old) / blocks for old, new in zip(squares, level, strict=True)]
        self._noises[psd] = (blocks, quiet, *squares)
        return [math.sqrt(square) for square in squares]

    def state_dict(self) -> State:
        """The noises, if there are any."""
        rows = [(float(psd), *noise) for psd, noise in sorted(self._noises.items())]
        return {LOUD: tuple(value for row in rows for value in row)} if rows else {}

    def load_state_dict(self, values: Mapping[str, Value]) -> None:
        """Take the noises. Raises ValueError if they are no rows of six."""
        row = numbers(values, LOUD, 'six numbers for each noisy detector') or ()
        if len(row) % _LOUD_ROW or not all(0.0 <= value < math.inf for value in row):
            raise mismatch(LOUD, row, 'six numbers for each noisy detector')
        self._noises = {int(row[at]): row[at + 1 : at + _LOUD_ROW] for at in range(0, len(row), _LOUD_ROW)}


_LOUD_ROW = 6


class OpticsHealth:
    """Judges blocks by the rig's limits."""

    def __init__(self, rig: Rig) -> None:
        config = rig.estimator
        self._xp = FIXED
        self._psds = len(rig.psds)
        self._size = config.block_size
        self._min_samples = min(config.min_samples, config.block_size)
        self._splitter = config.splitter
        self._nominal = rig.amplifier.sum_nominal
        # If two lasers share all detectors, half the light does not mean a lost laser.
        self._sum_min = config.sum_min * (0.5 if self._splitter else 1.0)
        self._sum_max = config.sum_max
        self.rejects_frozen = config.frozen == 'reject'
        step = rig.converter.volts_per_count
        self._full_scale = rig.converter.full_scale
        # The converter's last step on either side: the true value may lie beyond it.
        self._rail = float(np.float32((2 ** (rig.converter.bits - 1) - 1) * step))
        self._half = tuple(half / 2.0 for psd in rig.psds for half in psd.active_area)
        self._radius = tuple(psd.spot_radius for psd in rig.psds for _ in range(2))
        # If the noise is below one step, constant values are normal.
        self._moves = [bool((noise > step).any()) for noise in rig.noises]
        self._noise = (NOISY * np.sqrt(rig.noises**2 + step**2 / 12.0)).tolist()

    def still(self, measures: BlockMeasures) -> tuple[bool, ...]:
        """For each PSD: whether x, y and sum are identical in all samples."""
        if len(measures.volts) < max(self._min_samples, 2):
            return (False,) * self._psds
        return tuple([moves and same for moves, same in zip(self._moves, measures.same, strict=True)])

    def frozen(self, before: tuple[int, ...], measures: BlockMeasures) -> tuple[int, ...]:
        """Blocks in a row without change, per PSD, with this block; ``before``: without it."""
        return tuple([n + 1 if same else 0 for n, same in zip(before, self.still(measures), strict=True)])

    def classify(self, block: SampleBlock, measures: BlockMeasures, frozen: tuple[int, ...]) -> Verdict:
        """The block's verdict, causes before consequences.

        ``frozen``: blocks in a row without change, per PSD. ``x1`` in a reason is PSD 1's x, whatever channel it is on.
        """
        present, enough = len(block.seq), len(block.seq) >= self._min_samples
        least, most, dots = measures.least, measures.most, measures.means
        low, high = least[2::3], most[2::3]
        faults = _first_of_each([*self._dark(low), *self._saturated(least, most)])
        if not faults and bool((block.flags & FLAG_OVER_RANGE).any()):
            return Verdict(BlockStatus.SATURATED, 'the device reports a channel over range', 0)
        if self.rejects_frozen:
            faults = _first_of_each((psd, BlockStatus.FROZEN, reason) for psd, reason in _long(frozen)) | faults
        if not enough and not faults:
            reason = f'{present} of {self._size} samples, at least {self._min_samples} are needed'
            return Verdict(BlockStatus.TOO_FEW_SAMPLES, reason, 0)
        faults = _first_of_each(self._outside(dots)) | faults
        half_light = self._half_light(low) if self._splitter else False
        findings = self._findings(dots, high, set(faults), half_light)
        if not faults:
            return Verdict(BlockStatus.OK, '', 0, findings, half_light)
        return self._faulty(faults, enough, findings, half_light)

    def _faulty(
        self, faults: dict[int, tuple[BlockStatus, str]], enough: bool, findings: tuple[str, ...], half_light: bool
    ) -> Verdict:
        """Return the verdict of the worst cause: a lost laser explains a saturated or outside reading."""
        psd = min(faults, key=lambda p: (_ORDER.index(faults[p][0]), p))
        status, reason = faults[psd]
        lone = len(faults) == 1 and enough
        sound = tuple(i for i in range(self._psds) if i + 1 not in faults) if enough else ()
        return Verdict(status, reason, psd if lone else 0, findings, half_light, frozenset(faults), sound)

    def _dark(self, low: list[float]) -> Iterator[tuple[int, BlockStatus, str]]:
        for psd, least in enumerate(low, start=1):
            if least < self._sum_min:
                reason = f'laser {psd} lost: sum {least:.3f} V, below {self._sum_min:g} V'
                yield psd, BlockStatus.LASER_LOST, reason

    def _saturated(self, least: list[float], most: list[float]) -> list[tuple[int, BlockStatus, str]]:
        sizes = list(map(max, most, map(neg, least)))
        if max(sizes) < self._rail:
            return []
        return [
            (
                1 + column // 3,
                BlockStatus.SATURATED,
                f'{name} saturated: {size:.3f} V, converter.full_scale is {self._full_scale:g} V',
            )
            for column, (name, size) in enumerate(zip(channel_names(self._psds), sizes, strict=True))
            if size >= self._rail
        ]

    def _outside(self, dots: tuple[float, ...]) -> Iterator[tuple[int, BlockStatus, str]]:
        for column, (name, dot, half) in enumerate(zip(dot_names(self._psds), dots, self._half, strict=True)):
            if abs(dot) > half:
                reason = f'{name} at {dot * 1e3:.3f} mm, outside the active area'
                yield 1 + column // 2, BlockStatus.OUTSIDE_ACTIVE_AREA, reason

    def _half_light(self, low: list[float]) -> bool:
        return all(HALF_LIGHT[0] * self._nominal < s < HALF_LIGHT[1] * self._nominal for s in low)

    def _findings(
        self, dots: tuple[float, ...], high: list[float], faulty: set[int], half_light: bool
    ) -> tuple[str, ...]:
        out = []
        if half_light:
            out.append('one of the two lasers is out: half the light on both detectors')
        for psd in range(1, self._psds + 1):
            if psd in faulty:
                continue
            if high[psd - 1] > self._sum_max:
                out.append(f'psd_{psd} sees other light: sum {high[psd - 1]:.3f} V, above {self._sum_max:g} V')
            for column in (2 * psd - 2, 2 * psd - 1):
                if abs(dots[column]) + self._radius[column] > self._half[column]:
                    out.append(f'psd_{psd}: the spot is clipped at the edge')
                    break
        return tuple(out)

    def late_findings(
        self, measures: BlockMeasures, verdict: Verdict, frozen: tuple[int, ...], loudness: Loudness
    ) -> tuple[str, ...]:
        """Findings computed after the estimate: a noisy detector, a detector whose values do not change.

        ``loudness``: goes on with this block.
        """
        faulty = verdict.faults
        out = []
        if len(measures.volts) == self._size >= 10:
            for psd in range(1, self._psds + 1):
                rough = measures.rough[3 * psd - 3 : 3 * psd]
                noisy = psd not in faulty and any(map(gt, rough, self._noise[psd - 1]))
                usual = loudness.take(psd, rough, noisy)
                if noisy:
                    out.append(f'psd_{psd} is noisy: {max(usual) * 1e3:.1f} mV a sample')
        if not self.rejects_frozen:
            out += [reason for psd, reason in _long(frozen) if psd not in faulty]
        return tuple(out)

    def background_variance(self, sums: Sequence[float]) -> tuple[float, ...]:
        """Variance (m^2) that other light may have added to a dot of each PSD; 0 if there is none.

        Background light of fraction b shifts a reading by b (x_b - x). Its centre x_b is unknown. If
        x_b is uniform over the active area, the shift has a variance of (b L/2)^2 / 3. ``sums`` (P,): means, V.
        """
        out = []
        for psd in range(self._psds):
            total = sums[psd]
            share = max(total - self._nominal, 0.0) / total if total > self._sum_max else 0.0
            out.append(self._xp.square(share * max(self._half[2 * psd : 2 * psd + 2])) / 3.0)
        return tuple(out)


_ORDER = (BlockStatus.LASER_LOST, BlockStatus.SATURATED, BlockStatus.FROZEN, BlockStatus.OUTSIDE_ACTIVE_AREA)


class CalibratedRange:
    """The poses that the calibration of a rig was made with (``calibration.range``)."""

    def __init__(self, rig: Rig) -> None:
        """Raises ConfigError if the range is none."""
        given = rig.calibration.range
        if given != _UNKNOWN and (len(given) != 6 or any(a > b for a, b in zip(given[:3], given[3:], strict=True))):
            raise ConfigError(
                f'calibration.range: {len(given)} values {list(given)}: must be the least dx, dy, theta, then the '
                f'largest; take them from a calibration unchanged'
            )
        self._axes = list(zip(('dX', 'dY', 'theta'), given[:3], given[3:], _SHOWN, strict=False)) if given[1:] else []

    def findings(self, pose: tuple[float, float, float]) -> tuple[str, ...]:
        """What to say of ``pose``: dX, dY m, theta rad. Outside the range no calibration vouches for the covariance."""
        out = [
            f'{name} {scale * value:.3g} {unit} ({scale * low:.3g} to {scale * high:.3g})'
            for value, (name, low, high, (scale, unit)) in zip(pose, self._axes, strict=False)
            if not low <= value <= high
        ]
        return (f'outside the calibrated range: {", ".join(out)}',) if out else ()


_UNKNOWN = (0.0,)
_SHOWN = ((1e3, 'mm'), (1e3, 'mm'), (math.degrees(1.0), 'deg'))
