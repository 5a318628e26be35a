# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Bags cut off or spoiled: what can be read comes back; small files that ask for much are answered after little."""

import contextlib
import fcntl
import os
import struct
import subprocess
import sys
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import yaml
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import Reader

from msg_adapters import MESSAGE_TYPES, SAMPLES, to_messages
from psd_deflection.base.errors import RecordingError
from psd_deflection.cli.main import main
from psd_deflection.recordings import cdr
from psd_deflection.recordings.mcap_format import MAGIC, MAX_FIELDS, MAX_WARNINGS
from psd_deflection.recordings.read import mcap_reader
from psd_deflection.recordings.read.bag_reader import BagRecording
from psd_deflection.recordings.read.clouds import CloudDecoder
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.repair import recover
from psd_deflection.recordings.write.bag_writer import BagWriter, McapFile
from psd_deflection.records import ParameterChange, SampleBlock
from psd_deflection.rig.config import load_rig
from tools.program import PSD_DEFLECTION

from .making import HELLO, STEP, assert_same, block, run, write_mcap


def record(folder: Path, **kwargs: float) -> Path:
    with BagWriter(folder, rig_values=load_rig().values, device_hello=HELLO, **kwargs) as bag:  # type: ignore[arg-type]
        for r in run(200):
            bag.put(r)
    return folder


def cut(folder: Path, name: str, keep: int) -> None:
    """As a crash leaves it."""
    file = folder / name
    file.write_bytes(file.read_bytes()[:keep])
    (folder / 'metadata.yaml').unlink(missing_ok=True)


def theirs(folder: Path) -> dict[str, list[tuple[int, bytes]]]:
    out: dict[str, list[tuple[int, bytes]]] = {}
    with Reader(folder) as reader:
        for connection, t_ns, raw in reader.messages():
            out.setdefault(connection.topic, []).append((t_ns, bytes(raw)))
        assert reader.message_count == sum(map(len, out.values()))
    return out


@pytest.fixture(scope='module')
def full(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp('recover') / 'run')


@pytest.mark.slow
@settings(max_examples=25)
@given(part=st.floats(0.05, 1.0))
def test_a_bag_cut_anywhere_opens_elsewhere_after_recover(
    full: Path, tmp_path_factory: pytest.TempPathFactory, part: float
) -> None:
    folder = tmp_path_factory.mktemp('cut') / 'run'
    folder.mkdir()
    content = (full / 'run_0.mcap').read_bytes()
    (folder / 'run_0.mcap').write_bytes(content)
    cut(folder, 'run_0.mcap', int(part * len(content)))
    before = {(m.channel.topic, m.log_time, m.cdr) for m in open_recording(folder).messages()}
    done = recover(folder)
    assert done.metadata_written
    after = open_recording(folder)
    assert {(m.channel.topic, m.log_time, m.cdr) for m in after.messages()} == before
    assert after.complete
    assert not after.warnings
    assert after.parameters == (open_recording(full).parameters if before else {})
    assert after.hello == (HELLO if before else None)
    got, expected = theirs(folder), theirs(full)
    for topic, messages in got.items():
        assert messages == expected[topic][: len(messages)]
    assert sum(map(len, got.values())) == len(before)
    if done.files[0].repaired:
        assert (folder / 'run_0.mcap.cut').stat().st_size == int(part * len(content))


def test_recover_rewrites_missing_metadata_identically(full: Path, tmp_path: Path) -> None:
    folder = record(tmp_path / 'run')
    expected = yaml.safe_load((folder / 'metadata.yaml').read_text())
    (folder / 'metadata.yaml').unlink()
    assert not recover(folder).files[0].repaired
    assert yaml.safe_load((folder / 'metadata.yaml').read_text()) == expected


@pytest.mark.slow
def test_the_last_of_several_files_is_repaired(tmp_path: Path) -> None:
    folder = record(tmp_path / 'run', max_s=1.0)
    names = sorted(p.name for p in folder.glob('*.mcap'))
    assert names == ['run_0.mcap', 'run_1.mcap', 'run_2.mcap', 'run_3.mcap']
    expected = theirs(folder)
    cut(folder, 'run_3.mcap', (folder / 'run_3.mcap').stat().st_size // 2)
    repaired = [f.repaired for f in recover(folder).files]
    assert repaired == [False, False, False, True]
    got = theirs(folder)
    assert all(got[t] == expected[t][: len(got[t])] for t in got)
    assert len(got['/psd/samples']) >= 150


def test_a_file_that_was_only_begun_is_set_aside(tmp_path: Path) -> None:
    folder = record(tmp_path / 'run', max_s=2.5)
    cut(folder, 'run_1.mcap', 3)
    done = recover(folder)
    assert [p.name for p in done.set_aside] == ['run_1.mcap.cut']
    assert len(theirs(folder)['/psd/samples']) == 125


def test_a_lone_file_is_repaired(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / 'a.mcap', list(run(100)))
    path.write_bytes(path.read_bytes()[:-1000])
    assert recover(path).files[0].repaired
    assert open_recording(path).complete


def test_recover_rejects_a_running_recording(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / 'run', rig_values={})
    bag.put(block(0))
    bag.flush()
    # The lock of one process does not keep itself out: ask from another.
    answer = subprocess.run([*PSD_DEFLECTION, 'recover', str(tmp_path / 'run')], capture_output=True, text=True)
    assert answer.returncode == 4
    assert 'is being recorded at this moment' in answer.stderr
    bag.close()


@pytest.mark.parametrize('size', [20_000, 3])
def test_an_earlier_repair_is_not_overwritten(tmp_path: Path, size: int) -> None:
    folder = record(tmp_path / 'run', max_s=2.5)
    cut(folder, 'run_1.mcap', size)
    (folder / 'run_1.mcap.cut').write_text('precious')
    with pytest.raises(RecordingError, match=r'run_1\.mcap\.cut: exists already'):
        recover(folder)
    assert (folder / 'run_1.mcap.cut').read_text() == 'precious'
    assert (folder / 'run_1.mcap').stat().st_size == size


@pytest.mark.parametrize(
    ('content', 'message'),
    [(b'no mcap at all', 'not an MCAP'), (MAGIC, 'there is nothing to recover'), (None, 'no such recording')],
)
def test_an_unreadable_recording_gives_one_line(tmp_path: Path, content: bytes | None, message: str) -> None:
    path = tmp_path / 'a.mcap'
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RecordingError, match=message):
        recover(path)


def test_rotation_by_size_and_what_each_file_holds(tmp_path: Path) -> None:
    rig, records = load_rig(), list(run(400))
    change = ParameterChange(1, 5, (('sum_min', 1.0),))
    with BagWriter(tmp_path / 'run', rig_values=rig.values, device_hello=HELLO, max_bytes=100_000) as bag:
        for r in (*records[:20], change, *records[20:]):
            bag.put(r)
    files = sorted((tmp_path / 'run').glob('*.mcap'))
    assert len(files) >= 3
    assert all(f.stat().st_size >= 100_000 for f in files[:-1])
    for file in files:
        lone = open_recording(file)
        assert (lone.parameters, lone.hello, lone.changes) == (dict(rig.values), HELLO, [change])
    together = open_recording(tmp_path / 'run')
    assert (together.changes, [b.index for b in together.blocks()]) == ([change], list(range(400)))
    assert len(theirs(tmp_path / 'run')['/psd/samples']) == 400


def test_the_oldest_file_can_go(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'run', rig_values={}, max_s=1.0) as bag:
        for i in range(200):
            bag.put(block(i))
        assert bag.drop_oldest() == tmp_path / 'run' / 'run_0.mcap'
        assert sorted(p.name for p in bag.folder.glob('*.mcap')) == ['run_1.mcap', 'run_2.mcap', 'run_3.mcap']
    assert [b.index for b in open_recording(tmp_path / 'run').blocks()] == list(range(50, 200))
    assert len(theirs(tmp_path / 'run')['/psd/samples']) == 150


def test_chunks_are_on_the_disk_within_half_a_second_of_log_time(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'run', rig_values={}, durable=True) as bag:
        for i in range(100):
            bag.put(block(i))
            if i < 26:
                continue
            # What a kill at this moment would leave.
            (tmp_path / 'left.mcap').write_bytes(bag.path.read_bytes())
            durable = [int(b.t_ns[-1]) for b in open_recording(tmp_path / 'left.mcap').blocks()]
            assert int(block(i).t_ns[-1]) - durable[-1] <= 520 * STEP


def test_the_lock_goes_with_the_writer(tmp_path: Path) -> None:
    with McapFile(tmp_path / 'a.mcap', rig_values={}) as out, (tmp_path / 'a.mcap').open('rb') as stream:
        with pytest.raises(BlockingIOError):
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
        out.close()
        fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)


@pytest.mark.foreign
@pytest.mark.parametrize(
    'text',
    [
        '',
        'rosbag2_bagfile_information: [',
        'rosbag2_bagfile_information: {storage_identifier: mcap, relative_file_paths: [gone.mcap]}',
    ],
    ids=['empty', 'malformed', 'another file'],
)
def test_recover_rewrites_a_metadata_yaml_that_does_not_match(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = record(tmp_path / 'run')
    before, metadata = theirs(folder), folder / 'metadata.yaml'
    metadata.write_text(text)
    assert main(['info', str(folder)]) == 4
    assert '`psd-deflection recover` makes' in capsys.readouterr().err
    assert (main(['recover', str(folder)]), theirs(folder)) == (0, before)
    assert (folder / 'metadata.yaml.cut').read_text() == text
    # What describes it, and what rosbag2 compressed in its own way, stays.
    tree = yaml.safe_load(metadata.read_text())
    tree['rosbag2_bagfile_information'] |= {'compression_mode': 'message', 'relative_file_paths': ['run_0.mcap.zstd']}
    for valid in (metadata.read_text(), yaml.safe_dump(tree)):
        metadata.write_text(valid)
        assert (main(['recover', str(folder)]), metadata.read_text()) == (0, valid)


def test_a_repair_that_fails_leaves_the_file_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = record(tmp_path / 'run')
    cut(folder, 'run_0.mcap', 20_000)
    before = (folder / 'run_0.mcap').read_bytes()
    full = Mock(side_effect=OSError(28, 'No space left on device'))
    monkeypatch.setattr('psd_deflection.recordings.repair._Copy.finish', full)
    with pytest.raises(RecordingError, match='No space left on device'):
        recover(folder)
    assert [p.name for p in folder.iterdir()] == ['run_0.mcap']
    assert (folder / 'run_0.mcap').read_bytes() == before


def test_metadata_is_not_written_through_a_link(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'run', rig_values={}) as bag:
        bag.put(block(0))
    theirs = tmp_path / 'theirs'
    metadata = tmp_path / 'run' / 'metadata.yaml'
    metadata.unlink()
    metadata.symlink_to(theirs)
    assert recover(tmp_path / 'run').metadata_written
    assert not theirs.exists()
    assert not metadata.is_symlink()


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
def complete(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = write_mcap(tmp_path_factory.mktemp('complete') / 'a.mcap', list(run(120)), device_hello=HELLO)
    return path.read_bytes()


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(where=st.floats(0, 1))
def test_everything_before_a_cut_is_read(tmp_path: Path, complete: bytes, where: float) -> None:
    path = tmp_path / 'cut.mcap'
    cut = int(where * (len(complete) - 1))
    path.write_bytes(complete[:cut])
    expected = [r for r in run(120) if isinstance(r, SampleBlock)]
    got = readable(path)
    assert_same(got, expected[: len(got)])
    chunk_ends = [at + length for op, at, length in top_level(complete) if op == 6]
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


def test_a_damaged_chunk_costs_itself_only(tmp_path: Path, complete: bytes) -> None:
    at, length = [(at, length) for op, at, length in top_level(complete) if op == 6][1]
    spoiled = bytearray(complete)
    spoiled[at + length // 2] ^= 0xFF
    (tmp_path / 'a.mcap').write_bytes(spoiled)
    recording = BagRecording(tmp_path / 'a.mcap')
    indices = [b.index for b in recording.blocks()]
    assert (indices[:24], indices[-1]) == (list(range(24)), 119)
    assert 120 - len(indices) in range(24, 27)
    assert not recording.complete
    assert f'the chunk at byte {at} is damaged' in recording.warnings[0]


def test_a_chunk_that_declares_too_much_is_not_unpacked(tmp_path: Path, complete: bytes) -> None:
    at, _ = next((at, length) for op, at, length in top_level(complete) if op == 6)
    for size in (2**62, 2**27):
        spoiled = bytearray(complete)
        struct.pack_into('<Q', spoiled, at + 16, size)
        (tmp_path / 'a.mcap').write_bytes(spoiled)
        recording = BagRecording(tmp_path / 'a.mcap')
        assert next(recording.blocks()).index > 20
        assert str(size) in recording.warnings[0]


def test_an_index_that_declares_too_much_ends_the_file(tmp_path: Path, complete: bytes) -> None:
    at = next(at for op, at, length in top_level(complete) if op == 7)
    (tmp_path / 'a.mcap').write_bytes(complete[: at - 1] + b'\x80' + complete[at:])
    recording = BagRecording(tmp_path / 'a.mcap')
    assert [b.index for b in recording.blocks()] == list(range(25))
    assert f'ends at byte {at - 9} before its end' in recording.warnings[0]


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


CHUNK, CHANNEL, SCHEMA, MESSAGE, METADATA = 6, 4, 3, 5, 12


def record_of(opcode: int, content: bytes) -> bytes:
    return struct.pack('<BQ', opcode, len(content)) + content


def text(content: str) -> bytes:
    return struct.pack('<I', len(content)) + content.encode()


def chunk(plain: bytes) -> bytes:
    """A right chunk record, packed."""
    packed = zstandard.ZstdCompressor(level=1).compress(plain)
    head = struct.pack('<QQQI', 0, 0, len(plain), zlib.crc32(plain)) + text('zstd')
    return record_of(CHUNK, head + struct.pack('<Q', len(packed)) + packed)


def channel(number: int, topic: str = '/x') -> bytes:
    return record_of(CHANNEL, struct.pack('<HH', number, 0) + text(topic) + text('cdr') + struct.pack('<I', 0))


def change(number: int) -> bytes:
    return record_of(METADATA, text(f'psd_deflection.change.{number:06d}') + struct.pack('<I', 0))


def many(n: int) -> bytes:
    return b''.join(channel(i % 65536) for i in range(n))


CRAFTED = {
    'channels in a chunk': [chunk(many(65_536))],
    'empty records in a chunk': [chunk(record_of(0x90, b'') * 7_000_000)],
    'records of opcode 0 in a chunk': [chunk(bytes(63_000_000))],
    'twenty chunks of zeros': [chunk(bytes(63_000_000))] * 20,
    'chunks that unpack to ever more': [chunk(record_of(0x90, bytes(60_000_000)))] * 20,
    'empty records': [record_of(0x90, b'') * 100_000],
    'damaged chunks': [record_of(CHUNK, b'') * 15_000],
    'unreadable changes': [b''.join(change(i) for i in range(8_000))],
    'a large text in a chunk': [chunk(record_of(SCHEMA, struct.pack('<H', 1) + text('a' * 30_000_000)))] * 5,
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
def counting(monkeypatch: pytest.MonkeyPatch) -> Iterator[Work]:
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
    with counting(monkeypatch) as work:
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
    size = path.write_bytes(MAGIC + chunk(record_of(0x90, bytes(60_000_000))) * 100)
    recording = BagRecording(path)
    assert recording.topics() == {}
    (line,) = (w for w in recording.warnings if 'unpacks to' in w)
    wanted = f'{path}: unpacks to more than {64 * 2**20 + 100 * size} bytes, as many as a file of {size} bytes may'
    assert wanted in line
    assert not any('damaged' in w for w in recording.warnings)


def test_channels_are_left_out_beyond_what_a_file_can_need(tmp_path: Path) -> None:
    (tmp_path / 'a.mcap').write_bytes(MAGIC + chunk(many(65_536)))
    recording = BagRecording(tmp_path / 'a.mcap')
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
    with counting(monkeypatch) as work:
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
    (ours,) = to_messages(block(0))
    field = {'name': 'x', 'offset': 0, 'datatype': 7, 'count': 1}
    many_fields = {'width': 0, 'fields': [field] * (MAX_FIELDS + 1), 'point_step': 4, 'row_step': 0, 'data': b''}
    message = cdr.encode(ours.type, {**ours.fields, **many_fields})
    monkeypatch.setattr(cdr, 'decode', lambda *_: pytest.fail('decoded'))
    with pytest.raises(ValueError, match='more than 64 fields'):
        CloudDecoder().decode(message)


def test_a_long_recording_of_tiny_records_is_read_whole(tmp_path: Path) -> None:
    recording = BagRecording(write_mcap(tmp_path / 'a.mcap', list(run(400))))
    assert recording.topics()[SAMPLES] == 400
    assert recording.complete
