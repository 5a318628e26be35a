# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Whether the link of a recording vibrates faster than a block can follow."""

from __future__ import annotations

from typing import Any

import numpy as np

from psd_deflection.base.arithmetic import FIXED
from psd_deflection.base.errors import ConfigError
from psd_deflection.measure.uncertainty.combinations import combinations_of
from psd_deflection.measure.uncertainty.noise import SEGMENT_BLOCKS
from psd_deflection.measure.uncertainty.vibration import Tone, ToneSearch, rms_of
from psd_deflection.model.detector import VoltsToDots
from psd_deflection.recordings.recording import Recording
from psd_deflection.records import FloatArray, IntArray, SampleBlock
from psd_deflection.rig.config import Rig, rig_from_values

_LEAST_SHARE = 0.5
"""A second of which fewer samples are present, with the light on, tells nothing."""


class RecordedVibration:
    """Takes the blocks of a recording one by one. ``seconds``: segments of 50 blocks that could be judged."""

    def __init__(self, rig: Rig) -> None:
        self._rate = rig.converter.sample_rate_hz
        self._size = rig.estimator.block_size
        xp = FIXED
        self._xp = xp
        self._calibration = VoltsToDots.from_rig(rig)
        self._combinations = combinations_of(rig.centers, rig.centers + rig.zeros, xp=xp)
        self._turn = self._combinations.turn[: self._combinations.moving]
        self._light = rig.estimator.sum_min
        self._volt = rig.sensitivities.mean(axis=1)
        self._channels = 3 * len(rig.psds)
        self._search = ToneSearch(self._size, SEGMENT_BLOCKS, xp)
        self._segment = -1
        self._samples: list[tuple[IntArray, FloatArray, FloatArray]] = []
        self._loudest: Tone | None = None
        self._shaken = 0
        self.seconds = 0

    def add(self, block: SampleBlock) -> None:
        """One block, in order."""
        segment = block.index // SEGMENT_BLOCKS
        if segment != self._segment:
            self._close()
            self._segment = segment
        volts = self._calibration.observed(block.volts)
        sums = volts[:, 2::3].astype(np.float64)
        if volts.shape[1] == self._channels and sums.min() >= self._light:
            places = block.seq - segment * SEGMENT_BLOCKS * self._size
            self._samples.append((places, self._calibration.dots(volts), sums * self._volt))

    def found(self) -> dict[str, Any] | None:
        """After the last block: ``rms_m`` of the reading that the strongest vibration moves most, ``hz`` of it, and the
        ``share`` of the seconds in which something vibrates; None if nothing does.
        """
        self._close()
        if self._loudest is None:
            return None
        return {
            'rms_m': rms_of(self._loudest),
            'hz': self._loudest.frequency * self._rate,
            'share': self._shaken / self.seconds,
        }

    def _close(self) -> None:
        samples, self._samples = self._samples, []
        if sum(len(places) for places, _, _ in samples) < _LEAST_SHARE * SEGMENT_BLOCKS * self._size:
            return
        places, dots, sums = (np.concatenate(part) for part in zip(*samples, strict=True))
        moving = self._xp.einsum('sc,ac->sa', dots, self._turn)
        still = np.column_stack((self._combinations.fixed(dots), sums))
        tones = self._search.tones(places, moving, still, self._turn)
        self.seconds += 1
        self._shaken += bool(tones)
        self._loudest = max((*((self._loudest,) if self._loudest else ()), *tones), key=rms_of, default=None)


def vibration_of(recording: Recording) -> RecordedVibration | None:
    """What judges the blocks of ``recording``; None if its PSDs do not move with the tip, or are not described."""
    try:
        rig = rig_from_values(recording.parameters, str(recording.path))
    except ConfigError:
        return None
    if rig.psds_at_base or recording.psds != len(rig.psds) or recording.block_size != rig.estimator.block_size:
        return None
    return RecordedVibration(rig)
