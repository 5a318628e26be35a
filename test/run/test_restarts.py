# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A device that starts anew: the recording says so, and nobody who counts by numbers invents a loss."""

from __future__ import annotations

import contextlib
import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from psd_deflection.base.log import null_log
from psd_deflection.base.sequence import SequenceExtender, Step
from psd_deflection.cli.main import main
from psd_deflection.devices.protocol.frames import SampleFrame
from psd_deflection.devices.registry import make_source
from psd_deflection.devices.source import Event, SourceEndedError
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.rig.config import load_rig
from psd_deflection.run import processing
from psd_deflection.run.session import Session
from test.heard import WAIT_S
from test.run.conftest import Estimates, ScriptedDevice

pytestmark = pytest.mark.slow

Sample = Callable[..., SampleFrame]

STARTS = [(3000, 205), (2**31 + 7, 193), (5, 200), (4_000_000_000, 120), (3_999_999_870, 110)]
"""First number and samples of each run of the device: most begin or end amid a block, the last one ends with one."""

SENT = sum(n for _, n in STARTS)
BLOCKS = Counter((run, number // 20) for run, (first, n) in enumerate(STARTS) for number in range(first, first + n))
ESTIMATES = sum(samples >= load_rig().estimator.min_samples for samples in BLOCKS.values())


@pytest.fixture
def bag(device: ScriptedDevice, sample: Sample, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(processing, 'REQUEST_TIMEOUT_S', WAIT_S)
    values = {'port': str(device.link), 'bag_dir': str(tmp_path / 'bags'), 'keep_zero': False, 'realtime': False}
    session = Session(load_rig(overrides={**values, 'record': True, 'disk_reserve': 1_000_000}), null_log)
    estimates = Estimates(ESTIMATES)
    session.processing.sinks.append(estimates)
    session.start()
    for first, count in STARTS:
        # The clock of the device starts anew with it.
        device.send_frames(*(sample(first + k, 1000 * k) for k in range(count)))
    assert estimates.enough.wait(WAIT_S)
    folder = session.close()
    counters = session.acquisition.counters
    assert (counters.samples, counters.lost, counters.restarts) == (SENT, 0, len(STARTS) - 1)
    assert folder is not None
    return folder


def test_a_restart_is_recorded_and_no_command_invents_a_loss(bag: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['info', str(bag), '--json']) == 0
    info = json.loads(capsys.readouterr().out)
    assert (info['samples'], info['lost'], info['restarts']) == (SENT, 0, 4)
    assert main(['replay', str(bag), '--compare', '--json']) == 0
    assert json.loads(capsys.readouterr().out)['lost'] == 0
    assert main(['plot', str(bag), '--out', str(bag.parent / 'a.svg'), '--json']) == 0
    assert json.loads(capsys.readouterr().out)['lost'] == 0
    assert main(['convert', str(bag), '--out', str(bag.parent / 'again.mcap')]) == 0
    capsys.readouterr()
    assert main(['info', str(bag.parent / 'again.mcap')]) == 0
    text = capsys.readouterr().out
    assert f'{SENT} present, 0 lost' in text
    assert 'restarts     4 of the device' in text
    # Numbers that belong to no sample are few: other readers see less than two blocks of them at each restart.
    assert np.diff(open_recording(bag).samples['seq']).max() < 40


def test_recorded_restart_is_one_on_device_replay(bag: Path) -> None:
    source = make_source(load_rig(overrides={'source': 'replay', 'port': str(bag), 'replay.stamps': 'recorded'}))
    source.open(2.0)
    source.start()
    events: list[Event] = []
    with contextlib.suppress(SourceEndedError):
        while True:
            events += source.read(10.0).events
    sequence = SequenceExtender(20)
    steps = [sequence.extend(e.seq, e.t) for e in events]  # type: ignore[union-attr]
    assert sum(missing for _, _, missing in steps) == 0
    assert sum(step is Step.RESTART for _, step, _ in steps) == 4
    assert [number - steps[0][0] for number, _, _ in steps] == (
        open_recording(bag).samples['seq'] - open_recording(bag).samples['seq'][0]
    ).tolist()
