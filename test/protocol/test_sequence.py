"""Sequence numbers past 32 bits: gaps, repeats, wraps, restarts."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from psd_deflection.protocol.sequence import WRAP, SequenceExtender, Step


def test_the_next_one_a_gap_and_a_repeat() -> None:
    s = SequenceExtender(20)
    assert s.extend(7, 7000) == (7, Step.FIRST, 0)
    assert s.extend(8, 8000) == (8, Step.NEXT, 0)
    assert s.extend(8, 8000) == (8, Step.REPEAT, 0)
    assert s.extend(12, 12000) == (12, Step.GAP, 3)
    assert s.extend(9, 9000) == (9, Step.REPEAT, 0)
    assert s.extend(13, 13000) == (13, Step.NEXT, 0)


def test_a_number_that_stands_still_is_a_repeat_whatever_the_clock_says() -> None:
    s = SequenceExtender(20)
    s.extend(7, 7000)
    assert [s.extend(7, 7000 + 1000 * k) for k in range(3)] == [(7, Step.REPEAT, 0)] * 3
    assert s.extend(8, 11_000) == (8, Step.NEXT, 0)


def test_the_wrap_is_passed_with_and_without_a_gap() -> None:
    s = SequenceExtender(20)
    s.extend(WRAP - 1, 5)
    assert s.extend(0, 6) == (WRAP, Step.NEXT, 0)
    s = SequenceExtender(20)
    s.extend(WRAP - 2, 5)
    assert s.extend(3, 10) == (WRAP + 3, Step.GAP, 4)


def test_a_restart_keeps_the_blocks_aligned_to_the_device() -> None:
    s = SequenceExtender(20)
    s.extend(100_003, 100_003_000)
    number, step, _ = s.extend(0, 0)
    assert (number, step) == (100_020, Step.RESTART)
    assert s.extend(1, 1000) == (100_021, Step.NEXT, 0)


@given(st.integers(0, 2**40), st.integers(0, WRAP - 1))
def test_a_restart_from_any_number_leaves_out_less_than_two_blocks(last: int, seq: int) -> None:
    s = SequenceExtender(20)
    s.extend(last % WRAP, 10**6)
    before, _, _ = s.extend((last + 1) % WRAP, 10**6 + 1000)
    number, step, _ = s.extend(seq, 0)
    if step is Step.RESTART:
        assert number // 20 == before // 20 + 1
        assert number % 20 == seq % 20
        assert s.extend((seq + 1) % WRAP, 1000) == (number + 1, Step.NEXT, 0)


def test_a_clock_that_jumps_while_the_count_goes_on_is_no_restart() -> None:
    s = SequenceExtender(20)
    s.extend(5000, 5_000_000)
    assert s.extend(5001, 17) == (5001, Step.NEXT, 0)


@given(st.integers(0, WRAP - 1), st.lists(st.integers(1, 2**30), max_size=30))
def test_the_extended_number_follows_the_true_one(start: int, steps: list[int]) -> None:
    s = SequenceExtender(20)
    true = start
    s.extend(true % WRAP, true * 1000)
    for step in steps:
        true += step
        assert s.extend(true % WRAP, true * 1000) == (true, Step.NEXT if step == 1 else Step.GAP, step - 1)


@given(st.lists(st.tuples(st.integers(0, WRAP - 1), st.integers(0, 2**53)), max_size=60))
def test_whatever_comes_a_number_that_is_kept_is_above_those_before(samples: list[tuple[int, int]]) -> None:
    s = SequenceExtender(20)
    last = -1
    for seq, t_us in samples:
        number, step, missing = s.extend(seq, t_us)
        assert missing >= 0
        if step is not Step.REPEAT:
            assert number > last
            last = number


def test_numbers_given_anew_go_on_at_the_next_block() -> None:
    sequence = SequenceExtender(20)
    assert sequence.restart() is None
    assert sequence.extend(0, 0) == (0, Step.FIRST, 0)
    assert sequence.extend(1, 1000) == (1, Step.NEXT, 0)
    assert sequence.restart() == 20
    assert sequence.extend(0, 0) == (20, Step.NEXT, 0)
    assert sequence.extend(3, 3000) == (23, Step.GAP, 2)
