# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The campaigns of ``bench/campaign``, a few rounds of each: they must be able to run, and to fail."""

from __future__ import annotations

import contextlib
import random
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import serial

from bench.campaign import fuzz, soak
from bench.campaign.crash import evaluate, left_by_a_kill
from bench.campaign.faults import Row, report
from bench.campaign.fuzz import GRAMMARS, TARGETS, corrupted, evaluated
from bench.campaign.kinds import FAULTS
from bench.campaign.line import DIGIT, VOLTS_PER_COUNT, Line, identities
from psd_deflection.base.log import null_log
from psd_deflection.devices.protocol.frames import FrameDecoder, HelloRequestFrame, SampleFrame, encode
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.run.reading.acquisition import Acquisition
from test.heard import WAIT_S

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
FOUND = sorted((ROOT / 'test' / 'data' / 'fuzz').glob('*'))


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Line]:
    one = Line(tmp_path)
    yield one
    one.close()


@pytest.fixture
def recording_rig(line: Line, tmp_path: Path) -> Rig:
    return load_rig(
        None,
        {
            'port': str(tmp_path / 'port'),
            'record': True,
            'bag_dir': str(tmp_path / 'bags'),
            'keep_zero': False,
            'realtime': False,
        },
    )


@pytest.mark.filterwarnings('ignore:This process .* is multi-threaded:DeprecationWarning')
@pytest.mark.parametrize('after_s', [0.05, 0.4])
def test_what_a_kill_leaves_is_whole(recording_rig: Rig, tmp_path: Path, after_s: float) -> None:
    """What it costs is bounded in log time (test_recover); here a busy machine may add to it."""
    folder, killed_ns = left_by_a_kill(recording_rig, tmp_path / 'bags', after_s)
    assert evaluate(folder, killed_ns) > 0.0


def test_a_sample_is_known_again_by_its_volts() -> None:
    numbers = np.array([0, 1, 4095, 4096, 123_456, 2**24 - 1])
    counts = np.zeros((len(numbers), 6))
    counts[:, 0], counts[:, 3] = numbers % DIGIT - DIGIT // 2, numbers // DIGIT - DIGIT // 2
    np.testing.assert_array_equal(identities((counts * VOLTS_PER_COUNT).astype(np.float32)), numbers)


def test_the_line_keeps_its_ledger(line: Line, recording_rig: Rig) -> None:
    acquisition = Acquisition(recording_rig, null_log)
    acquisition.open()
    acquisition.start()
    observed: set[int] = set()
    line.inject(b'\x00rubbish\x00')
    first = line.next_identity()
    fault = FAULTS[[f.name for f in FAULTS].index('frame truncated')]
    while not line.taken_by_fault & set(range(first, line.next_identity())):
        fault.act(line, 0)
    last = line.next_identity()
    while max(observed, default=0) < last:
        item = acquisition.queue.get(timeout=WAIT_S)
        raw = getattr(item, 'raw', None)
        if raw is not None:
            observed.update(identities(raw.readings.astype(np.float32) * np.float32(VOLTS_PER_COUNT)).tolist())
    acquisition.stop()
    expected = set(range(min(observed), max(observed) + 1)) - line.taken_by_fault
    assert expected <= observed
    assert len(line.taken_by_fault & set(range(first, last))) == 1


def test_a_cable_is_pulled_only_when_the_host_has_read(line: Line) -> None:
    """However late it reads: what a cable takes with it would look like a loss of the daemon's."""
    observed: set[int] = set()
    decoder, unread = FrameDecoder(), threading.Event()
    with serial.Serial(line.device_name, timeout=0, exclusive=True) as host:
        host.write(encode(HelloRequestFrame()))
        assert line.greeted.wait(WAIT_S)
        pulled = threading.Thread(target=line.unplug)
        first = line.next_identity()
        while line.next_identity() < first + 80:
            unread.wait(0.005)
        pulled.start()
        first = line.next_identity()
        while line.next_identity() < first + 80:
            unread.wait(0.005)
            assert pulled.is_alive(), 'pulled while 80 samples waited to be read'
        with contextlib.suppress(serial.SerialException):
            while True:
                for frame in decoder.feed(host.read(4096)):
                    if isinstance(frame, SampleFrame):
                        observed.add(frame.seq)
        pulled.join()
    assert set(range(min(observed), line.next_identity())) - line.taken_by_fault <= observed


def test_there_are_enough_kinds_and_a_bad_row_fails_the_campaign(capsys: pytest.CaptureFixture[str]) -> None:
    assert len(FAULTS) >= 25
    assert len({f.name for f in FAULTS}) == len(FAULTS)
    good = Row(FAULTS[0], injected=2, detected=2, recovered=2, times=[0.2, 0.3])
    between = {'between the faults': (0, 0)}
    assert report([good], {FAULTS[0].name: (0, 7), **between})
    assert not report([good], {FAULTS[0].name: (1, 7), **between})
    assert not report([good], {FAULTS[0].name: (0, 7), 'between the faults': (3, 0)})
    slow = Row(FAULTS[0], injected=1, detected=1, recovered=1, times=[1.2])
    assert not report([slow], {FAULTS[0].name: (0, 0), **between})
    unseen = Row(FAULTS[0], injected=1, detected=0, recovered=1, times=[0.2])
    assert not report([unseen], {FAULTS[0].name: (0, 0), **between})
    assert 'NOT AS IT MUST BE' in capsys.readouterr().out


def test_many_frames_at_once_are_the_frames_one_by_one() -> None:
    rng = np.random.default_rng(6)
    seq, t_us = rng.integers(0, 2**33, 300), rng.integers(0, 2**53, 300)
    counts = rng.integers(-32768, 32768, (300, 6))
    # Zeros are what COBS is about.
    seq[:100] %= 300
    t_us[50:150] = 0
    counts[rng.random((300, 6)) < 0.3] = 0
    expected = b''.join(
        encode(SampleFrame(0, s % 2**32, t, tuple(c)))
        for s, t, c in zip(seq.tolist(), t_us.tolist(), counts.tolist(), strict=True)
    )
    assert soak.sample_frames(seq, t_us, counts) == expected


def test_a_spread_is_numpy_s() -> None:
    values = [10**15 + n * n for n in range(50)]
    running = soak.RunningDeviation()
    for value in values:
        running.add(value)
    assert running.std == pytest.approx(float(np.std([n * n for n in range(50)])), rel=1e-12)
    assert running.mean == pytest.approx(float(np.mean(values)))


def test_simulated_minutes_lose_nothing_and_keep_time(capsys: pytest.CaptureFixture[str]) -> None:
    assert soak.simulated_time(100 / 3600)
    assert 'wrapped past 2^32' in capsys.readouterr().out


@pytest.mark.parametrize('name', GRAMMARS)
def test_any_choice_within_a_grammar_is_answered(name: str) -> None:
    target, seeds = TARGETS[name]()
    chance = random.Random(7)
    rejected = [evaluated(target, c) for c in [*seeds, b'', *(chance.randbytes(200) for _ in range(10))]]
    assert any(rejected)


@pytest.mark.parametrize('name', [n for n in TARGETS if n not in GRAMMARS])
def test_fuzz_targets_take_what_is_good_and_reject_what_was_found_bad(name: str) -> None:
    target, seeds = TARGETS[name]()
    assert evaluated(target, seeds[0]) == []
    assert evaluated(target, b'\x00\x03nonsense\x00') != []
    chance = random.Random(5)
    for seed in [*seeds, b'', *(p.read_bytes() for p in FOUND if p.name.startswith(name))]:
        evaluated(target, seed)
        for _ in range(5):
            spoiled = bytearray(seed or b'\x00')
            spoiled[chance.randrange(len(spoiled))] ^= 1 << chance.randrange(8)
            evaluated(target, bytes(spoiled))


def test_a_hang_and_a_rejection_of_two_lines_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    assert evaluated(lambda content: ['rejected'], b'') == ['rejected']
    with pytest.raises(AssertionError, match='more than one line'):
        evaluated(lambda content: ['rejected\nat length'], b'')
    monkeypatch.setattr(fuzz, 'HANG_S', -1.0)
    for name in ('frames', 'hello', 'csv', 'yaml'):
        target, seeds = TARGETS[name]()
        with pytest.raises(AssertionError, match='for one input'):
            evaluated(target, seeds[0])


def test_damaged_frames_are_rejected(capsys: pytest.CaptureFixture[str]) -> None:
    assert corrupted(20_000) == 0
    assert ' 0 accepted with a wrong content' in capsys.readouterr().out
