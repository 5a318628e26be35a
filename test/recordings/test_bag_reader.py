# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Bags of ours and of others, whole and made up, as the reader gives them back."""

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import Reader, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_typestore

import psd_deflection
from msg_adapters import MESSAGE_TYPES, RIG, SAMPLES, to_messages
from psd_deflection.base.errors import RecordingError
from psd_deflection.cli.main import main
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings import cdr
from psd_deflection.recordings.read.mcap_reader import McapReader
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.repair import recover
from psd_deflection.recordings.replay.engine import rig_at_end, rig_at_start
from psd_deflection.recordings.write.bag_writer import BagWriter, McapFile
from psd_deflection.records import (
    CHANNELS,
    AppliedLoad,
    DeflectionEstimate,
    Mark,
    ParameterChange,
    RawChunk,
    ReferencePose,
    SampleBlock,
    TemperatureReading,
)
from psd_deflection.rig.config import Rig, load_rig

from .making import HELLO, T0, assert_same, block, run, write_mcap

CLOUD = 'sensor_msgs/msg/PointCloud2'
Capsys = pytest.CaptureFixture[str]
Write = Callable[[Path, Sequence[SampleBlock]], Path]


@pytest.fixture(scope='module')
def complete_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('bags') / 'run'
    with BagWriter(folder, rig_values=load_rig(None, {'sum_min': 1.5}).values, device_hello=HELLO) as out:
        for r in run(150):
            out.put(r)
    return folder


@pytest.mark.slow
def test_every_record_comes_back(complete_bag: Path) -> None:
    recording = open_recording(complete_bag)
    records = list(run(150))
    assert_same(list(recording.blocks()), [r for r in records if isinstance(r, SampleBlock)])
    assert recording.loads() == [r for r in records if isinstance(r, AppliedLoad)]
    assert recording.temperatures() == [r for r in records if isinstance(r, TemperatureReading)]
    assert recording.marks() == [r for r in records if isinstance(r, Mark)]
    references = [r for r in records if isinstance(r, ReferencePose)]
    np.testing.assert_allclose(recording.references(), references, rtol=1e-15)
    assert (recording.parameters, recording.hello) == ({**load_rig().values, 'sum_min': 1.5}, HELLO)
    assert recording.version == psd_deflection.__version__
    assert recording.complete
    assert not recording.warnings
    assert recording.sample_rate_hz == pytest.approx(1000.0, rel=1e-12)


@pytest.mark.slow
def test_recorded_estimates_come_back(complete_bag: Path) -> None:
    series = open_recording(complete_bag).estimates()
    assert set(series) == {
        '/link_tip/deflection',
        '/link_tip/deflection_with_covariance',
        '/link_tip/exact/deflection',
        '/link_tip/wls/deflection',
    }
    expected = [r for r in run(150) if isinstance(r, DeflectionEstimate) and r.primary]
    for got in (series['/link_tip/deflection'], series['/link_tip/deflection_with_covariance']):
        np.testing.assert_array_equal(got.t_ns, [e.t_ns for e in expected])
        np.testing.assert_array_equal(got.pose[:, :2], [(e.dx, e.dy) for e in expected])
        np.testing.assert_allclose(got.pose[:, 2], [e.theta for e in expected], rtol=1e-12)
        np.testing.assert_allclose(got.tilt, [(e.phi, e.omega) for e in expected], rtol=1e-9)
    covariance = series['/link_tip/deflection_with_covariance'].covariance
    assert covariance is not None
    np.testing.assert_array_equal(covariance.reshape(-1, 9), [e.covariance for e in expected])
    assert series['/link_tip/deflection'].covariance is None


@pytest.mark.slow
def test_a_lone_file_and_a_folder_without_metadata_are_read(complete_bag: Path, tmp_path: Path) -> None:
    expected = list(open_recording(complete_bag).blocks())
    assert_same(list(open_recording(complete_bag / 'run_0.mcap').blocks()), expected)
    shutil.copytree(complete_bag, tmp_path / 'bare')
    (tmp_path / 'bare' / 'metadata.yaml').unlink()
    bare = open_recording(tmp_path / 'bare')
    assert_same(list(bare.blocks()), expected)
    assert 'no metadata.yaml' in bare.warnings[0]
    assert_same(list(open_recording(complete_bag / 'metadata.yaml').blocks()), expected)


@pytest.mark.slow
def test_several_files_are_read_in_their_order(tmp_path: Path) -> None:
    records = [block(i) for i in range(44)]
    folder = tmp_path / 'run'
    folder.mkdir()
    for i in range(11):
        write_mcap(folder / f'run_{i}.mcap', records[4 * i : 4 * i + 4])
    assert_same(list(open_recording(folder).blocks()), records)
    names = ['run_2.mcap', 'run_1.mcap', 'run_0.mcap']
    information = {'version': 9, 'storage_identifier': 'mcap', 'relative_file_paths': names}
    (folder / 'metadata.yaml').write_text(yaml.safe_dump({'rosbag2_bagfile_information': information}))
    assert next(open_recording(folder).blocks()).index == 8


def came_back(folder: Path, records: Sequence[SampleBlock], write: Write = write_mcap) -> Recording:
    """The recording that ``write`` makes of these, once its blocks are seen to be the same."""
    recording = open_recording(write(folder / 'a.mcap', records))
    assert_same(list(recording.blocks()), records)
    return recording


def modulo(path: Path, records: Sequence[SampleBlock]) -> Path:
    """A recording of someone who knows eight fields only."""
    names, formats = ['seq', 'dt', *CHANNELS], {'seq': 'u4', 'dt': 'u4'}
    with McapFile(path, rig_values={}) as out:
        for b in records:
            fields = cloud(b, names, formats, 36)
            out.write_encoded(SAMPLES, CLOUD, cdr.encode(CLOUD, fields), int(b.t_ns[0]))
    return path


@pytest.mark.slow
@pytest.mark.parametrize('write', [write_mcap, modulo])
def test_numbers_go_on_past_32_bits_within_a_file(tmp_path: Path, write: Write) -> None:
    start = 2**32 // 20 - 3
    came_back(tmp_path, [block(start + i, first_index=start, lost=(5,) * (i == 2)) for i in range(70)], write)


@pytest.mark.parametrize('epoch', [1, 2, 7])
def test_blocks_of_a_run_past_its_wrap_are_cut_as_they_were(tmp_path: Path, epoch: int) -> None:
    start = epoch * 2**32 // 20 + 2
    came_back(tmp_path, [block(start + i, first_index=start) for i in range(60)])


@pytest.mark.parametrize('write', [write_mcap, modulo])
def test_a_long_gap_with_a_wrap_in_it_is_a_gap(tmp_path: Path, write: Write) -> None:
    start, gap = 2**32 // 20 - 100_000, 300_000
    came_back(tmp_path, [block(start, first_index=start), block(start + gap, first_index=start)], write)


@pytest.mark.slow
def test_a_jump_of_the_whole_number_needs_no_guess(tmp_path: Path) -> None:
    assert not came_back(tmp_path, [block(5), block(3 * 2**32, first_index=3 * 2**32 - 10)]).warnings


@pytest.mark.slow
def test_changes_of_parameters_come_back(tmp_path: Path) -> None:
    changes = [
        ParameterChange(T0, 3, (('psd_1.zero', (1e-3, -2e-3)), ('psd_2.zero', (0.1, 1 / 3)))),
        ParameterChange(T0 + 5, 12, (('sum_min', 2.25), ('min_samples', 7))),
    ]
    path = write_mcap(tmp_path / 'a.mcap', [block(0), *changes, block(1)])
    assert repr(open_recording(path).changes) == repr(changes)
    assert open_recording(path).topics() == {SAMPLES: 2, RIG: 2}


def with_state(folder: Path, text: str) -> Path:
    """A file with one message of the rig."""
    with McapFile(folder / 'a.mcap', rig_values={}) as out:
        out.write_encoded(RIG, 'std_msgs/msg/String', cdr.encode('std_msgs/msg/String', {'data': text}), 1)
    return folder / 'a.mcap'


@pytest.mark.slow
@pytest.mark.parametrize(
    'text',
    [
        '{}',
        '{"version": "1", "t_ns": "x", "block": 1, "parameters": {}, "changed": {}}',
        '{"version": "1", "t_ns": 1, "block": 1, "parameters": {}, "changed": [1]}',
        '{"version": "1", "t_ns": 1, "block": 1, "parameters": {}, "changed": {"a": {}}}',
        '[' * 100_000,
    ],
)
def test_a_change_that_is_not_readable_is_left_out(tmp_path: Path, text: str) -> None:
    recording = open_recording(with_state(tmp_path, text))
    assert list(recording.changes) == []
    assert 'is left out' in recording.warnings[0]


def test_a_restarted_device_does_not_mix_blocks(tmp_path: Path) -> None:
    again = [block(i, t0=T0 + 5 * 10**9) for i in range(3)]
    recording = open_recording(write_mcap(tmp_path / 'a.mcap', [*(block(i) for i in range(5)), *again]))
    blocks = list(recording.blocks())
    assert [b.index for b in blocks] == list(range(8))
    assert [len(b.seq) for b in blocks] == [20] * 8
    np.testing.assert_array_equal(blocks[5].volts, again[0].volts)
    assert any('start again after 99' in w for w in recording.warnings)


@pytest.mark.slow
def test_other_blocks_are_those_of_a_recording_opened_so(tmp_path: Path) -> None:
    # After a restart numbers go on with the next block, so they depend on its size.
    again = [block(i, lost=(0, 1, 2) if i == 1 else (), t0=T0 + 5 * 10**9) for i in (1, 2)]
    path = write_mcap(tmp_path / 'a.mcap', [*(block(i) for i in range(5)), *again])
    first = open_recording(path)
    assert len(first.samples) == sum(len(b.seq) for b in first.blocks())
    other, fresh = first.with_block_size(7), open_recording(path, block_size=7)
    assert [(b.index, b.seq.tolist()) for b in other.blocks()] == [(b.index, b.seq.tolist()) for b in fresh.blocks()]
    assert np.array_equal(other.samples, fresh.samples)
    assert other.restarts == fresh.restarts != set()
    assert not np.array_equal(other.samples['seq'], first.samples['seq'])
    assert first.with_block_size(first.block_size) is first


def test_numbers_left_out_at_a_restart_are_not_lost(tmp_path: Path) -> None:
    # The device was started at another number, of which the first in the recording is amid a block.
    again = [block(i, lost=(0, 1, 2) if i == 1 else (), t0=T0 + 5 * 10**9) for i in (1, 2)]
    recording = open_recording(write_mcap(tmp_path / 'a.mcap', [*(block(i) for i in range(5)), *again]))
    samples = recording.samples
    assert recording.restarts == {(99, 103)}
    assert recording.lost(int(samples['seq'][0]), int(samples['seq'][-1]), len(samples)) == 0
    assert recording.lost(90, 110, 15) == 3


@pytest.mark.parametrize('value', ['[1]', '[5, 4]', '[0.5, 7]', '[1, 1e300]', '"x"', '[-1, 3]', f'[1, {2**70}]'])
def test_a_restart_that_makes_no_sense_is_none(tmp_path: Path, value: str) -> None:
    changed = f'{{"device.restart": {value}}}'
    text = f'{{"version": "1", "t_ns": 0, "block": 0, "parameters": {{}}, "changed": {changed}}}'
    recording = open_recording(with_state(tmp_path, text))
    assert (recording.restarts, recording.lost(0, 9, 8)) == (set(), 2)


def test_a_block_in_two_messages_is_one_block_again(tmp_path: Path) -> None:
    full = block(1)
    t_ns = full.t_ns.copy()
    t_ns[12:] += 10 * 10**9
    paused = SampleBlock(1, full.seq, t_ns, full.volts, full.flags)
    later = block(2, t0=T0 + 10 * 10**9)
    came_back(tmp_path, [block(0), paused, later])


@pytest.mark.slow
def test_the_recorded_block_size_counts(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / 'a.mcap', [block(i) for i in range(5)], rig_values={'block_size': 10})
    assert [len(b.seq) for b in open_recording(path).blocks()] == [10] * 10


def cloud(
    b: SampleBlock, names: Sequence[str], formats: dict[str, str], step: int, big: bool = False
) -> dict[str, Any]:
    """PointCloud2 fields with any layout that has our eight names."""
    kinds = {'u4': 6, 'f4': 7, 'f8': 8, 'u2': 4}
    order = '>' if big else '<'
    types = [formats.get(n, 'f4') for n in names]
    offsets = [4 + sum(int(kind[1]) for kind in types[:i]) for i in range(len(names))]
    ordered = [order + kind for kind in types]
    dtype = np.dtype({'names': list(names), 'formats': ordered, 'offsets': offsets, 'itemsize': step})
    points = np.zeros(len(b.seq), dtype)
    points['seq'] = b.seq
    points['dt'] = b.t_ns - b.t_ns[0]
    for i, c in enumerate(CHANNELS):
        points[c] = b.volts[:, i]
    (message,) = to_messages(b)
    return {
        **message.fields,
        'header': {**message.fields['header'], 'frame_id': 'some_other_frame'},
        'fields': [
            {'name': n, 'offset': o, 'datatype': kinds[kind], 'count': 1}
            for n, o, kind in zip(names, offsets, types, strict=True)
        ],
        'is_bigendian': big,
        'point_step': step,
        'row_step': step * len(points),
        'data': points.tobytes(),
    }


@pytest.mark.slow
@pytest.mark.parametrize('big', [False, True])
@pytest.mark.parametrize('compression', list(CompressionType))
@pytest.mark.parametrize('chunked', [False, True])
def test_other_layouts_compressions_and_no_chunks(
    tmp_path: Path, big: bool, compression: CompressionType, chunked: bool
) -> None:
    names = ['intensity', *reversed(CHANNELS), 'dt', 'seq']
    formats = {'seq': 'u4', 'dt': 'u4', 'intensity': 'u2', **dict.fromkeys(CHANNELS, 'f8')}
    expected = [block(i) for i in range(60)]
    with (tmp_path / 'a.mcap').open('wb') as stream:
        writer = Writer(stream, compression=compression, use_chunking=chunked, index_types=IndexType.NONE)
        writer.start('ros2')
        schema = writer.register_schema('sensor_msgs/PointCloud2', 'ros2msg', MESSAGE_TYPES[CLOUD].definition.encode())
        channel = writer.register_channel(SAMPLES, 'cdr', schema)
        for b in expected:
            message = cdr.encode(CLOUD, cloud(b, names, formats, 64, big))
            writer.add_message(channel, int(b.t_ns[0]), message, int(b.t_ns[0]))
        writer.finish()
    recording = open_recording(tmp_path / 'a.mcap')
    assert_same(list(recording.blocks()), expected)
    assert (recording.complete, recording.parameters, recording.hello) == (True, {}, None)


@pytest.mark.slow
def test_samples_that_are_no_numbers_count_as_lost(tmp_path: Path) -> None:
    b = block(0)
    b.volts[3, 2] = np.nan
    recording = open_recording(write_mcap(tmp_path / 'a.mcap', [b, block(1)]))
    first, second = recording.blocks()
    assert (first.seq.tolist(), len(second.seq)) == ([0, 1, 2, *range(4, 20)], 20)
    assert 'NaN' in recording.warnings[0]


@pytest.mark.slow
def test_a_load_without_a_stamp_counts_from_when_it_came(tmp_path: Path) -> None:
    with McapFile(tmp_path / 'a.mcap', rig_values={}) as out:
        for t_ns in (0, T0 + 7):
            (m,) = to_messages(AppliedLoad(t_ns, 1.0, 2.0, 3.0))
            out.write_encoded(m.topic, m.type, cdr.encode(m.type, m.fields), T0 + 99)
    assert [r.t_ns for r in open_recording(tmp_path / 'a.mcap').loads()] == [T0 + 99, T0 + 7]


def information(folder: Path, **changes: object) -> Path:
    folder.mkdir()
    tree = {'storage_identifier': 'mcap', 'relative_file_paths': ['a_0.mcap'], **changes}
    (folder / 'metadata.yaml').write_text(yaml.safe_dump({'rosbag2_bagfile_information': tree}))
    return folder


@pytest.mark.foreign
@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'storage_identifier': 'sqlite3'}, 'sqlite3 storage.*`mcap convert IN.db3 OUT.mcap` or `ros2 bag convert`'),
        ({'compression_mode': 'FILE'}, 'compressed by rosbag2'),
        ({'relative_file_paths': []}, 'names no file'),
        ({'relative_file_paths': [3]}, 'names no file'),
        ({'relative_file_paths': ['../../etc/passwd']}, 'passwd: is listed in metadata.yaml but missing'),
    ],
)
def test_bags_of_another_kind_are_rejected(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    folder = information(tmp_path / 'b', **changes)
    with pytest.raises(RecordingError, match=message) as caught:
        open_recording(folder)
    assert '\n' not in str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('name', 'content', 'message'),
    [
        ('a.mcap', b'', 'is empty'),
        ('a.mcap', b'\x89PNG and more', 'is not an MCAP file'),
        ('a.db3', b'SQLite format 3\0', 'is no recording'),
        ('a.mcap', b'\x89MCAP0\r\n', 'holds no samples before the cut'),
        ('metadata.yaml', b'rosbag2_bagfile_information: [1', 'malformed YAML'),
        ('metadata.yaml', b'- 1', 'has no rosbag2_bagfile_information'),
        ('metadata.yaml', b'\xff\xfe\xff', 'it is no text'),
        ('metadata.yaml', b'[' * 5000, 'malformed YAML'),
    ],
)
def test_files_that_are_none_are_rejected_in_one_line(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingError, match=message) as caught:
        list(open_recording(tmp_path / name).blocks())
    assert str(tmp_path / name) in str(caught.value)
    assert '\n' not in str(caught.value)


@pytest.mark.slow
def test_what_is_not_there_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match='no such recording'):
        open_recording(tmp_path / 'nothing')
    with pytest.raises(RecordingError, match='is no bag'):
        open_recording(tmp_path)


@pytest.mark.slow
@pytest.mark.foreign
def test_another_type_on_our_topic_is_rejected(tmp_path: Path) -> None:
    with McapFile(tmp_path / 'a.mcap', rig_values={}) as out:
        (m,) = to_messages(TemperatureReading(T0, 20.0))
        out.write_encoded(SAMPLES, m.type, cdr.encode(m.type, m.fields), T0)
    with pytest.raises(RecordingError, match=r"/psd/samples is 'sensor_msgs/msg/Temperature'"):
        list(open_recording(tmp_path / 'a.mcap').blocks())


@pytest.mark.slow
@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (lambda points: points['seq'].__setitem__(slice(None), 7), 'seq does not rise'),
        (lambda points: points['dt'].__setitem__(5, 0), 'dt does not rise'),
    ],
)
def test_points_out_of_order_are_rejected(tmp_path: Path, change: Any, message: str) -> None:
    (m,) = to_messages(block(0))
    points = np.frombuffer(bytearray(m.fields['data']), np.dtype([('seq', '<u4'), ('dt', '<u4'), ('v', '<f4', 6)]))
    change(points)
    with McapFile(tmp_path / 'a.mcap', rig_values={}) as out:
        out.write_encoded(SAMPLES, m.type, cdr.encode(m.type, {**m.fields, 'data': points.tobytes()}), T0)
    with pytest.raises(RecordingError, match=message):
        list(open_recording(tmp_path / 'a.mcap').blocks())


STORE = get_typestore(Stores.ROS2_JAZZY)
CLEAN = Path(__file__).resolve().parents[2] / 'bags' / 'clean'
BLOCK_NS = 20_000_000


@pytest.fixture(scope='module')
def zeroed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a rig that is not the nominal one, zeroed while it is recorded."""
    recording = open_recording(CLEAN)
    pipeline = Pipeline(load_rig(None, {'psd_2.center': [-0.09, 0.0], 'link.length': 0.6}))
    folder = tmp_path_factory.mktemp('run') / 'run'
    with BagWriter(folder, rig_values=pipeline.rig.flat(), device_hello=HELLO) as bag:
        for block in recording.blocks():
            for record in pipeline.process(RawChunk(block.seq, block.t_ns, block.volts, block.flags)):
                bag.put(record)
            if block.index == 40:
                change = pipeline.zero()
                assert change is not None
                bag.put(change)
    return folder


def passed_on(
    bag: Path, out: Path, name: Callable[[str], str] = str, keep: Callable[[str, int], bool] = lambda *_: True
) -> Path:
    """``bag`` as rosbag2 passes it on: written by rosbags, without metadata records, with other ``name``s of topics.

    ``keep``: of a topic and its time since the first message, ns.
    """
    with Reader(bag) as source, RosbagsWriter(out, version=9, storage_plugin=StoragePlugin.MCAP) as target:
        made = {}
        for connection, t_ns, raw in source.messages():
            if not keep(connection.topic, t_ns - source.start_time):
                continue
            topic = connection.topic
            if topic not in made:
                made[topic] = target.add_connection(name(topic), connection.msgtype, typestore=STORE)
            target.write(made[topic], t_ns, raw)
    assert not any(name.startswith('psd_deflection') for f in out.glob('*.mcap') for name in McapReader(f).metadata)
    return out


def copied(out: Path, bags: Sequence[tuple[str, Path]], chunk_size: int = 1_000_000) -> Path:
    """The messages of ``bags``, each in its namespace, in one file without our metadata."""
    with out.open('wb') as stream:
        writer = Writer(stream, chunk_size=chunk_size)
        writer.start('ros2')
        numbers: dict[str, int] = {}
        for namespace, folder in bags:
            for channel, log_time, message in open_recording(folder).messages():
                topic = namespace + channel.topic
                if topic not in numbers:
                    schema = writer.register_schema(channel.type, 'ros2msg', b'')
                    numbers[topic] = writer.register_channel(topic, 'cdr', schema)
                writer.add_message(numbers[topic], log_time, message, log_time)
        writer.finish()
    return out


def in_arm(topic: str) -> str:
    return topic if topic == '/diagnostics' else f'/arm{topic}'


def rigs(bag: Path) -> tuple[Rig, Rig]:
    recording = open_recording(bag)
    return rig_at_start(recording), rig_at_end(recording)


@pytest.mark.slow
def test_rig_zero_and_hello_are_messages_too(zeroed: Path, tmp_path: Path, capsys: Capsys) -> None:
    bag = passed_on(zeroed, tmp_path / 'converted')
    before, after = open_recording(zeroed), open_recording(bag)
    assert rigs(bag) == rigs(zeroed)
    assert rig_at_end(after).psds[0].zero != rig_at_start(after).psds[0].zero
    assert (after.hello, after.version, repr(after.changes)) == (before.hello, before.version, repr(before.changes))
    assert main(['replay', str(bag), '--compare', '--strict']) == 0
    answer = capsys.readouterr()
    assert 'no bit differs' in answer.out
    assert 'nominal' not in answer.err


def test_a_late_subscriber_of_a_played_bag_gets_the_rig(zeroed: Path) -> None:
    with Reader(zeroed) as bag:
        (connection,) = (c for c in bag.connections if c.topic == RIG)
        (profile,) = connection.ext.offered_qos_profiles
    assert profile.durability.name == 'TRANSIENT_LOCAL'


def test_another_rig_in_the_same_bag_is_reported(tmp_path: Path) -> None:
    bags = []
    for length in (0.5, 0.6):
        folder = tmp_path / f'{length}'
        with BagWriter(folder, rig_values=load_rig(None, {'link.length': length}).flat()) as bag:
            for channel, log_time, message in open_recording(CLEAN).messages([SAMPLES]):
                bag.write_encoded(channel.topic, channel.type, message, log_time + round(length * 1e12))
        bags.append(folder)
    recording = open_recording(copied(tmp_path / 'both.mcap', [('', folder) for folder in bags]))
    assert rig_at_start(recording).link.length == 0.5
    assert any('another rig starts' in w for w in recording.warnings)


def test_what_both_hold_is_compared(zeroed: Path, tmp_path: Path, capsys: Capsys) -> None:
    topics = ('/psd/samples', '/link_tip/deflection', RIG)

    def edges(topic: str, since: int) -> bool:
        first = {'/psd/samples': 30, '/link_tip/deflection': 31}.get(topic, 0) * BLOCK_NS
        return topic in topics and first <= since < 150 * BLOCK_NS

    bag = passed_on(zeroed, tmp_path / 'part', keep=lambda topic, _: topic in topics)
    assert main(['replay', str(bag), '--compare']) == 0
    answer = capsys.readouterr().out
    assert 'the recording is partial: 0 messages are only in it' in answer
    assert main(['replay', str(bag), '--compare', '--strict']) == 1
    capsys.readouterr()
    # Whoever comes late does not know what the pipeline remembers; a zero of long ago is in the rig.
    late = passed_on(zeroed, tmp_path / 'late', keep=edges)
    main(['replay', str(late), '--compare', '--json'])
    compared = json.loads(capsys.readouterr().out)['compared']
    assert compared['equal'] + compared['different'] == 119
    assert compared['only_replayed'] > 0
    assert not compared['identical']


def test_a_gap_amid_our_own_recording_is_a_difference(tmp_path: Path, capsys: Capsys) -> None:
    def without(folder: Path, lost: range) -> Path:
        recording = open_recording(CLEAN)
        with BagWriter(folder, rig_values=dict(recording.parameters)) as bag:
            number = 0
            for channel, log_time, message in recording.messages():
                if channel.topic == '/link_tip/deflection':
                    number += 1
                    if number in lost:
                        continue
                bag.write_encoded(channel.topic, channel.type, message, log_time)
        return folder

    assert main(['replay', str(without(tmp_path / 'end', range(190, 300))), '--compare']) == 0
    assert main(['replay', str(without(tmp_path / 'amid', range(90, 92))), '--compare']) == 1
    assert '2 only in the replay' in capsys.readouterr().out


def test_a_namespaced_recording_is_read_as_it_is(zeroed: Path, tmp_path: Path, capsys: Capsys) -> None:
    bag = passed_on(zeroed, tmp_path / 'arm', in_arm)
    assert (open_recording(bag).topics(), rigs(bag)) == (open_recording(zeroed).topics(), rigs(zeroed))
    assert main(['replay', str(bag), '--compare', '--strict']) == 0
    capsys.readouterr()
    assert main(['info', str(bag)]) == 0
    assert '/arm' in capsys.readouterr().out
    cut = copied(tmp_path / 'cut.mcap', [('/arm', zeroed)], chunk_size=10_000)
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size * 2 // 3])
    recording = open_recording(cut)
    assert recording.namespace == '/arm'
    assert sum(1 for _ in recording.blocks()) > 50


def test_of_several_rigs_one_is_chosen(zeroed: Path, tmp_path: Path, capsys: Capsys) -> None:
    two = copied(tmp_path / 'two.mcap', [('/left', CLEAN), ('/right', zeroed)])
    with pytest.raises(RecordingError, match='2 rigs; give the namespace of one: /left, /right'):
        open_recording(two)
    assert main(['replay', str(two)]) == 4
    assert '/left, /right' in capsys.readouterr().err
    for given in ('/right', 'right/'):
        recording = open_recording(two, namespace=given)
        assert rig_at_start(recording) == rigs(zeroed)[0]
    assert main(['replay', str(two), '--namespace', '/right', '--compare', '--strict']) == 0
    selected = open_recording(two, namespace='/left')
    assert selected.parameters == open_recording(CLEAN).parameters != recording.parameters
    with pytest.raises(RecordingError, match='in the namespace /up'):
        next(open_recording(two, namespace='/up').blocks())


@pytest.mark.foreign
def test_remapped_samples_are_found_and_no_foreign_cloud(zeroed: Path, tmp_path: Path) -> None:
    bag = passed_on(zeroed, tmp_path / 'remapped', lambda topic: '/raw/psd/samples' if topic == SAMPLES else topic)
    recording = open_recording(bag)
    assert (recording.namespace, recording.topics()) == ('/raw', open_recording(zeroed).topics())
    assert rigs(bag) == rigs(zeroed)
    foreign = tmp_path / 'foreign.mcap'
    with foreign.open('wb') as stream:
        writer = Writer(stream)
        writer.start('ros2')
        schema = writer.register_schema('sensor_msgs/msg/PointCloud2', 'ros2msg', b'')
        writer.add_message(writer.register_channel('/lidar/psd/samples', 'cdr', schema), 1, b'\0\1\0\0', 1)
        writer.finish()
    with pytest.raises(RecordingError, match='holds no samples'):
        next(open_recording(foreign).blocks())


RECORDS = [block(i) for i in range(40)]


def bag(folder: Path, storage: str | None = 'mcap') -> Path:
    information(folder, version=5, storage_identifier=storage, relative_file_paths=['run_0.mcap'])
    write_mcap(folder / 'run_0.mcap', RECORDS)
    return folder


@pytest.mark.foreign
@pytest.mark.parametrize('storage', ['mcap', '', None])
def test_a_bag_after_a_reindex_is_read(tmp_path: Path, storage: str | None) -> None:
    recording = open_recording(bag(tmp_path / 'run', storage))
    assert_same(list(recording.blocks()), RECORDS)
    assert recording.warnings == []


@pytest.mark.foreign
def test_a_file_that_metadata_do_not_list_is_named(tmp_path: Path) -> None:
    folder = bag(tmp_path / 'run')
    shutil.copy(folder / 'run_0.mcap', folder / 'copy.mcap')
    recording = open_recording(folder)
    assert_same(list(recording.blocks()), RECORDS)
    (warning,) = recording.warnings
    assert warning.startswith(f'{folder}/copy.mcap: is not listed in metadata.yaml and is not read')
    recover(folder)
    assert open_recording(folder).warnings == []


@pytest.mark.foreign
@pytest.mark.parametrize('leap_s', [-3600.0, 12.0, 1.7e9])
def test_a_leap_of_log_times_is_reported_once(tmp_path: Path, leap_s: float, capsys: Capsys) -> None:
    with McapFile(tmp_path / 'a.mcap', rig_values={}) as out:
        for record in RECORDS:
            leapt = int(leap_s * 1e9) if record.index >= 20 else 0
            for message in to_messages(record):
                encoded = cdr.encode(message.type, message.fields)
                out.write_encoded(message.topic, message.type, encoded, int(record.t_ns[0]) + leapt)
    recording = open_recording(tmp_path / 'a.mcap')
    for _ in range(2):
        assert_same(list(recording.blocks()), RECORDS)
    (warning,) = recording.warnings
    assert f"the recorder's clock leapt by {leap_s:+.3f} s" in warning
    assert np.diff(recording.samples['t']).max() < 0.0011
    assert main(['recover', recording.path.as_posix()]) == 0
    assert ' 0.780 s; was intact' in capsys.readouterr().out
