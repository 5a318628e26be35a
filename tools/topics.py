# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Writes the table of topics in docs/topics.md from the rows that the nodes' publishers and subscriptions are made of.

python -m tools.topics
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

from msg_adapters import Delivery
from psd_deflection.ros.topics import HEARD, PUBLISHED, SERVED, GraphTopic
from tools.program import ROOT

PAGE = ROOT / 'docs' / 'topics.md'
BEGIN, END = '<!-- topics: python -m tools.topics writes this table -->', '<!-- end of topics -->'


def table() -> str:
    """The table: a line for each topic, or for those of several PSDs or solvers, and one for each action."""
    lines = ['| topic | type | node | QoS | |', '|---|---|---|---|---|']
    heard = (rows[0] for rows in HEARD.values())
    actions = [f'| `{a.name}` (action) | {a.type.split("/")[-1]} | {a.node} | | {a.says} |' for a in SERVED.values()]
    return '\n'.join([*lines, *_lines(PUBLISHED.values(), ''), *_lines(heard, ' (in)'), *actions])


def _lines(rows: Iterable[GraphTopic], direction: str) -> Iterator[str]:
    for _, alike in itertools.groupby(rows, key=lambda row: row._replace(name='')):
        group = list(alike)
        names = ', '.join(f'`{row.name}`' for row in group[:2]) + (' …' if len(group) > 2 else '')
        row = group[0]
        kind = row.type.split('/')[-1] or 'any'
        yield f'| {names}{direction} | {kind} | {row.node} | {_qos(row.delivery)} | {row.says} |'


def _qos(delivery: Delivery) -> str:
    reliable = '' if delivery.reliable else ', best effort'
    return f'{delivery.depth}{reliable}{", latched" if delivery.latched else ""}'


def written(page: str) -> str:
    """``page`` with the present table."""
    before, _, rest = page.partition(BEGIN)
    return f'{before}{BEGIN}\n\n{table()}\n\n{END}{rest.partition(END)[2]}'


if __name__ == '__main__':
    PAGE.write_text(written(PAGE.read_text(encoding='utf-8')), encoding='utf-8')
