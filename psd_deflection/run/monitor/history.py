# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The last days in cells of a second, ten seconds and a minute: least, greatest and mean of each quantity, lost
samples, estimates. Rings of fixed memory, merged exactly to what is asked; a time without blocks has no cell, and time
that goes back forgets what lies after it."""

import base64
import json
import math
from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from psd_deflection.base.text import plain_number
from psd_deflection.records import FloatArray
from psd_deflection.run.monitor.feed import BlockResult

LEVELS = ((1, 86_400), (10, 25_920), (60, 10_140))
"""Width of a cell, s, and how many are kept: a day, three days, a week and the hour in which it is looked at."""
KEPT_LEVEL = 1
"""The level whose cells outlive a run."""
MOST_MARKS = 2000
"""Marks, loads, zeros and alarms that are kept."""
SENT_MARKS = 500
"""Those of them that one answer has: the newest of its time."""
MOST_POINTS, LEAST_POINTS = 2000, 10
"""Cells that one answer may have."""
MOST_BLOCKS = 1000
"""Blocks that wait until the second is over; if more have its time they are put away at once."""
MOST_LOST = 10**12
"""A second in which more samples are lost counts so many."""
LATEST_S = 9e9
"""Times beyond this, s since 1970, have no nanoseconds in 64 bits."""

_NONE = np.iinfo(np.int64).min
_POSE = ('dx', 'dy', 'theta')

Cells = npt.NDArray[np.void]


class AskedError(ValueError):
    """What was asked for does not exist; the message says what can be asked for."""


class Asked(NamedTuple):
    """A window of time, ns since 1970, and the most cells that it may have."""

    from_ns: int
    to_ns: int
    points: int


def asked(query: Mapping[str, str]) -> Asked:
    """The window that the parameters of a request name: ``from``, ``to`` in s, ``points``. Raises AskedError."""
    for name in query:
        if name not in ('from', 'to', 'points'):
            raise AskedError(f'{name[:40]!r} is no parameter; there are from, to and points')
    since, until = (_seconds(name, query.get(name)) for name in ('from', 'to'))
    if not since < until:
        raise AskedError(f'from = {since:.15g}: must be before to = {until:.15g}')
    points = query.get('points', str(MOST_POINTS // 2))
    # A word of many digits would take long to be read.
    if not (points.isascii() and points.isdigit() and len(points) < 6 and LEAST_POINTS <= int(points) <= MOST_POINTS):
        raise AskedError(f'points = {points[:40]!r}: must be a whole number from {LEAST_POINTS} to {MOST_POINTS}')
    return Asked(round(since * 1e9), round(until * 1e9), int(points))


def _seconds(name: str, text: str | None) -> float:
    try:
        value = plain_number('' if text is None else text[:40])
    except ValueError:
        value = math.nan
    if not abs(value) <= LATEST_S:
        given = 'is missing' if text is None else f'= {text[:40]!r}'
        raise AskedError(f'{name} {given}: must be a time in s since 1970, at most {LATEST_S:g}')
    return value


class Window(NamedTuple):
    """Cells side by side, from ``start_ns`` on. ``columns``: (n,) each, NaN in a cell in which no value came."""

    start_ns: int
    width_ns: int
    columns: dict[str, FloatArray]

    def content(self) -> dict[str, Any]:
        """As JSON: times in s, columns as little-endian 32-bit floats in base64."""
        packed = {n: base64.b64encode(v.astype('<f4').tobytes()).decode() for n, v in self.columns.items()}
        return {'start': self.start_ns / 1e9, 'width': self.width_ns / 1e9, 'columns': packed}


class Kept(NamedTuple):
    """What outlives a run: cells of the kept level from ``from_key`` on, in order, and all marks (time ns, JSON).

    ``marks``: None if there are no new ones.
    """

    from_key: int
    cells: Cells
    marks: list[tuple[int, str]] | None


class Ring:
    """The newest cells of one width: cell ``key`` covers ``key * width_ns`` to ``(key + 1) * width_ns``."""

    def __init__(self, width_s: int, length: int, kind: np.dtype[np.void]) -> None:
        self.width_ns = width_s * 1_000_000_000
        self.length = length
        # Written once, so that the memory is there from the start.
        self.cells: Cells = np.full(length, empty_cell(kind), kind)

    def merge(self, cell: np.void, t_ns: int) -> None:
        """Add ``cell`` to the one in whose time ``t_ns`` is."""
        key = t_ns // self.width_ns
        mine = self.cells[key % self.length]
        if mine['key'] != key:
            self.cells[key % self.length] = cell
            mine['key'] = key
            return
        for name in ('blocks', 'lost', 'count', 'total'):
            mine[name] += cell[name]
        np.minimum(mine['least'], cell['least'], out=mine['least'])
        np.maximum(mine['greatest'], cell['greatest'], out=mine['greatest'])

    def put(self, cells: Cells) -> None:
        """Add ``cells``, each with a key of this width, in order, to those that are there."""
        if not len(cells):
            return
        cells = cells[cells['key'] > max(self.newest, int(cells['key'][-1])) - self.length]
        at = cells['key'] % self.length
        there = self.cells['key'][at]
        self.cells[at[there < cells['key']]] = cells[there < cells['key']]
        for cell in cells[there == cells['key']]:
            self.merge(cell, int(cell['key']) * self.width_ns)

    def between(self, first: int, last: int) -> Cells:
        """The cells with first <= key < last, in order, of the newest ``length``."""
        last = min(last, self.newest + 1)
        # An older one may still be in its place, if nothing came since in those that share it.
        first = max(first, self.newest + 1 - self.length)
        if first >= last:
            return self.cells[:0]
        keys = np.arange(first, last, dtype=np.int64)
        cells: Cells = self.cells[keys % self.length]
        there: Cells = cells[cells['key'] == keys]
        return there

    @property
    def newest(self) -> int:
        """Key of the newest cell."""
        return int(self.cells['key'].max())

    def forget(self, key: int) -> None:
        """Forget the cells from ``key`` on."""
        self.cells['key'][self.cells['key'] >= key] = _NONE


class History:
    """Takes blocks and marks as they come; answers what the page asks for. One thread at a time.

    ``psds``: how many sums a block has. ``block_size``: samples of a block that is gone altogether. ``levels``: as
    ``LEVELS``, the finest first; each width is a multiple of the first.
    """

    def __init__(self, psds: int, block_size: int, levels: tuple[tuple[int, int], ...] = LEVELS) -> None:
        self.names = (*_POSE, *(f'sum{n}' for n in range(1, psds + 1)))
        self._block_size = block_size
        self._kind = cell_kind(len(self.names))
        self.rings = [Ring(width_s, length, self._kind) for width_s, length in levels]
        self.marks: deque[tuple[int, str]] = deque(maxlen=MOST_MARKS)
        self._empty = empty_cell(self._kind)
        self._unsaved_from = 0
        self._new_marks = True
        self._second: int | None = None
        self._start_second(None)

    @property
    def kind(self) -> np.dtype[np.void]:
        """Of a cell."""
        return self._kind

    @property
    def kept_length(self) -> int:
        """So many cells of the kept level reach as far back as the coarsest level."""
        ring, last = self.rings[KEPT_LEVEL], self.rings[-1]
        return last.length * (last.width_ns // ring.width_ns)

    def unsaved(self, since_key: int | None = None) -> Kept:
        """What is new or changed since the last call: what was kept from ``from_key`` on is to be replaced by it.

        ``since_key``: where one began that was not kept after all.
        """
        self._close()
        ring, since = self.rings[KEPT_LEVEL], self._unsaved_from
        since = since if since_key is None else min(since, since_key)
        # What the ring has lost since then holds as it was kept.
        since = max(since, ring.newest + 1 - ring.length)
        cells = ring.between(since, ring.newest + 1).copy()
        if len(cells):
            # More blocks may come in the last one.
            self._unsaved_from = int(cells['key'][-1])
        marks = list(self.marks) if self._new_marks or since_key is not None else None
        self._new_marks = False
        return Kept(since, cells, marks)

    def load(self, saved: Kept) -> None:
        """Take what an earlier run kept: it is before what has come since, or in the same cell."""
        current_keys = self.rings[KEPT_LEVEL].cells['key']
        ends = [int(keys.min()) for keys in (current_keys[current_keys != _NONE], saved.cells['key'][-1:]) if len(keys)]
        self._unsaved_from = min(ends, default=0)
        for ring in self.rings[KEPT_LEVEL:]:
            ring.put(_merged(saved.cells, ring.width_ns // self.rings[KEPT_LEVEL].width_ns))
        marks = sorted({*(saved.marks or ()), *self.marks}, key=lambda mark: mark[0])
        self.marks.clear()
        self.marks.extend(marks)

    @property
    def bytes(self) -> int:
        """Memory of the cells."""
        return sum(ring.cells.nbytes for ring in self.rings)

    def add(self, result: BlockResult) -> None:
        """Take one more block."""
        spots, estimate = result.spots, result.estimate
        second = spots.t_ns // 1_000_000_000
        if second != self._second or self._blocks >= MOST_BLOCKS:
            self._close()
            if self._second is not None and second < self._second:
                self._go_back(spots.t_ns)
            self._start_second(second)
        self._blocks += 1
        self._lost += spots.lost + result.gone * self._block_size
        if estimate is not None:
            for values, value in zip(self._values, estimate.pose, strict=False):
                values.append(value)
        for values, value in zip(self._values[len(_POSE) :], spots.sums, strict=True):
            if math.isfinite(value):
                values.append(value)

    def mark(self, t_ns: int, text: str) -> None:
        """Keep a mark: its time and what the page gets of it, JSON."""
        self._new_marks = True
        self.marks.append((t_ns, text))

    def window(self, wanted: Asked) -> Window:
        """What is known of a window, in as few cells as ``wanted.points``; empty times at its ends are left out."""
        self._close()
        need_ns = -((wanted.from_ns - wanted.to_ns) // wanted.points)
        ring = self.ring_for(wanted.from_ns, need_ns)
        merged = max(1, -(-need_ns // ring.width_ns))
        width_ns = merged * ring.width_ns
        first, last = wanted.from_ns // width_ns, -(-wanted.to_ns // width_ns)
        cells = ring.between(first * merged, last * merged)
        if not len(cells):
            return Window(first * width_ns, width_ns, self._columns(cells[:0], np.zeros(0, np.int64), 0))
        out = _merged(cells, merged)
        at = out['key'] - out['key'][0]
        return Window(int(out['key'][0]) * width_ns, width_ns, self._columns(out, at, int(at[-1]) + 1))

    def answer(self, wanted: Asked) -> str:
        """:meth:`window` with the marks in it, as JSON."""
        inside = [text for t_ns, text in self.marks if wanted.from_ns <= t_ns <= wanted.to_ns]
        omitted = max(len(inside) - SENT_MARKS, 0)
        content = json.dumps({**self.window(wanted).content(), 'marks_left_out': omitted})
        return f'{content[:-1]}, "marks": [{",".join(inside[omitted:])}]}}'

    def _columns(self, cells: Cells, at: npt.NDArray[np.int64], length: int) -> dict[str, FloatArray]:
        """``cells`` (m,) put to the places ``at`` (m,) of columns of ``length``."""

        def placed(values: npt.NDArray[Any], nothing: float) -> FloatArray:
            column = np.full(length, nothing)
            column[at] = values
            return column

        out = {}
        for i, name in enumerate(self.names):
            count = cells['count'][:, i]
            there = count > 0
            mean = np.divide(cells['total'][:, i], count, out=np.full(len(cells), math.nan), where=there)
            out[name] = placed(mean, math.nan)
            out[f'{name}_low'] = placed(np.where(there, cells['least'][:, i], math.nan), math.nan)
            out[f'{name}_high'] = placed(np.where(there, cells['greatest'][:, i], math.nan), math.nan)
        out['blocks'] = placed(cells['blocks'], 0.0)
        out['estimates'] = placed(cells['count'][:, 0], 0.0)
        out['lost'] = placed(cells['lost'], 0.0)
        return out

    def ring_for(self, from_ns: int, need_ns: int) -> Ring:
        """The coarsest level that is fine enough, or a coarser one if that does not reach back to ``from_ns``."""
        fine = [ring for ring in self.rings if ring.width_ns <= need_ns] or self.rings[:1]
        for ring in self.rings[len(fine) - 1 : -1]:
            if from_ns // ring.width_ns > ring.newest - ring.length:
                return ring
        return self.rings[-1]

    def _start_second(self, second: int | None) -> None:
        self._second = second
        self._blocks = self._lost = 0
        self._values: list[list[float]] = [[] for _ in self.names]

    def _close(self) -> None:
        """Put the blocks of the second under way into the rings; more may come in it."""
        if self._second is None or not self._blocks:
            return
        cell = self._empty.copy()
        cell['blocks'], cell['lost'] = self._blocks, min(self._lost, MOST_LOST)
        for i, values in enumerate(self._values):
            if values:
                cell['count'][i], cell['total'][i] = len(values), math.fsum(values)
                cell['least'][i], cell['greatest'][i] = min(values), max(values)
        for ring in self.rings:
            ring.merge(cell, self._second * 1_000_000_000)
        self._start_second(self._second)

    def _go_back(self, t_ns: int) -> None:
        """Forget what lies from the second of ``t_ns`` on."""
        finest, *coarser = self.rings
        self._unsaved_from = min(self._unsaved_from, t_ns // self.rings[KEPT_LEVEL].width_ns)
        finest.forget(t_ns // finest.width_ns)
        for ring in coarser:
            key = t_ns // ring.width_ns
            ring.forget(key)
            # The part of its cell that lies before.
            scale = ring.width_ns // finest.width_ns
            for cell in finest.between(key * scale, (key + 1) * scale):
                ring.merge(cell, int(cell['key']) * finest.width_ns)
        earlier = [mark for mark in self.marks if mark[0] < t_ns]
        self._new_marks = True
        self.marks.clear()
        self.marks.extend(earlier)


def _merged(cells: Cells, scale: int) -> Cells:
    """``cells``, in order, as cells ``scale`` times as wide."""
    if not len(cells) or scale == 1:
        return cells
    keys = cells['key'] // scale
    starts = np.flatnonzero(np.diff(keys, prepend=keys[0] - 1))
    out = np.zeros(len(starts), cells.dtype)
    out['key'] = keys[starts]
    for name in ('blocks', 'lost', 'count', 'total'):
        out[name] = np.add.reduceat(cells[name], starts)
    out['least'] = np.minimum.reduceat(cells['least'], starts)
    out['greatest'] = np.maximum.reduceat(cells['greatest'], starts)
    return out


def cell_kind(channels: int) -> np.dtype[np.void]:
    """A cell: ``count``, ``total`` and so on have a place for each quantity."""
    many = (channels,)
    fields: list[Any] = [('key', 'i8'), ('blocks', 'i4'), ('lost', 'i8'), ('count', 'i4', many)]
    return np.dtype([*fields, ('total', 'f8', many), ('least', 'f4', many), ('greatest', 'f4', many)])


def empty_cell(kind: np.dtype[np.void]) -> np.void:
    """A cell of this kind without a block."""
    cell: np.void = np.zeros(1, kind)[0]
    cell['key'], cell['least'], cell['greatest'] = _NONE, np.inf, -np.inf
    return cell
