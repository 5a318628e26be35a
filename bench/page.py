# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Makes docs/performance.md, and three rows of README, from bench/results.json and bench/cpu.json."""

from collections.abc import Mapping, Sequence
from typing import Any

from bench.cpu import RESULTS as CPU
from bench.rows import RESULTS, ROOT, Figure, Row, read

TEMPLATE = ROOT / 'bench' / 'performance_template.md'
PAGE = ROOT / 'docs' / 'performance.md'
README = ROOT / 'README.md'
PRINTED_BY = '| `make bench ARGS=--full` |'  # How the rows of README end that are made here.
SMALL = 2.0  # Per cent of the CPU, below which parts are added up.


def cell(f: Figure, unit: str = '') -> str:
    quartiles = '' if f.runs == 1 else f' [{f.low:.3g}–{f.high:.3g}]'
    return f'{f.median:.3g}{quartiles} {unit}'.rstrip()


def lines_of(row: Row) -> list[str]:
    """The rows of the table: one for each figure that ours stand beside, or one of ours alone."""
    ours = [f for f in row.figures if f.kind == 'ours']
    if len(ours) > 1:
        each = '; '.join(f'{f.name}: {f.median:.3g}' for f in ours)
        return [f'| {row.work}, {row.unit} | {each} | | |']
    work, first, lines = row.work, cell(ours[0], row.unit), []
    for f in row.figures[1:]:
        ratio = f'{row.ratio(f):.2f} ×'
        bound = '' if f.bound is None else f'{"≥" if f.kind == "peer" else "≤"} {f.bound:g}: '
        verdict = row.verdict(f).replace('not met', '**not met**')
        bound = f' ({bound}{verdict})' if bound else ''
        lines.append(f'| {work} | {first} | {f.kind}: {f.name}, {cell(f)} | {ratio}{bound} |')
        work = first = ''
    if not lines:
        bound = '' if ours[0].bound is None else f'≥ {ours[0].bound:g}: {row.verdict(ours[0])}'
        return [f'| {row.work} | {first} ({ours[0].name}) | | {bound.replace("not met", "**not met**")} |']
    return lines


def measured(machine: Mapping[str, Any]) -> str:
    """Where and of what the figures are."""
    versions = ', '.join(f'{name} {version}' for name, version in machine['versions'].items())
    return (
        f'{machine["date"]}, commit {machine["commit"]}, {machine["processor"]}, {machine["cores"]} cores, '
        f'load {machine["load"]} at the end, Python {machine["python"]}, {versions}.'
    )


def shares(row: Row, machine: Mapping[str, Any]) -> str:
    lines = [
        f'{machine["date"]}, commit {machine["commit"]}, {machine["processor"]}, load {machine["load"]} at the end.',
        *('', f'| {row.work} | {row.unit} |', '|---|---|'),
    ]
    threads: dict[str, list[str]] = {}
    for f in row.figures:
        if f.median >= SMALL:
            thread, _, part = f.name.partition(': ')
            threads.setdefault(thread, []).append(f'{part} {f.median:.1f}')
    lines += [f'| {thread} | {"; ".join(parts)} |' for thread, parts in threads.items()]
    small = sum(f.median for f in row.figures if f.median < SMALL)
    return '\n'.join([*lines, f'| parts below {SMALL:g} % | {small:.1f} |'])


def page(rows: Sequence[Row], machine: Mapping[str, Any], cpu: Sequence[Row], cpu_machine: Mapping[str, Any]) -> str:
    table = ['| work | psd_deflection | beside | ratio (wanted) |', '|---|---|---|---|']
    table += [line for row in rows for line in lines_of(row)]
    text = TEMPLATE.read_text(encoding='utf-8')
    text = text.replace('<!-- machine -->', measured(machine)).replace('<!-- table -->', '\n'.join(table))
    return text.replace('<!-- cpu -->', shares(cpu[0], cpu_machine))


def readme(text: str, rows: Sequence[Row]) -> str:
    """``text`` of README with its rows of figures made of ``rows``."""
    by_work = {row.work: row for row in rows}
    live = 'live: last byte of a block to callback in another process'
    median, late = by_work[f'{live}, median'], by_work[f'{live}, 99th percentile']
    cpu, looked_at = (by_work[f'live{page}: CPU of the node, recording'] for page in ('', ', live page looked at'))
    replay = by_work['replay of 10 minutes to estimates, all solvers']
    bare = next(f for f in replay.figures if f.kind == 'limit')
    ratios = [row.ratio(row.figures[1]) for row in (median, late)]
    made = (
        f'| latency, last byte → callback in another process | {median.figures[0].median:.2f} ms (median), '
        f'{late.figures[0].median:.2f} ms (p99): {ratios[0]:.2f} × and {ratios[1]:.2f} × a bare publish → callback ',
        f'| CPU of the node, recording | {cpu.figures[0].median:.1f} % of a core; '
        f'{looked_at.figures[0].median:.1f} % with the live page ',
        f'| replay of ten minutes | {600.0 / replay.figures[0].median:.0f} × real time; '
        f'{replay.ratio(bare):.1f} × bare iteration of the file with `mcap` ',
    )
    lines = iter(f'{line}{PRINTED_BY}' for line in made)
    return '\n'.join(next(lines) if line.endswith(PRINTED_BY) else line for line in text.split('\n'))


def main() -> None:
    README.write_text(readme(README.read_text(encoding='utf-8'), read(RESULTS)[0]), encoding='utf-8')
    PAGE.write_text(page(*read(RESULTS), *read(CPU)), encoding='utf-8')


if __name__ == '__main__':
    main()
