# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``make bench``, without a live line: frames, replay, conversion, simulation, discover beside peers and limits."""

import argparse
import contextlib
import csv
import struct
import subprocess
import sys
import tempfile
import time
import unittest.mock
import zlib
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pandas
from cobs import cobs
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer
from scipy.signal import lsim

from bench.live import make_recording
from bench.rows import BY_HAND, ROOT, Row, figure, in_turns, keep
from msg_adapters import SAMPLES, point_cloud2
from psd_deflection.devices.protocol.frames import FrameDecoder, SampleFrame, encode
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.simulation.catalogue import with_effects_of
from psd_deflection.model.simulation.loads import load_history
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.recordings.conversion import Beside, convert
from psd_deflection.recordings.observation import read_observation
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import replayed, rig_at_start
from psd_deflection.recordings.replay.simulated_recording import SimulatedRecording
from psd_deflection.records import CHANNELS, FloatArray, RawChunk
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.studies.discover.discover import discover

READ_FRAMES = 18  # Frames of one read: the reader waits until a block is nearly whole.
TEN = (
    *('clamp_bending_compliance,compliance=1e-4', 'damping,bending_ratio=0.02', 'creep,amplitude=0.03'),
    *('load_direction,angle=0.01', 'sensor_position,psd=1,x=1e-3', 'sensor_rotation,psd=2,angle=0.01'),
    *('axis_crosstalk,psd=1,xy=0.02', 'sensor_gain,psd=2,x=0.01', 'thermal_drift,psd=1,x=1e-6'),
    'mains_interference,frequency=50,amplitude_x1=0.001',
)


def frames(times: int) -> list[Row]:
    random = np.random.default_rng(0)
    counts = random.integers(-30000, 30000, (20000, 6)).tolist()
    stream = b''.join(encode(SampleFrame(0, i, 1000 * i, tuple(row))) for i, row in enumerate(counts))
    step = READ_FRAMES * len(stream) // len(counts)
    pieces = [stream[i : i + step] for i in range(0, len(stream), step)]
    layout, crc = struct.Struct('<BBIQ6h'), struct.Struct('<I')

    def ours(received: list[bytes]) -> int:
        decoder = FrameDecoder()
        return sum(len(decoder.feed(piece)) for piece in received)

    def peer(received: list[bytes]) -> int:
        rest, count = b'', 0
        for piece in received:
            *full, rest = (rest + piece).split(b'\0')
            decoded = []
            for frame in full:
                payload = cobs.decode(frame)
                if zlib.crc32(payload[:-4]) == crc.unpack(payload[-4:])[0]:
                    decoded.append(layout.unpack(payload[:-4]))
            count += len(decoded)
        return count

    def limit(received: list[bytes]) -> None:
        for piece in received:
            for frame in piece.split(b'\0'):
                zlib.crc32(frame)

    if ours(pieces) != len(counts) or peer(pieces) != len(counts):
        raise SystemExit('frames were lost')
    rows = []
    for what, received, bound in (('in pieces as they are read', pieces, 1.0), ('at once', [stream], 5.0)):
        decoder = ('FrameDecoder', 'ours', partial(ours, received), None)
        beside = ('cobs + struct, frame by frame', 'peer', partial(peer, received), bound)
        least = ('split and crc32 of the same bytes', 'limit', partial(limit, received), None)
        rows.append(in_turns(f'frame decoding, {what}', 'us a frame', 1e6 / len(counts), times, decoder, beside, least))
    return rows


def replay(times: int, minutes: float) -> list[Row]:
    with tempfile.TemporaryDirectory() as folder:
        path, n = make_recording(Path(folder), minutes)
        (file,) = path.glob('*.mcap')
        rig = rig_at_start(open_recording(path))

        def ours() -> None:
            pipeline = Pipeline(rig)
            for _records in replayed(open_recording(path), pipeline):
                pass
            if pipeline.counters.samples != n:
                raise SystemExit(f'replay saw {pipeline.counters.samples} of {n} samples')

        def by_mcap_ros2() -> None:
            pipeline = Pipeline(rig)
            for message in _decoded(file):
                _process(pipeline, message)

        def limit() -> None:
            with file.open('rb') as stream:
                for _message in make_reader(stream).iter_messages():
                    pass

        peer = ('the pipeline fed by mcap-ros2-support', 'peer', by_mcap_ros2, 1.0)
        bare = ('bare mcap iteration of the file', 'limit', limit, 1.3)
        work = f'replay of {minutes:g} minutes to estimates, all solvers'
        return [in_turns(work, 's', 1.0, times, ('psd_deflection replay', 'ours', ours, None), peer, bare)]


def _decoded(file: Path) -> Iterator[Any]:
    with file.open('rb') as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        yield from (message for _, _, _, message in reader.iter_decoded_messages([SAMPLES]))


def _process(pipeline: Pipeline, message: Any) -> None:
    """The samples of a PointCloud2."""
    points = _points(message)
    volts = np.stack([points[c] for c in CHANNELS], axis=1)
    stamp = message.header.stamp
    t_ns = int(stamp.sec) * 10**9 + int(stamp.nanosec) + 1_000_000 * np.arange(len(points), dtype=np.int64)
    chunk = RawChunk(points['seq'].astype(np.int64), t_ns, volts, np.zeros(len(points), np.uint8))
    for _record in pipeline.process(chunk):
        pass


_DTYPES = {2: 'u1', 5: '<i4', 6: '<u4', 7: '<f4', 8: '<f8'}


def _points(message: Any) -> npt.NDArray[np.void]:
    names, formats, offsets = zip(*((f.name, _DTYPES[f.datatype], f.offset) for f in message.fields), strict=True)
    layout = {'names': names, 'formats': formats, 'offsets': offsets, 'itemsize': message.point_step}
    points: npt.NDArray[np.void] = np.frombuffer(bytes(message.data), np.dtype(cast(Any, layout)))
    return points


def conversion(times: int, minutes: float) -> list[Row]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        table = folder / 'run.csv'
        n = round(minutes * 60_000)
        volts = np.random.default_rng(0).normal(0.0, 1.0, (n, 6)).astype(np.float32)
        with table.open('w', newline='') as stream:
            writer = csv.writer(stream)
            writer.writerow(['t', *CHANNELS])
            writer.writerows((f'{i / 1000:.9f}', *map(str, row)) for i, row in enumerate(volts))
        number = iter(range(10**6))

        def new(ending: str) -> Path:
            return folder / f'out_{next(number)}{ending}'

        def ours(source: Path, out: Path) -> None:
            recording = open_recording(source)
            if convert(recording, out, recording.parameters, Beside.of(recording), recording.blocks()) != n:
                raise SystemExit('samples were lost')

        bag = folder / 'run.mcap'
        ours(table, bag)

        def pandas_to_mcap() -> None:
            frame = pandas.read_csv(table, dtype=dict.fromkeys(CHANNELS, np.float32))
            points = np.zeros(len(frame), [('seq', '<u4'), *((c, '<f4') for c in CHANNELS)])
            fields = [
                {'name': f, 'offset': of, 'datatype': 6 if f == 'seq' else 7, 'count': 1}
                for f, (_, of, *_) in (points.dtype.fields or {}).items()
            ]
            size, same = points.dtype.itemsize, {'is_bigendian': False, 'is_dense': True, 'fields': fields}
            points['seq'] = np.arange(len(frame))
            for channel in CHANNELS:
                points[channel] = frame[channel]
            t_ns = np.rint(frame['t'].to_numpy() * 1e9).astype(np.int64)
            with new('.mcap').open('wb') as stream:
                writer = Writer(stream)
                schema = writer.register_msgdef('sensor_msgs/msg/PointCloud2', point_cloud2.MESSAGE.definition)
                for first in range(0, len(points), 20):
                    block = points[first : first + 20]
                    at = int(t_ns[first])
                    header = {'stamp': {'sec': at // 10**9, 'nanosec': at % 10**9}, 'frame_id': 'psd'}
                    shape = {'height': 1, 'width': len(block), 'point_step': size, 'row_step': block.nbytes}
                    message = {'header': header, **shape, **same, 'data': block.tobytes()}
                    writer.write_message(SAMPLES, schema, message, at, at)
                writer.finish()

        def mcap_to_pandas() -> None:
            points = np.concatenate([_points(message) for message in _decoded(bag)])
            frame = pandas.DataFrame({c: points[c] for c in CHANNELS})
            frame.insert(0, 't', np.arange(len(frame)) / 1000)
            frame.to_csv(new('.csv'), index=False)

        def copy() -> None:
            new('.copy').write_bytes(table.read_bytes())

        def row(way: str, source: Path, ending: str, by_hand: str, peer: Callable[[], None]) -> Row:
            ours_too = ('psd_deflection convert', 'ours', lambda: ours(source, new(ending)), None)
            limit = ('reading and writing the bytes of the CSV', 'limit', copy, None)
            work = f'{way}, {minutes:g} minutes of samples'
            return in_turns(work, 's', 1.0, times, ours_too, (f'{by_hand} by hand', 'peer', peer, 1.0), limit)

        return [
            row('CSV to bag', table, '.mcap', 'pandas and mcap-ros2-support', pandas_to_mcap),
            row('bag to CSV', bag, '.csv', 'mcap-ros2-support and pandas', mcap_to_pandas),
        ]


def simulation(times: int) -> list[Row]:
    """60 s of the rig with ten effects; the peer has the three modes alone, without optics, effects and electronics."""
    rig, loads = with_effects_of(load_rig(), TEN, 'bench'), np.zeros((60_000, 3))
    loads[5_000:30_000] = (5.0, -10.0, 2.0)
    model = ForwardModel(rig)
    physics = model.physics
    t = np.arange(len(loads)) * physics.period
    bending = 2.0 * np.pi * physics.bending_frequency, physics.bending_damping_ratio
    torsion = 2.0 * np.pi * physics.torsion_frequency, physics.torsion_damping_ratio

    def peer() -> None:
        for axis, (w, z) in enumerate((bending, bending, torsion)):
            lsim(([w * w], [1.0, 2.0 * z * w, w * w]), loads[:, axis], t, interp=False)

    arrays: list[FloatArray] = [np.zeros((3, len(t))), np.zeros((4, len(t))), np.zeros((6, len(t)))]

    def limit() -> None:
        for array in arrays:
            np.multiply(array, 1.0001)

    beside = ('scipy lsim of its three modes alone', 'peer', peer, 20.0)
    least = ('one pass of numpy over pose, dots and volts', 'limit', limit, None)
    ours = ('ForwardModel', 'ours', lambda: ForwardModel(rig).run(loads), None)
    return [in_turns('forward simulation, 60 s, ten effects', 'ms', 1e3, times, ours, beside, least)]


FOUR = (
    *('sensor_rotation,psd=2,angle=0.01', 'load_direction,angle=0.004', 'amplifier_lag,time_constant=0.0005'),
    'bending_stiffness,scale=-0.013',
)
SEARCHES: tuple[tuple[str, tuple[str, ...], tuple[str, ...], float | None], ...] = (
    ('one effect', FOUR[:1], (), 1.3),
    ('four effects', FOUR, (), None),
    ('an unknown effect', ('sensor_nonlinearity,psd=1,k=300',), ('sensor_nonlinearity',), None),
)
"""What is missing, how it is simulated, what the library lacks, and the bound to its forward simulations."""


def search(times: int, seconds: float) -> list[Row]:
    """``discover`` beside the forward simulations that it made and the time that its recording lasts."""
    return [searched(max(1, times if i == 0 else 1), seconds, *case) for i, case in enumerate(SEARCHES)]


def searched(
    times: int, seconds: float, what: str, effects: Sequence[str], without: Sequence[str], bound: float | None
) -> Row:
    known = load_rig()
    rig: Rig = with_effects_of(known, effects, 'bench')
    history = load_history('identification', 1000.0)
    loads = np.resize(history.loads, (round(1000 * seconds), 3))
    observation = read_observation(SimulatedRecording(rig, known, loads), known)
    inside: list[float] = []
    counts: list[int] = []
    expect = ForwardModel.expect

    def timed(model: ForwardModel, loads: FloatArray, temperature: FloatArray | None = None) -> SimulatedSamples:
        began = time.perf_counter()
        try:
            return expect(model, loads, temperature)
        finally:
            inside[-1] += time.perf_counter() - began

    def ours() -> None:
        inside.append(0.0)
        with unittest.mock.patch.object(ForwardModel, 'expect', timed):
            discovery = discover([observation], known, without=without)
        right = discovery.verdict == 'unknown_effect'
        if not without:
            # What explains the recording as well counts as found.
            sets = [{e.active.effect.name, *e.equivalent} for e in discovery.effects]
            names = [words.partition(',')[0] for words in effects]
            right = len(sets) == len(names) and all(any(n in s for s in sets) for n in names)
        if not right:
            raise SystemExit(f'{what}: discover found {discovery!r}')
        counts.append(discovery.simulations)

    row = in_turns(f'discover, {seconds:g} s of a recording, {what}', 's', 1.0, times, ('discover', 'ours', ours, None))
    row.figures.append(figure(f'in its {counts[0]} forward simulations', 'limit', inside, bound))
    row.figures.append(figure('what its recording lasts', 'limit', [seconds], 1.0))
    return row


def used_by(*arguments: str) -> tuple[float, float]:
    """(s, MB): time and most memory of the command ``psd-deflection``."""
    command = [sys.executable, '-c', _REPORTS_MEMORY, *arguments]
    began = time.perf_counter()
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f'psd-deflection {" ".join(arguments)}: {done.stderr.strip()}')
    return time.perf_counter() - began, float(done.stdout.split()[-1]) / 1024


_REPORTS_MEMORY = """
import atexit, re, runpy, sys
# The memory that getrusage tells of is at least what the bench itself had when it started this process.
atexit.register(lambda: print(re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1]))
runpy.run_module('psd_deflection', run_name='__main__', alter_sys=True)
"""
"""Runs the command and ends with its largest memory, KiB."""


def verdicts(times: int) -> list[Row]:
    """The command ``discover`` from start to report, on CSV files of one effect."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for repeats in (1, 4, 10):
            table = f'{folder}/{repeats}.csv'
            loads = ['--loads', 'identification'] * repeats
            used_by('simulate', '--out', table, *loads, '--effect', SEARCHES[0][1][0], '--seed', '5')
            lasts = len(load_history('identification', 1000.0).loads) * repeats / 1000.0
            runs = [used_by('discover', table, '--out', f'{folder}/found') for _ in range(times)]
            seconds, memory = zip(*runs, strict=True)
            work, name = f'discover, {lasts:g} s in a CSV, one effect', 'psd-deflection discover'
            limit = figure('what its recording lasts', 'limit', [lasts], 1.0)
            rows.append(Row(f'{work}: from start to report', 's', [figure(name, 'ours', seconds), limit]))
            rows.append(Row(f'{work}: memory', 'MB', [figure(name, 'ours', memory)]))
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--minutes', type=float, default=10.0, help='of the recordings that are replayed and converted')
    parser.add_argument('--seconds', type=float, default=60.0, help='of the recording that discover gets')
    parser.add_argument('--times', type=int, default=5)
    parser.add_argument('--only', choices=('frames', 'replay', 'conversion', 'simulation', 'discover', 'verdict'))
    parser.add_argument('--results', type=Path, default=BY_HAND / 'results.json')
    args = parser.parse_args()
    jobs: dict[str, Callable[[], list[Row]]] = {
        'frames': lambda: frames(args.times),
        'replay': lambda: replay(args.times, args.minutes),
        'conversion': lambda: conversion(args.times, args.minutes),
        'simulation': lambda: simulation(args.times),
        'discover': lambda: search(args.times // 2, args.seconds),
        'verdict': lambda: verdicts(max(1, args.times // 2)),
    }
    for name, job in jobs.items():
        if args.only in (None, name):
            keep(job(), args.results)
    return 0


if __name__ == '__main__':
    with contextlib.suppress(KeyboardInterrupt):
        sys.exit(main())
