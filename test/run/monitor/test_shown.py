# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the page is sent of samples and estimates."""

import asyncio
import dataclasses
import json
import math
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from psd_deflection import records
from psd_deflection.base.log import INFO
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import replayed, rig_at_start
from psd_deflection.run.monitor.feed import COLUMNS, BlockResult, Feed, row_columns, row_json
from psd_deflection.run.monitor.shown import RejectedError
from psd_deflection.run.monitor.shown_recording import ShownRecording

from .serving import START_NS, estimate_of, spots_of

BAGS = Path(__file__).parents[3] / 'bags'


def source_of(name: str, feed: Feed, message: list[str], ended: threading.Event, speed: float = 1e6) -> ShownRecording:
    rig = rig_at_start(open_recording(BAGS / name))

    def open_steps() -> tuple[Pipeline, Iterator[list[records.Record]]]:
        recording = open_recording(BAGS / name)
        pipeline = Pipeline(rig)
        return pipeline, replayed(recording, pipeline)

    def log(text: str, level: int = INFO, /) -> None:
        message.append(text)
        ended.set()

    first = next(iter(open_recording(BAGS / name).blocks()))
    inputs = [records.AppliedLoad(int(first.t_ns[0]) + k * 10**9, 0.0, -k, 0.0) for k in (3, 1, 0, 2)]
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
        source.zero(0.0)
    with pytest.raises(RejectedError, match='not recorded again'):
        asyncio.run(source.record(True))
    assert wanted == ['lost_samples: end of the recording']


class Heard(Feed):
    """Says when the first block with an estimate has come."""

    def __init__(self) -> None:
        super().__init__()
        self.estimated = threading.Event()

    def put(self, record: records.Record) -> None:
        super().put(record)
        if isinstance(record, records.SpotMeans) and record.status is records.BlockStatus.OK:
            self.estimated.set()


def test_zero_is_not_delayed_by_slow_recording() -> None:
    feed, stated = Heard(), list[str]()
    # The next block comes two seconds later, the longest wait; a request is answered at once.
    source = source_of('clean', feed, stated, threading.Event(), speed=1e-3)
    source.start()
    assert feed.estimated.wait(60.0)
    reported = source.zero(0.0)
    source.close()
    assert reported.startswith('unloaded dots (mm): psd_1 (')
    assert stated == [reported]


class Played(Feed):
    """Tells the times of the blocks that were played, and waits for one."""

    def __init__(self) -> None:
        super().__init__()
        self.times: list[int] = []
        self.gone = 0
        self.other_records: list[records.Record] = []
        self._new = threading.Condition()

    def put(self, record: records.Record) -> None:
        super().put(record)
        self.gone += sum(item.gone for item in self.take() if isinstance(item, BlockResult))
        with self._new:
            if isinstance(record, records.SpotMeans):
                self.times.append(record.t_ns)
            elif isinstance(record, records.AppliedLoad | records.ReferencePose | records.ParameterChange):
                self.other_records.append(record)
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
        assert feed.times[-1] == goal
    described = source.describe()
    assert (described['paused'], described['load']) == (True, [0.0, -2.0, 0.0])
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


def test_a_row_has_the_block_and_its_primary_estimate() -> None:
    feed = Feed()
    feed.put(estimate_of(7))
    feed.put(records.TipLoad(0, 0.0, 0.0, 0.0))
    feed.put(estimate_of(7, primary=False)._replace(dx=9.0))
    feed.put(spots_of(7, lost=3))
    (result,) = feed.take()
    assert isinstance(result, BlockResult)
    row = dict(zip(COLUMNS, json.loads(row_json(result)), strict=True))
    assert row['t'] == START_NS / 1e9 + 0.14
    assert (row['block'], row['present'], row['lost'], row['status']) == (7, 17, 3, 0)
    assert math.isclose(row['dx'], 1e-3 * math.sin(0.7), rel_tol=1e-6)
    assert math.isclose(row['sd_theta'], 3e-6, rel_tol=1e-6)
    assert math.isclose(row['x1'], 1e-3 * math.cos(0.7), rel_tol=1e-6)


def test_blocks_of_which_nothing_came_are_counted_with_the_next() -> None:
    feed = Feed(limit=6)
    for index in (5, 6, 9, 2, 3):
        feed.put(spots_of(index))
    feed.put(records.ParameterChange(START_NS, 4, ((records.RESTART, (70.0, 2000.0)),)))
    feed.put(spots_of(100))
    feed.put(spots_of(101))
    assert [r.gone for r in feed.take() if isinstance(r, BlockResult)] == [0, 0, 2, 0, 0, 0]
    feed.put(spots_of(103))
    feed.skip()
    feed.put(spots_of(200))
    assert [r.gone for r in feed.take() if isinstance(r, BlockResult)] == [1, 0]


def test_a_block_without_an_estimate_does_not_borrow_one() -> None:
    feed = Feed()
    feed.put(estimate_of(3))
    feed.put(spots_of(4, status=records.BlockStatus.LASER_LOST))
    feed.put(spots_of(5, status=records.BlockStatus.LASER_LOST))
    for result in feed.take():
        assert isinstance(result, BlockResult)
        row = dict(zip(COLUMNS, json.loads(row_json(result)), strict=True))
        assert [row[k] for k in ('dx', 'dy', 'theta', 'sd_dx', 'sd_dy', 'sd_theta')] == [None] * 6
        assert row['status'] == records.BlockStatus.LASER_LOST


def test_nan_becomes_null() -> None:
    spots = dataclasses.replace(spots_of(0), dots=(math.nan, math.inf, 0.0, -math.inf))
    row = json.loads(row_json(BlockResult(spots, None)))
    assert row[2:6] == [None, None, 0, None]


def test_items_beyond_the_queue_are_dropped_and_counted() -> None:
    feed = Feed(limit=10)
    block = records.SampleBlock(
        0, np.zeros(1, np.int64), np.zeros(1, np.int64), np.zeros((1, 6), np.float32), np.zeros(1, np.uint8)
    )
    for index in range(25):
        feed.put(spots_of(index))
        feed.put(block)
    assert (feed.waiting, feed.dropped) == (10, 40)
    # The oldest are kept: what is shown has no hole before its end.
    assert [r.spots.index for r in feed.take() if isinstance(r, BlockResult)] == [0, 1, 2, 3, 4]
    feed.put(spots_of(99))
    assert feed.waiting == 1


def test_a_row_of_three_psds_has_their_columns() -> None:
    spots = dataclasses.replace(spots_of(0), dots=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0), sums=(7.0, 8.0, 9.0))
    row = dict(zip(row_columns(3), json.loads(row_json(BlockResult(spots, None))), strict=True))
    assert [row[k] for k in ('x3', 'y3', 'sum1', 'sum3', 'dx')] == [5.0, 6.0, 7.0, 9.0, None]
    assert row['present'] == spots.present
