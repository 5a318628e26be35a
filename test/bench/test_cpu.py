# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where the CPU time goes: parts without what is inside them, threads without gaps, kinds of native code."""

from collections.abc import Callable

import pytest

from bench import cpu


@pytest.mark.ros
@pytest.mark.parametrize('place', [place for places in cpu.PARTS.values() for place in places])
def test_every_part_is_there(place: str) -> None:
    function: Callable[..., object]
    _, _, function = cpu.resolve(place)
    assert callable(function)
