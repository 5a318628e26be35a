# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The newcomer's day on a device that is not ours: its frames, its recording's physics, and what counts as right."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from blind import day
from blind.generator import RATE
from psd_deflection.devices.protocol.frames import FrameDecoder, HelloFrame, SampleFrame

pytestmark = pytest.mark.slow


def test_our_decoder_reads_its_frames() -> None:
    counts = (-3, 4, 16_384, -32_768, 32_767, 0)
    sample = day.frame(0x01, struct.pack('<BIQ6h', 0, 7, 7000, *counts))
    hello, read = FrameDecoder().feed(day.hello() + sample)
    assert isinstance(hello, HelloFrame)
    assert hello.info['sample_rate_hz'] == RATE
    assert isinstance(read, SampleFrame)
    assert (read.seq, tuple(read.counts)) == (7, counts)


def test_a_ping_is_answered_with_its_cookie_and_a_question_with_who_it_is() -> None:
    asked = day.frame(0x12, struct.pack('<Q', 99))[:-1]
    # What the simulated device answers; else only a serial line in real time shows it.
    assert day.Device._answer(asked, 1.5) == day.frame(0x13, struct.pack('<QQ', 99, 1_500_000))
    assert day.Device._answer(day.frame(0x11, b'')[:-1], 0.0) == day.hello()
    assert day.Device._answer(b'\x05\x01', 0.0) == b''


def test_each_weight_moves_the_dots_at_its_time() -> None:
    counts, times = day.measured(0.02, 1)
    moved = np.abs(np.diff(counts[:, [0, 1, 3, 4]], axis=0)).max(axis=1)
    for at in times:
        first = round(at * RATE)
        assert moved[first : first + 40].max() > 3 * moved[first - 500 : first].max()


LATE = [(1.3, 1.5), (2.0, 2.4)]
RIGHT = {
    'verdict': 'effects_found',
    'effects': [{'name': 'sensor_rotation', 'parameters': {'psd': 1, 'angle': {'value': 0.020001, 'sd': 4e-6}}}],
    'setup': [
        {'name': 'load_time', 'where': 'load 1', 'value': 1.4},
        {'name': 'load_time', 'where': 'load 2', 'value': 2.42},
    ],
    'unknown': [],
}


@pytest.mark.parametrize(
    ('changed', 'message'),
    [
        ({}, []),
        ({'effects': []}, ['effects: []']),
        ({'setup': RIGHT['setup'][:1]}, ['load 2: said None s late, was 2.00 to 2.40 s']),
        (
            {'unknown': [{'signature': 'on y2'}], 'verdict': 'unknown_effect'},
            ['unknown_effect, unknown: on y2'],
        ),
    ],
)
def test_an_answer_is_right_if_angle_and_times_are(
    tmp_path: Path, changed: dict[str, object], message: list[str]
) -> None:
    (tmp_path / 'result.json').write_text(json.dumps({**RIGHT, **changed}))
    assert day.evaluated(tmp_path, 0.02, LATE) == message
    if not changed:
        (wrong,) = day.evaluated(tmp_path, 0.021, LATE)
        assert wrong.startswith('angle')
