# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Counts the structure: the rooms of the package with their tests, the imports between them, and what lies beside."""

import argparse
import ast
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import grimp

PACKAGES = ('psd_deflection', 'msg_adapters')
MOST_COMPLEX, MOST_PARAMETERS = 20, 8
DOCUMENTED = frozenset({'_replace', '_asdict', '_fields', '_make', '_repr_html_', '_repr_png_'})
Function = ast.FunctionDef | ast.AsyncFunctionDef


def room_of(module: str) -> str:
    """The room of a module, without the package's name; '' for the package's own file."""
    parts = module.split('.')
    return parts[0] if parts[0] != PACKAGES[0] else '.'.join(parts[1:2])


class Measured(NamedTuple):
    """Of a function: its paths and its parameters, without ``self``, ``cls`` and the starred ones."""

    complexity: int
    parameters: int

    @property
    def is_large(self) -> bool:
        """Whether either number is above its bound."""
        return self.complexity > MOST_COMPLEX or self.parameters > MOST_PARAMETERS


def _own_nodes(function: ast.AST) -> Iterator[ast.AST]:
    """All nodes of a function but those of functions and classes inside it."""
    waiting = [function]
    while waiting:
        node = waiting.pop()
        yield node
        inside = ast.iter_child_nodes(node)
        waiting += [n for n in inside if not isinstance(n, Function | ast.ClassDef)]


def complexity(function: ast.AST) -> int:
    """1 and each place where the way through it forks."""
    paths = 1
    for node in _own_nodes(function):
        if isinstance(node, ast.BoolOp):
            paths += len(node.values) - 1
        elif isinstance(node, ast.Try):
            paths += len(node.handlers) + bool(node.orelse)
        elif isinstance(node, ast.For | ast.While | ast.AsyncFor):
            paths += 1 + bool(node.orelse)
        elif isinstance(node, ast.comprehension):
            paths += 1 + len(node.ifs)
        elif isinstance(node, ast.If | ast.IfExp | ast.match_case):
            paths += 1
    return paths


def measured(source: str) -> dict[str, Measured]:
    """The functions of a module by name; those inside a class or a function as ``Outer.inner``."""
    out: dict[str, Measured] = {}

    def visit(outer: ast.AST, prefix: str) -> None:
        for node in ast.iter_child_nodes(outer):
            if isinstance(node, Function):
                of = [a.arg for a in (*node.args.posonlyargs, *node.args.args)]
                count = len(of) + len(node.args.kwonlyargs) - (of[:1] in (['self'], ['cls']))
                out[prefix + node.name] = Measured(complexity(node), count)
            if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                visit(node, f'{prefix}{node.name}.')
            else:
                visit(node, prefix)

    visit(ast.parse(source), '')
    return out


def large_functions(root: Path) -> dict[str, Measured]:
    """The large functions of the package below ``root``, as ``room/module.py:Class.method``."""
    package = root / PACKAGES[0]
    return {
        f'{path.relative_to(package).as_posix()}:{name}': one
        for path in sorted(package.rglob('*.py'))
        for name, one in measured(path.read_text(encoding='utf-8')).items()
        if one.is_large
    }


def lines_of(folder: Path) -> list[int]:
    """The lines of each Python file below ``folder``."""
    return [len(path.read_text(encoding='utf-8').splitlines()) for path in folder.rglob('*.py')]


def private_names(folder: Path) -> list[str]:
    """The uses of private names in the files below ``folder``, as ``name._private``."""
    found = (n for path in folder.rglob('*.py') for n in re.findall(r'[a-z_]+\._[a-z]\w+', path.read_text('utf-8')))
    of_others = [name for name in found if not name.startswith(('self.', 'cls.'))]
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
    large = large_functions(root)
    print(f'\n{len(large)} large functions')
    for name, one in sorted(large.items(), key=lambda item: item[1], reverse=True):
        print(f'  {name}: complexity {one.complexity}, {one.parameters} parameters')
    print('', *beside(root), sep='\n')
    print(f'\n{len(files)} rooms, {len(every)} files, {sum(every)} lines, {len(between)} arrows')
    return 0


if __name__ == '__main__':
    sys.exit(main())
