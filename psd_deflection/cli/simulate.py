"""Simulate the rig: as a recording (--out), or as a device on a pseudo-terminal (--serve).

The rig file says what the rig is and which effects are known of; --effect adds one that nobody knows
of: neither the estimates nor the parameters in the recording tell of it. A recording holds the
samples, the loads, the temperature where one is given, and with --reference the true pose.

  psd-deflection simulate --out run --loads thesis --temperature 20,24
  psd-deflection simulate --out odd.csv --effect axis_crosstalk,psd=1,xy=0.02
  psd-deflection simulate --out s.mcap --loads 'steps:0,0,0;0,-10,-5.85:2'
  psd-deflection simulate --serve --link rig_port
"""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from psd_deflection.cli import serve
from psd_deflection.cli._options import given_as_option, recording_name, refuse, seed
from psd_deflection.cli._report import print_json
from psd_deflection.config import EFFECTS_PREFIX, Rig, load_rig, replace_values
from psd_deflection.errors import ConfigError, UsageError
from psd_deflection.pipeline import Pipeline
from psd_deflection.recordings.bag_writer import BagWriter, McapFile
from psd_deflection.recordings.csv_writer import CsvSampleSink
from psd_deflection.recordings.sinks import Sink
from psd_deflection.records import (
    AppliedLoad,
    FloatArray,
    RawChunk,
    Record,
    ReferencePose,
    SampleBlock,
    TemperatureReading,
)
from psd_deflection.simulation.catalogue import effects_of_rig
from psd_deflection.simulation.load_words import HELP, load_history, temperature_history
from psd_deflection.simulation.simulator import RigSimulator

CHUNK_SECONDS = 1.0
LEAST_SAMPLES = 2
"""Fewer tell no sample rate: such a CSV could not be read again."""

OF_A_RECORDING: dict[str, object] = {
    'out': None,
    'loads': None,
    'temperature': None,
    'effect': [],
    'reference': False,
    'json': False,
}
"""Options of a recording, and what they are where they are not given."""

BAG_START_NS = 1_000_000_000
"""A bag's stamps start here: zero means "no stamp" to many tools."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.epilog = HELP
    parser.add_argument('--params-file', metavar='RIG.yaml', help='the rig and its known effects')
    parser.add_argument('--seed', type=seed, default=0, help='seed of the noise (default 0)')
    group = parser.add_argument_group('as a recording (--out)')
    group.add_argument('--out', type=recording_name(), metavar='OUT', help='X.csv, X.mcap or a bag folder (X)')
    group.add_argument(
        '--loads', metavar='WORDS', action='append', help='a load history, see below (default: thesis); repeatable'
    )
    group.add_argument(
        '--temperature', metavar='T0[,T1...]', help='°C, straight lines through these, evenly spread over the recording'
    )
    group.add_argument(
        '--effect',
        metavar='NAME,KEY=VALUE,...',
        action='append',
        default=[],
        help='hide an effect in it; repeatable',
    )
    group.add_argument('--reference', action='store_true', help='record the true pose as an independent measurement')
    group.add_argument('--json', action='store_true', help='for programs: the summary as one JSON object')
    serve.add_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Serve or write."""
    if args.serve or args.attached:
        refuse(args, OF_A_RECORDING, 'is for a recording (--out), not for a device (--serve)')
        return serve.run_device(args)
    if args.out is None:
        raise UsageError('--out OUT (a recording) or --serve (a device) is needed')
    refuse(args, serve.OF_A_DEVICE, 'is for a device: give --serve and no --out')
    # With its own effects first, so that what is wrong in the file is not laid to the options.
    known = with_effects(load_rig(args.params_file), ())
    with given_as_option():
        rig = with_effects(known, args.effect)
        rate = rig.converter.sample_rate_hz
        parts = [load_history(words, rate, '--loads') for words in args.loads or ['thesis']]
        history = parts[0].then(*parts[1:])
        if len(history) < LEAST_SAMPLES:
            raise UsageError(
                f'--loads: last {len(history)} samples at {rate:g} Hz; a recording has at least {LEAST_SAMPLES}'
            )
        temperature = (
            None if args.temperature is None else temperature_history(args.temperature, len(history), '--temperature')
        )
    out = Path(args.out)
    count = write_recording(out, rig, known, history.loads, temperature, args.seed, args.reference, args.json)
    names = [a.label for a in effects_of_rig(rig)]
    if args.json:
        print_json({'out': args.out, 'samples': count, 'duration_s': count / rate, 'effects': names})
    else:
        print(f'{out}: {count} samples, {count / rate:.1f} s; effects: {", ".join(names) or "none"}')
    return 0


def with_effects(rig: Rig, words: Sequence[str]) -> Rig:
    """``rig`` with the effects of ``NAME,KEY=VALUE,...``; raises ConfigError."""
    changes: dict[str, object] = {}
    for i, text in enumerate(words):
        name, *pairs = text.split(',')
        changes[f'{EFFECTS_PREFIX}effect_{i}.name'] = name
        for pair in pairs:
            key, equals, value = pair.partition('=')
            if not equals:
                raise ConfigError(f'--effect {text}: {pair!r} is not KEY=VALUE')
            changes[f'{EFFECTS_PREFIX}effect_{i}.{key}'] = value
    changed = replace_values(rig, changes, '--effect') if changes else rig
    effects_of_rig(changed)
    return changed


def write_recording(
    out: Path,
    rig: Rig,
    known: Rig,
    loads: FloatArray,
    temperature: FloatArray | None,
    seed: int,
    reference: bool,
    quiet: bool = False,
) -> int:
    """Simulate ``rig`` and write what a daemon with the parameters ``known`` would; returns the number of samples.

    Raises RecordingError, ConfigError.
    """
    is_csv = out.suffix.lower() == '.csv'
    sink: Sink
    values = known.flat()
    if is_csv:
        sink = CsvSampleSink(out, loads=True, references=reference, temperatures=temperature is not None)
    elif out.suffix.lower() == '.mcap':
        sink = McapFile(out, rig_values=values)
    else:
        sink = BagWriter(out, rig_values=values)
    bar = tqdm(total=len(loads), unit=' samples', delay=1.0, leave=False, disable=quiet or None, ncols=80)
    with contextlib.closing(sink), bar:
        for record in records(rig, known, loads, temperature, seed, reference, 0 if is_csv else BAG_START_NS):
            sink.put(record)
            if isinstance(record, SampleBlock):
                bar.update(len(record.seq))
    return len(loads)


def records(
    rig: Rig, known: Rig, loads: FloatArray, temperature: FloatArray | None, seed: int, reference: bool, start_ns: int
) -> Iterator[Record]:
    """What the rig would have recorded, and the estimates that the daemon would have made of it."""
    simulator, pipeline = RigSimulator(rig, seed), Pipeline(known)
    period = 1e9 / rig.converter.sample_rate_hz
    # A temperature takes effect with the block that follows it: then block by block.
    size = max(1, round(CHUNK_SECONDS * rig.converter.sample_rate_hz))
    size = rig.estimator.block_size if temperature is not None else size
    last: tuple[float, ...] | None = None
    last_temperature: float | None = None
    block = rig.estimator.block_size
    for start in range(0, len(loads), size):
        stop = min(start + size, len(loads))
        seq = np.arange(start, stop, dtype=np.int64)
        t_ns = start_ns + np.rint(seq * period).astype(np.int64)
        for i in range(start, stop):
            load = (float(loads[i, 0]), float(loads[i, 1]), float(loads[i, 2]))
            if load != last:
                last = load
                yield AppliedLoad(int(t_ns[i - start]), *load)
            # The thermometer reads as often as an estimate comes: it is slow, and so is the air.
            if temperature is not None and i % block == 0 and float(temperature[i]) != last_temperature:
                last_temperature = float(temperature[i])
                yield TemperatureReading(int(t_ns[i - start]), last_temperature)
                warmer = pipeline.temperature(last_temperature)
                if warmer is not None:
                    yield warmer
        part = simulator.step(loads[start:stop], None if temperature is None else temperature[start:stop])
        if reference:
            for i in range(0, stop - start, block):
                # The middle of the block is where the estimate stands.
                k = min(i + block // 2, stop - start - 1)
                yield ReferencePose(int(t_ns[k]), *(float(v) for v in part.pose[k]))
        flags = np.zeros(stop - start, dtype=np.uint8)
        yield from pipeline.process(RawChunk(seq, t_ns, part.counts, flags, rig.converter.volts_per_count))
    yield from pipeline.flush()
