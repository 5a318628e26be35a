# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Makes the golden recordings and the truth beside them: ``make golden``.

The bytes of the simulated device go through the same decoder, clock map, pipeline and bag writer as
in the daemon, with the script's own clock, so that the files come out the same on every run with the
same libraries. CI replays the files that are committed; it does not make them anew.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from psd_deflection.devices.contract_frames import SimulatedFrames
from psd_deflection.devices.protocol.frames import FrameDecoder, HelloFrame, SampleFrame
from psd_deflection.devices.rig_feed import RigFeed
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.simulation.loads import LoadHistory, direct, sidebar, steps
from psd_deflection.recordings.write.bag_writer import BagWriter
from psd_deflection.records import FloatArray, RawChunk
from psd_deflection.rig.config import load_rig, replace_values

HERE = Path(__file__).resolve().parent
START_NS = 1_767_225_600_000_000_000
"""2026-01-01 00:00 UTC."""

SECONDS = 4

Dark = tuple[tuple[int, int, int], ...]


@dataclass(frozen=True, slots=True)
class Golden:
    """``rig``: the rig file, the default rig if None. ``values``: parameters that differ from it.

    ``lose``: samples that the wire loses. ``dark``: when a laser is off.
    """

    rig: Path | None = None
    values: Mapping[str, object] = field(default_factory=dict)
    lose: frozenset[int] = frozenset()
    dark: Dark = ()


LOST = frozenset({45, 46, 200, *range(1003, 1030), *range(2000, 2145), 3999})
RECORDINGS: dict[str, Golden] = {
    'clean': Golden(),
    'lost_samples': Golden(lose=LOST),
    'laser_off': Golden(dark=((2, 1507, 2523),)),
    'motion': Golden(
        values={
            'filter': 'modal',
            'degraded': 'hold',
            'solvers': ['exact', 'wls', 'iterative', 'beam', 'wls_exact', 'ols'],
        },
        dark=((2, 1507, 2523),),
    ),
    'calibrated': Golden(rig=HERE / 'calibrated_rig.yaml'),
    'three_psds': Golden(rig=HERE.parent / 'config' / 'three_psds.yaml', dark=((3, 2007, 2523),)),
}
"""With the defaults, and of a filter, a calibrated rig and three PSDs, of which one goes dark."""


def history() -> LoadHistory:
    """Nothing, 30 N on the sidebar, 50 N on the link, nothing: a second each."""
    return steps([(0.0, 0.0, 0.0), sidebar(30.0), direct(50.0), (0.0, 0.0, 0.0)], 1.0)


def record(name: str, golden: Golden) -> None:
    """One recording ``bags/NAME`` and ``bags/NAME_truth.csv``."""
    rig = replace_values(load_rig(golden.rig), golden.values)
    loads = history().loads

    def held(first: int, n: int) -> FloatArray:
        index = np.minimum(np.arange(first, first + n), len(loads) - 1)
        return loads[index]

    feed = RigFeed(rig, held, seed=2026, dark=golden.dark)
    feed.poses = []
    device = SimulatedFrames(feed, serial='GOLDEN', lose=golden.lose)
    frames = FrameDecoder(len(rig.psds)).feed(b'\x00' + device.take(SECONDS * 1_000_000_000 - 1, room=1 << 30))
    hello = next(f for f in frames if isinstance(f, HelloFrame))
    samples = [f for f in frames if isinstance(f, SampleFrame)]
    pipeline = Pipeline(rig)
    folder = HERE / name
    shutil.rmtree(folder, ignore_errors=True)
    with BagWriter(folder, rig_values=rig.flat(), device_hello=hello.info) as bag:
        chunk = RawChunk(
            np.array([f.seq for f in samples], np.int64),
            START_NS + np.array([f.t_device_us for f in samples], np.int64) * 1000,
            np.array([f.counts for f in samples], np.int16),
            np.array([f.flags for f in samples], np.uint8),
            rig.converter.volts_per_count,
        )
        for step in (pipeline.process(chunk), pipeline.flush()):
            for item in step:
                bag.put(item)
    poses = np.concatenate(feed.poses)[: SECONDS * 1000]
    rows = poses.reshape(-1, rig.estimator.block_size, 3).mean(axis=1)
    with (HERE / f'{name}_truth.csv').open('w', encoding='ascii') as stream:
        stream.write('block,dx,dy,theta\n')
        for block, (dx, dy, theta) in enumerate(rows.tolist()):
            stream.write(f'{block},{dx!r},{dy!r},{theta!r}\n')


def main() -> int:
    """Make them all."""
    for name, golden in RECORDINGS.items():
        record(name, golden)
        print(f'bags/{name}: {sum(p.stat().st_size for p in (HERE / name).iterdir())} bytes')
    return 0


if __name__ == '__main__':
    sys.exit(main())
