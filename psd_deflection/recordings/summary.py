# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is in a recording, in numbers."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from msg_adapters import DEFLECTION, LOAD, SAMPLES
from psd_deflection.base.arithmetic import FIXED
from psd_deflection.base.errors import ConfigError
from psd_deflection.measure.averaging import SEGMENT_BLOCKS
from psd_deflection.measure.uncertainty.combinations import combinations_of
from psd_deflection.measure.uncertainty.vibration import FOLLOWED, Tone, ToneSearch, rms_of
from psd_deflection.model.detector import VoltsToDots
from psd_deflection.recordings.recording import Recording
from psd_deflection.records import CLOCK_SQUEEZED, CLOCK_STEP, FloatArray, IntArray, ParameterChange, SampleBlock
from psd_deflection.rig.config import Rig, left_as_in_the_thesis, rig_from_values
from psd_deflection.rig.declarations import BY_NAME

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
        self._moving = self._combinations.matrix[: self._combinations.moving]
        self._light = rig.estimator.sum_min
        self._volt = rig.sensitivities.mean(axis=1)
        self._channels = 3 * len(rig.psds)
        self._search = ToneSearch(self._size, SEGMENT_BLOCKS, xp, FOLLOWED)
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

    def tree(self) -> dict[str, Any] | None:
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
        still = np.column_stack((self._combinations.fixed(dots), sums))
        tones = self._search.tones(places, dots, still, self._moving).moving
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


THESIS_RIG = 'the rig of the thesis is taken; --params-file RIG.yaml (in Python: rig) names another'

_BREAK = 0.5
"""If time and sample numbers disagree by this share, the device was stopped or restarted between two blocks."""


def changed_parameters(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters that differ from their defaults, and those that this version does not know."""
    return {k: v for k, v in parameters.items() if k not in BY_NAME or BY_NAME[k].default != BY_NAME[k].meant(v)}


def _values_of(recording: Recording, name: str) -> list[tuple[ParameterChange, float]]:
    """The changes that note ``name``, a number."""
    values = [(change, dict(change.values).get(name)) for change in recording.changes]
    return [(change, float(value)) for change, value in values if isinstance(value, float | int)]


def lacks(recording: Recording, topics: Mapping[str, int]) -> list[str]:
    """Missing parts that some command needs, each with the fix."""
    missing = []
    if not topics.get(SAMPLES):
        missing.append(f'samples ({SAMPLES}): nothing can be computed from it')
    if not recording.parameters:
        missing.append(f'parameters: {THESIS_RIG}')
    if recording.hello is None:
        missing.append('what the device says of itself')
    if not topics.get(DEFLECTION):
        missing.append(f'estimates ({DEFLECTION}): `psd-deflection replay` makes them')
    if not topics.get(LOAD):
        missing.append(f'known loads ({LOAD}): `psd-deflection discover` needs them')
    return missing


class _Counted:
    """What the blocks of a recording hold. ``first``, ``last``: number and time (ns) of a sample."""

    def __init__(self, recording: Recording, blocks: Iterable[SampleBlock]) -> None:
        self.blocks = self.samples = self.flagged = 0
        self.first = self.last = (0, 0)
        self.vibration: RecordedVibration | None = None
        self._steps = self._lasted_ns = 0
        self._expected_ns = 0.0
        for block in blocks:
            if not self.blocks:
                self.vibration = vibration_of(recording)
                rate = recording.sample_rate_hz
                self._expected_ns = 1e9 / rate if rate > 0.0 else 0.0
            if self.vibration is not None:
                self.vibration.add(block)
            self._count(block)

    @property
    def rate_hz(self) -> float:
        """Samples a second, without the pauses of the device."""
        return self._steps * 1e9 / self._lasted_ns if self._lasted_ns else 0.0

    def _count(self, block: SampleBlock) -> None:
        begin, end = ((int(block.seq[i]), int(block.t_ns[i])) for i in (0, -1))
        if not self.blocks:
            self.first = self.last = begin
        # From the end of the block before, so that a pause of the device counts neither as samples nor as time.
        for n, dt in ((begin[0] - self.last[0], begin[1] - self.last[1]), (end[0] - begin[0], end[1] - begin[1])):
            if abs(dt - n * self._expected_ns) <= _BREAK * n * self._expected_ns:
                self._steps, self._lasted_ns = self._steps + n, self._lasted_ns + dt
        self.last = end
        self.blocks += 1
        self.samples += len(block.seq)
        self.flagged += int((block.flags != 0).sum())


def summary(recording: Recording, topics: Mapping[str, int], blocks_of_it: Iterable[SampleBlock]) -> dict[str, Any]:
    """What ``info --json`` prints: times in s and ns, counts, metadata.

    ``topics``: from ``recording.topics()``; ``blocks_of_it``: its blocks, for a caller that counts them.
    """
    counts = _Counted(recording, blocks_of_it if topics.get(SAMPLES) else ())
    first, last, samples = counts.first, counts.last, counts.samples
    path = recording.path
    files = [f for f in path.iterdir() if f.is_file()] if path.is_dir() else [path]
    return {
        'path': str(path),
        'bytes': sum(f.stat().st_size for f in files),
        'namespace': recording.namespace,
        'version': recording.version,
        'made_with': dict(recording.made_with),
        'node': recording.node,
        'device_hello': recording.hello,
        'start_ns': first[1],
        'duration_s': recording.lasts(first[1], last[1]) if samples else 0.0,
        'samples': samples,
        'lost': recording.lost(first[0], last[0], samples) if samples else 0,
        'dropped_here': {'samples': recording.dropped_here[0], 'messages': recording.dropped_here[1]},
        'restarts': len(recording.restarts),
        'clock_steps': [{'t_ns': c.t_ns, 'step_s': s} for c, s in _values_of(recording, CLOCK_STEP)],
        'squeezed': sum(int(n) for _, n in _values_of(recording, CLOCK_SQUEEZED)),
        'flagged': counts.flagged,
        'sample_rate_hz': counts.rate_hz,
        'vibration': counts.vibration.tree() if counts.vibration is not None else None,
        'blocks': counts.blocks,
        'block_size': recording.block_size,
        'topics': topics,
        'marks': [{'t_ns': m.t_ns, 't_s': (m.t_ns - first[1]) * 1e-9, 'text': m.text} for m in recording.marks()],
        'parameters': dict(recording.parameters),
        'changed_parameters': changed_parameters(recording.parameters),
        'as_in_the_thesis': list(left_as_in_the_thesis(recording.parameters)) if recording.parameters else [],
        'changes': [{'t_ns': c.t_ns, 'block': c.block, 'values': dict(c.values)} for c in recording.changes],
        'lacks': lacks(recording, topics),
        'complete': recording.complete,
        'warnings': list(recording.warnings),
    }
