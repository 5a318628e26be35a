# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Records to message fields and back, with rosbags' own message store as the judge of the bytes."""

import json
import math
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from msg_adapters import (
    DEFLECTION,
    DEFLECTION_WITH_COVARIANCE,
    MESSAGE_TYPES,
    RIG,
    SPOTS,
    TOPIC_TYPES,
    from_fields,
    point_cloud2,
    pose_stamped,
    pose_with_covariance_stamped,
    solver_topic,
    spot_topics,
    string,
    temperature,
    to_messages,
    twist_stamped,
    vector3_stamped,
)
from msg_adapters.header import header, stamp_ns
from msg_adapters.message_type import MessageType
from msg_adapters.orientation import angles, quaternion
from psd_deflection.recordings import cdr
from psd_deflection.records import (
    CHANNELS,
    MOST_PSDS,
    AppliedLoad,
    BaseAcceleration,
    BlockStatus,
    DiagnosticEntry,
    DiagnosticReport,
    EndEffectorDeflection,
    FloatArray,
    Mark,
    ReferencePose,
    RigState,
    SampleBlock,
    TemperatureReading,
    TipLoad,
    TipMotion,
    channel_names,
)

from .making import T0, block, estimate, run, spots

STORE = get_typestore(Stores.ROS2_JAZZY)
times = st.integers(0, 2**31 * 10**9 - 1)
numbers = st.floats(allow_nan=False, allow_infinity=False)


def rotation(theta: float, phi: float, omega: float) -> FloatArray:
    """R = Ry(omega) Rx(phi) Rz(theta), written out as matrices."""
    s, c = math.sin, math.cos
    ry = np.array([[c(omega), 0, s(omega)], [0, 1, 0], [-s(omega), 0, c(omega)]])
    rx = np.array([[1, 0, 0], [0, c(phi), -s(phi)], [0, s(phi), c(phi)]])
    rz = np.array([[c(theta), -s(theta), 0], [s(theta), c(theta), 0], [0, 0, 1]])
    r: FloatArray = ry @ rx @ rz
    return r


@given(st.floats(-math.pi, math.pi), st.floats(-1.5, 1.5), st.floats(-math.pi, math.pi))
def test_quaternion_is_the_rotation_of_the_contract(theta: float, phi: float, omega: float) -> None:
    q = quaternion(theta, phi, omega)
    x, y, z, w = (q[k] for k in 'xyzw')
    assert abs(x * x + y * y + z * z + w * w - 1.0) < 1e-15
    got = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    np.testing.assert_allclose(got, rotation(theta, phi, omega), atol=1e-14)
    back = angles(q)
    np.testing.assert_allclose(rotation(*back), rotation(theta, phi, omega), atol=1e-7)


def test_angles_are_independent_of_length_except_of_none() -> None:
    for length in (0.1, 10.0):
        q = {k: length * v for k, v in quaternion(0.3, -0.2, 0.1).items()}
        assert angles(q) == pytest.approx((0.3, -0.2, 0.1), abs=1e-14)
    for w in (0.0, math.inf):
        assert all(map(math.isnan, angles({'x': 0.0, 'y': 0.0, 'z': 0.0, 'w': w})))


@pytest.mark.parametrize('phi', [-math.pi / 2, math.pi / 2])
def test_a_plate_on_its_edge_has_angles(phi: float) -> None:
    """By rounding the sine is beyond 1 for some of them."""
    for theta in np.linspace(-3.0, 3.0, 25):
        for omega in np.linspace(-3.0, 3.0, 25):
            assert angles(quaternion(theta, phi, omega))[1] == pytest.approx(phi, abs=1e-7)


@given(times)
def test_stamps_lose_no_nanosecond(t_ns: int) -> None:
    assert stamp_ns({'header': header(t_ns, '')}) == t_ns


@pytest.mark.parametrize('name', sorted(MESSAGE_TYPES))
def test_definitions_are_the_standard_ones(name: str) -> None:
    typed = get_typestore(Stores.EMPTY)
    from rosbags.typesys import get_types_from_msg

    typed.register(get_types_from_msg(MESSAGE_TYPES[name].definition, name))
    assert typed.hash_rihs01(name) == STORE.hash_rihs01(name) == MESSAGE_TYPES[name].type_hash
    for part, fields in typed.fielddefs.items():
        assert fields == STORE.fielddefs[part]
    # Each part once, and the message itself at the head alone.
    headings = [line for line in MESSAGE_TYPES[name].definition.splitlines() if line.startswith('MSG: ')]
    assert len(set(headings)) == len(headings)
    assert f'MSG: {name.replace("/msg/", "/")}' not in headings


def test_the_parts_of_a_definition_stand_below_80_signs_each() -> None:
    kind = MessageType('a/msg/B', '', 'a/C c\n', {'a/C': 'int8 d\nint8 E=1\n'})
    assert kind.definition == f'a/C c\n{"=" * 80}\nMSG: a/C\nint8 d\nint8 E=1\n'
    assert (kind.members(), kind.members('a/C'), kind.members('int8')) == ([('a/C', 'c')], [('int8', 'd')], [])


def test_each_raw_sample_as_plain_numbers() -> None:
    given_block = block(3)
    assert vector3_stamped.MESSAGE.type_hash == STORE.hash_rihs01(vector3_stamped.MESSAGE.name)
    encode = cdr.encoder_of(vector3_stamped.MESSAGE)
    for psd in (1, 2):
        reported = list(vector3_stamped.from_block(given_block, psd, 'left_'))
        assert [t_ns for t_ns, _ in reported] == given_block.t_ns.tolist()
        for (t_ns, fields), volts in zip(reported, given_block.volts, strict=True):
            m = STORE.deserialize_cdr(encode(fields), vector3_stamped.MESSAGE.name)
            assert m.header.stamp.sec * 10**9 + m.header.stamp.nanosec == t_ns
            assert m.header.frame_id == f'left_psd_{psd}'
            assert [m.vector.x, m.vector.y, m.vector.z] == volts[3 * psd - 3 : 3 * psd].tolist()


def test_a_prefix_is_before_every_frame_once() -> None:
    records = (block(0), spots(1), estimate(1), TipLoad(T0, 1.0, 2.0, 3.0), DiagnosticReport(T0, (), ''))
    for record in records:
        plain, prefixed = (to_messages(record, prefix) for prefix in ('', 'left_'))
        assert len(plain) == len(prefixed) > 0
        for first, other in zip(plain, prefixed, strict=True):
            frame = first.fields['header']['frame_id']
            assert other.fields['header']['frame_id'] == (f'left_{frame}' if frame else '')
            assert other.fields | {'header': None} == first.fields | {'header': None}


@given(times, numbers, numbers, numbers)
def test_inputs_come_back_as_they_went(t_ns: int, a: float, b: float, c: float) -> None:
    # An acceleration without a stamp is rejected.
    base = BaseAcceleration(max(t_ns, 1), (a, b, c), (c, a, b))
    for record in (AppliedLoad(t_ns, a, b, c), TemperatureReading(t_ns, a), base):
        (m,) = to_messages(record)
        back = from_fields(m.topic, cdr.decode(m.type, cdr.encode(m.type, m.fields)))
        assert back == record
        assert type(back) is type(record)


@given(times, numbers, numbers, st.floats(-3.1, 3.1))
def test_a_reference_comes_back_as_it_went(t_ns: int, dx: float, dy: float, theta: float) -> None:
    (m,) = to_messages(ReferencePose(t_ns, dx, dy, theta))
    back = from_fields(m.topic, cdr.decode(m.type, cdr.encode(m.type, m.fields)))
    assert isinstance(back, ReferencePose)
    assert back[:3] == (t_ns, dx, dy)
    assert back.theta == pytest.approx(theta, abs=1e-15, rel=1e-15)


def test_the_fields_of_an_acceleration() -> None:
    """What is in another frame, or says not when it acts, is none."""
    base = BaseAcceleration(T0, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0))
    (m,) = to_messages(base, 'left/')
    assert (m.topic, m.t_ns) == ('/link_base/acceleration', T0)
    assert m.fields['header']['frame_id'] == 'left/link_base'
    assert m.fields['accel'] == {'linear': {'x': 1.0, 'y': 2.0, 'z': 3.0}, 'angular': {'x': 4.0, 'y': 5.0, 'z': 6.0}}
    assert from_fields(m.topic, m.fields) == base
    for frame in ('', 'link_tip', 'link_base_2', 'x' * 1000):
        with pytest.raises(ValueError, match=rf"frame_id is '{frame[:40]}': .* has to be given in link_base"):
            from_fields(m.topic, m.fields | {'header': header(T0, frame)})
    with pytest.raises(ValueError, match='stamp is 0'):
        from_fields(m.topic, m.fields | {'header': header(0, 'link_base')})


def test_an_estimated_load_is_no_input() -> None:
    (m,) = to_messages(TipLoad(T0, 1.0, 2.0, 3.0))
    assert m.topic == '/link_tip/wrench'
    with pytest.raises(ValueError, match='not an input'):
        from_fields(m.topic, m.fields)


def test_independent_decoder_reads_every_message_alike() -> None:
    observed = set()
    for record in run(60):
        for m in to_messages(record):
            raw = cdr.encode(m.type, m.fields)
            assert raw[:4] == b'\0\1\0\0'
            decoded = STORE.deserialize_cdr(raw, m.type)
            assert STORE.serialize_cdr(decoded, m.type) == raw or m.type == point_cloud2.MESSAGE.name
            if 'header' in m.fields:
                stamp = decoded.header.stamp
                assert stamp.sec * 10**9 + stamp.nanosec == m.t_ns
            assert cdr.decode(m.type, raw) == m.fields
            observed.add(m.topic)
    of_two = {*TOPIC_TYPES} - {*spot_topics(MOST_PSDS)[2:]}
    assert observed | {RIG} == {*of_two, solver_topic('exact'), solver_topic('wls')}


@pytest.mark.parametrize('flags', [0, 1])
def test_an_independent_decoder_reads_the_samples_of_a_block(flags: int) -> None:
    given_block = block(7, lost=(0, 13), flags=flags)
    (m,) = to_messages(given_block)
    cloud = STORE.deserialize_cdr(cdr.encode(m.type, m.fields), m.type)
    names = [f.name for f in cloud.fields]
    assert names == ['seq', 'dt', *CHANNELS] + (['flags'] if flags else [])
    assert [f.offset for f in cloud.fields] == [4 * i for i in range(len(names))]
    assert [f.datatype for f in cloud.fields][:8] == [6, 6, 7, 7, 7, 7, 7, 7]
    assert (cloud.height, cloud.width, cloud.point_step) == (1, 18, 36 if flags else 32)
    assert (cloud.row_step, cloud.is_bigendian, cloud.is_dense) == (18 * cloud.point_step, False, True)
    assert {f.count for f in cloud.fields} == {1}
    assert cloud.header.frame_id == 'link_tip'
    formats = ['<u4', '<u4', *['<f4'] * 6, '<u4'][: len(names)]
    points = np.frombuffer(cloud.data.tobytes(), np.dtype(list(zip(names, formats, strict=True))))
    np.testing.assert_array_equal(points['seq'], given_block.seq)
    np.testing.assert_array_equal(points['dt'] + given_block.t_ns[0], given_block.t_ns)
    for i, c in enumerate(CHANNELS):
        np.testing.assert_array_equal(points[c], given_block.volts[:, i])


def test_seq_is_recorded_modulo_2_to_32_with_high_part() -> None:
    start = 2**32 // 20
    (m,) = to_messages(block(start, first_index=start))
    _, points = point_cloud2.to_points(m.fields)
    assert (points['seq'][[0, -1]].tolist(), points['seq_high'][[0, -1]].tolist()) == ([2**32 - 16, 3], [0, 1])
    assert [f['name'] for f in m.fields['fields']] == ['seq', 'dt', *CHANNELS, 'flags', 'seq_high']
    # It is enough that the last number is above.
    (m,) = to_messages(block(start, lost=(17, 18, 19), first_index=start))
    _, points = point_cloud2.to_points(m.fields)
    assert points['seq_high'].tolist() == [0] * 16 + [1]
    (before,) = to_messages(block(start - 1, first_index=start - 1))
    assert before.fields['point_step'] == 32


@pytest.mark.parametrize(('span', 'pieces'), [(2**32 - 1, 1), (2**32, 2)])
def test_a_block_is_cut_only_if_its_times_do_not_fit(span: int, pieces: int) -> None:
    full = block(0)
    t_ns = full.t_ns.copy()
    t_ns[-1] = t_ns[0] + span
    given_block = SampleBlock(0, full.seq, t_ns, full.volts, full.flags)
    messages = to_messages(given_block)
    assert len(messages) == pieces
    assert (next(point_cloud2.parts(given_block)) is given_block) == (pieces == 1)
    observed = [point_cloud2.to_points(m.fields) for m in messages]
    times = np.concatenate([t + points['dt'].astype(np.int64) for t, points in observed])
    np.testing.assert_array_equal(times, t_ns)


KINDS = ['int8', 'uint8', 'int16', 'uint16', 'int32', 'uint32', 'float32', 'float64']
"""sensor_msgs/PointField: 1 to 8."""


@pytest.mark.parametrize('kind', KINDS)
def test_a_cloud_of_another_program_may_have_numbers_of_any_kind(kind: str) -> None:
    names = ['seq', 'dt', *CHANNELS]
    dtype = np.dtype([(name, kind) for name in names])
    points = np.zeros(2, dtype)
    for i, name in enumerate(names):
        points[name] = [i, 10 + i]
    size = np.dtype(kind).itemsize
    number = 1 + KINDS.index(kind)
    fields = [{'name': name, 'offset': size * i, 'datatype': number, 'count': 1} for i, name in enumerate(names)]
    (m,) = to_messages(block(0))
    cloud = {'fields': fields, 'point_step': dtype.itemsize, 'width': 2, 'data': points.tobytes()}
    _, got = point_cloud2.to_points({**m.fields, **cloud})
    assert got.dtype['x1'] == np.dtype(kind)
    assert [tuple(row) for row in got.tolist()] == [tuple(range(8)), tuple(range(10, 18))]


def test_a_cloud_of_another_program_may_be_big_endian() -> None:
    (m,) = to_messages(block(0))
    _, ours = point_cloud2.to_points(m.fields)
    swapped = np.frombuffer(m.fields['data'], '<u4').astype('>u4').tobytes()
    _, points = point_cloud2.to_points({**m.fields, 'is_bigendian': True, 'data': swapped})
    assert points.tolist() == ours.tolist()


@pytest.mark.parametrize('psds', range(2, MOST_PSDS + 1))
def test_a_cloud_is_of_as_many_psds_as_have_all_their_channels(psds: int) -> None:
    assert point_cloud2.psds_of(np.zeros(1, point_cloud2.point_of(psds))) == psds
    names = [*channel_names(psds), *channel_names(MOST_PSDS)[3 * psds : 3 * psds + 2]]
    assert point_cloud2.psds_of(np.zeros(1, [(name, '<f4') for name in names])) == psds


def test_points_that_contradict_themselves_are_rejected() -> None:
    (m,) = to_messages(block(0))
    for change, message in (
        ({'width': 21}, 'do not make'),
        ({'height': 2}, 'height'),
        ({'point_step': 28, 'width': 20, 'data': bytes(560)}, 'outside a point'),
        ({'point_step': 2**32 - 1, 'width': 0, 'data': b''}, 'a point of'),
        ({'point_step': 0, 'width': 0, 'data': b''}, 'a point of 0 bytes is not one of ours'),
        ({'point_step': 1, 'width': 1, 'data': b'x'}, "'seq' at offset 0 is outside a point of 1 bytes"),
        ({'fields': m.fields['fields'][1:]}, r"no field 'seq' \(fields: dt, x1, y1, sum1, x2, y2, sum2\)"),
        ({'fields': []}, r"no field 'seq' \(fields: none\)"),
    ):
        with pytest.raises(ValueError, match=message):
            point_cloud2.to_points({**m.fields, **change})


@pytest.mark.parametrize('status', BlockStatus)
def test_a_dot_that_was_not_observed_is_not_published(status: BlockStatus) -> None:
    observed = status in (BlockStatus.OK, BlockStatus.OUTSIDE_ACTIVE_AREA, BlockStatus.NOT_SOLVED)
    assert [m.topic for m in to_messages(spots(1, status))] == (list(SPOTS) if observed else [])


def test_of_a_block_without_one_psd_the_others_are_published() -> None:
    """PSD 2 is left out as it is dark: then it has no dot; or as it contradicts the others: then it has."""
    for status, topics in ((BlockStatus.LASER_LOST, [SPOTS[0]]), (BlockStatus.OK, list(SPOTS))):
        assert [m.topic for m in to_messages(replace(spots(3, status), excluded=(2,)))] == topics


def test_dots_that_are_no_numbers_are_not_published() -> None:
    lost = replace(spots(3), dots=(1e-3, -2e-3, math.nan, 0.0))
    assert to_messages(lost) == ()
    assert to_messages(replace(lost, excluded=(2,))) == ()


def test_each_dot_is_published_in_its_own_frame_and_axes() -> None:
    observed = [(m.topic, m.fields['header']['frame_id'], m.fields['point']) for m in to_messages(spots(3))]
    assert observed == [
        ('/psd_1/spot', 'psd_1', {'x': 1e-3, 'y': -2e-3, 'z': 0.0}),
        ('/psd_2/spot', 'psd_2', {'x': 1e-4 * 3, 'y': 0.0, 'z': 0.0}),
    ]


def test_only_the_primary_estimate_is_the_deflection() -> None:
    assert [m.topic for m in to_messages(estimate(1, 'wls', primary=False))] == ['/link_tip/wls/deflection']
    primary = to_messages(estimate(1))
    assert [m.topic for m in primary] == [DEFLECTION, '/link_tip/exact/deflection', DEFLECTION_WITH_COVARIANCE]
    assert all(m.fields['header']['frame_id'] == 'link_tip_rest' for m in primary)


def test_the_covariance_stands_at_x_y_and_yaw_alone() -> None:
    e = estimate(3)
    wanted = np.diag([0.0, 0.0, 1e6, 1e6, 1e6, 0.0])
    wanted[np.ix_([0, 1, 5], [0, 1, 5])] = np.reshape(e.covariance, (3, 3))
    assert pose_with_covariance_stamped.from_estimate(e)['pose']['covariance'] == wanted.ravel().tolist()


def test_end_effector_has_full_pose_in_chain_frame() -> None:
    e = EndEffectorDeflection(T0, (1.0, 2.0, 3.0), (0.1, 0.2, 0.3, 0.9), tuple(map(float, range(36))))
    fields = pose_with_covariance_stamped.from_end_effector(e, 'arm')
    assert (stamp_ns(fields), fields['header']['frame_id']) == (T0, 'arm')
    assert fields['pose']['pose']['position'] == {'x': 1.0, 'y': 2.0, 'z': 3.0}
    assert fields['pose']['pose']['orientation'] == {'x': 0.1, 'y': 0.2, 'z': 0.3, 'w': 0.9}
    assert fields['pose']['covariance'] == [*map(float, range(36))]


def test_a_vector_of_two_or_four_numbers_is_rejected() -> None:
    e = EndEffectorDeflection(T0, (1.0, 2.0, 3.0), (0.1, 0.2, 0.3, 0.9), (0.0,) * 36)
    for numbers in ((1.0, 2.0), (1.0,) * 5):
        for wrong in (e._replace(position=numbers), e._replace(quaternion=numbers)):
            with pytest.raises(ValueError, match='zip'):
                pose_with_covariance_stamped.from_end_effector(wrong, 'arm')
        for base in (BaseAcceleration(T0, numbers, (0.0,) * 3), BaseAcceleration(T0, (0.0,) * 3, numbers)):
            with pytest.raises(ValueError, match='zip'):
                to_messages(base)
    with pytest.raises(ValueError, match='zip'):
        pose_stamped.to_poses(np.ones((1, 6)))


def test_a_pose_lies_in_the_plane_with_all_its_angles() -> None:
    e = estimate(3)
    for fields in (to_messages(e)[0].fields['pose'], pose_with_covariance_stamped.from_estimate(e)['pose']['pose']):
        assert fields['position'] == {'x': e.dx, 'y': e.dy, 'z': 0.0}
        assert angles(fields['orientation']) == pytest.approx((e.theta, e.phi, e.omega), abs=1e-15)
    (reference,) = to_messages(ReferencePose(T0, 1e-3, -2e-3, 0.01))
    assert reference.fields['pose']['position'] == {'x': 1e-3, 'y': -2e-3, 'z': 0.0}
    assert angles(reference.fields['pose']['orientation']) == pytest.approx((0.01, 0.0, 0.0), abs=1e-15)


def test_a_velocity_is_in_the_plane_and_about_z() -> None:
    motion = TipMotion(T0, 1, 0.0, 0.0, 0.0, 0.0, 0.0, (0.0,) * 9, 1.0, 2.0, 3.0, (0.0,) * 9, False)
    twist = {'linear': {'x': 1.0, 'y': 2.0, 'z': 0.0}, 'angular': {'x': 0.0, 'y': 0.0, 'z': 3.0}}
    assert twist_stamped.from_motion(motion)['twist'] == twist


def test_a_reference_has_the_covariance_of_x_y_and_yaw() -> None:
    fields = pose_with_covariance_stamped.from_estimate(estimate(3))
    fields['pose']['covariance'] = list(range(36))
    # Rows and columns 0, 1 and 5 of six.
    wanted = [0, 1, 5, 6, 7, 11, 30, 31, 35]
    reference, e = pose_with_covariance_stamped.to_reference(fields), estimate(3)
    assert list(reference.covariance) == wanted
    assert (reference.t_ns, reference.dx, reference.dy) == (e.t_ns, e.dx, e.dy)
    assert (reference.theta, reference.phi, reference.omega) == pytest.approx((e.theta, e.phi, e.omega), abs=1e-15)


def test_a_load_is_a_force_in_the_plane_and_a_torque_about_z() -> None:
    for record in (TipLoad(T0, 1.0, 2.0, 3.0), AppliedLoad(T0, 1.0, 2.0, 3.0)):
        (m,) = to_messages(record)
        assert m.fields['header']['frame_id'] == 'link_tip_rest'
        assert m.fields['wrench'] == {'force': {'x': 1.0, 'y': 2.0, 'z': 0.0}, 'torque': {'x': 0.0, 'y': 0.0, 'z': 3.0}}


def test_a_mark_is_a_text_without_a_time() -> None:
    (m,) = to_messages(Mark(T0, 'bumped it here'))
    assert (m.topic, m.t_ns, m.fields) == ('/link_tip/mark', T0, {'data': 'bumped it here'})
    assert from_fields(m.topic, m.fields) == Mark(0, 'bumped it here')


def test_numbers_of_many_messages_are_poses_and_covariances() -> None:
    """As a reader takes them: the float64 of each message in order."""
    wanted, rows = (estimate(2), estimate(5)), []
    for fields in (pose_with_covariance_stamped.from_estimate(e)['pose'] for e in wanted):
        rows.append([*fields['pose']['position'].values(), *fields['pose']['orientation'].values()])
        rows[-1] += fields['covariance']
    numbers = np.array(rows)
    poses, tilts = pose_stamped.to_poses(numbers)
    np.testing.assert_allclose(poses, [(e.dx, e.dy, e.theta) for e in wanted], atol=1e-15)
    np.testing.assert_allclose(tilts, [(e.phi, e.omega) for e in wanted], atol=1e-15)
    covariances = pose_with_covariance_stamped.to_covariances(numbers)
    assert covariances.reshape(2, 9).tolist() == [list(e.covariance) for e in wanted]


def test_diagnostics_keep_levels_and_values() -> None:
    report = DiagnosticReport(T0, (DiagnosticEntry('clock', 2, 'lost', (('skew_ppm', '12.5'), ('µ', '°'))),), 'T-1')
    (m,) = to_messages(report)
    decoded = STORE.deserialize_cdr(cdr.encode(m.type, m.fields), m.type)
    status = decoded.status[0]
    assert (status.level, status.name, status.message) == (2, 'clock', 'lost')
    assert [(v.key, v.value) for v in status.values] == [('skew_ppm', '12.5'), ('µ', '°')]


@given(st.binary(max_size=200), st.sampled_from(sorted(MESSAGE_TYPES)))
def test_bytes_are_a_message_or_rejected(junk: bytes, name: str) -> None:
    try:
        fields = cdr.decode(name, junk)
    except ValueError as error:
        assert str(error).startswith(f'not a {name} (')  # noqa: PT017
        return
    assert list(fields) == [member for _, member in MESSAGE_TYPES[name].members()]


# The library takes a text that is cut for a shorter one; diagnostics end with a text, and are read for nothing.
ENDING_OTHERWISE = sorted({*MESSAGE_TYPES} - {'diagnostic_msgs/msg/DiagnosticArray', string.MESSAGE.name})


@given(st.sampled_from(ENDING_OTHERWISE), st.data())
def test_a_message_that_is_cut_is_rejected(name: str, data: st.DataObject) -> None:
    record = next(m for r in run(60) for m in to_messages(r) if m.type == name)
    full = cdr.encode(name, record.fields)
    assert cdr.decode(name, full) == record.fields
    size = data.draw(st.integers(0, len(full) - 1))
    with pytest.raises(ValueError, match=f'not a {name}'):
        cdr.decode(name, full[:size])


def test_an_independent_decoder_reads_the_rig() -> None:
    zeros = {'psd_1.zero': [0.1, 0.2], 'psd_2.zero': [0.0, 0.0]}
    state = RigState(5, 7, zeros, {'serial': 'ö'}, {'sum_min': 2.0}, '1', {'numpy': '2'})
    (m,) = to_messages(state)
    raw = cdr.encode(m.type, m.fields)
    text = STORE.deserialize_cdr(raw, m.type).data
    assert json.loads(text)['zero'] == {'psd_1': [0.1, 0.2], 'psd_2': [0.0, 0.0]}
    assert string.to_rig(cdr.decode(m.type, raw)) == state


def test_rig_of_read_only_maps_is_written_sets_are_not() -> None:
    frozen = MappingProxyType({'psd_1.zero': [0.1, 0.2], 'nested': MappingProxyType({'a': 1})})
    (m,) = to_messages(RigState(5, 7, frozen, None, {}, '1'))
    assert json.loads(m.fields['data'])['parameters'] == {'psd_1.zero': [0.1, 0.2], 'nested': {'a': 1}}
    with pytest.raises(TypeError, match='has no JSON'):
        to_messages(RigState(5, 7, {'bad': {1, 2}}, None, {}, '1'))


def test_the_longest_text_is_read_and_a_longer_one_is_not() -> None:
    (m,) = to_messages(RigState(5, 7, {}, None, {}, '1'))
    text = m.fields['data'].ljust(string.MAX_CHARACTERS)
    assert string.to_rig({'data': text}).block == 7
    with pytest.raises(ValueError, match='has 16000001 characters, more than 16000000'):
        string.to_rig({'data': text + ' '})


def test_what_the_pipeline_remembers_is_reported_or_not() -> None:
    for memory in (None, {}, {'state.noise': [1.0, 2.5]}):
        (m,) = to_messages(RigState(5, 7, {}, None, {}, '1', memory=memory))
        assert ('memory' in m.fields['data']) == (memory is not None)
        assert string.to_rig(m.fields).memory == memory


@pytest.mark.parametrize('text', ['', '[]', '{"version": 1}', '[' * 100_000, 'x' * (string.MAX_CHARACTERS + 1)])
def test_a_text_that_is_no_rig_is_rejected(text: str) -> None:
    with pytest.raises(ValueError, match=r'lacks|Expecting|nested|characters'):
        string.to_rig({'data': text})


def test_a_temperature_goes_with_a_variance_that_says_not_known() -> None:
    fields = temperature.from_reading(TemperatureReading(1_500_000_000, 21.5))
    assert (fields['temperature'], fields['variance']) == (21.5, 0.0)
    assert temperature.to_reading(fields) == TemperatureReading(1_500_000_000, 21.5)


def test_a_rotation_without_tilts_is_about_z() -> None:
    rotated = quaternion(0.3)
    assert list(rotated.values()) == pytest.approx([0.0, 0.0, math.sin(0.15), math.cos(0.15)], abs=1e-15)


def cloud(step: int, *more: dict[str, object]) -> dict[str, object]:
    """One point of another program with our fields, and ``more`` of its own."""
    names = ('seq', 'dt', *CHANNELS)
    ours = [{'name': n, 'offset': 4 * i, 'datatype': 6 if i < 2 else 7, 'count': 1} for i, n in enumerate(names)]
    size = {'point_step': step, 'row_step': step, 'width': 1, 'height': 1, 'data': bytes(step)}
    return {'header': header(5, 'x'), 'is_bigendian': False, 'is_dense': True, 'fields': [*ours, *more], **size}


@pytest.mark.parametrize(
    'more',
    [
        {'name': 'x', 'offset': 32, 'datatype': 7, 'count': 3},
        {'name': 'x', 'offset': 32, 'datatype': 9, 'count': 1},
        {'name': '', 'offset': 32, 'datatype': 7, 'count': 1},
        {'name': 'seq', 'offset': 32, 'datatype': 7, 'count': 1},
    ],
)
def test_fields_that_cannot_be_read_are_passed_over(more: dict[str, object]) -> None:
    kinds = np.dtype(point_cloud2.layout(cloud(48, more)))
    assert kinds.names == ('seq', 'dt', *CHANNELS)
    assert np.zeros(1, kinds)['seq'].dtype == np.dtype('<u4')


def test_field_may_end_with_point_and_point_has_64_kib() -> None:
    for offset, fits in ((44, True), (45, False)):
        more = {'name': 'x', 'offset': offset, 'datatype': 7, 'count': 1}
        if fits:
            assert np.dtype(point_cloud2.layout(cloud(48, more))).names == ('seq', 'dt', *CHANNELS, 'x')
        else:
            with pytest.raises(ValueError, match='outside a point of 48 bytes'):
                point_cloud2.layout(cloud(48, more))
    stamp, points = point_cloud2.to_points(cloud(65_536))
    assert (stamp, len(points)) == (5, 1)
    with pytest.raises(ValueError, match='65537'):
        point_cloud2.to_points(cloud(65_537))
