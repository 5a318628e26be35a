"""Counts the structure: the rooms of the package, and the imports between them.

  python -m tools.rooms [CHECKOUT]

A room is a folder or a file at the top of ``psd_deflection``, or ``msg_adapters``. An arrow leads
from a room to another one that it imports, however often. The package's own ``__init__`` is a door
for users and no room. A circle is a group of rooms, or of modules, that lead to each other.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

import grimp
import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

PACKAGES = ('psd_deflection', 'msg_adapters')


def room_of(module: str) -> str:
    """The room of a module, without the package's name; '' for the package's own file."""
    parts = module.split('.')
    return parts[0] if parts[0] != PACKAGES[0] else '.'.join(parts[1:2])


def circles(arrows: Iterable[tuple[str, str]]) -> list[list[str]]:
    """Groups of names that lead to each other, sorted."""
    pairs = list(arrows)
    names = sorted({name for pair in pairs for name in pair})
    place = {name: i for i, name in enumerate(names)}
    rows, columns = [place[a] for a, _ in pairs], [place[b] for _, b in pairs]
    matrix = csr_array((np.ones(len(pairs)), (rows, columns)), shape=(len(names), len(names)))
    _, groups = connected_components(matrix, connection='strong')
    found: dict[int, list[str]] = defaultdict(list)
    for name, group in zip(names, groups.tolist(), strict=True):
        found[group].append(name)
    return sorted(group for group in found.values() if len(group) > 1)


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('checkout', nargs='?', type=Path, default=Path())
    root = parser.parse_args().checkout.resolve()
    sys.path.insert(0, str(root))
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    between: dict[tuple[str, str], int] = defaultdict(int)
    modules = []
    for module in graph.modules:
        for other in graph.find_modules_directly_imported_by(module):
            if '' not in (room_of(module), room_of(other)):
                modules.append((module, other))
                if room_of(module) != room_of(other):
                    between[room_of(module), room_of(other)] += 1
    files: dict[str, list[int]] = defaultdict(list)
    for package in PACKAGES:
        for path in (root / package).rglob('*.py'):
            name = '.'.join(path.relative_to(root).with_suffix('').parts).removesuffix('.__init__')
            if room_of(name):
                files[room_of(name)].append(len(path.read_text(encoding='utf-8').splitlines()))
    print('| room | files | lines | imports rooms | is imported by rooms |\n|---|---|---|---|---|')
    for room, lengths in sorted(files.items()):
        out, into = (sum(pair[side] == room for pair in between) for side in (0, 1))
        print(f'| `{room}` | {len(lengths)} | {sum(lengths)} | {out} | {into} |')
    every = [n for lengths in files.values() for n in lengths]
    print(f'\n{len(files)} rooms, {len(every)} files, {sum(every)} lines, {len(between)} arrows')
    of_rooms, of_modules = circles(between) or 'none', circles(modules) or 'none'
    print(f'circles of rooms: {of_rooms}; circles of modules: {of_modules}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
