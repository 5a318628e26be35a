# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Bags of others: ``ros2 bag record`` or ``convert``, reindexed, copied by hand, from stepped clocks."""

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.writer import Writer
from rosbags.rosbag2 import Reader, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_typestore

from msg_adapters import RIG, SAMPLES, to_messages
from psd_deflection.base.errors import RecordingError
from psd_deflection.cli.main import main
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings import cdr
from psd_deflection.recordings.read.mcap_reader import McapReader
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.repair import recover
from psd_deflection.recordings.replay.engine import rig_at_end, rig_at_start
from psd_deflection.recordings.write.bag_writer import BagWriter, McapFile
from psd_deflection.records import RawChunk
from psd_deflection.rig.config import Rig, load_rig

from .making import HELLO, assert_same, block, write_mcap

STORE = get_typestore(Stores.ROS2_JAZZY)
CLEAN = Path(__file__).resolve().parents[2] / 'bags' / 'clean'
BLOCK_NS = 20_000_000


@pytest.fixture(scope='module')
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
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
            if connection.topic not in made:
                made[connection.topic] = target.add_connection(
                    name(connection.topic), connection.msgtype, typestore=STORE
                )
            target.write(made[connection.topic], t_ns, raw)
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
                    numbers[topic] = writer.register_channel(
                        topic, 'cdr', writer.register_schema(channel.type, 'ros2msg', b'')
                    )
                writer.add_message(numbers[topic], log_time, message, log_time)
        writer.finish()
    return out


def in_arm(topic: str) -> str:
    return topic if topic == '/diagnostics' else f'/arm{topic}'


def rigs(bag: Path) -> tuple[Rig, Rig]:
    recording = open_recording(bag)
    return rig_at_start(recording), rig_at_end(recording)


@pytest.mark.slow
def test_rig_zero_and_hello_are_messages_too(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = passed_on(run, tmp_path / 'converted')
    before, after = open_recording(run), open_recording(bag)
    assert rigs(bag) == rigs(run)
    assert rig_at_end(after).psds[0].zero != rig_at_start(after).psds[0].zero
    assert (after.hello, after.version, repr(after.changes)) == (before.hello, before.version, repr(before.changes))
    assert main(['replay', str(bag), '--compare', '--strict']) == 0
    answer = capsys.readouterr()
    assert 'no bit differs' in answer.out
    assert 'nominal' not in answer.err


def test_a_late_subscriber_of_a_played_bag_gets_the_rig(run: Path) -> None:
    with Reader(run) as bag:
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


def test_what_both_hold_is_compared(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kept = ('/psd/samples', '/link_tip/deflection', RIG)

    def edges(topic: str, since: int) -> bool:
        first = {'/psd/samples': 30, '/link_tip/deflection': 31}.get(topic, 0) * BLOCK_NS
        return topic in kept and first <= since < 150 * BLOCK_NS

    bag = passed_on(run, tmp_path / 'part', keep=lambda topic, _: topic in kept)
    assert main(['replay', str(bag), '--compare']) == 0
    answer = capsys.readouterr().out
    assert 'the recording is partial: 0 messages are only in it' in answer
    assert main(['replay', str(bag), '--compare', '--strict']) == 1
    capsys.readouterr()
    # Whoever comes late does not know what the pipeline remembers; a zero of long ago is in the rig.
    late = passed_on(run, tmp_path / 'late', keep=edges)
    main(['replay', str(late), '--compare', '--json'])
    compared = json.loads(capsys.readouterr().out)['compared']
    assert compared['equal'] + compared['different'] == 119
    assert compared['only_replayed'] > 0
    assert not compared['identical']


def test_a_gap_amid_our_own_recording_is_a_difference(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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


def test_a_namespaced_recording_is_read_as_it_is(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = passed_on(run, tmp_path / 'arm', in_arm)
    assert open_recording(bag).topics() == open_recording(run).topics()
    assert rigs(bag) == rigs(run)
    assert main(['replay', str(bag), '--compare', '--strict']) == 0
    capsys.readouterr()
    assert main(['info', str(bag)]) == 0
    assert '/arm' in capsys.readouterr().out
    cut = copied(tmp_path / 'cut.mcap', [('/arm', run)], chunk_size=10_000)
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size * 2 // 3])
    recording = open_recording(cut)
    assert recording.namespace == '/arm'
    assert sum(1 for _ in recording.blocks()) > 50


def test_of_several_rigs_one_is_chosen(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    two = copied(tmp_path / 'two.mcap', [('/left', CLEAN), ('/right', run)])
    with pytest.raises(RecordingError, match='2 rigs; give the namespace of one: /left, /right'):
        open_recording(two)
    assert main(['replay', str(two)]) == 4
    assert '/left, /right' in capsys.readouterr().err
    for given in ('/right', 'right/'):
        recording = open_recording(two, namespace=given)
        assert rig_at_start(recording) == rigs(run)[0]
    assert main(['replay', str(two), '--namespace', '/right', '--compare', '--strict']) == 0
    left = open_recording(two, namespace='/left')
    assert left.parameters == open_recording(CLEAN).parameters != recording.parameters
    with pytest.raises(RecordingError, match='in the namespace /up'):
        next(open_recording(two, namespace='/up').blocks())


def test_remapped_samples_are_found_and_no_foreign_cloud(run: Path, tmp_path: Path) -> None:
    bag = passed_on(run, tmp_path / 'remapped', lambda topic: '/raw/psd/samples' if topic == SAMPLES else topic)
    recording = open_recording(bag)
    assert recording.namespace == '/raw'
    assert recording.topics() == open_recording(run).topics()
    assert rigs(bag) == rigs(run)
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


def bag(folder: Path, *, storage: str | None = 'mcap', listed: tuple[str, ...] = ('run_0.mcap',)) -> Path:
    folder.mkdir()
    write_mcap(folder / 'run_0.mcap', RECORDS)
    information = {'version': 5, 'storage_identifier': storage, 'relative_file_paths': list(listed)}
    (folder / 'metadata.yaml').write_text(yaml.safe_dump({'rosbag2_bagfile_information': information}))
    return folder


@pytest.mark.parametrize('storage', ['mcap', '', None])
def test_a_bag_after_a_reindex_is_read(tmp_path: Path, storage: str | None) -> None:
    recording = open_recording(bag(tmp_path / 'run', storage=storage))
    assert_same(list(recording.blocks()), RECORDS)
    assert recording.warnings == []


def test_another_storage_names_both_converters(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r'sqlite3 storage.*`mcap convert IN.db3 OUT.mcap` or `ros2 bag convert`'):
        open_recording(bag(tmp_path / 'run', storage='sqlite3'))


def test_a_file_that_metadata_do_not_list_is_named(tmp_path: Path) -> None:
    folder = bag(tmp_path / 'run')
    shutil.copy(folder / 'run_0.mcap', folder / 'copy.mcap')
    recording = open_recording(folder)
    assert_same(list(recording.blocks()), RECORDS)
    (warning,) = recording.warnings
    assert warning.startswith(f'{folder}/copy.mcap: is not listed in metadata.yaml and is not read')
    recover(folder)
    assert open_recording(folder).warnings == []


@pytest.mark.parametrize('leap_s', [-3600.0, 12.0, 1.7e9])
def test_a_leap_of_log_times_is_reported_once(tmp_path: Path, leap_s: float) -> None:
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
