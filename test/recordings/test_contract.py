# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The committed recordings, held against what other people's programs rely on, by readers not ours."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from msg_adapters import TOPIC_TYPES
from psd_deflection.recordings.read.readers import open_recording

ROOT = Path(__file__).resolve().parents[2]
BAGS = sorted(p.parent for p in (ROOT / 'bags').glob('*/metadata.yaml'))
STORE = get_typestore(Stores.ROS2_JAZZY)
FIELDS = ['seq', 'dt', 'x1', 'y1', 'sum1', 'x2', 'y2', 'sum2']


def decoded(folder: Path) -> dict[str, list[Any]]:
    out: dict[str, list[Any]] = {}
    with Reader(folder) as reader:
        for connection, _, raw in reader.messages():
            # Of each solver a pose, of each PSD beyond the second a point.
            other = 'PointStamped' if connection.topic.endswith('/spot') else 'PoseStamped'
            assert connection.msgtype == TOPIC_TYPES.get(connection.topic, f'geometry_msgs/msg/{other}')
            out.setdefault(connection.topic, []).append(STORE.deserialize_cdr(raw, connection.msgtype))
        assert {c.topic: c.msgcount for c in reader.connections} == {t: len(m) for t, m in out.items()}
    return out


def stamp(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def points(message: Any) -> Any:
    names = [f.name for f in message.fields]
    assert names[:8] == FIELDS
    dtype = np.dtype(
        {
            'names': names,
            'formats': ['<u4' if f.datatype == 6 else '<f4' for f in message.fields],
            'offsets': [f.offset for f in message.fields],
            'itemsize': message.point_step,
        }
    )
    return np.frombuffer(message.data.tobytes(), dtype)


def test_there_are_recordings() -> None:
    assert BAGS


@pytest.mark.parametrize('folder', BAGS, ids=lambda p: p.name)
def test_the_container(folder: Path) -> None:
    (file,) = folder.glob('*.mcap')
    with file.open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == 'ros2'
        names = {m.name for m in reader.iter_metadata()}
        assert names == {'psd_deflection', 'rosbag2'}
        assert len(list(reader.iter_messages(['/link_tip/rig']))) == 1
    with file.open('rb') as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, Chunk):
                assert record.compression == 'zstd'
                assert record.uncompressed_crc
                assert record.message_end_time - record.message_start_time <= 10**9


@pytest.mark.parametrize('folder', BAGS, ids=lambda p: p.name)
def test_the_messages(folder: Path) -> None:
    topics = decoded(folder)
    topics.pop('/link_tip/rig', None)
    for messages in topics.values():
        assert (np.diff([stamp(m) for m in messages]) >= 0).all()
    middles, seqs = [], []
    for cloud in topics['/psd/samples']:
        p = points(cloud)
        assert (cloud.height, cloud.width, cloud.header.frame_id) == (1, len(p), 'link_tip')
        assert len(set((p['seq'] // 20).tolist())) == 1
        assert (np.diff(p['dt'].astype(np.int64)) > 0).all()
        assert all(np.isfinite(p[n]).all() for n in FIELDS[2:])
        seqs.append(p['seq'].astype(np.int64))
        slots = p['seq'].astype(np.int64) % 20
        middles.append(stamp(cloud) + (p['dt'] + (9.5 - slots) * 1e6).mean())
    assert (np.diff(np.concatenate(seqs)) > 0).all()
    estimates = topics['/link_tip/deflection']
    apart = np.abs(np.array([stamp(m) for m in estimates])[:, None] - np.array(middles)[None, :]).min(axis=1)
    assert apart.max() < 100_000
    for m in estimates:
        q = m.pose.orientation
        assert abs(q.x**2 + q.y**2 + q.z**2 + q.w**2 - 1.0) < 1e-15
        assert m.header.frame_id == 'link_tip_rest'
    for m in topics['/link_tip/deflection_with_covariance']:
        k = m.pose.covariance.reshape(6, 6)
        np.testing.assert_allclose(k, k.T)
        assert np.linalg.eigvalsh(k[np.ix_([0, 1, 5], [0, 1, 5])]).min() > 0


@pytest.mark.slow
@pytest.mark.parametrize('folder', BAGS, ids=lambda p: p.name)
def test_we_read_what_they_read(folder: Path) -> None:
    theirs = [points(m) for m in decoded(folder)['/psd/samples']]
    ours = open_recording(folder).samples
    for name in ['seq', *FIELDS[2:]]:
        np.testing.assert_array_equal(ours[name], np.concatenate([p[name] for p in theirs]))
