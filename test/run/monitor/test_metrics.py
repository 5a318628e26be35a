# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``/metrics`` as Prometheus reads it: its own parser is the judge."""

import math
from collections.abc import Callable
from typing import Any

import pytest
from prometheus_client.openmetrics.parser import text_string_to_metric_families as parsed

from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.rig.config import load_rig
from psd_deflection.run.monitor import server
from psd_deflection.run.monitor.feed import BlockResult
from psd_deflection.run.monitor.metrics import CONTENT_TYPE, Family, counters, of_block, of_pipeline, text_of

from .serving import Serving, estimate_of, spots_of
from .test_server import ask, listen

Serve = Callable[..., Serving]


def numbers(text: str) -> dict[tuple[str, ...], float]:
    """Name and label values of each sample."""
    return {(s.name, *s.labels.values()): s.value for family in parsed(text) for s in family.samples}


def scraped(serving: Serving) -> dict[tuple[str, ...], float]:
    status, text, headers = ask(f'{serving.url}metrics', 'GET')
    assert status == 200
    assert headers['Content-Type'] == CONTENT_TYPE
    return numbers(text)


def shown(serving: Serving, index: int) -> None:
    """Wait until the page has this block."""
    listen(serving.url, lambda m: any(r[1] == index for r in m.get('rows', [])))


def test_a_scrape_has_counters_and_the_newest_estimate(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, 'FRESH_S', math.inf)
    serving = serve()
    before = scraped(serving)
    assert before[('psd_deflection_samples_total',)] == 40.0
    assert not any('meters' in key[0] for key in before)
    serving.give(0, 3)
    shown(serving, 2)
    after = scraped(serving)
    best = estimate_of(2)
    assert after[('psd_deflection_deflection_meters', 'y')] == best.dy
    assert after[('psd_deflection_deflection_sd_meters', 'x')] == pytest.approx(2e-7)
    assert after[('psd_deflection_twist_radians',)] == best.theta
    assert after[('psd_deflection_sum_volts', '2')] == 5.0
    assert after[('psd_deflection_page_dropped_total',)] == 0.0


def test_the_estimate_of_a_device_that_is_away_is_no_estimate(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, 'FRESH_S', 0.0)
    serving = serve()
    serving.give(0, 1)
    shown(serving, 0)
    assert not any('meters' in key[0] or 'volts' in key[0] for key in scraped(serving))


@pytest.mark.parametrize(('headers', 'status'), [({'Host': 'evil.example'}, 403), ({}, 200)])
def test_it_has_the_gate_of_the_page(serve: Serve, headers: dict[str, str], status: int) -> None:
    url = serve().url
    assert ask(url, 'GET', headers=headers)[0] == status
    assert ask(f'{url}metrics', 'GET', headers=headers)[0] == status


def test_names_types_and_units_are_those_of_openmetrics() -> None:
    pipeline = Pipeline(load_rig())
    families: list[Any] = list(parsed(text_of([*of_pipeline(pipeline), *of_block(BlockResult(spots_of(1), None))])))
    types = {family.name: (family.type, family.unit) for family in families}
    assert types['psd_deflection_blocks'] == ('counter', '')
    assert types['psd_deflection_sum_volts'] == ('gauge', 'volts')
    assert types['psd_deflection_build'] == ('info', '')
    assert all(family.documentation for family in families)


def test_words_of_a_device_cannot_break_the_text() -> None:
    words = 'a "quoted" \\ word\nof two lines'
    text = text_of([counters('samples_lost', 'cause', 'Lost', {words: 3, '\udce9': 1})])
    found = numbers(text)
    assert found[('psd_deflection_samples_lost_total', words)] == 3.0
    assert found[('psd_deflection_samples_lost_total', '?')] == 1.0


def test_a_number_that_is_none_is_reported_as_one() -> None:
    text = text_of([Family('sum_volts', 'gauge', 'Sum', (({}, math.nan), ({'psd': '1'}, math.inf)), 'volts')])
    values = list(numbers(text).values())
    assert math.isnan(values[1])
    assert values[2] == math.inf
