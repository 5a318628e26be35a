# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What computes, and the words for what has changed since a recording."""

from __future__ import annotations

import platform

import numpy as np

from psd_deflection import __version__
from psd_deflection.recordings.provenance import NAMES, differences, provenance


def test_versions_and_processor_are_there() -> None:
    now = provenance()
    assert set(now) <= set(NAMES)
    assert (now['psd_deflection'], now['numpy'], now['python']) == (
        __version__,
        np.__version__,
        platform.python_version(),
    )
    assert now['machine'] == platform.machine()
    assert now['processor']


def test_nothing_differs_from_itself() -> None:
    assert differences(provenance(), provenance()) == []


def test_what_differs_is_named_with_both_values() -> None:
    then = {**provenance(), 'numpy': '1.25.0'}
    assert differences(then, provenance()) == [f'numpy 1.25.0, now {np.__version__}']


def test_the_processor_does_not_count() -> None:
    assert differences({**provenance(), 'processor': 'another', 'C library': 'another'}, provenance()) == []


def test_a_recording_that_does_not_say_is_of_another_version() -> None:
    assert differences({}, provenance()) == ['a version that does not say what computed it']


def test_untrusted_provenance_is_sanitized_or_skipped() -> None:
    then = {**provenance(), 'numpy': '\x1b[2J', 'mine': 'x' * 10_000}
    assert differences(then, provenance()) == [f'numpy \\x1b[2J, now {np.__version__}']
