"""Replay: a recording through the same pipeline as in the live node, block by block.

Commands, the monitor and the benchmarks use it. ``source: replay`` is different: it is a device
(:mod:`psd_deflection.devices.replay`) that plays only the samples, in real time.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from psd_deflection.config import BY_NAME, Rig, load_rig, replace_values, rig_as_recorded
from psd_deflection.pipeline import Pipeline
from psd_deflection.recordings.readers import open_recording
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.summary import NO_PARAMETERS
from psd_deflection.records import ENVIRONMENT, RawChunk, Record, SampleBlock


def rig_at_start(recording: Recording) -> Rig:
    """The rig at the start of the recording; the thesis rig if the recording holds none. Raises ConfigError."""
    return rig_as_recorded(recording.parameters, f'{recording.path} (recorded parameters)')


def rig_at_end(recording: Recording) -> Rig:
    """The rig with every recorded change. A zero taken during the run describes the rig from the start.

    Raises ConfigError.
    """
    rig = rig_at_start(recording)
    for change in recording.changes:
        values = {name: value for name, value in change.values if name in BY_NAME}
        if values:
            rig = replace_values(rig, values, f'{recording.path} (changed at block {change.block})')
    return rig


def nominal_rig(recording: Recording, params_file: str | None = None) -> list[str]:
    """The warning that the nominal rig is taken, if neither ``params_file`` nor the recording gives another."""
    if recording.parameters or params_file is not None:
        return []
    return [f'{recording.path}: lacks {NO_PARAMETERS}']


def open_for_replay(
    path: str | Path, params_file: str | None = None, namespace: str | None = None
) -> tuple[Recording, Rig]:
    """The recording, cut into the rig's blocks, and the rig: from ``params_file``, else from the recording.

    ``namespace``: as :func:`open_recording` has it.

    Raises RecordingError and ConfigError.
    """
    recording = open_recording(path, namespace=namespace)
    rig = rig_at_start(recording) if params_file is None else load_rig(params_file)
    if recording.block_size != rig.estimator.block_size:
        recording = open_recording(path, block_size=rig.estimator.block_size, namespace=namespace)
    return recording, rig


def replayed(
    recording: Recording, pipeline: Pipeline, blocks: Iterable[SampleBlock] | None = None
) -> Iterator[list[Record]]:
    """The records of each step; each recorded change of parameters applies at its block.

    ``blocks``: the recording's blocks, for a caller that counts them.
    """
    changes = list(recording.changes)
    # Our recorder notes when a temperature took effect; for other recordings the stamps decide.
    noted = any(name in ENVIRONMENT for change in changes for name, _ in change.values)
    temperatures = [] if noted or not pipeline.needs_temperature else recording.temperatures()
    for block in recording.blocks() if blocks is None else blocks:
        while temperatures and temperatures[0].t_ns <= block.t_ns[0]:
            warmer = pipeline.temperature(temperatures.pop(0).celsius)
            if warmer is not None:
                yield [warmer]
        while changes and changes[0].block <= block.index:
            # The unfinished block belongs to the time before the change.
            yield list(pipeline.flush())
            change = changes.pop(0)
            pipeline.apply(change)
            yield [change]
        yield list(pipeline.process(RawChunk(block.seq, block.t_ns, block.volts, block.flags)))
    yield list(pipeline.flush())
