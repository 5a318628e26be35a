# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is in a recording, in numbers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from msg_adapters import DEFLECTION, LOAD, SAMPLES
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.vibration import RecordedVibration, vibration_of
from psd_deflection.records import CLOCK_SQUEEZED, CLOCK_STEP, ParameterChange, SampleBlock
from psd_deflection.rig.config import left_as_in_the_thesis
from psd_deflection.rig.declarations import BY_NAME

NO_PARAMETERS = 'parameters: the nominal rig is taken if no rig file is given'

_BREAK = 0.5
"""If time and sample numbers disagree by this share, the device was stopped or restarted between two blocks."""


def changed_parameters(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters that differ from their defaults, and those that this version does not know."""
    return {k: v for k, v in parameters.items() if k not in BY_NAME or BY_NAME[k].default != BY_NAME[k].meant(v)}


def _noted(recording: Recording, name: str) -> list[tuple[ParameterChange, float]]:
    """The changes that note ``name``, a number."""
    noted = [(change, dict(change.values).get(name)) for change in recording.changes]
    return [(change, float(value)) for change, value in noted if isinstance(value, float | int)]


def lacks(recording: Recording, topics: Mapping[str, int]) -> list[str]:
    """Missing parts that some command needs, each with the fix."""
    found = []
    if not topics.get(SAMPLES):
        found.append(f'samples ({SAMPLES}): nothing can be computed from it')
    if not recording.parameters:
        found.append(NO_PARAMETERS)
    if recording.hello is None:
        found.append('what the device says of itself')
    if not topics.get(DEFLECTION):
        found.append(f'estimates ({DEFLECTION}): `psd-deflection replay` makes them')
    if not topics.get(LOAD):
        found.append(f'known loads ({LOAD}): `psd-deflection discover` needs them')
    return found


def summary(recording: Recording, topics: Mapping[str, int], blocks_of_it: Iterable[SampleBlock]) -> dict[str, Any]:
    """What ``info --json`` prints: times in s and ns, counts, metadata.

    ``topics``: from ``recording.topics()``; ``blocks_of_it``: its blocks, for a caller that counts them.
    """
    blocks = samples = flagged = 0
    first = last = (0, 0)
    counted, lasted = 0, 0
    vibration: RecordedVibration | None = None
    if topics.get(SAMPLES):
        expected_ns = 1e9 / recording.sample_rate_hz if recording.sample_rate_hz > 0.0 else 0.0
        vibration = vibration_of(recording)
        for block in blocks_of_it:
            if vibration is not None:
                vibration.add(block)
            begin, end = ((int(block.seq[i]), int(block.t_ns[i])) for i in (0, -1))
            if blocks == 0:
                first = last = begin
            # From the end of the block before, so that a pause of the device counts neither as samples nor as time.
            for n, dt in ((begin[0] - last[0], begin[1] - last[1]), (end[0] - begin[0], end[1] - begin[1])):
                if abs(dt - n * expected_ns) <= _BREAK * n * expected_ns:
                    counted, lasted = counted + n, lasted + dt
            last = end
            blocks += 1
            samples += len(block.seq)
            flagged += int((block.flags != 0).sum())
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
        'duration_s': (last[1] - first[1]) * 1e-9,
        'samples': samples,
        'lost': recording.lost(first[0], last[0], samples) if samples else 0,
        'dropped_here': {'samples': recording.dropped_here[0], 'messages': recording.dropped_here[1]},
        'restarts': len(recording.restarts),
        'clock_steps': [{'t_ns': c.t_ns, 'step_s': s} for c, s in _noted(recording, CLOCK_STEP)],
        'squeezed': sum(int(n) for _, n in _noted(recording, CLOCK_SQUEEZED)),
        'flagged': flagged,
        'sample_rate_hz': counted * 1e9 / lasted if lasted else 0.0,
        'vibration': vibration.found() if vibration is not None else None,
        'blocks': blocks,
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
