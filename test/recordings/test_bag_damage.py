# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Bags that were cut off or spoiled: what can be read comes back, the rest is told in a line."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from msg_adapters import MESSAGE_TYPES, to_messages
from psd_deflection.base.errors import RecordingError
from psd_deflection.recordings import cdr
from psd_deflection.recordings.read.bag_reader import BagRecording
from psd_deflection.records import SampleBlock

from .making import HELLO, assert_same, run, write_mcap


def readable(path: Path) -> list[SampleBlock]:
    """What can be read; [] where the answer is a RecordingError of one line."""
    blocks: list[SampleBlock] = []

    def everything() -> None:
        recording = BagRecording(path)
        recording.topics()
        blocks.extend(recording.blocks())
        recording.loads()
        recording.estimates()

    text = ''
    try:
        everything()
    except RecordingError as error:
        text = str(error)
    assert text.startswith(str(path)) or not text
    assert '\n' not in text
    return blocks


@pytest.fixture(scope='module')
def full(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = write_mcap(tmp_path_factory.mktemp('whole') / 'a.mcap', list(run(120)), device_hello=HELLO)
    return path.read_bytes()


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(where=st.floats(0, 1))
def test_everything_before_a_cut_is_read(tmp_path: Path, full: bytes, where: float) -> None:
    path = tmp_path / 'cut.mcap'
    cut = int(where * (len(full) - 1))
    path.write_bytes(full[:cut])
    expected = [r for r in run(120) if isinstance(r, SampleBlock)]
    got = readable(path)
    assert_same(got, expected[: len(got)])
    chunk_ends = [at + length for op, at, length in top_level(full) if op == 6]
    full_chunks = sum(end <= cut for end in chunk_ends)
    # 50 blocks a second, and a chunk spans just less than half of one.
    assert len(got) >= min(24 * full_chunks, 120)
    if got:
        recording = BagRecording(path)
        assert not recording.complete
        assert 'ends at byte' in recording.warnings[0]
        assert recording.hello == HELLO


def top_level(content: bytes) -> list[tuple[int, int, int]]:
    """(opcode, offset of the content, length) of the records of a file."""
    out, at = [], 8
    while at + 9 <= len(content) - 8:
        opcode, length = struct.unpack_from('<BQ', content, at)
        out.append((opcode, at + 9, length))
        at += 9 + length
    return out


def test_a_damaged_chunk_costs_itself_only(tmp_path: Path, full: bytes) -> None:
    chunks = [(at, length) for op, at, length in top_level(full) if op == 6]
    at, length = chunks[1]
    spoiled = bytearray(full)
    spoiled[at + length // 2] ^= 0xFF
    (tmp_path / 'a.mcap').write_bytes(spoiled)
    recording = BagRecording(tmp_path / 'a.mcap')
    indices = [b.index for b in recording.blocks()]
    assert indices[:24] == list(range(24))
    assert indices[-1] == 119
    assert 120 - len(indices) in range(24, 27)
    assert not recording.complete
    assert f'the chunk at byte {at} is damaged' in recording.warnings[0]


def test_a_chunk_that_declares_too_much_is_not_unpacked(tmp_path: Path, full: bytes) -> None:
    at, _ = next((at, length) for op, at, length in top_level(full) if op == 6)
    for size in (2**62, 2**27):
        spoiled = bytearray(full)
        struct.pack_into('<Q', spoiled, at + 16, size)
        (tmp_path / 'a.mcap').write_bytes(spoiled)
        recording = BagRecording(tmp_path / 'a.mcap')
        assert next(recording.blocks()).index > 20
        assert str(size) in recording.warnings[0]


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.floats(0, 1), st.binary(min_size=1, max_size=12)), min_size=1, max_size=4))
def test_no_damage_ends_in_a_traceback(tmp_path: Path, changes: list[tuple[float, bytes]]) -> None:
    # Uncompressed and without CRC, so that the damage reaches every parser.
    plain = tmp_path / 'plain.mcap'
    if not plain.exists():
        with plain.open('wb') as stream:
            writer = Writer(stream, compression=CompressionType.NONE, enable_crcs=False, chunk_size=4000)
            writer.start('ros2')
            channels: dict[str, int] = {}
            for record in run(12):
                for m in to_messages(record):
                    if m.topic not in channels:
                        schema = writer.register_schema(m.type, 'ros2msg', MESSAGE_TYPES[m.type].definition.encode())
                        channels[m.topic] = writer.register_channel(m.topic, 'cdr', schema)
                    writer.add_message(channels[m.topic], m.t_ns, cdr.encode(m.type, m.fields), m.t_ns)
            writer.finish()
    content = bytearray(plain.read_bytes())
    for where, junk in changes:
        at = int(where * (len(content) - len(junk)))
        content[at : at + len(junk)] = junk
    path = tmp_path / 'junk.mcap'
    path.write_bytes(content)
    for b in readable(path):
        assert len(b.seq) == len(b.t_ns) == len(b.volts) == len(b.flags) > 0
        assert np.isfinite(b.volts).all()
        assert (np.diff(b.seq) > 0).all()
