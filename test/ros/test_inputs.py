# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Which messages of other nodes a session takes, and why it does not take the others."""

import copy
import math
from typing import Any

import pytest

from msg_adapters import ACCELERATION, LOAD, MARK, REFERENCE, REFERENCE_WITH_COVARIANCE, TEMPERATURE, TOPICS
from psd_deflection.records import AppliedLoad, BaseAcceleration, Mark, ReferencePose, TemperatureReading
from psd_deflection.rig.config import rig_from_values
from psd_deflection.ros.sinks import input_fault

NOW_NS = 1_700_000_000_000_000_000
RECORDS: dict[str, Any] = {
    LOAD: AppliedLoad(t_ns=NOW_NS, fx=3.0, fy=-4.0, tz=0.5),
    MARK: Mark(t_ns=NOW_NS, text='bumped it here'),
    REFERENCE: ReferencePose(t_ns=NOW_NS, dx=1e-3, dy=2e-3, theta=0.1),
    TEMPERATURE: TemperatureReading(t_ns=NOW_NS, celsius=21.0),
    ACCELERATION: BaseAcceleration(t_ns=NOW_NS, linear=(0.0, 1.0, 0.0), angular=(0.0, 0.0, 2.0)),
}


def fields_of(topic: str) -> Any:
    declared = {t.name: t for t in TOPICS}
    if topic == REFERENCE_WITH_COVARIANCE:
        inner = copy.deepcopy(fields_of(REFERENCE))
        return {'header': inner['header'], 'pose': {'pose': inner['pose'], 'covariance': [0.0] * 36}}
    return copy.deepcopy(declared[topic].fields(RECORDS[topic]))


def fault(topic: str, changes: dict[str, Any], **rig: Any) -> str:
    """Of the good message of ``topic`` with ``changes`` by dotted names."""
    fields = fields_of(topic)
    for name, value in changes.items():
        *way, last = name.split('.')
        holder = fields
        for key in way:
            holder = holder[key]
        holder[last] = value
    return input_fault(topic, fields, rig_from_values(rig), NOW_NS)


@pytest.mark.parametrize('topic', [*RECORDS, REFERENCE_WITH_COVARIANCE])
def test_what_our_own_nodes_send_is_taken(topic: str) -> None:
    assert fault(topic, {}) == ''


@pytest.mark.parametrize('topic', [LOAD, REFERENCE, REFERENCE_WITH_COVARIANCE])
def test_the_frame_is_that_of_this_rig_at_rest_or_not_reported(topic: str) -> None:
    assert fault(topic, {'header.frame_id': ''}) == ''
    assert fault(topic, {'header.frame_id': 'left_link_tip_rest'}, frame_prefix='left_') == ''
    assert fault(topic, {'header.frame_id': 'link_tip_rest'}, frame_prefix='left_') != ''
    for other in ('tool0', 'world', 'link_tip', 'xlink_tip_rest'):
        assert fault(topic, {'header.frame_id': other}) == f"frame_id '{other}': must be link_tip_rest"


@pytest.mark.parametrize(
    ('text', 'why'),
    [
        ('', '0 characters: must be 1 to 200'),
        ('  ', 'not only spaces'),
        ('x' * 201, '201 characters: must be 1 to 200'),
        ('a\x1b[2Jb', 'control character'),
        ('two\nlines', 'control character'),
        ('\N{RIGHT-TO-LEFT OVERRIDE}x', 'control character'),
    ],
)
def test_a_mark_is_one_short_line(text: str, why: str) -> None:
    assert why in fault(MARK, {'data': text})


def test_an_acceleration_says_its_frame() -> None:
    assert fault(ACCELERATION, {'header.frame_id': ''}) == "frame_id '': must be link_base"
    assert fault(ACCELERATION, {'header.frame_id': 'a_link_base'}) != ''
    assert fault(ACCELERATION, {'header.frame_id': 'a_link_base'}, frame_prefix='a_') == ''


@pytest.mark.parametrize('part', ['force.z', 'torque.x', 'torque.y'])
def test_a_component_that_cannot_be_used_is_rejected(part: str) -> None:
    text = fault(LOAD, {f'wrench.{part}': 50.0})
    assert text == f'{part.replace(".", " ")} = 50: cannot be used, only force x, force y and torque z can'
    assert fault(LOAD, {f'wrench.{part}': -0.0}) == ''


@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf, 1e300, -1e300])
@pytest.mark.parametrize(
    ('topic', 'name'),
    [
        (LOAD, 'wrench.force.x'),
        (LOAD, 'wrench.torque.z'),
        (REFERENCE, 'pose.position.y'),
        (REFERENCE, 'pose.orientation.w'),
        (REFERENCE_WITH_COVARIANCE, 'pose.pose.position.x'),
        (TEMPERATURE, 'temperature'),
        (ACCELERATION, 'accel.linear.z'),
        (ACCELERATION, 'accel.angular.x'),
    ],
)
def test_numbers_that_cannot_be_are_rejected(topic: str, name: str, value: float) -> None:
    assert fault(topic, {name: value}) != ''


def test_a_value_out_of_bounds_is_rejected_with_the_bound() -> None:
    assert fault(TEMPERATURE, {'temperature': 293.15}) == '293.15 °C: must be -100 to 200'
    assert fault(REFERENCE, {'pose.position.x': 0.5}) == ''
    assert (
        fault(REFERENCE, {'pose.position.x': 1.5}) == 'a tip 1.5 m away: must be finite and at most the length, 0.585 m'
    )


@pytest.mark.parametrize('topic', [*sorted({*RECORDS} - {MARK}), REFERENCE_WITH_COVARIANCE])
def test_a_stamp_that_is_no_time_is_rejected(topic: str) -> None:
    for stamp in ({'sec': -(2**31), 'nanosec': 0}, {'sec': 5, 'nanosec': 2_000_000_000}):
        assert 'is no time' in fault(topic, {'header.stamp': stamp})


@pytest.mark.parametrize('topic', [LOAD, TEMPERATURE, ACCELERATION])
def test_foreign_stamp_is_rejected_unless_of_reference(topic: str) -> None:
    now = NOW_NS // 10**9
    # A stamp of 0 is now.
    for seconds in (0, now, now + 50, now - 50, now + 70, now - 70, 2**31 - 1):
        stamp = {'sec': seconds, 'nanosec': 0}
        assert bool(fault(topic, {'header.stamp': stamp})) == (seconds > 0 and abs(seconds - now) > 60), seconds
        # Its offset is found afterwards, from the motion.
        assert fault(REFERENCE, {'header.stamp': stamp}) == ''
