# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The table of topics is whole: nothing is published or heard beside it."""

import ast
import functools

import pytest

from msg_adapters import BY_NAME, TOPICS, to_messages
from psd_deflection.rig.config import load_rig
from psd_deflection.ros.topics import HEARD, PUBLISHED, SERVED
from psd_deflection.run.fanout import published, subscribed
from test.recordings.making import estimate
from tools.program import ROOT

MAKERS = {
    'create_publisher': 'endpoints.py',
    'create_subscription': 'gate.py',
    'ActionServer': 'endpoints.py',
    'ActionClient': 'endpoints.py',
    'GuardedServer': 'gate.py',
    'GuardedClient': 'gate.py',
}
"""What makes publishers, subscriptions and actions, and the one file that may call it: they are made from rows."""


@functools.cache
def users() -> dict[str, set[str]]:
    """The files in which each of them is called or inherited from."""
    out: dict[str, set[str]] = {maker: set() for maker in MAKERS}
    for path in sorted((ROOT / 'psd_deflection').rglob('*.py')):
        text = path.read_text(encoding='utf-8')
        if not any(maker in text for maker in MAKERS):
            continue
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Attribute):
                used = [node.attr]
            elif isinstance(node, ast.Call | ast.ClassDef):
                names = [node.func] if isinstance(node, ast.Call) else node.bases
                used = [name.id for name in names if isinstance(name, ast.Name)]
            else:
                continue
            for name in used:
                if name in out:
                    out[name].add(path.name)
    return out


@pytest.mark.parametrize('maker', MAKERS)
def test_publishers_and_actions_are_made_from_rows(maker: str) -> None:
    assert users()[maker] == {MAKERS[maker]}


def test_every_topic_of_a_record_has_a_row() -> None:
    inputs = {t.name for t in TOPICS if t.to_record is not None}
    assert inputs <= HEARD.keys()
    rig = load_rig(overrides={'filter': 'modal'})
    assert published(rig).keys() <= PUBLISHED.keys()
    assert set(subscribed(rig)) == inputs
    for row in PUBLISHED.values():
        if row.name in BY_NAME:
            assert row.type == BY_NAME[row.name].message.name
    assert {m.topic for m in to_messages(estimate(3))} <= PUBLISHED.keys()


def test_a_topic_without_a_row_is_rejected() -> None:
    endpoints = pytest.importorskip('psd_deflection.ros.endpoints')
    with pytest.raises(KeyError, match='/made/up'):
        endpoints.publisher_of(None, '/made/up')


def test_every_row_says_what_is_on_it() -> None:
    rows = [*PUBLISHED.values(), *(row for rows in HEARD.values() for row in rows)]
    assert [row.name for row in rows if not (row.description and row.node)] == []
    assert [row.name for row in SERVED.values() if not (row.description and row.node and row.type)] == []
    # Any type there may be is named by a parameter, and that is one.
    assert [row.name for row in rows if not row.type] == ['~/controller_state']
