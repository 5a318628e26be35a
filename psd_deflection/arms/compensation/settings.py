# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the offsets of a compensator may do, and what makes them hold."""

from __future__ import annotations

from dataclasses import dataclass

from psd_deflection.base.errors import ConfigError
from psd_deflection.rig.parameters import Section, check_value, parameter

AXES = ('x', 'y', 'z', 'rx', 'ry', 'rz')
OFFSETS, COMMANDS = 'offsets', 'commands'
ALL_JOINTS = 'all'


@dataclass(frozen=True, slots=True)
class CompensatorSettings:
    """What the offsets may do and what makes them hold; the node has them as ROS parameters.

    Offsets and rates are those of each joint: rad or m. Raises ConfigError for a value out of
    bounds.
    """

    tip: str = parameter('', '', 'link of the end effector in the URDF; it must be named')
    base: str = parameter('', '', 'link from which on joints count; empty: the root')
    urdf: str = parameter('', '', 'URDF file with the kinematics of the arm; empty: the topic robot_description')
    drive: bool = parameter(False, '', 'publish offsets for a controller; false: proposals')
    axes: tuple[str, ...] = parameter(
        ('x', 'y', 'z'), '', "axes of the end effector's rigid pose that are corrected", choices=AXES
    )
    output: str = parameter(
        OFFSETS,
        '',
        'what a controller gets: offsets that it adds to its commands, or commands (position plus offset)',
        choices=(OFFSETS, COMMANDS),
    )
    joints: tuple[str, ...] = parameter(
        (ALL_JOINTS,), '', 'joints in the order of the outputs; all: those of the URDF file, from the base on'
    )
    takeover: bool = parameter(
        True, '', 'with offsets: wait until the controller tells those that it applies, and begin there; false: at 0'
    )
    frame_prefix: str = parameter('', '', 'prefix of the frames of the deflection')
    controller_state: str = parameter(
        '', '', "type of what the robot's controller tells again and again on ~/controller_state while it is active"
    )
    max_offset: float = parameter(0.05, 'rad or m', 'largest offset of a joint', above=0.0, maximum=10.0, live=True)
    max_rate: float = parameter(
        0.1,
        'rad/s or m/s',
        'largest rate of an offset, also on the way back to zero',
        above=0.0,
        maximum=10.0,
        live=True,
    )
    time_constant: float = parameter(
        0.2, 's', 'lag of the offsets behind the deflection', minimum=1e-3, maximum=100.0, live=True
    )
    damping: float = parameter(
        0.01,
        'm',
        'damping of the least squares; an error of 1 rad counts as one of 1 m',
        above=0.0,
        maximum=10.0,
        live=True,
    )
    stale: float = parameter(
        0.08,
        's',
        'age of a deflection or of joint positions from which on the offsets hold',
        minimum=1e-3,
        maximum=10.0,
        live=True,
    )
    max_sd: float = parameter(
        1e-3,
        'm or rad',
        'standard deviation above which a deflection is not followed',
        above=0.0,
        maximum=10.0,
        live=True,
    )
    jump: float = parameter(
        0.02,
        'm or rad',
        'change between two deflections above which the offsets hold',
        above=0.0,
        maximum=10.0,
        live=True,
    )
    max_deflection: float = parameter(
        0.25,
        'm or rad',
        'largest deflection that the links can have; a larger one is not followed',
        above=0.0,
        maximum=10.0,
        live=True,
    )
    max_joint_speed: float = parameter(
        10.0,
        'rad/s or m/s',
        'speed of a joint above which its positions leap, and the offsets hold',
        above=0.0,
        maximum=1000.0,
        live=True,
    )
    follow_error: float = parameter(
        0.01,
        'rad or m',
        'offset, or distance from a command, that the joints must be seen to follow',
        above=0.0,
        maximum=10.0,
        live=True,
    )
    good: int = parameter(
        25, '', 'good estimates in a row after which held offsets follow again', minimum=1, maximum=10000, live=True
    )

    release_after: float = parameter(
        10.0,
        's',
        'time after which offsets that are held go back to zero, but not while the robot stands; 0: never',
        minimum=0.0,
        maximum=1e6,
        live=True,
    )

    def __post_init__(self) -> None:
        for name, declared in SETTINGS.parameters.items():
            check_value(declared, getattr(self, name), 'compensator')
        if len(set(self.axes)) < len(self.axes):
            raise ConfigError('compensator: axes: none may be there twice')


SETTINGS = Section(CompensatorSettings)
