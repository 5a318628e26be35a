# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Bounds of what others can make grow."""

import threading

import pytest

from psd_deflection.base.bounds import OTHERS, BoundedMap, ByteBudget, RateLimit, Tally


def test_a_budget_holds_no_more_than_its_bytes() -> None:
    budget = ByteBudget(100)
    assert budget.take(60)
    assert not budget.take(41)
    assert budget.held == 60
    assert budget.take(40)
    assert budget.holders == 2
    budget.give_back(100, 2)
    assert (budget.held, budget.holders) == (0, 0)
    assert budget.take(100)
    assert not budget.take(1)


def test_two_threads_do_not_take_the_same_bytes() -> None:
    class Size(int):
        """While it is added, another thread asks for bytes: it gets none before the first has its own."""

        def __radd__(self, held: int) -> int:
            if not other.is_alive() and not answers:
                other.start()
                other.join(0.05)
            return held + int(self)

    budget, answers = ByteBudget(1), list[bool]()
    other = threading.Thread(target=lambda: answers.append(budget.take(1)))
    assert budget.take(Size(1))
    other.join()
    assert (answers, budget.held) == ([False], 1)


@pytest.mark.parametrize('way', ['item', 'setdefault', 'update'])
def test_bounded_map_keeps_updated_key_under_flood(way: str) -> None:
    known: BoundedMap[str, int] = BoundedMap(10)
    for n in range(10_000):
        known['ours'] = n
        if way == 'item':
            known[f'name {n}'] = n
        elif way == 'setdefault':
            known.setdefault(f'name {n}', n)
        else:
            known.update({f'name {n}': n})
        assert len(known) <= 10
    assert (known['ours'], list(known)[-1]) == (9999, 'name 9999')
    assert 'name 1' not in known
    del known['ours']
    assert 'ours' not in known


def test_a_tally_counts_every_word_and_remembers_few() -> None:
    tally = Tally(5)
    for n in range(1000):
        tally.add('known')
        tally.add(f'word {n}', 2)
    assert (len(tally), tally.total(), tally['known'], tally[OTHERS]) == (5, 3000, 1000, 2 * (1000 - 3))
    assert tally['never'] == 0
    assert 'never' not in tally
    assert dict(tally) == {'known': 1000, 'word 0': 2, 'word 1': 2, 'word 2': 2, OTHERS: 1994}


def test_a_rate_is_bounded_second_by_second() -> None:
    rate = RateLimit(2)
    allowed = [rate.allows(at) for at in (5.0, 5.1, 5.2, 5.9, 6.0, 6.1, 6.2)]
    assert allowed == [True, True, False, False, True, True, False]


def test_updated_key_is_never_missing_for_a_thread() -> None:
    class Word(str):
        """Its hash is asked for whenever a map is changed: there another thread may read."""

        def __hash__(self) -> int:
            observed.append(not held or 'a' in held[0])
            return super().__hash__()

        __eq__ = str.__eq__

    observed: list[bool] = []
    held: list[BoundedMap[str, int]] = []
    words: BoundedMap[str, int] = BoundedMap()
    words['a'] = 1
    held.append(words)
    words[Word('a')] = 2
    assert observed
    assert all(observed)
