# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from psd_deflection.base.log import INFO
from psd_deflection.cli.main import main
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import replayed, rig_at_start
from psd_deflection.records import AppliedLoad, BlockStatus, ParameterChange, Record, ReferencePose, SpotMeans
from psd_deflection.run.monitor.feed import BlockResult, Feed
from psd_deflection.run.monitor.shown import RejectedError
from psd_deflection.run.monitor.shown_recording import ShownRecording

BAGS = Path(__file__).parents[3] / 'bags'


def source_of(name: str, feed: Feed, message: list[str], ended: threading.Event, speed: float = 1e6) -> ShownRecording:
    rig = rig_at_start(open_recording(BAGS / name))

    def open_steps() -> tuple[Pipeline, Iterator[list[Record]]]:
        recording = open_recording(BAGS / name)
        pipeline = Pipeline(rig)
        return pipeline, replayed(recording, pipeline)

    def log(text: str, level: int = INFO, /) -> None:
        message.append(text)
        ended.set()

    first = next(iter(open_recording(BAGS / name).blocks()))
    inputs = [AppliedLoad(int(first.t_ns[0]) + k * 10**9, 0.0, -k, 0.0) for k in (3, 1, 0, 2)]
    return ShownRecording(name, open_steps, feed, log, speed=speed, inputs=inputs)


def test_rates_are_per_second_for_any_report_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('psd_deflection.run.monitor.shown_recording.time.time_ns', lambda: 0)
    ended = threading.Event()
    source = source_of('clean', Feed(), list[str](), ended)
    source.start()
    assert ended.wait(60.0)
    source.close()
    replay, estimates = source.health(2_000_000_000).entries
    assert ('rate (samples/s)', '2000') in replay.values
    assert ('rate (estimates/s)', '100') in estimates.values
    assert ('rate (samples/s)', '0') in source.health(3_000_000_000).entries[0].values


def test_a_recording_is_shown_as_it_is_with_its_losses() -> None:
    feed, wanted, ended = Feed(), list[str](), threading.Event()
    source = source_of('lost_samples', feed, wanted, ended)
    source.start()
    assert ended.wait(60.0)
    source.close()
    results = [r for r in feed.take() if isinstance(r, BlockResult)]
    recorded = open_recording(BAGS / 'lost_samples').estimates()['/link_tip/deflection']
    assert [r.estimate.t_ns for r in results if r.estimate is not None] == recorded.t_ns.tolist()
    # 175 between the first and the last present one, and the last, which its block tells of.
    report = source.health(0)
    assert ('lost', '176') in report.entries[0].values
    assert report.entries[0].message == 'end of the recording'
    with pytest.raises(RejectedError, match='has ended'):
        source.zero()
    with pytest.raises(RejectedError, match='not recorded again'):
        asyncio.run(source.record(True))
    assert wanted == ['lost_samples: end of the recording']


class Heard(Feed):
    """Says when the first block with an estimate has come."""

    def __init__(self) -> None:
        super().__init__()
        self.estimated = threading.Event()

    def put(self, record: Record) -> None:
        super().put(record)
        if isinstance(record, SpotMeans) and record.status is BlockStatus.OK:
            self.estimated.set()


def test_zero_is_not_delayed_by_slow_recording() -> None:
    feed, stated = Heard(), list[str]()
    # The next block comes two seconds later, the longest wait; a request is answered at once.
    source = source_of('clean', feed, stated, threading.Event(), speed=1e-3)
    source.start()
    assert feed.estimated.wait(60.0)
    reported = source.zero()
    source.close()
    assert reported.startswith('unloaded dots (mm): psd_1 (')
    assert stated == [reported]


class Played(Feed):
    """Tells the times of the blocks that were played, and waits for one."""

    def __init__(self) -> None:
        super().__init__()
        self.times: list[int] = []
        self.gone = 0
        self.others: list[Record] = []
        self._new = threading.Condition()

    def put(self, record: Record) -> None:
        super().put(record)
        self.gone += sum(item.gone for item in self.take() if isinstance(item, BlockResult))
        with self._new:
            if isinstance(record, SpotMeans):
                self.times.append(record.t_ns)
            elif isinstance(record, AppliedLoad | ReferencePose | ParameterChange):
                self.others.append(record)
            self._new.notify_all()

    def until(self, condition: Callable[[], bool]) -> None:
        with self._new:
            assert self._new.wait_for(condition, 60.0)


def test_what_is_passed_over_on_the_way_to_a_goal_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('psd_deflection.run.monitor.shown_recording.BEFORE_GOAL_NS', 0)
    feed = Played()
    source = source_of('clean', feed, [], threading.Event(), speed=1e-3)
    source.start()
    feed.until(lambda: len(feed.times) >= 1)
    source.play(None, 3.0)
    feed.until(lambda: feed.times[-1] >= feed.times[0] + 2.9e9)
    source.close()
    assert len(feed.times) < 50
    assert feed.gone == 0


def test_a_recording_can_be_paused_and_sought() -> None:
    feed, ended = Played(), threading.Event()
    # A block every two seconds: what comes sooner was sought.
    source = source_of('clean', feed, [], ended, speed=1e-3)
    source.start()
    feed.until(lambda: len(feed.times) >= 1)
    assert source.play(True, None) == 'paused'
    start = feed.times[0]
    times = open_recording(BAGS / 'clean').estimates()['/link_tip/deflection'].t_ns
    for seconds in (3.0, 1.0, 2.0):
        before = len(feed.times)
        assert source.play(None, seconds) == 'paused'
        goal = int(times[times >= start + seconds * 1e9][0])
        feed.until(lambda before=before, goal=goal: goal in feed.times[before:])  # type: ignore[misc]
        # Played up to there, and no further.
        assert feed.times[-1] == goal
    described = source.describe()
    assert (described['paused'], described['load']) == (True, [0.0, -2.0, 0.0])
    # Beyond the end it ends; from there it starts again.
    source.play(False, 9.0)
    assert ended.wait(60.0)
    assert feed.times[-1] >= times[-1]
    before = len(feed.times)
    assert source.play(False, None) == 'playing'
    feed.until(lambda: len(feed.times) > before)
    assert feed.times[before] == start
    source.close()
    with pytest.raises(RejectedError, match='those that were recorded'):
        source.load(0.0, 0.0, 0.0, False, 0.0, 0.0)
    with pytest.raises(RejectedError, match='those that were recorded'):
        source.mark('x', 0.0)
    with pytest.raises(RejectedError, match='those that were recorded'):
        source.step()


@pytest.mark.parametrize(
    ('arguments', 'status', 'reported'),
    [
        (['no_such_bag'], 4, 'no such recording'),
        ([str(BAGS / 'clean'), '--speed', '0'], 2, '--speed 0: must be above 0'),
        (['--speed', '0'], 2, '--speed 0: must be above 0'),
        ([str(BAGS / 'clean'), '--port', '/dev/ttyACM0'], 2, '--port is for a rig'),
        (['--http-port', '70000'], 2, 'monitor_port = 70000'),
        ([str(BAGS / 'clean'), '--address', '192.0.2.1', '--http-port', '0'], 3, 'cannot be served there'),
    ],
)
def test_what_cannot_be_is_one_line(
    arguments: list[str], status: int, reported: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(['monitor', *arguments]) == status
    err = capsys.readouterr().err
    assert reported in err
    assert err.strip().count('\n') == 0
