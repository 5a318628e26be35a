# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Consistent Overhead Byte Stuffing, judged by the package ``cobs``."""

from __future__ import annotations

import cobs.cobs as oracle
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psd_deflection.devices.protocol.cobs import decode, encode

RUNS = st.integers(0, 3).flatmap(lambda k: st.integers(max(254 * k - 2, 0), 254 * k + 2))
"""Lengths of runs without a zero: short ones, and those where a block of 254 bytes ends."""
PAYLOADS = st.binary(max_size=600) | st.lists(RUNS, max_size=4).map(lambda runs: b'\0'.join(b'\x07' * n for n in runs))


@given(PAYLOADS)
def test_any_payload_is_encoded_as_the_judge_does_and_comes_back(payload: bytes) -> None:
    encoded = encode(payload)
    assert encoded == oracle.encode(payload)
    assert 0 not in encoded
    assert decode(encoded) == payload


@given(st.binary(max_size=600) | PAYLOADS.map(encode).map(lambda full: full[:-1]))
def test_any_bytes_are_decoded_or_rejected_as_the_judge_does(encoded: bytes) -> None:
    try:
        expected = oracle.decode(encoded)
    except oracle.DecodeError:
        with pytest.raises(ValueError, match='not COBS'):
            decode(encoded)
    else:
        assert decode(encoded) == expected


def test_the_blocks_around_254_bytes() -> None:
    for size in range(250, 514):
        for payload in (b'a' * size, b'a' * size + b'\0', b'\0' + b'a' * size, b'a' * size + b'\0b'):
            assert encode(payload) == oracle.encode(payload)
            assert decode(encode(payload)) == payload
