# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Errors that people make and no operator does, of ten kinds: what ``make mutants`` tries besides."""

from pathlib import Path
from typing import NamedTuple

BY_HAND = Path(__file__).with_name('mutants_by_hand.txt')
KINDS = (
    *('sign of a cross term', 'transposed matrix', 'half a sample', 'effective number', 'degrees', 'frame'),
    *('index of a PSD', 'dropped limit', 'stale age', 'swapped deviation'),
)
"""Of the mutants made by hand. An effective number is that of independent values in a mean or a sum."""


class HandMade(NamedTuple):
    """One line ``was``, which ``file`` has once, ``made`` another one; ``kind``: one of ``KINDS``."""

    kind: str
    file: str
    was: str
    made: str

    def code(self, text: str) -> str:
        """The file with the change. Raises ValueError if it has not got this line once."""
        lines = text.splitlines(keepends=True)
        at = self.line_of(text) - 1
        lines[at] = lines[at].replace(self.was, self.made)
        return ''.join(lines)

    def line_of(self, text: str) -> int:
        """Where the line is, from 1. Raises ValueError as :meth:`code`."""
        numbers = [number for number, line in enumerate(text.splitlines(), 1) if line.strip() == self.was]
        if len(numbers) != 1:
            raise ValueError(f'{BY_HAND.name}: {self.file} has this line {len(numbers)} times, not once: {self.was}')
        return numbers[0]

    def words(self, text: str) -> str:
        """For the list, as :meth:`Mutant.words`."""
        return f'{self.file}: {self.was} -> {self.made}'


def hand_made() -> list[HandMade]:
    """Those of the list. Raises ValueError if one of them is of no kind."""
    out = []
    for line in BY_HAND.read_text().splitlines():
        if line and not line.startswith('#'):
            kind, file, change = line.split(': ', 2)
            was, _, made = change.partition(' -> ')
            if kind not in KINDS or not made:
                raise ValueError(f'{BY_HAND.name}: KIND: FILE: a line -> another, not {line}')
            out.append(HandMade(kind, file, was, made))
    return out
