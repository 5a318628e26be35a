# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Writes the tables of docs/ that the program has already: topics, commands, parameters, exit statuses, effects."""

import itertools
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from msg_adapters import Delivery
from psd_deflection.base import errors
from psd_deflection.cli.main import COMMANDS
from psd_deflection.model.simulation.catalogue import catalogue
from psd_deflection.model.simulation.declaration import Effect
from psd_deflection.rig.declarations import SECTIONS
from psd_deflection.rig.parameters import Parameter
from psd_deflection.ros.topics import HEARD, PUBLISHED, SERVED, GraphTopic
from tools.program import ROOT

OWN_EFFECTS = {path.stem for path in (ROOT / 'psd_deflection/model/simulation/effects').glob('[a-z]*.py')}
"""Not those of the person who writes the pages."""
_CHANNEL = re.compile(r'_(?:x|y|sum)\d$')


def topics() -> str:
    """A row for each topic, or for those of several PSDs or solvers, and one for each action."""
    heard = (rows[0] for rows in HEARD.values())
    kinds = ((a, a.type.split('/')[-1]) for a in SERVED.values())
    actions = [f'| `{a.name}` (action) | {kind} | {a.node} | | {a.description} |' for a, kind in kinds]
    return _table('topic | type | node | QoS | ', [*_rows(PUBLISHED.values(), ''), *_rows(heard, ' (in)'), *actions])


def commands() -> str:
    return _table('command | ', (f'| `{name}` | {summary} |' for name, summary in COMMANDS.items()))


def exit_statuses() -> str:
    return _table('status | meaning', (f'| {s} | {meaning} |' for s, meaning in errors.EXIT_STATUSES.items()))


def parameters() -> str:
    """A row for each section of the rig file with its parameters: those of the PSDs and beams once."""
    rows = []
    for section in SECTIONS:
        if not re.match(r'(psd|beam)_[2-9]', section.prefix):
            cells = (_named(p, len(section.prefix)) for p in section.parameters.values())
            rows.append(f'| {section.prefix.replace("_1", "_N") or "none"} | {", ".join(cells)} |')
    return _table('prefix | parameters', rows)


def _named(p: Parameter, start: int) -> str:
    return f'`{p.name[start:]}{"*" if p.live else ""}`'


def effects() -> str:
    shown = sorted((e for e in catalogue().values() if e.name in OWN_EFFECTS), key=lambda e: e.rank)
    return _table('effect | what it does | parameters', (_effect(e) for e in shown))


def _effect(effect: Effect) -> str:
    # Those of the channels are one: amplitude_x1, amplitude_y1 … is `amplitude_…`.
    values = (f'`{_CHANNEL.sub("_…", p.name)}`{f" ({p.unit})" if p.unit else ""}' for p in effect.parameters)
    return f'| `{effect.name}` | {effect.summary} | {", ".join(dict.fromkeys(values))} |'


def _table(head: str, rows: Iterable[str]) -> str:
    first = f'| {head}|' if head.endswith(' ') else f'| {head} |'
    return '\n'.join([first, '|---' * (head.count('|') + 1) + '|', *rows])


def _rows(rows: Iterable[GraphTopic], direction: str) -> Iterator[str]:
    for _, alike in itertools.groupby(rows, key=lambda row: row._replace(name='')):
        group = list(alike)
        names = ', '.join(f'`{row.name}`' for row in group[:2]) + (' …' if len(group) > 2 else '')
        row = group[0]
        kind = row.type.split('/')[-1] or 'any'
        yield f'| {names}{direction} | {kind} | {row.node} | {_qos(row.delivery)} | {row.description} |'


def _qos(delivery: Delivery) -> str:
    reliable = '' if delivery.reliable else ', best effort'
    return f'{delivery.depth}{reliable}{", latched" if delivery.latched else ""}'


TABLES = {f.__name__.replace('_', ' '): f for f in (topics, commands, exit_statuses, parameters, effects)}
PAGES = tuple(ROOT / 'docs' / name for name in ('topics.md', 'commands.md', 'effects.md'))
MOST_WORDS = 45_000


def words() -> int:
    """Return how many words README and docs/ have, as ``wc -w`` counts them."""
    pages = [ROOT / 'README.md', *(ROOT / 'docs').rglob('*.md')]
    return sum(len(page.read_text(encoding='utf-8').split()) for page in pages)


def written(page: str) -> str:
    """Return the text of ``page`` with the current tables."""
    for name, table in TABLES.items():
        begin, end = f'<!-- {name}: python -m tools.pages writes this table -->', f'<!-- end of {name} -->'
        before, marker, rest = page.partition(begin)
        if marker:
            page = f'{before}{begin}\n\n{table()}\n\n{end}{rest.partition(end)[2]}'
    return page


def main(pages: Iterable[Path] = PAGES) -> None:
    for page in pages:
        page.write_text(written(page.read_text(encoding='utf-8')), encoding='utf-8')
    print(f'{words()} words in README and docs/, of at most {MOST_WORDS}')


if __name__ == '__main__':
    main()
