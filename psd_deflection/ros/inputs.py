# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Why a message of another node cannot be used by a session: its frame, its stamp, its numbers, or what nobody can use.

A load or a reference in a wrong frame would be a wrong truth for all that follows. Nothing is transformed here: rclpy's
wheels have no tf2. So the sender gives it in the frame of the rig.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from msg_adapters import ACCELERATION, LOAD, MARK, REFERENCE, REFERENCE_WITH_COVARIANCE, TEMPERATURE
from msg_adapters.header import stamp_ns
from msg_adapters.string import to_mark
from psd_deflection.arms.inputs import frame_fault, quaternion_fault, stamp_fault
from psd_deflection.rig.config import Rig
from psd_deflection.ros.names import BASE, REST

STAMP_WITHIN_S = 60.0
"""A stamp further from now is of another clock. A reference may have one: `validate` finds the offset."""
LARGEST_LOAD = 1e6
"""Bound of a force, N, and of a torque, N m."""
COLDEST, HOTTEST = -100.0, 200.0
"""Bounds of a temperature, degrees Celsius: one in kelvin is rejected."""
LARGEST_ACCELERATION = 1e5
"""Bound of a component, m/s^2 or rad/s^2."""

Fields = Mapping[str, Any]


def input_fault(topic: str, fields: Fields, rig: Rig, now_ns: int) -> str:
    """Why the message on ``topic`` cannot be used; '' if it can. ``now_ns``: in the time of the samples."""
    stamp = fields.get('header', {}).get('stamp', {'sec': 0, 'nanosec': 0})
    return stamp_fault(stamp['sec'], stamp['nanosec']) or _FAULTS[topic](fields, rig, now_ns)


def _load_fault(fields: Fields, rig: Rig, now_ns: int) -> str:
    wrench = fields['wrench']
    where = frame_fault(fields['header']['frame_id'], rig.monitor.frame_prefix + REST)
    if where or (where := _time_fault(fields, now_ns)):
        return where
    for name, axis, value in _components(wrench):
        if not abs(value) <= LARGEST_LOAD:
            return f'{name} {axis} = {value:g}: must be finite and at most {LARGEST_LOAD:g}'
    for name, axis in (('force', 'z'), ('torque', 'x'), ('torque', 'y')):
        if wrench[name][axis]:
            return f'{name} {axis} = {wrench[name][axis]:g}: cannot be used, only force x, force y and torque z can'
    return ''


def _reference_fault(fields: Fields, rig: Rig, now_ns: int) -> str:
    # With a covariance the pose lies one level deeper.
    pose = fields['pose'].get('pose', fields['pose'])
    reach = rig.link.length
    away = math.hypot(pose['position']['x'], pose['position']['y'])
    return (
        frame_fault(fields['header']['frame_id'], rig.monitor.frame_prefix + REST)
        or quaternion_fault([pose['orientation'][axis] for axis in 'xyzw'])
        or ('' if away <= reach else f'a tip {away:g} m away: must be finite and at most the length, {reach:g} m')
    )


def _temperature_fault(fields: Fields, rig: Rig, now_ns: int) -> str:
    celsius = fields['temperature']
    if not COLDEST <= celsius <= HOTTEST:
        return f'{celsius:g} °C: must be {COLDEST:g} to {HOTTEST:g}'
    return _time_fault(fields, now_ns)


def _acceleration_fault(fields: Fields, rig: Rig, now_ns: int) -> str:
    frame, wanted = fields['header']['frame_id'], rig.monitor.frame_prefix + BASE
    if frame != wanted:
        return f'frame_id {frame!r}: must be {wanted}'
    for name, axis, value in _components(fields['accel']):
        if not abs(value) <= LARGEST_ACCELERATION:
            return f'{name} {axis} = {value:g}: must be finite and at most {LARGEST_ACCELERATION:g}'
    return _time_fault(fields, now_ns)


def _mark_fault(fields: Fields, rig: Rig, now_ns: int) -> str:
    try:
        to_mark(fields)
    except ValueError as error:
        return str(error)
    return ''


def _components(vectors: Fields) -> Iterator[tuple[str, str, float]]:
    return ((name, axis, vector[axis]) for name, vector in vectors.items() for axis in 'xyz')


def _time_fault(fields: Fields, now_ns: int) -> str:
    """Why the stamp cannot be of now; 0 means now."""
    t_ns = stamp_ns(fields)
    away_s = abs(t_ns - now_ns) / 1e9 if t_ns else 0.0
    return (
        '' if away_s <= STAMP_WITHIN_S else f'its stamp is {away_s:.3g} s from now: must be within {STAMP_WITHIN_S:g}'
    )


_FAULTS: Mapping[str, Callable[[Fields, Rig, int], str]] = {
    LOAD: _load_fault,
    MARK: _mark_fault,
    REFERENCE: _reference_fault,
    REFERENCE_WITH_COVARIANCE: _reference_fault,
    TEMPERATURE: _temperature_fault,
    ACCELERATION: _acceleration_fault,
}
