"""Write the samples of a recording, and its loads, references and temperatures, in another form.

OUT ending in .csv becomes a CSV recording, in .mcap a lone MCAP file, anything else a bag folder.
Volts come through bit for bit. Estimates are not carried over: psd-deflection replay makes them.
OUT ending in .rrd becomes a recording for the Rerun viewer (pip install rerun-sdk), for people to look at:
the estimates that replay makes, dots, loads and losses, and how they are shown. It is not read again.

  psd-deflection convert bags/clean --out clean.csv
  psd-deflection convert bags/lost_samples --out lost_samples.rrd
  psd-deflection convert run.csv --out run --params-file my_rig.yaml
"""

from __future__ import annotations

import argparse
import contextlib
import heapq
import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path

from psd_deflection.cli._options import recording_name
from psd_deflection.cli._progress import progress_of, told
from psd_deflection.cli._report import print_json, show, warn
from psd_deflection.config import load_rig
from psd_deflection.pipeline import Pipeline
from psd_deflection.recordings.readers import open_recording
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.replay_engine import open_for_replay, replayed
from psd_deflection.recordings.sinks import is_csv, open_sink
from psd_deflection.records import AppliedLoad, ParameterChange, Record, ReferencePose, SampleBlock, TemperatureReading

Convertible = SampleBlock | ParameterChange | AppliedLoad | ReferencePose | TemperatureReading


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('recording', metavar='REC', help='a bag folder, an .mcap or a .csv')
    parser.add_argument(
        '--out',
        type=recording_name(rerun=True),
        metavar='OUT',
        required=True,
        help='what to make: X.csv, X.mcap, X.rrd or a bag folder (X)',
    )
    parser.add_argument(
        '--params-file',
        metavar='RIG.yaml',
        help="the rig to note in a bag or to use for an .rrd; otherwise the recording's own",
    )
    parser.add_argument('--json', action='store_true', help='for programs: the summary as one JSON object')


def _time(record: Convertible) -> int:
    return int(record.t_ns[0]) if isinstance(record, SampleBlock) else record.t_ns


def convert(recording: Recording, out: Path, parameters: dict[str, object], quiet: bool = False) -> int:
    """Write ``recording`` to ``out``; returns the number of samples. Raises RecordingError."""
    with told('reading loads, references, temperatures', quiet=quiet):
        changes, loads = recording.changes, recording.loads()
        references, temperatures = recording.references(), recording.temperatures()
    blocks = progress_of(recording.blocks(), quiet=quiet)
    records: Iterable[Convertible] = heapq.merge(changes, loads, references, temperatures, blocks, key=_time)
    if is_csv(out):
        # A row takes what is waiting, and a block's last row what came during the block.
        records = itertools.chain(loads, references, temperatures, blocks)
    beside: dict[type[Record], Sequence[Record]] = {
        AppliedLoad: loads,
        ReferencePose: references,
        TemperatureReading: temperatures,
    }
    sink = open_sink(
        out, parameters, device_hello=recording.hello, samples_with=[k for k, found in beside.items() if found]
    )
    samples = 0
    with contextlib.closing(sink), blocks:
        for record in records:
            sink.put(record)
            samples += len(record.seq) if isinstance(record, SampleBlock) else 0
    return samples


def run(args: argparse.Namespace) -> int:
    """Convert and say what was written."""
    if Path(args.out).suffix.lower() == '.rrd':
        return _to_rerun(args.recording, Path(args.out), args.params_file, args.json)
    recording = open_recording(args.recording)
    parameters: dict[str, object] = dict(recording.parameters)
    if args.params_file is not None:
        rig = load_rig(args.params_file)
        parameters = rig.flat()
    samples = convert(recording, Path(args.out), parameters, args.json)
    if args.json:
        print_json({'out': args.out, 'samples': samples, 'warnings': list(recording.warnings)})
    else:
        show(f'{args.out}: {samples} samples')
    _warn(recording)
    return 0


def _to_rerun(path: str, out: Path, params_file: str | None, in_json: bool) -> int:
    recording, rig = open_for_replay(path, params_file)
    pipeline = Pipeline(rig)
    bar = progress_of(recording.blocks(), quiet=in_json)
    with contextlib.closing(open_sink(out, rig.flat(), title=recording.path.stem)) as sink, bar:
        for records in replayed(recording, pipeline, bar):
            for record in records:
                sink.put(record)
    estimates, blocks = pipeline.counters.estimates, pipeline.counters.blocks
    if in_json:
        found = {'out': str(out), 'blocks': blocks, 'estimates': estimates, 'warnings': list(recording.warnings)}
        print_json(found)
    else:
        show(f'{out}: {estimates} estimates of {blocks} blocks; look at it: rerun {out}')
    _warn(recording)
    return 0


def _warn(recording: Recording) -> None:
    for warning in recording.warnings:
        warn(warning)
