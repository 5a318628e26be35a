"""Replay: a recording through the same pipeline as in the live node, block by block.

Commands, the monitor and the benchmarks replay with this. ``source: replay`` is another thing: a
device (:mod:`psd_deflection.devices.replay`) that plays the samples alone, at their own pace.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from psd_deflection.config import BY_NAME, Rig, load_rig, replace_values, rig_as_recorded
from psd_deflection.pipeline import Pipeline
from psd_deflection.recordings.readers import open_recording
from psd_deflection.recordings.recording import Recording
from psd_deflection.records import ENVIRONMENT, RawChunk, Record, SampleBlock


def rig_at_start(recording: Recording) -> Rig:
    """The rig that the recording began with; the thesis rig if it tells of none. Raises ConfigError."""
    return rig_as_recorded(recording.parameters, f'{recording.path} (recorded parameters)')


def rig_at_end(recording: Recording) -> Rig:
    """The rig with every recorded change: a zero that was taken is what the rig was all along, only known better.

    Raises ConfigError.
    """
    rig = rig_at_start(recording)
    for change in recording.changes:
        values = {name: value for name, value in change.values if name in BY_NAME}
        if values:
            rig = replace_values(rig, values, f'{recording.path} (changed at block {change.block})')
    return rig


def open_for_replay(path: str | Path, params_file: str | None = None) -> tuple[Recording, Rig]:
    """The recording, to be cut into the rig's blocks, and the rig: of ``params_file``, else its own.

    Raises RecordingError and ConfigError.
    """
    recording = open_recording(path)
    rig = rig_at_start(recording) if params_file is None else load_rig(params_file)
    if recording.block_size != rig.estimator.block_size:
        recording = open_recording(path, block_size=rig.estimator.block_size)
    return recording, rig


def replayed(
    recording: Recording, pipeline: Pipeline, blocks: Iterable[SampleBlock] | None = None
) -> Iterator[list[Record]]:
    """The records of each step; recorded changes of parameters apply at their own block.

    ``blocks``: those of the recording, if a caller counts them on the way.
    """
    changes = list(recording.changes)
    # What our own recorder noted says when a temperature took effect; of others' recordings, the stamps do.
    noted = any(name in ENVIRONMENT for change in changes for name, _ in change.values)
    temperatures = [] if noted or not pipeline.needs_temperature else recording.temperatures()
    for block in recording.blocks() if blocks is None else blocks:
        while temperatures and temperatures[0].t_ns <= block.t_ns[0]:
            warmer = pipeline.temperature(temperatures.pop(0).celsius)
            if warmer is not None:
                yield [warmer]
        while changes and changes[0].block <= block.index:
            # What is unfinished belongs to the time before the change.
            yield list(pipeline.flush())
            change = changes.pop(0)
            pipeline.apply(change)
            yield [change]
        yield list(pipeline.process(RawChunk(block.seq, block.t_ns, block.volts, block.flags)))
    yield list(pipeline.flush())
