# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The firmware's own COBS and CRC, compiled for this machine, against ours: byte for byte, both ways."""

import ctypes
import shutil
import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from psd_deflection.devices.protocol.frames import HelloFrame, PingFrame, SampleFrame, StatusFrame, encode

FIRMWARE = Path(__file__).parent.parent.parent / 'docs' / 'firmware'
CC = shutil.which('cc') or shutil.which('gcc') or shutil.which('clang')
pytestmark = pytest.mark.skipif(CC is None, reason='no C compiler')


@pytest.fixture(scope='module')
def frames(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    library = tmp_path_factory.mktemp('firmware') / 'frames.so'
    options = ['-std=c11', '-Wall', '-Wextra', '-Werror', '-O1', '-shared', '-fPIC']
    subprocess.run([str(CC), *options, str(FIRMWARE / 'frames.c'), '-o', str(library)], check=True)
    loaded = ctypes.CDLL(str(library))
    loaded.frame_encode.restype = ctypes.c_size_t
    loaded.frame_encode.argtypes = [ctypes.c_uint8, ctypes.c_char_p, ctypes.c_size_t, ctypes.c_char_p]
    loaded.frame_decode.restype = ctypes.c_bool
    loaded.frame_decode.argtypes = [ctypes.c_char_p, ctypes.POINTER(ctypes.c_size_t)]
    return loaded


def encoded(frames: ctypes.CDLL, kind: int, body: bytes) -> bytes:
    out = ctypes.create_string_buffer(600)
    size = frames.frame_encode(kind, body, len(body), out)
    return out.raw[:size]


def decoded(frames: ctypes.CDLL, stuffed: bytes) -> bytes | None:
    buffer = ctypes.create_string_buffer(stuffed, max(len(stuffed), 1))
    size = ctypes.c_size_t(len(stuffed))
    return buffer.raw[: size.value] if frames.frame_decode(buffer, ctypes.byref(size)) else None


@pytest.mark.slow
@given(
    flags=st.integers(0, 3),
    seq=st.integers(0, 2**32 - 1),
    t_us=st.integers(0, 2**53),
    counts=st.tuples(*[st.integers(-32768, 32767)] * 6),
)
def test_samples(
    frames: ctypes.CDLL, flags: int, seq: int, t_us: int, counts: tuple[int, int, int, int, int, int]
) -> None:
    body = bytes([flags]) + seq.to_bytes(4, 'little') + t_us.to_bytes(8, 'little')
    body += b''.join(c.to_bytes(2, 'little', signed=True) for c in counts)
    assert encoded(frames, 0x01, body) == encode(SampleFrame(flags, seq, t_us, counts))


@given(st.text(max_size=300))
def test_long_frames_cross_the_254_bytes(frames: ctypes.CDLL, text: str) -> None:
    body = b'\x01{"serial":"' + b'A' * (len(text) + 60) + b'"}'
    assert encoded(frames, 0x10, body) == encode(HelloFrame(1, {'serial': 'A' * (len(text) + 60)}))


@given(st.binary(max_size=400))
def test_what_it_encodes_it_decodes(frames: ctypes.CDLL, body: bytes) -> None:
    stuffed = encoded(frames, 0x42, body)
    assert stuffed.count(0) == 1
    assert decoded(frames, stuffed[:-1]) == b'\x42' + body


@given(st.integers(0, 2**64 - 1))
def test_it_reads_what_the_host_sends(frames: ctypes.CDLL, cookie: int) -> None:
    assert decoded(frames, encode(PingFrame(cookie))[:-1]) == b'\x12' + cookie.to_bytes(8, 'little')


@given(st.binary(max_size=60))
def test_garbage_is_no_frame(frames: ctypes.CDLL, junk: bytes) -> None:
    assert decoded(frames, junk) is None


@given(st.integers(0, 12 * 8 - 1))
def test_one_flipped_bit_is_no_frame(frames: ctypes.CDLL, bit: int) -> None:
    stuffed = bytearray(encode(StatusFrame(3, 2150))[:-1])
    stuffed[bit // 8] ^= 1 << bit % 8
    assert decoded(frames, bytes(stuffed)) is None
