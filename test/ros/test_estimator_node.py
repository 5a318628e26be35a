# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The node as a process of its own, seen from a second participant with its own rclpy."""

import array
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, PoseStamped, PoseWithCovarianceStamped, Vector3Stamped, WrenchStamped
from rcl_interfaces.srv import GetParameters
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import qos_profile_sensor_data
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool
from visualization_msgs.msg import MarkerArray

from msg_adapters import SAMPLES, point_cloud2
from psd_deflection.cli.main import main
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.rig.declarations import PARAMETERS
from psd_deflection.ros.endpoints import publisher_of
from test.ros.conftest import BLOCK_NS, Peer, stamp

pytestmark = pytest.mark.ros
TOPICS = {
    '/link_tip/deflection': 'geometry_msgs/msg/PoseStamped',
    '/link_tip/deflection_with_covariance': 'geometry_msgs/msg/PoseWithCovarianceStamped',
    '/link_tip/rig': 'std_msgs/msg/String',
    '/link_tip/wrench': 'geometry_msgs/msg/WrenchStamped',
    '/link_tip/exact/deflection': 'geometry_msgs/msg/PoseStamped',
    '/link_tip/wls/deflection': 'geometry_msgs/msg/PoseStamped',
    '/link_tip/iterative/deflection': 'geometry_msgs/msg/PoseStamped',
    '/psd_1/spot': 'geometry_msgs/msg/PointStamped',
    '/psd_2/spot': 'geometry_msgs/msg/PointStamped',
    '/psd/samples': 'sensor_msgs/msg/PointCloud2',
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
    '/link_tip/load': 'geometry_msgs/msg/WrenchStamped',
    '/link_tip/mark': 'std_msgs/msg/String',
    '/reference/deflection': 'geometry_msgs/msg/PoseStamped',
    '/environment/temperature': 'sensor_msgs/msg/Temperature',
}


def points_of(cloud: Any) -> Any:
    return np.frombuffer(bytes(cloud.data), point_cloud2.point_of(2, cloud.point_step // 4 - 8))


def test_what_is_published_and_how_often(start: Callable[..., Any], peer: Any) -> None:
    start()
    poses = peer.collect(PoseStamped, '/link_tip/deflection')
    wide = peer.collect(PoseWithCovarianceStamped, '/link_tip/deflection_with_covariance')
    wrenches = peer.collect(WrenchStamped, '/link_tip/wrench')
    spots = peer.collect(PointStamped, '/psd_2/spot')
    clouds = peer.collect(PointCloud2, '/psd/samples')
    health = peer.collect(DiagnosticArray, '/diagnostics')
    peer.until(lambda: len(poses) >= 251 and len(wrenches) >= 251 and len(health) >= 3, 'five seconds of estimates')
    last = max(stamp(poses[250]), stamp(wrenches[250]))
    # What was lost up to then is told later.
    peer.until(lambda: stamp(health[-1]) > last, 'the diagnostics after them')
    graph = dict(peer.node.get_topic_names_and_types())
    for topic, kind in TOPICS.items():
        assert graph.get(topic) == [kind], topic
    for messages in (poses, wrenches):
        stamps = np.array([stamp(m) for m in messages[:251]])
        assert {m.header.frame_id for m in messages} == {'link_tip_rest'}
        # 50 to the second. Whole ones are missing where the simulated device had no processor and nobody read it.
        steps = np.diff(stamps)
        blocks = np.rint(steps / BLOCK_NS)
        assert np.median(blocks) == blocks.min() == 1
        assert (abs(steps - blocks * BLOCK_NS) < blocks * 100_000).all()
    # The stamp is the middle of a block whose samples are in /psd/samples, and now is just after it.
    starts = {stamp(c): c for c in clouds}
    matched = [p for p in poses if any(abs(stamp(p) - t - 9_500_000) < 50_000 for t in starts)]
    assert len(matched) > 200
    assert abs(time.time_ns() - stamp(poses[-1])) < 10 * 10**9
    assert (clouds[0].width, clouds[0].point_step) == (20, 32)
    assert abs(poses[0].pose.orientation.w) > 0.99
    covariance = np.array(wide[-1].pose.covariance).reshape(6, 6)
    assert 1e-8 < math.sqrt(covariance[0, 0]) < 1e-6
    assert covariance[5, 5] > 0
    assert abs(spots[0].point.x) < 5e-3
    names = {s.name for s in health[-1].status}
    assert 'estimator: acquisition' in names
    values = {v.key: v.value for s in health[-1].status for v in s.values}
    # On a busy machine the simulated device drops samples, and says so; there is no other cause here.
    causes = {key: int(value) for key, value in values.items() if key.startswith('lost: ')}
    assert set(causes) <= {'lost: dropped by the device'}
    assert int(values['lost']) == sum(causes.values())
    missing = int((blocks - 1).sum())
    # A block is left out if more than half of its 20 samples are lost.
    assert int(values['lost']) + int(values['dropped by a full queue']) >= 10 * missing
    assert values['bad frames'] == '0'
    assert float(values['rate (samples/s)']) > 0


@pytest.mark.slow
def test_another_vendors_dds_sees_the_same_values(start: Callable[..., Any], peer: Any) -> None:
    start()
    poses = peer.collect(PoseStamped, '/link_tip/deflection')
    peer.until(lambda: len(poses) > 0, 'a first estimate')
    # A process of its own, without the libraries that rclpy brought along.
    clean = {k: v for k, v in os.environ.items() if k not in ('LD_LIBRARY_PATH', '_ROS_WHEELS_BOOTSTRAP_COMPLETE')}
    script = Path(__file__).parent / 'cyclone_subscriber.py'
    command, pipe = [sys.executable, str(script), 'rt/link_tip/deflection', '50'], subprocess.PIPE
    other = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env=clean)
    peer.until(lambda: other.poll() is not None, 'the other vendor to have 50 messages')
    stdout, stderr = other.communicate()
    assert other.returncode == 0, (other.returncode, stderr, len(poses))
    observed = {row[0]: row[1:] for row in json.loads(stdout)}
    assert len(observed) == 50
    ours = {stamp(p): p for p in poses}
    common = sorted(set(observed) & set(ours))
    assert len(common) >= 45
    for t in common:
        at, o = ours[t].pose.position, ours[t].pose.orientation
        assert observed[t] == [ours[t].header.frame_id, at.x, at.y, at.z, o.x, o.y, o.z, o.w]


def test_zero_and_record(start: Callable[..., Any], peer: Any, tmp_path: Path, simulated_port: str) -> None:
    rig = tmp_path / 'rig.yaml'
    lines = f'    bag_dir: {tmp_path / "bags"}\n    psd_1:\n      zero: [0.0002, 0.0001]\n'
    rig.write_text(f'estimator:\n  ros__parameters:\n{lines}')
    daemon = start('--params-file', str(rig), '--port', simulated_port)
    poses = peer.collect(PoseStamped, '/link_tip/deflection')
    peer.until(lambda: len(poses) >= 30, 'estimates')
    # The file's zero is wrong by tenths of a millimetre, and so is the deflection.
    assert abs(poses[-1].pose.position.x) > 5e-5
    answer = peer.zero()
    assert 'psd_1 (' in answer.message
    peer.until_of_now(poses, 'estimates after the zero')
    assert abs(poses[-1].pose.position.x) < 1e-5
    begun = peer.call(SetBool, '/estimator/record', SetBool.Request(data=True))
    assert begun.success
    folder = Path(begun.message.removeprefix('recording to '))
    assert folder.parent == tmp_path / 'bags'
    now = len(poses)
    peer.until(lambda: len(poses) >= now + 60, 'a second of estimates')
    ended = peer.call(SetBool, '/estimator/record', SetBool.Request(data=False))
    assert ended.success
    assert ended.message == f'recording ended: {folder}'
    assert peer.call(SetBool, '/estimator/record', SetBool.Request(data=False)).message == 'no recording runs'
    assert [line for line in daemon.lines if 'recording' in line] == [begun.message, ended.message]
    # An independent reader finds in the bag what was received.
    store = get_typestore(Stores.ROS2_JAZZY)
    received = {stamp(p): p.pose.position.x for p in poses}
    with Reader(folder) as bag:
        recorded = {
            stamp(m): m.pose.position.x
            for c, _, raw in bag.messages()
            if c.topic == '/link_tip/deflection'
            for m in [store.deserialize_cdr(raw, c.msgtype)]
        }
    assert len(recorded) >= 50
    assert all(recorded[t] == received[t] for t in recorded if t in received)
    assert len(set(recorded) & set(received)) >= 50


@pytest.mark.slow
def test_a_dump_of_the_parameters_starts_the_node_again(start: Callable[..., Any], peer: Any, tmp_path: Path) -> None:
    first = start('--ros-args', '-p', 'sum_min:=2.4', '-p', "psd_1.axes:=[-y, 'x']")
    first.until('publishing on ROS domain')
    names = [p.name for p in PARAMETERS] + ['simulated', 'use_sim_time']
    request = GetParameters.Request(names=names)
    values = peer.call(GetParameters, '/estimator/get_parameters', request).values
    held = {name: parameter_value_to_python(value) for name, value in zip(names, values, strict=True)}
    held = {name: list(value) if isinstance(value, array.array) else value for name, value in held.items()}
    assert (held['psd_1.axes'], held['psd_2.axes']) == (['-y', '+x'], ['+x', '+y'])
    assert first.end() == 0, first.lines
    # As ros2 param dump writes it, which leaves a y without quotes.
    dump = tmp_path / 'dump.yaml'
    dump.write_text(yaml.dump({'/estimator': {'ros__parameters': held}}))
    again = start('--ros-args', '--params-file', str(dump))
    again.until('publishing on ROS domain')
    values = peer.call(GetParameters, '/estimator/get_parameters', request).values
    assert [parameter_value_to_python(value) for value in values] == [
        parameter_value_to_python(Parameter('', value=held[name]).get_parameter_value()) for name in names
    ]


@pytest.mark.slow
def test_the_log_file_of_the_process_has_the_lines(start: Callable[..., Any], tmp_path: Path) -> None:
    daemon = start('--ros-args', '-p', f'zero_file:={tmp_path}', '--log-level', 'warn', '--log-file-name', 'tip')
    daemon.until('no port given')
    assert daemon.end() == 0, daemon.lines
    (file,) = Path(os.environ['ROS_LOG_DIR']).glob(f'tip_{daemon.process.pid}_*.log')
    (line,) = file.read_text().splitlines()
    assert re.fullmatch(r'\[WARN\] \[\d+\.\d{9}\] \[estimator\]: no port given: started the simulated rig .*', line)


@pytest.mark.slow
def test_raw_samples_as_plain_numbers_in_prefixed_frames(start: Callable[..., Any], peer: Any, tmp_path: Path) -> None:
    words = ('publish_volts:=true', 'frame_prefix:=left_', 'markers:=true')
    daemon = start('--record', str(tmp_path), '--ros-args', *(w for word in words for w in ('-p', word)))
    volts = [peer.collect(Vector3Stamped, f'/psd_{n}/volts', 1000) for n in (1, 2)]
    clouds = peer.collect(PointCloud2, '/psd/samples')
    poses = peer.collect(PoseStamped, '/link_tip/deflection')
    markers = peer.collect(MarkerArray, '/link_tip/markers')
    peer.until(lambda: len(poses) >= 25 and min(map(len, volts)) >= 500 and len(markers) > 0, 'all of them')
    frames = {m.header.frame_id for m in (*poses, *clouds, *volts[0], *volts[1], *markers[-1].markers)}
    assert frames == {'left_link_tip_rest', 'left_link_tip', 'left_psd_1', 'left_psd_2', 'left_link_base'}
    rows = {stamp(c) + int(p['dt']): p for c in clouds for p in points_of(c)}
    for number, heard in enumerate(volts, 1):
        pairs = [(m.vector, rows[stamp(m)]) for m in heard if stamp(m) in rows]
        assert len(pairs) >= 200
        for vector, row in pairs:
            assert (vector.x, vector.y, vector.z) == tuple(row[f'{c}{number}'] for c in ('x', 'y', 'sum'))
    assert daemon.end() == 0, daemon.lines
    (folder,) = tmp_path.glob('psd_*')
    with Reader(folder) as bag:
        topics = {c.topic for c in bag.connections}
        assert not topics & {'/psd_1/volts', '/psd_2/volts'}
        assert '/psd/samples' in topics
    recording = open_recording(folder)
    assert recording.node == '/estimator'
    assert main(['replay', str(folder), '--compare', '--strict']) == 0


@pytest.mark.slow
@pytest.mark.parametrize('signals', [[signal.SIGTERM], [signal.SIGINT, signal.SIGINT]])
def test_signals_end_it_and_leave_a_whole_recording(
    start: Callable[..., Any], peer: Any, tmp_path: Path, signals: list[int]
) -> None:
    daemon = start('--record', str(tmp_path))
    poses = peer.collect(PoseStamped, '/link_tip/deflection')
    peer.until(lambda: len(poses) >= 25, 'estimates')
    for number in signals:
        daemon.send(number)
    assert daemon.wait() == 0, daemon.lines
    (folder,) = tmp_path.glob('psd_*')
    assert f' replay {folder} --compare' in daemon.lines[-1]
    with Reader(folder) as bag:
        assert bag.message_count > 100
    assert not any('Traceback' in line for line in daemon.lines)


STEPPED = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>
int clock_gettime(clockid_t clock, struct timespec *now) {
  static int (*real)(clockid_t, struct timespec *);
  if (!real) real = dlsym(RTLD_NEXT, "clock_gettime");
  int status = real(clock, now);
  if (clock == CLOCK_REALTIME && access(getenv("STEP_FILE"), F_OK) == 0) now->tv_sec += atol(getenv("STEP_S"));
  return status;
}
"""
"""Preloaded, it sets the system clock of one process by STEP_S as soon as STEP_FILE exists."""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which('cc') is None or sys.platform != 'linux', reason='a C compiler and LD_PRELOAD')
@pytest.mark.parametrize('step_s', [3600, -3600])
def test_a_signal_ends_it_after_a_step_of_the_system_clock(
    start: Callable[..., Any], peer: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step_s: int
) -> None:
    library, flag = tmp_path / 'stepped.so', tmp_path / 'step'
    build = ['cc', '-shared', '-fPIC', '-x', 'c', '-', '-o', str(library), '-ldl']
    subprocess.run(build, input=STEPPED, text=True, check=True)
    with monkeypatch.context() as preloaded:
        for name, value in {'LD_PRELOAD': library, 'STEP_FILE': flag, 'STEP_S': step_s}.items():
            preloaded.setenv(name, str(value))
        daemon = start('--record', str(tmp_path))
    reports = peer.collect(DiagnosticArray, '/diagnostics')
    peer.until(lambda: len(reports) > 1, 'reports')
    flag.touch()
    stated = f'the system clock was set by {"+3600." if step_s > 0 else "-3"}'
    peer.until(lambda: any(s.message.startswith(stated) for r in reports for s in r.status), 'the step')
    began = time.monotonic()
    assert daemon.end() == 0, daemon.lines
    assert time.monotonic() - began < 8.0
    (folder,) = tmp_path.glob('psd_*')
    assert main(['replay', str(folder), '--compare']) == 0


def test_parameters_give_a_topic_the_qos_of_sensor_data(peer: Peer) -> None:
    wanted = {'reliability': 'best_effort', 'depth': 5}
    overrides = [Parameter(f'qos_overrides.{SAMPLES}.publisher.{name}', value=v) for name, v in wanted.items()]
    node = rclpy.create_node('sensor', context=peer.context, parameter_overrides=overrides)
    got = publisher_of(node, SAMPLES).qos_profile
    node.destroy_node()
    assert (got.reliability, got.depth) == (qos_profile_sensor_data.reliability, qos_profile_sensor_data.depth)


def test_what_cannot_run_says_why_in_one_line(domain: int, capfd: pytest.CaptureFixture[str]) -> None:
    for words, status, message in (
        ('-p link.lenght:=1.0', 3, 'link.lenght = 1.0: no parameter of that name; did you mean'),
        ('-p amplifier.noise:=-1.0', 3, 'amplifier.noise = -1.0 V: must be above 0'),
        ('-p solver:=magic', 3, 'magic'),
        ('-p solver:=appendix_d', 3, "solver = 'appendix_d': a method as printed"),
        ('-p solvers:=[]', 3, 'is an empty list'),
        (
            '-p qos_overrides./psd/samples.publisher.reliability:=best_efort',
            3,
            'qos_overrides: Unexpected QoS override for policy `reliability`: `best_efort`',
        ),
        ('--params-file /nowhere/rig.yaml', 3, '/nowhere/rig.yaml'),
    ):
        assert main(['estimator', '--ros-args', *words.split()]) == status, words
        (line,) = [line for line in capfd.readouterr().err.splitlines() if message in line]
        assert line.startswith('psd-deflection estimator: '), line
    assert main(['estimator', '--port', '/dev/nothing_here']) == 5
    assert '/dev/nothing_here: no such port' in capfd.readouterr().err
    assert main(['estimator', '--params-file', '/nowhere/rig.yaml']) == 3
    assert '/nowhere/rig.yaml: no such parameter file' in capfd.readouterr().err
