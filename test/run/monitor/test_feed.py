# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
import json
import math

import numpy as np

from psd_deflection.records import RESTART, BlockStatus, ParameterChange, SampleBlock, TipLoad
from psd_deflection.run.monitor.feed import COLUMNS, BlockResult, Feed, row_columns, row_json

from .serving import START_NS, estimate_of, spots_of


def test_a_row_has_the_block_and_its_primary_estimate() -> None:
    feed = Feed()
    feed.put(estimate_of(7))
    feed.put(TipLoad(0, 0.0, 0.0, 0.0))
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
    feed.put(ParameterChange(START_NS, 4, ((RESTART, (70.0, 2000.0)),)))
    feed.put(spots_of(100))
    # Those that did not fit were seen: they are no loss.
    feed.put(spots_of(101))
    assert [r.gone for r in feed.take() if isinstance(r, BlockResult)] == [0, 0, 2, 0, 0, 0]
    feed.put(spots_of(103))
    feed.skip()
    feed.put(spots_of(200))
    assert [r.gone for r in feed.take() if isinstance(r, BlockResult)] == [1, 0]


def test_a_block_without_an_estimate_does_not_borrow_one() -> None:
    feed = Feed()
    feed.put(estimate_of(3))
    feed.put(spots_of(4, status=BlockStatus.LASER_LOST))
    feed.put(spots_of(5, status=BlockStatus.LASER_LOST))
    for result in feed.take():
        assert isinstance(result, BlockResult)
        row = dict(zip(COLUMNS, json.loads(row_json(result)), strict=True))
        assert [row[k] for k in ('dx', 'dy', 'theta', 'sd_dx', 'sd_dy', 'sd_theta')] == [None] * 6
        assert row['status'] == BlockStatus.LASER_LOST


def test_nan_becomes_null() -> None:
    spots = dataclasses.replace(spots_of(0), dots=(math.nan, math.inf, 0.0, -math.inf))
    row = json.loads(row_json(BlockResult(spots, None)))
    assert row[2:6] == [None, None, 0, None]


def test_items_beyond_the_queue_are_dropped_and_counted() -> None:
    feed = Feed(limit=10)
    block = SampleBlock(
        0, np.zeros(1, np.int64), np.zeros(1, np.int64), np.zeros((1, 6), np.float32), np.zeros(1, np.uint8)
    )
    for index in range(25):
        feed.put(spots_of(index))
        feed.put(block)
    assert feed.waiting == 10
    assert feed.dropped == 40
    # The oldest are kept: what is shown has no hole before its end.
    assert [r.spots.index for r in feed.take() if isinstance(r, BlockResult)] == [0, 1, 2, 3, 4]
    feed.put(spots_of(99))
    assert feed.waiting == 1


def test_a_row_of_three_psds_has_their_columns() -> None:
    spots = dataclasses.replace(spots_of(0), dots=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0), sums=(7.0, 8.0, 9.0))
    row = dict(zip(row_columns(3), json.loads(row_json(BlockResult(spots, None))), strict=True))
    assert [row[k] for k in ('x3', 'y3', 'sum1', 'sum3', 'dx')] == [5.0, 6.0, 7.0, 9.0, None]
    assert row['present'] == spots.present
