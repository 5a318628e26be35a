# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The kinematics of an arm: the joints between two links of a URDF file, its pose and its Jacobian.

Pinocchio would do the same. Its wheels take 0.35 GB with what they bring along, for one product of matrices a joint.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from psd_deflection.arms.chains.transform import IDENTITY, Transform, of_position_and_angles, rotation_about
from psd_deflection.base.errors import ConfigError
from psd_deflection.base.foreign_yaml import text_of_file
from psd_deflection.base.text import did_you_mean, plain_number
from psd_deflection.records import FloatArray

NO_TIP = 'tip: the link of the end effector must be named'
MOST_BYTES = 5_000_000
MOVABLE = ('revolute', 'continuous', 'prismatic')


@dataclass(frozen=True, slots=True, eq=False)
class ArmJoint:
    """A joint. ``origin``: its frame in the link before; ``axis``: unit vector in it; limits in rad or m.

    ``kind``: one of ``MOVABLE``, or ``fixed``.
    """

    name: str
    kind: str
    origin: Transform
    axis: FloatArray
    lower: float = -math.inf
    upper: float = math.inf

    def at(self, q: float) -> Transform:
        """The link behind the joint in the link before it."""
        if self.kind == 'prismatic':
            return self.origin @ Transform(np.eye(3), self.axis * q)
        return self.origin @ rotation_about(self.axis, q)


class Arm:
    """Joints in series. ``names``, ``lower``, ``upper``: of those that move, in order from the base."""

    def __init__(self, joints: Sequence[ArmJoint]) -> None:
        self._joints = tuple(joints)
        movable = [j for j in joints if j.kind in MOVABLE]
        if not movable:
            raise ConfigError('no joint between base and tip moves')
        self.names = tuple(j.name for j in movable)
        self.lower = np.array([j.lower for j in movable])
        self.upper = np.array([j.upper for j in movable])

    def pose(self, q: FloatArray) -> Transform:
        """The tip in the base at the joint positions ``q`` (n,), rad or m."""
        return self._frames(q)[0]

    def jacobian(self, q: FloatArray) -> FloatArray:
        """(6, n): velocity (m/s) and angular velocity (rad/s) of the tip in the base, per unit of each joint."""
        end, at = self._frames(q)
        columns = []
        for joint, frame in at:
            axis = frame.rotation @ joint.axis
            if joint.kind == 'prismatic':
                columns.append(np.concatenate([axis, np.zeros(3)]))
            else:
                columns.append(np.concatenate([np.cross(axis, end.position - frame.position), axis]))
        return np.column_stack(columns)

    def _frames(self, q: FloatArray) -> tuple[Transform, list[tuple[ArmJoint, Transform]]]:
        """The tip, and each joint that moves with its frame in the base."""
        angles = iter(q)
        frame = IDENTITY
        at = []
        for joint in self._joints:
            if joint.kind in MOVABLE:
                frame = frame @ joint.at(float(next(angles)))
                at.append((joint, frame))
            else:
                frame = frame @ joint.origin
        return frame, at


class JointLimits(NamedTuple):
    """Limits of a joint: positions, rad or m; ``speed``, rad/s or m/s."""

    lower: float
    upper: float
    speed: float


def read_limits(path: str | Path) -> dict[str, JointLimits]:
    """The limits of each joint of a URDF file that moves, infinite if it has none. Raises ConfigError."""
    return limits_of(text_of_file(Path(path), 'URDF file', MOST_BYTES), str(path))


def limits_of(text: str, where: str) -> dict[str, JointLimits]:
    """The same of the text of one, which comes from ``where``."""
    out = {}
    for element in _robot(text, where).iterfind('joint'):
        name, kind, limit = element.get('name', ''), element.get('type', ''), element.find('limit')
        if kind in MOVABLE:
            at = f'{where}: joint {name}'
            lower, upper = _range(limit, kind, at)
            out[name] = JointLimits(lower, upper, _speed(limit, at))
    return out


def _robot(text: str, where: str) -> ElementTree.Element:
    """The root of a URDF."""
    if len(text) > MOST_BYTES:
        raise ConfigError(f'{where}: {len(text)} characters: must be at most {MOST_BYTES}')
    if '<!DOCTYPE' in text or '<!ENTITY' in text:
        raise ConfigError(f'{where}: has a document type or entities, which a URDF file does not need')
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ConfigError(f'{where}: not XML ({error}); expand xacro files first') from None
    if root.tag != 'robot':
        raise ConfigError(f'{where}: not a URDF file: its root is <{root.tag}>, not <robot>')
    names = [element.get('name', '') for element in root.iterfind('joint')]
    twice = next((name for name, count in Counter(names).items() if count > 1), None)
    if twice is not None:
        raise ConfigError(f'{where}: joint {twice}: there are two of that name')
    return root


def read_arm(path: str | Path, tip: str, base: str = '') -> Arm:
    """The joints from the link ``base`` (default: the root) to the link ``tip`` of a URDF file. Raises ConfigError."""
    return arm_of(text_of_file(Path(path), 'URDF file', MOST_BYTES), str(path), tip, base)


def arm_of(text: str, where: str, tip: str, base: str = '') -> Arm:
    """The same of the text of one, which comes from ``where``."""
    if not tip:
        raise ConfigError(NO_TIP)
    root = _robot(text, where)
    links = [link.get('name', '') for link in root.iterfind('link')]
    parents = {}
    for element in root.iterfind('joint'):
        child = element.find('child')
        if child is not None:
            parents[child.get('link', '')] = element
    for link, what in ((tip, 'tip'), (base, 'base')):
        if link and link not in links:
            raise ConfigError(f'{where}: {what}: no link {link}{did_you_mean(link, links)}')
    joints: list[ArmJoint] = []
    link = tip
    while link != base and link in parents:
        element = parents.pop(link)
        joints.append(_joint(where, element))
        parent = element.find('parent')
        link = parent.get('link', '') if parent is not None else ''
    if base and link != base:
        raise ConfigError(f'{where}: no joints lead from {base} to {tip}')
    try:
        return Arm(joints[::-1])
    except ConfigError as error:
        raise ConfigError(f'{where}: {error}') from None


def _joint(file: str, element: ElementTree.Element) -> ArmJoint:
    name, kind = element.get('name', ''), element.get('type', '')
    where = f'{file}: joint {name}'
    if kind not in (*MOVABLE, 'fixed'):
        raise ConfigError(f'{where}: type {kind}: must be one of {", ".join(MOVABLE)} or fixed')
    if element.find('mimic') is not None:
        raise ConfigError(f'{where}: mimics another joint, which cannot be compensated with')
    origin, axis, limit = (element.find(tag) for tag in ('origin', 'axis', 'limit'))
    place = of_position_and_angles(
        _three(origin, 'xyz', where, (0.0, 0.0, 0.0)), _three(origin, 'rpy', where, (0.0, 0.0, 0.0))
    )
    direction = _three(axis, 'xyz', where, (1.0, 0.0, 0.0))
    length = float(np.linalg.norm(direction))
    if not length:
        raise ConfigError(f'{where}: its axis is zero')
    # Not used here, but whoever wrote a wrong one has others.
    _speed(limit, where)
    return ArmJoint(name, kind, place, direction / length, *_range(limit, kind, where))


def _speed(limit: ElementTree.Element | None, where: str) -> float:
    """Largest speed of a joint."""
    text = '' if limit is None else limit.get('velocity', '')
    speed = _numbers(text, 1, f'{where}: velocity')[0] if text else math.inf
    if speed < 0.0:
        raise ConfigError(f'{where}: velocity = {speed:g}: must be at least 0')
    return speed


def _range(limit: ElementTree.Element | None, kind: str, where: str) -> tuple[float, float]:
    """Least and largest position of a joint."""
    if limit is None or kind not in ('revolute', 'prismatic'):
        return -math.inf, math.inf
    lower, upper = (_numbers(limit.get(side, '0'), 1, f'{where}: {side}')[0] for side in ('lower', 'upper'))
    if lower > upper:
        raise ConfigError(f'{where}: lower = {lower:g} is above upper = {upper:g}')
    return lower, upper


def _three(
    element: ElementTree.Element | None, key: str, where: str, default: tuple[float, float, float]
) -> FloatArray:
    text = element.get(key) if element is not None else None
    return np.array(default if text is None else _numbers(text, 3, f'{where}: {key}'))


def _numbers(text: str, count: int, where: str) -> list[float]:
    try:
        numbers = [plain_number(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ConfigError(f'{where} = {text!r}: must be {count} finite number{"s" * (count > 1)}')
    return numbers
