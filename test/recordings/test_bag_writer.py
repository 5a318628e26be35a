# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What we write, read by readers that are not ours: rosbags and mcap."""

import collections
import errno
import gc
import io
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk, ChunkIndex
from mcap.stream_reader import StreamReader
from rosbags.rosbag2 import Reader

from msg_adapters import RIG, TOPIC_TYPES, spot_topics, to_messages
from psd_deflection.base.errors import RecordingError
from psd_deflection.base.files import HeldFolder
from psd_deflection.recordings import cdr
from psd_deflection.recordings.write.bag_writer import BagWriter, McapFile
from psd_deflection.records import MOST_PSDS
from psd_deflection.rig.config import load_rig

from .making import T0, block, run

pytestmark = pytest.mark.slow
HELLO = {'serial': 'A1', 'firmware': '1.2', 'sample_rate_hz': 1000, 'channels': ['x1', 'y1']}


def record(folder: Path, blocks: int = 120) -> Path:
    with BagWriter(folder, rig_values=load_rig().values, device_hello=HELLO) as bag:
        for r in run(blocks):
            bag.put(r)
    return folder


def metadata_of(path: Path) -> dict[str, dict[str, str]]:
    with path.open('rb') as f:
        return {m.name: m.metadata for m in make_reader(f, validate_crcs=True).iter_metadata()}


def test_an_independent_reader_gets_every_byte_that_was_written(tmp_path: Path) -> None:
    folder = record(tmp_path / 'run')
    expected: dict[str, list[tuple[int, bytes]]] = {}
    for r in run(120):
        for m in to_messages(r):
            expected.setdefault(m.topic, []).append((m.t_ns, cdr.encode(m.type, m.fields)))
    got: dict[str, list[tuple[int, bytes]]] = {}
    with Reader(folder) as reader:
        types = {c.topic: c.msgtype for c in reader.connections}
        for connection, t_ns, raw in reader.messages():
            got.setdefault(connection.topic, []).append((t_ns, bytes(raw)))
    assert (len(got.pop(RIG)), got) == (1, expected)
    of_two = {t: kind for t, kind in TOPIC_TYPES.items() if t not in spot_topics(MOST_PSDS)[2:]}
    assert {t: types[t] for t in of_two} == of_two
    assert {c for c in types if c not in TOPIC_TYPES} == {'/link_tip/exact/deflection', '/link_tip/wls/deflection'}


def test_metadata_yaml_is_what_rosbag2_writes(tmp_path: Path) -> None:
    folder = record(tmp_path / 'run')
    info = yaml.safe_load((folder / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    assert list(info) == [
        *('version', 'storage_identifier', 'duration', 'starting_time', 'message_count', 'topics_with_message_count'),
        *('compression_format', 'compression_mode', 'relative_file_paths', 'files', 'custom_data', 'ros_distro'),
    ]
    assert (info['version'], info['storage_identifier'], info['ros_distro']) == (9, 'mcap', 'jazzy')
    assert info['relative_file_paths'] == [f['path'] for f in info['files']] == ['run_0.mcap']
    assert info['message_count'] == sum(t['message_count'] for t in info['topics_with_message_count'])
    assert info['starting_time'] == {'nanoseconds_since_epoch': T0}
    for topic in info['topics_with_message_count']:
        assert list(topic['topic_metadata']) == [
            'name',
            'type',
            'serialization_format',
            'offered_qos_profiles',
            'type_description_hash',
        ]
        (qos,) = topic['topic_metadata']['offered_qos_profiles']
        assert (qos['history'], qos['deadline']) == ('keep_last', {'sec': 9223372036, 'nsec': 854775807})
    with (folder / 'run_0.mcap').open('rb') as f:
        summary = make_reader(f).get_summary()
    assert summary is not None
    in_channels = {c.topic: yaml.safe_load(c.metadata['offered_qos_profiles']) for c in summary.channels.values()}
    in_yaml = {
        t['topic_metadata']['name']: t['topic_metadata']['offered_qos_profiles']
        for t in info['topics_with_message_count']
    }
    assert in_channels == in_yaml
    serialized = metadata_of(folder / 'run_0.mcap')['rosbag2']['serialized_metadata']
    assert yaml.safe_load(serialized) == info


def test_index_of_long_recording_is_complete(tmp_path: Path) -> None:
    path = tmp_path / 'a.mcap'
    with McapFile(path, rig_values={}) as out:
        for number in range(300):
            out.put(block(number))
            out.flush()
        assert not [o for o in gc.get_objects() if isinstance(o, ChunkIndex)]
    with path.open('rb') as f:
        summary = make_reader(f, validate_crcs=True).get_summary()
        assert summary is not None
        assert len(summary.chunk_indexes) == 300
        for index in (summary.chunk_indexes[0], summary.chunk_indexes[-1]):
            f.seek(index.chunk_start_offset)
            assert (f.read(1)[0], sorted(index.message_index_offsets)) == (Opcode.CHUNK, [1])
    assert [p.name for p in tmp_path.iterdir()] == ['a.mcap']


def test_an_empty_bag_opens(tmp_path: Path) -> None:
    with BagWriter(tmp_path / 'empty', rig_values={}):
        pass
    with Reader(tmp_path / 'empty') as reader:
        assert reader.message_count == 0


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    record(tmp_path / 'run', 1)
    before = (tmp_path / 'run' / 'run_0.mcap').read_bytes()
    with pytest.raises(RecordingError, match='run: exists already'):
        BagWriter(tmp_path / 'run', rig_values={})
    with pytest.raises(RecordingError, match='exists already'):
        McapFile(tmp_path / 'run' / 'run_0.mcap', rig_values={})
    assert (tmp_path / 'run' / 'run_0.mcap').read_bytes() == before


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path: Path) -> None:
    (tmp_path / 'file').write_text('')
    with pytest.raises(RecordingError, match='cannot be made'):
        BagWriter(tmp_path / 'file' / 'run', rig_values={})


class SmallDisk(io.FileIO):
    """A file on a disk that has room for ``room`` bytes more."""

    room = 100_000

    def write(self, content: Any) -> int:
        if self.room <= 0:
            raise OSError(errno.ENOSPC, 'No space left on device')
        written = super().write(memoryview(content)[: self.room])
        self.room -= written
        return written


def test_a_full_disk_ends_the_recording_with_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        HeldFolder, 'create', lambda folder, name: io.BufferedWriter(SmallDisk(folder.path / name, 'xb'))
    )
    bag = BagWriter(tmp_path / 'run', rig_values={})
    monkeypatch.undo()
    records = list(run(1000))
    with pytest.raises(RecordingError, match=r'run_0.mcap: cannot be written \(No space left on device\)'):
        collections.deque(map(bag.put, records), maxlen=0)
    assert bag.closed
    with pytest.raises(RecordingError, match='is closed'):
        bag.put(records[0])
    bag.close()
    assert not (tmp_path / 'run' / 'metadata.yaml').exists()
    with bag.path.open('rb') as f:
        first_chunk = next(r for r in StreamReader(f, emit_chunks=True).records if isinstance(r, Chunk))
    assert first_chunk.message_start_time == T0
