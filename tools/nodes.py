# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Prints what every ROS node does alike: a row a check, a column a node."""

import re
import sys
from collections.abc import Sequence

import pytest

from tools.program import ROOT

TESTS = ROOT / 'test' / 'ros' / 'test_conformance.py'
YES, NO = 'yes', 'NO'
CELL = re.compile(r'::test_(\w+)\[(\w+)\]')


class Table:
    """A plug-in of pytest that keeps the outcome of each check for each node."""

    def __init__(self) -> None:
        self.cells: dict[str, dict[str, str]] = {}
        self.notes: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Take one outcome: of the test, or of a fixture that failed."""
        found = CELL.search(report.nodeid)
        if found is None or (report.when != 'call' and report.passed):
            return
        check, node = found.groups()
        row = self.cells.setdefault(check.replace('_', ' '), {})
        if report.skipped and isinstance(report.longrepr, tuple):
            why = report.longrepr[2].removeprefix('Skipped: ')
            if why not in self.notes:
                self.notes.append(why)
            row[node] = f'({self.notes.index(why) + 1})'
        else:
            row[node] = YES if report.passed and row.get(node) != NO else NO

    def lines(self) -> list[str]:
        nodes = sorted({node for row in self.cells.values() for node in row})
        wide = max(map(len, self.cells), default=0)
        heads = ' '.join(f'{node:^{len(node) + 2}}' for node in nodes)
        out = [f'{"":{wide}}  {heads}'.rstrip()]
        for check, row in self.cells.items():
            cells = ' '.join(f'{row.get(node, ""):^{len(node) + 2}}' for node in nodes)
            out.append(f'{check:{wide}}  {cells}'.rstrip())
        return [*out, '', *(f'({n}) {why}' for n, why in enumerate(self.notes, start=1))]

    def complete(self) -> bool:
        """Whether every cell has an answer, and none is no."""
        nodes = {node for row in self.cells.values() for node in row}
        return bool(nodes) and all(row.get(node, NO) != NO for row in self.cells.values() for node in nodes)


def main(words: Sequence[str]) -> int:
    """Run the checks and print the table."""
    table = Table()
    status = pytest.main(['-q', '-p', 'no:cacheprovider', str(TESTS), *words], plugins=[table])
    print(*table.lines(), sep='\n')
    return 0 if status == 0 and table.complete() else 1


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
