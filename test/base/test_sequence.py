# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Sequence numbers past 32 bits: gaps, repeats, wraps, restarts."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psd_deflection.base.sequence import WRAP, RecordedSequence, SequenceExtender, Step


def test_the_next_one_a_gap_and_a_repeat() -> None:
    s = SequenceExtender(20)
    assert s.extend(7, 7000) == (7, Step.FIRST, 0)
    assert s.extend(8, 8000) == (8, Step.NEXT, 0)
    assert s.extend(8, 8000) == (8, Step.REPEAT, 0)
    assert s.extend(12, 12000) == (12, Step.GAP, 3)
    assert s.extend(9, 9000) == (9, Step.REPEAT, 0)
    assert s.extend(13, 13000) == (13, Step.NEXT, 0)


@given(st.integers(0, 2**40), st.integers(0, WRAP - 1))
def test_restart_at_any_number_skips_under_two_blocks(last: int, seq: int) -> None:
    s = SequenceExtender(20)
    s.extend(last % WRAP, 10**6)
    before, _, _ = s.extend((last + 1) % WRAP, 10**6 + 1000)
    number, step, _ = s.extend(seq, 0)
    if step is Step.RESTART:
        assert number // 20 == before // 20 + 1
        assert number % 20 == seq % 20
        assert s.extend((seq + 1) % WRAP, 1000) == (number + 1, Step.NEXT, 0)


@given(st.lists(st.integers(0, WRAP - 1), min_size=2, max_size=50))
def test_numbers_at_random_are_no_losses(numbers: list[int]) -> None:
    s = SequenceExtender(20, 1000.0)
    # The device's clock goes on as it should.
    missing = sum(s.extend(seq, 1000 * n)[2] for n, seq in enumerate(numbers))
    assert missing <= len(numbers) * 64 + 20 * len(numbers)


@pytest.mark.parametrize('missing', [1, 63, 1000, 86_400_000, 2**31 - 2])
@pytest.mark.parametrize('fast', [0.5, 1.0, 10.0])
def test_a_gap_that_the_clock_confirms_is_a_loss(missing: int, fast: float) -> None:
    s = SequenceExtender(20, 1000.0)
    s.extend(5, 5000)
    seq = 5 + 1 + missing
    assert s.extend(seq, 5000 + round((1 + missing) * 1000 / fast)) == (seq, Step.GAP, missing)


HALF = WRAP // 2


@pytest.mark.parametrize(
    ('ahead', 'later_us', 'step'),
    [
        # A neighbour, 63 numbers ahead or behind at most.
        (63, -1, Step.GAP),
        (64, -1, Step.RESTART),
        (-63, 0, Step.REPEAT),
        (-63, 1, Step.RESTART),
        (-64, 0, Step.RESTART),
        (0, 1, Step.REPEAT),
        # A gap of less than half way round, if the time is newer.
        (64, 1, Step.GAP),
        (64, 0, Step.RESTART),
        (HALF - 1, 1, Step.GAP),
        (HALF, 1, Step.RESTART),
    ],
)
def test_what_a_jump_of_the_number_means(ahead: int, later_us: int, step: Step) -> None:
    s = SequenceExtender(20)
    s.extend(5_000_000, 7000)
    number, got, missing = s.extend((5_000_000 + ahead) % WRAP, 7000 + later_us)
    assert (got, missing) == (step, ahead - 1 if step is Step.GAP else 0)
    assert (number == 5_000_000 + ahead) == (step is not Step.RESTART)


@given(st.integers(0, WRAP - 1), st.lists(st.integers(1, 2**30), max_size=30))
def test_the_extended_number_follows_the_true_one(start: int, steps: list[int]) -> None:
    s = SequenceExtender(20)
    true = start
    s.extend(true % WRAP, true * 1000)
    for step in steps:
        true += step
        assert s.extend(true % WRAP, true * 1000) == (true, Step.NEXT if step == 1 else Step.GAP, step - 1)


@given(st.lists(st.tuples(st.integers(0, WRAP - 1), st.integers(0, 2**53)), max_size=60))
def test_kept_numbers_always_increase(samples: list[tuple[int, int]]) -> None:
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
    # Any time is newer than those before, 0 too.
    assert sequence.restart() == 40
    assert sequence.extend(100, 0) == (140, Step.GAP, 100)


class Recorded:
    """Numbers of a recording in blocks of 20; times in ms."""

    def __init__(self, seq: list[int], ms: list[float]) -> None:
        self.message: list[str] = []
        self.restarts: list[tuple[int, int]] = []
        self._sequence = RecordedSequence(
            20, self.message.append, lambda last, first: self.restarts.append((last, first))
        )
        assert self.extended(seq, ms) == seq

    def extended(self, seq: list[int], ms: list[float], full: bool = False) -> list[int]:
        return [int(n) for n in self._sequence.extended(np.array(seq), self._ns(ms), full)]

    def follows(self, seq: list[int], ms: list[float]) -> bool:
        return self._sequence.follows(np.array(seq), self._ns(ms), False)

    @staticmethod
    def _ns(ms: list[float]) -> np.typing.NDArray[np.int64]:
        return np.rint(np.array(ms) * 1e6).astype(np.int64)


def test_recording_follows_if_number_and_time_increase() -> None:
    of = Recorded([5, 6, 7], [5.0, 6.0, 7.0])
    assert of.follows([8, 9], [8.0, 9.0])
    assert not of.follows([7, 8, 9], [8.0, 9.0, 10.0])
    assert not of.follows([8, 9], [7.0, 9.0])
    assert not of.follows([8, 8], [8.0, 9.0])
    assert not of.follows([8, 9], [8.0, 8.0])
    assert of.follows([8, 9], [8.0, 8.000001])
    assert of.follows([8, 9], [7.000001, 9.0])
    assert not of.follows([8, 9], [7.0, 9.0])


def test_time_going_back_is_reported_and_then_kept() -> None:
    of = Recorded([5, 6, 7], [5.0, 6.0, 7.0])
    assert (of.extended([8, 9, 10], [6.5, 8.0, 9.0]), of.message) == ([8, 9, 10], ['time goes back to 6500000 ns'])
    assert not of.follows([11], [8.5])
    assert of.follows([11], [9.5])


def test_constant_seq_or_time_in_message_is_rejected() -> None:
    of = Recorded([5, 6, 7], [5.0, 6.0, 7.0])
    with pytest.raises(ValueError, match='seq does not rise'):
        of.extended([8, 9, 9], [8.0, 9.0, 10.0])
    with pytest.raises(ValueError, match='dt does not rise'):
        of.extended([8, 9, 10], [8.0, 9.0, 9.0])
    assert of.extended([8, 9], [8.0, 8.000001]) == [8, 9]


def test_number_wraps_up_to_20_khz_and_restarts_above() -> None:
    """In 50 000 s these are 10^9 samples, and a thousand for a clock that is off."""
    last, most = 4_000_000_000, 1_000_001_000
    of = Recorded([last], [0.0])
    assert of.extended([(last + most) % WRAP], [5e7]) == [last + most]
    assert (of.message, of.restarts) == ([], [])
    of = Recorded([last], [0.0])
    number = (last + most + 1) % WRAP
    # 4 10^9 is the first of a block: the next block begins 20 later.
    first = last + 20 + number % 20
    assert of.extended([number], [5e7]) == [first]
    assert (of.message, of.restarts) == (['sample numbers start again after 4000000000'], [(last, first)])


def test_the_last_number_once_more_is_a_restart_of_a_recording() -> None:
    of = Recorded([5, 6, 7], [5.0, 6.0, 7.0])
    assert of.extended([7, 8], [8.0, 9.0]) == [27, 28]
    assert (of.message, of.restarts) == (['sample numbers start again after 7'], [(7, 27)])


def test_the_number_after_the_last_of_32_bits_is_0_and_goes_on() -> None:
    of = Recorded([WRAP - 1], [0.0])
    assert (of.message, of.extended([0], [1.0])) == ([], [WRAP])
    assert of.follows([1], [2.0])
    assert of.extended([1, 2], [2.0, 3.0]) == [WRAP + 1, WRAP + 2]
    assert (of.message, of.restarts) == ([], [])


def test_decreasing_full_numbers_are_rejected() -> None:
    of = Recorded([5, 6, 7], [5.0, 6.0, 7.0])
    with pytest.raises(ValueError, match='seq does not rise'):
        of.extended([9, 8], [8.0, 9.0], full=True)
    with pytest.raises(ValueError, match='seq does not rise'):
        of.extended([9, 8, 10], [8.0, 9.0, 10.0])


def test_wrap_and_full_numbers_extend_sequence() -> None:
    assert Recorded([WRAP - 3], [0.0]).extended([WRAP - 2, WRAP - 1, 0, 1], [1.0, 2.0, 3.0, 4.0]) == [
        *range(WRAP - 2, WRAP + 2)
    ]
    of = Recorded([WRAP - 1], [0.0])
    assert of.extended([5, 6], [1.0, 2.0], full=True) == [WRAP // 20 * 20 + 20 + 5, WRAP // 20 * 20 + 20 + 6]
    assert len(of.restarts) == 1
