"""Lines that come again and again."""

from __future__ import annotations

from psd_deflection.base.log import WARNING, texts
from psd_deflection.run.repeats import FIRST_WAIT_S, LONGEST_WAIT_S, Repeats


def test_a_line_a_second_for_a_day_is_few_lines_and_none_is_forgotten() -> None:
    said: list[str] = []
    repeats = Repeats(texts(said.append))
    for k in range(86_400):
        # The words may differ each time: it is the kind that counts.
        repeats.tell('hello', f'HELLO {k} refused', WARNING, 1000.0 + k)
    assert said[:2] == ['HELLO 0 refused', 'HELLO 10 refused (and 9 more like it)']
    assert len(said) < 40
    repeats.settle(1000.0 + 86_400 + LONGEST_WAIT_S)
    counted = sum(int(line.split('(and ')[1].split()[0]) for line in said if '(and ' in line)
    assert counted + len(said) == 86_400


def test_what_was_counted_is_said_when_it_is_due() -> None:
    said: list[str] = []
    repeats = Repeats(texts(said.append))
    for _ in range(3):
        repeats.tell('restart', 'started anew', WARNING, 5.0)
    assert said == ['started anew']
    repeats.settle(5.0 + 0.9 * FIRST_WAIT_S)
    assert len(said) == 1
    repeats.settle(5.0 + FIRST_WAIT_S)
    assert said[1:] == ['started anew (and 1 more like it)']
    repeats.settle(1e6)
    assert len(said) == 2


def test_the_first_few_are_said_one_by_one_and_so_is_what_comes_after_a_quiet_time() -> None:
    said: list[str] = []
    repeats = Repeats(texts(said.append))
    for k in range(5):
        repeats.tell('away', f'gone {k}', WARNING, float(k), at_once=3)
    assert said == ['gone 0', 'gone 1', 'gone 2']
    repeats.settle(1e5)
    repeats.tell('away', 'gone again', WARNING, 2e5, at_once=3)
    assert said[3:] == ['gone 4 (and 1 more like it)', 'gone again']


def test_one_kind_does_not_hold_up_another() -> None:
    said: list[str] = []
    repeats = Repeats(texts(said.append))
    repeats.tell('a', 'one', WARNING, 0.0)
    repeats.tell('b', 'two', WARNING, 0.0)
    assert said == ['one', 'two']
