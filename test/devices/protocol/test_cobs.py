# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Consistent Overhead Byte Stuffing, judged by the package ``cobs``."""

import cobs.cobs as cobs_oracle
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psd_deflection.devices.protocol.frames import cobs_decode, cobs_encode

RUNS = st.integers(0, 3).flatmap(lambda k: st.integers(max(254 * k - 2, 0), 254 * k + 2))
"""Lengths of runs without a zero: short ones, and those where a block of 254 bytes ends."""
PAYLOADS = st.binary(max_size=600) | st.lists(RUNS, max_size=4).map(lambda runs: b'\0'.join(b'\x07' * n for n in runs))


@given(PAYLOADS)
def test_any_payload_is_encoded_as_the_judge_does_and_comes_back(payload: bytes) -> None:
    encoded = cobs_encode(payload)
    assert encoded == cobs_oracle.encode(payload)
    assert 0 not in encoded
    assert cobs_decode(encoded) == payload


@given(st.binary(max_size=600) | PAYLOADS.map(cobs_encode).map(lambda full: full[:-1]))
def test_any_bytes_are_decoded_or_rejected_as_the_judge_does(encoded: bytes) -> None:
    try:
        expected = cobs_oracle.decode(encoded)
    except cobs_oracle.DecodeError:
        with pytest.raises(ValueError, match='not COBS'):
            cobs_decode(encoded)
    else:
        assert cobs_decode(encoded) == expected


def test_the_blocks_around_254_bytes() -> None:
    for size in range(250, 514):
        for payload in (b'a' * size, b'a' * size + b'\0', b'\0' + b'a' * size, b'a' * size + b'\0b'):
            assert cobs_encode(payload) == cobs_oracle.encode(payload)
            assert cobs_decode(cobs_encode(payload)) == payload
