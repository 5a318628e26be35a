# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where the CPU time goes: parts without what is inside them, threads without gaps, kinds of native code."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable

import pytest

from bench import cpu


class Ticks:
    """A clock that the test moves, ns."""

    def __init__(self) -> None:
        self.now = 0

    def __call__(self) -> int:
        return self.now

    def work(self, ns: int) -> None:
        self.now += ns


@pytest.mark.slow
def test_a_part_has_its_own_time_without_that_of_the_parts_inside() -> None:
    ticks = Ticks()
    clocks = cpu.Clocks(ticks)
    inner = clocks.timed('inner', lambda: ticks.work(30))

    def both() -> None:
        ticks.work(5)
        inner()
        clocks.collects('start', {})
        ticks.work(7)
        clocks.collects('stop', {})
        inner()

    clocks.timed('outer', both)()
    thread = threading.get_native_id()
    assert clocks.spent[thread] == {'inner': 60, 'outer': 5, cpu.COLLECTION: 7}
    assert clocks.calls[thread] == {'inner': 2, 'outer': 1, cpu.COLLECTION: 1}


@pytest.mark.slow
def test_a_part_that_raises_is_left() -> None:
    clocks = cpu.Clocks(Ticks())

    def rejects() -> None:
        raise ValueError

    with pytest.raises(ValueError):
        clocks.timed('rejected', rejects)()
    clocks.timed('next', lambda: None)()
    assert clocks.calls[threading.get_native_id()] == {'rejected': 1, 'next': 1}


@pytest.mark.slow
def test_what_is_in_no_part_is_the_rest_of_its_thread() -> None:
    def task(name: str, used: int, calls: int, **spent: int) -> dict[str, object]:
        return {'name': name, 'used': used, 'spent': spent, 'calls': calls}

    reported = {
        'before': {'1': task('pipeline', 10, 1, fit=4)},
        'after': {
            '1': task('pipeline', 10 + 2 * 10**9, 3, fit=4 + 10**9),
            '2': task('dds.udp', 10**9, 0),
            '3': task('measurement', 10**9, 0),
        },
        'took': 10.0,
        'cost': 1e7,
    }
    spent, took, clocks = cpu.parts(reported)
    assert spent == {('pipeline', 'fit'): 1.0, ('pipeline', cpu.REST): 1.0, ('dds.udp', 'all of it'): 1.0}
    assert (took, round(clocks, 4)) == (10.0, round(2 * 1e7 / 3e9, 4))
    (row,) = cpu.rows_of(spent, took, clocks, Counter())
    assert row.work == 'CPU of the node by part: 30.0 % of a core, clocks 1 % of it'
    assert round(sum(f.median for f in row.figures), 6) == 100.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ('frames', 'kind'),
    [
        (['memcpy (/lib/libc.so.6)', 'DOUBLE_add (/x/_multiarray_umath.so)', 'f (/x/libpython3.11.so)'], 'numpy'),
        (['_PyEval_EvalFrameDefault (/x/libpython3.11.so)'], "Python's interpreter and objects"),
        (['do_futex ([kernel.kallsyms])', 'take_gil (/x/libpython3.11.so)'], cpu.KINDS[5][0]),
        (['do_futex ([kernel.kallsyms])', 'f (/x/libfastdds.so)'], 'rclpy, rmw, DDS'),
        (['vfs_read ([kernel.kallsyms])', 'read (/lib/libc.so.6)'], cpu.KINDS[6][0]),
        (['f (/x/other.so)', 'g (/x/libpython3.11.so)'], 'not known'),
    ],
)
def test_the_kind_of_a_sample_is_its_most_reporting(frames: list[str], kind: str) -> None:
    assert cpu.kind_of(frames) == kind


@pytest.mark.ros
@pytest.mark.parametrize('place', [place for places in cpu.PARTS.values() for place in places])
def test_every_part_is_there(place: str) -> None:
    function: Callable[..., object]
    _, _, function = cpu.resolve(place)
    assert callable(function)
