# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What ``/link_tip/rig`` says of the pipeline's memory: enough for a recorder that joins at any block."""

import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from msg_adapters import RIG
from psd_deflection.cli.main import main
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.recordings import cdr
from psd_deflection.records import RawChunk, Record
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.run.fanout import Fanout
from psd_deflection.run.rig_publisher import RigPublisher
from test.late import Heard, written

MODAL = {'filter': 'modal', 'degraded': 'hold', 'solvers': ['exact', 'wls']}
BLOCKS = 1150
ZEROED = (100, 700)
"""Blocks after which a zero is taken."""


class Running:
    """A session without threads: blocks go through its pipeline, messages to ``heard``."""

    def __init__(self, rig: Rig, first: int) -> None:
        self.rig = rig
        self.heard: list[Heard] = []
        self.pipeline = Pipeline(rig)
        session = SimpleNamespace(pipeline=self.pipeline, rig=rig, acquisition=SimpleNamespace(hello=None))
        self.reported = RigPublisher(self, cast(Any, session))
        self._session = session
        self._fanout = Fanout()
        self._fanout.sinks.append(self)
        self._fanout.change_sinks.append(self.reported)
        self.reported.notify()
        self.records: list[Record] = []
        for block, chunk in enumerate(chunks(rig, first)):
            for record in self.pipeline.process(chunk):
                self.records.append(record)
                self._fanout.put(record)
                self.reported.put(record)
            if block in ZEROED:
                change = self.pipeline.zero()
                assert change is not None
                session.rig = self.pipeline.rig
                self._fanout.put(change)
            if block % 50 == 37:
                self.reported.notify(again=False)

    def put(self, topic: str, type_name: str, message: bytes, t_ns: int) -> None:
        """One message; it arrives after those before."""
        self.heard.append(Heard(topic, type_name, message, 1_000_000 + len(self.heard)))

    def memories(self) -> list[dict[str, Any]]:
        """The messages about the rig that hold a memory."""
        texts = [json.loads(cdr.decode(m.type, m.cdr)['data']) for m in self.heard if m.topic == RIG]
        return [text for text in texts if 'memory' in text]

    def from_message(self, number: int) -> list[Heard]:
        """What a recorder has that joins then: the latched message and all that follow."""
        latched = [m for m in self.heard[:number] if m.topic == RIG][-1:]
        later = [m._replace(topic='/arm' + m.topic) for m in (*latched, *self.heard[number:])]
        return [m._replace(t_ns=max(m.t_ns, self.heard[number].t_ns)) for m in later]


def chunks(rig: Rig, first: int) -> Iterator[RawChunk]:
    """A block each, with a sample lost now and then."""
    counts = RigSimulator(rig, 1).step(loads()).counts
    for block in range(BLOCKS):
        seq = np.arange(20 * block, 20 * block + 20)
        present = seq % 977 != 0
        yield RawChunk(
            seq[present] + 20 * first,
            (seq[present] + 1) * 1_000_000,
            counts[seq[present]],
            np.zeros(int(present.sum()), np.uint8),
            rig.converter.volts_per_count,
        )


def loads() -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    out = np.zeros((20 * BLOCKS, 3))
    out[6000:9000], out[17000:] = (10.0, -30.0, -10.0), (0.0, -20.0, 5.0)
    return out


@pytest.fixture(scope='module', params=[{}, pytest.param(MODAL, marks=pytest.mark.slow)], ids=['defaults', 'modal'])
def running(request: pytest.FixtureRequest) -> Running:
    return Running(load_rig(overrides=request.param), 4000)


def test_memory_is_reported_first_soon_and_every_10_s(running: Running) -> None:
    reported = running.memories()
    assert [text['block'] - 4000 for text in reported] == [0, 50, 550, 1050]
    assert reported[0]['memory'] == {}
    assert all('state.noise' in text['memory'] for text in reported[1:])
    # Bounded: between two segments of the noise it is small.
    assert max(len(json.dumps(text)) for text in reported) < 150_000


@pytest.mark.parametrize(('seconds', 'start'), [(2.3, 550), (10.99, 550), (11.5, 1050)])
def test_late_recorder_replays_exactly_from_memory(
    running: Running, seconds: float, start: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In a namespace, in two files."""
    number = round(seconds / (0.02 * BLOCKS) * len(running.heard))
    bag = written(tmp_path / 'late', running.from_message(number))
    assert main(['replay', str(bag), '--compare', '--strict']) == 0
    output = capsys.readouterr().out
    assert f'starts in mid-run; compared from block {4000 + start}' in output
    assert 'no bit differs' in output


def test_early_recorder_replays_exactly_from_start(
    running: Running, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = written(tmp_path / 'early', running.heard)
    assert main(['replay', str(bag), '--compare', '--strict']) == 0
    output = capsys.readouterr().out
    assert 'mid-run' not in output
    assert 'no bit differs' in output


def test_a_late_recording_without_a_memory_says_so(
    running: Running, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    heard = running.from_message(len(running.heard) // 4)
    bag = written(tmp_path / 'short', heard[: len(heard) // 10])
    main(['replay', str(bag), '--compare'])
    assert 'starts in mid-run, and ends before the pipeline said what it remembers' in capsys.readouterr().err
