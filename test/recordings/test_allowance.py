# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Small files that ask for a lot of work: they are answered with a line after little work.

Work is counted, not timed: calls, bytes unpacked, bytes read.
"""

import contextlib
import os
import struct
import sys
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import zstandard

from msg_adapters import SAMPLES
from psd_deflection.base.errors import RecordingError
from psd_deflection.recordings import cdr
from psd_deflection.recordings.mcap_format import MAGIC, MAX_FIELDS, MAX_WARNINGS
from psd_deflection.recordings.read import mcap_reader
from psd_deflection.recordings.read.bag_reader import BagRecording
from psd_deflection.recordings.read.clouds import CloudDecoder
from psd_deflection.recordings.repair import recover

from .making import run, write_mcap

CHUNK, CHANNEL, SCHEMA, MESSAGE, METADATA = 6, 4, 3, 5, 12


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack('<BQ', opcode, len(content)) + content


def text(content: str) -> bytes:
    return struct.pack('<I', len(content)) + content.encode()


def chunk(plain: bytes) -> bytes:
    """A right chunk record, packed."""
    packed = zstandard.ZstdCompressor(level=1).compress(plain)
    head = struct.pack('<QQQI', 0, 0, len(plain), zlib.crc32(plain)) + text('zstd')
    return record(CHUNK, head + struct.pack('<Q', len(packed)) + packed)


def channel(number: int, topic: str = '/x') -> bytes:
    return record(CHANNEL, struct.pack('<HH', number, 0) + text(topic) + text('cdr') + struct.pack('<I', 0))


def change(number: int) -> bytes:
    return record(METADATA, text(f'psd_deflection.change.{number:06d}') + struct.pack('<I', 0))


def many(n: int) -> bytes:
    return b''.join(channel(i % 65536) for i in range(n))


CRAFTED = {
    'channels in a chunk': [chunk(many(65_536))],
    'empty records in a chunk': [chunk(record(0x90, b'') * 7_000_000)],
    'records of opcode 0 in a chunk': [chunk(bytes(63_000_000))],
    'twenty chunks of zeros': [chunk(bytes(63_000_000))] * 20,
    'chunks that unpack to ever more': [chunk(record(0x90, bytes(60_000_000)))] * 20,
    'empty records': [record(0x90, b'') * 100_000],
    'damaged chunks': [record(CHUNK, b'') * 15_000],
    'unreadable changes': [b''.join(change(i) for i in range(8_000))],
    'a large text in a chunk': [chunk(record(SCHEMA, struct.pack('<H', 1) + text('a' * 30_000_000)))] * 5,
}


@pytest.fixture(params=CRAFTED)
def crafted(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Path]:
    path = tmp_path / 'small.mcap'
    parts: Sequence[bytes] = CRAFTED[request.param]
    path.write_bytes(MAGIC + b''.join(parts))
    yield path
    path.unlink()


@dataclass(slots=True)
class Work:
    """Functions called, of Python and of C; bytes that chunks were unpacked to; bytes that were read."""

    calls: int = 0
    unpacked: int = 0
    read: int = 0


def bytes_read() -> int:
    """By this process so far, from files and all else."""
    return int(Path('/proc/self/io').read_text().split()[1])


@contextlib.contextmanager
def counted(monkeypatch: pytest.MonkeyPatch) -> Iterator[Work]:
    """Counts the work that is done inside."""
    work = Work()
    decompress = mcap_reader._decompress

    def decompressed(*given: Any) -> bytes:
        plain = decompress(*given)
        work.unpacked += len(plain)
        return plain

    def called(_frame: object, event: str, _of: object) -> None:
        work.calls += event.endswith('call')

    before = sys.getprofile()
    monkeypatch.setattr(mcap_reader, '_decompress', decompressed)
    read = bytes_read()
    sys.setprofile(called)
    try:
        yield work
    finally:
        sys.setprofile(before)
        work.read = bytes_read() - read


def test_a_small_file_causes_little_work(crafted: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    size = crafted.stat().st_size
    with counted(monkeypatch) as work:
        recording = BagRecording(crafted)
        recording.topics()
        with pytest.raises(RecordingError, match='no samples'):
            next(recording.blocks())
    # In proportion to its size, and some for any file. Unbounded, each would make ten times as many calls or more, or
    # unpack a gigabyte.
    assert work.calls < 2_000_000 + 8 * size
    assert work.unpacked < 4 * (64 * 2**20 + 100 * size)
    assert work.read < 10 * size + 1_000_000
    assert len(recording.warnings) <= 2 * (MAX_WARNINGS + 1)
    assert not recording.complete


def test_file_unpacking_to_gigabytes_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / 'a.mcap'
    path.write_bytes(MAGIC + chunk(record(0x90, bytes(60_000_000))) * 100)
    recording = BagRecording(path)
    assert recording.topics() == {}
    size = path.stat().st_size
    (line,) = (w for w in recording.warnings if 'unpacks to' in w)
    bound = 64 * 2**20 + 100 * size
    assert f'{path}: unpacks to more than {bound} bytes, as many as a file of {size} bytes may' in line
    assert not any('damaged' in w for w in recording.warnings)


def test_channels_are_left_out_beyond_what_a_file_can_need(tmp_path: Path) -> None:
    path = tmp_path / 'a.mcap'
    path.write_bytes(MAGIC + chunk(many(65_536)))
    recording = BagRecording(path)
    recording.topics()
    assert any('more records than a file of' in w for w in recording.warnings)


@pytest.mark.parametrize('tail', [1_000, 2 * 10**9])
def test_a_tail_of_zeros_is_a_cut(tmp_path: Path, tail: int, monkeypatch: pytest.MonkeyPatch) -> None:
    records = list(run(60))
    full = write_mcap(tmp_path / 'a.mcap', records).read_bytes()
    path = tmp_path / 'zeros.mcap'
    path.write_bytes(full[: len(full) * 2 // 3])
    cut = BagRecording(path)
    before = [b.index for b in cut.blocks()]
    ends = next(s.cut_at for s in cut._sources)
    assert ends is not None
    path.write_bytes(full[:ends])
    os.truncate(path, ends + tail)
    with counted(monkeypatch) as work:
        recording = BagRecording(path)
        assert [b.index for b in recording.blocks()] == before
    assert f'ends at byte {ends} before its end' in recording.warnings[0]
    assert work.read < 10 * ends + 1_000_000
    if tail < 10_000:
        assert recover(path).files[0].repaired
        assert BagRecording(path).complete


@pytest.mark.parametrize('opcode', [CHUNK, MESSAGE])
def test_a_record_of_gigabytes_is_not_read(tmp_path: Path, opcode: int) -> None:
    path = tmp_path / 'a.mcap'
    path.write_bytes(MAGIC + struct.pack('<BQ', opcode, 2**31))
    os.truncate(path, 2**31 + 17)
    recording = BagRecording(path)
    assert recording.topics() == {}
    assert f'has {2**31} bytes and is left out' in recording.warnings[-1]


def test_cloud_of_too_many_fields_is_not_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    field = {'name': 'x', 'offset': 0, 'datatype': 7, 'count': 1}
    message = cdr.encode(
        'sensor_msgs/msg/PointCloud2',
        {
            'header': {'stamp': {'sec': 1, 'nanosec': 0}, 'frame_id': 'link_tip'},
            'height': 1,
            'width': 0,
            'fields': [field] * (MAX_FIELDS + 1),
            'is_bigendian': False,
            'point_step': 4,
            'row_step': 0,
            'data': b'',
            'is_dense': True,
        },
    )
    monkeypatch.setattr(cdr, 'decode', lambda *_: pytest.fail('decoded'))
    with pytest.raises(ValueError, match='more than 64 fields'):
        CloudDecoder().decode(message)


def test_a_long_recording_of_tiny_records_is_read_whole(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / 'a.mcap', list(run(400)))
    recording = BagRecording(path)
    assert recording.topics()[SAMPLES] == 400
    assert recording.complete
