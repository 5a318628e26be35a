# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Counts the structure: the rooms of the package with their tests, the imports between them, and what lies beside."""

import argparse
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import grimp

PACKAGES = ('psd_deflection', 'msg_adapters')
DOCUMENTED = frozenset({'_replace', '_asdict', '_fields', '_make', '_repr_html_', '_repr_png_'})


def room_of(module: str) -> str:
    """The room of a module, without the package's name; '' for the package's own file."""
    parts = module.split('.')
    return parts[0] if parts[0] != PACKAGES[0] else '.'.join(parts[1:2])


def lines_of(folder: Path) -> list[int]:
    """The lines of each Python file below ``folder``."""
    return [len(path.read_text(encoding='utf-8').splitlines()) for path in folder.rglob('*.py')]


def private_names(folder: Path) -> list[str]:
    """The uses of private names in the files below ``folder``, as ``name._private``."""
    names = (n for path in folder.rglob('*.py') for n in re.findall(r'[a-z_]+\._[a-z]\w+', path.read_text('utf-8')))
    of_others = [name for name in names if not name.startswith(('self.', 'cls.'))]
    return [name for name in of_others if name.rpartition('.')[2] not in DOCUMENTED]


def beside(root: Path) -> Iterator[str]:
    """What lies beside the package, a line each."""
    for folders in (('psd_deflection',), ('test',), ('bench', 'blind', 'tools')):
        every = [n for folder in folders for n in lines_of(root / folder)]
        yield f'{", ".join(folders)}: {sum(every)} lines in {len(every)} files'
    (targets,) = re.findall(r'^\.PHONY: (.*)', (root / 'Makefile').read_text(), re.M)
    yield f'make targets: {len(targets.split())}; private names in test: {len(private_names(root / "test"))}'


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('checkout', nargs='?', type=Path, default=Path())
    root = parser.parse_args().checkout.resolve()
    sys.path.insert(0, str(root))
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    between: dict[tuple[str, str], int] = defaultdict(int)
    for module in graph.modules:
        for other in graph.find_modules_directly_imported_by(module):
            if '' not in (room_of(module), room_of(other)) and room_of(module) != room_of(other):
                between[room_of(module), room_of(other)] += 1
    files: dict[str, list[int]] = defaultdict(list)
    for package in PACKAGES:
        for path in (root / package).rglob('*.py'):
            name = '.'.join(path.relative_to(root).with_suffix('').parts).removesuffix('.__init__')
            if room_of(name):
                files[room_of(name)].append(len(path.read_text(encoding='utf-8').splitlines()))
    print('| room | files | lines | lines of tests | imports rooms | is imported by rooms |\n|---|---|---|---|---|---|')
    for room, lengths in sorted(files.items()):
        out, into = (sum(pair[side] == room for pair in between) for side in (0, 1))
        tests = sum(lines_of(root / 'test' / room))
        print(f'| `{room}` | {len(lengths)} | {sum(lengths)} | {tests} | {out} | {into} |')
    every = [n for lengths in files.values() for n in lengths]
    print('', *beside(root), sep='\n')
    print(f'\n{len(files)} rooms, {len(every)} files, {sum(every)} lines, {len(between)} arrows')
    return 0


if __name__ == '__main__':
    sys.exit(main())
