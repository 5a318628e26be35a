# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A calibration while the recording is being written."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

import psd_deflection
from psd_deflection.base.errors import RecordingError
from psd_deflection.recordings.conversion import Beside, convert
from psd_deflection.run.bench_calibration import LEAST_PAUSE_S, LOOK_S, BenchStep, follow
from psd_deflection.studies.calibrate.from_recordings import CalibrationOptions
from tools.program import ROOT

RIG_FILE = ROOT / 'config' / 'thesis_rig.yaml'
LOADS = [(0, 0, 0), (30, 0, 0), (0, -50, -29), (0, 0, 0), (-40, 40, 20)]
SHARES = (0.02, 0.6, 1.0)
"""How much of the recording is there at each look that finds it grown."""


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole recording with a reference."""
    folder = tmp_path_factory.mktemp('bench') / 'bag'
    made = psd_deflection.simulate(RIG_FILE, LOADS, seconds=1, seed=4)
    convert(made, folder, made.parameters, Beside.of(made), made.blocks())
    return folder


class Bench:
    """Time, and a recording that grows while ``follow`` pauses."""

    def __init__(self, bag: Path, folder: Path) -> None:
        self.bag, self.folder = bag, folder
        self.time, self.written = 0.0, 0
        self.looks: list[float] = []
        folder.mkdir()
        self.grow()

    def grow(self) -> None:
        """Write the next part."""
        (full,) = self.bag.glob('*.mcap')
        content = full.read_bytes()
        (self.folder / full.name).write_bytes(content[: round(SHARES[self.written] * len(content))])
        self.written += 1

    def recording(self) -> bool:
        return self.written < len(SHARES)

    def pause(self, seconds: float) -> None:
        self.time += seconds
        if self.time >= self.written * LEAST_PAUSE_S + 1.0:
            self.grow()

    def steps(self) -> Iterator[BenchStep]:
        asked = CalibrationOptions(str(RIG_FILE))
        for step in follow(self.folder, asked, self.recording, pause=self.pause, now=lambda: self.time):
            self.looks.append(self.time)
            yield step


@pytest.mark.slow
def test_what_is_determined_grows_with_the_recording(bag: Path, tmp_path: Path) -> None:
    bench = Bench(bag, tmp_path / 'growing')
    first, half, full = list(bench.steps())
    assert first.progress is None
    assert first.answer is None
    assert 'holds no samples' in first.words
    assert half.progress is not None
    assert full.progress is not None
    assert (half.ended, full.ended) == (False, True)
    assert half.progress.determined > 0
    sums = [sum(parameter.sd_ratio for parameter in progress.parameters) for progress in (half.progress, full.progress)]
    assert sums[1] < sums[0]
    assert half.progress.seconds < full.progress.seconds == pytest.approx(len(LOADS), abs=0.01)
    assert bench.looks[1] - bench.looks[0] >= LEAST_PAUSE_S
    assert bench.looks == pytest.approx([0.0, 3.0, 5.0], abs=2 * LOOK_S)


@pytest.mark.slow
@pytest.mark.repeatable
def test_its_last_answer_is_that_of_the_recording(bag: Path, tmp_path: Path) -> None:
    last = list(Bench(bag, tmp_path / 'growing').steps())[-1]
    assert last.answer is not None
    afterwards = psd_deflection.calibrate(bag, RIG_FILE)
    assert last.answer.calibration.values.tolist() == afterwards.calibration.values.tolist()
    assert last.progress is not None
    json.dumps(last.progress.tree())


def test_a_recording_that_goes_away_is_an_error(bag: Path, tmp_path: Path) -> None:
    bench = Bench(bag, tmp_path / 'growing')
    steps = bench.steps()
    next(steps)
    for file in bench.folder.iterdir():
        file.unlink()
    bench.folder.rmdir()
    with pytest.raises(RecordingError, match='growing: cannot be read'):
        next(steps)
