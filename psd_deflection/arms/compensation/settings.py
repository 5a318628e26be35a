# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The settings of the compensator, and those of the shaper of joint trajectories with the shaper that they make."""

from dataclasses import dataclass

from psd_deflection.arms.compensation.arm import read_limits
from psd_deflection.arms.compensation.trajectory import TrajectoryShaper
from psd_deflection.base.errors import ConfigError
from psd_deflection.model.link.shapers import KINDS, Shaper, in_series, recommended, shaper
from psd_deflection.rig.config import rig_from_values
from psd_deflection.rig.parameter_files import read_parameter_file
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


MODES = ('bending', 'torsion')
RECOMMENDED, NONE = 'recommended', 'none'
DESCRIPTION = 'robot_description'
LEAST_FREQUENCY = 0.1
"""Of a mode, Hz."""


@dataclass(frozen=True, slots=True)
class ShaperSettings:
    """What is shaped, how, and what is rejected; the node has them as ROS parameters.

    Raises ConfigError for a value out of bounds, or if two contradict each other.
    """

    params_file: str = parameter('', '', 'rig file with the modes, as `identify` writes it')
    modes: tuple[str, ...] = parameter((MODES[0],), '', 'modes of the rig file, none twice', choices=MODES)
    frequency: float = parameter(0.0, 'Hz', 'of a mode, instead of a rig file; 0: none', minimum=0.0, maximum=1000.0)
    damping_ratio: float = parameter(0.0, '', 'of that mode', minimum=0.0, maximum=0.9)
    shaper: str = parameter(
        RECOMMENDED,
        '',
        f'{NONE} passes trajectories through; {RECOMMENDED} is the shortest that leaves 5 % at most if the frequency '
        'is 5 % off',
        choices=(*KINDS, RECOMMENDED, NONE),
    )
    urdf: str = parameter(
        '',
        '',
        'reject trajectories beyond the limits of the joints of this URDF file; '
        f'{DESCRIPTION}: of the robot that this topic describes',
    )
    max_step: float = parameter(
        0.05,
        'rad or m',
        'a trajectory that begins further from where the joints are is rejected',
        minimum=1e-6,
        maximum=10.0,
        live=True,
    )
    action: str = parameter(
        '',
        '',
        "the controller's action, as /joint_trajectory_controller/follow_joint_trajectory: goals of "
        '~/follow_joint_trajectory go there, shaped; empty: no action is served',
    )
    lead: float = parameter(
        0.1,
        's',
        'a trajectory begins so much later: time for it to arrive, so that one that replaces another makes no step',
        minimum=0.0,
        maximum=1.0,
        live=True,
    )

    def __post_init__(self) -> None:
        for name, declared in SHAPING.parameters.items():
            check_value(declared, getattr(self, name), 'shaper')
        if len(set(self.modes)) < len(self.modes):
            raise ConfigError('shaper: modes: none may be there twice')
        if 0.0 < self.frequency < LEAST_FREQUENCY:
            raise ConfigError(f'shaper: frequency = {self.frequency:g} Hz: must be at least {LEAST_FREQUENCY:g}')
        if self.damping_ratio and not self.frequency:
            raise ConfigError('shaper: damping_ratio: must be given together with frequency')
        if self.frequency and self.params_file:
            raise ConfigError('shaper: frequency and params_file: must not be given together')


SHAPING = Section(ShaperSettings)


def shaper_of(settings: ShaperSettings) -> tuple[Shaper, str]:
    """The shaper that the settings ask for, and a line about it. Raises ConfigError."""
    if settings.shaper == NONE:
        return Shaper(NONE, (0.0,), (1.0,)), f'trajectories pass through unchanged (shaper: {NONE})'
    modes = _modes(settings)
    shapers = []
    for frequency, damping in modes:
        mode_shaper = (
            recommended(frequency, 0.0, damping)
            if settings.shaper == RECOMMENDED
            else shaper(settings.shaper, frequency, damping)
        )
        shapers.append(mode_shaper)
    out = in_series(shapers)
    of = ' and '.join(f'{frequency:g} Hz, damping ratio {damping:g}' for frequency, damping in modes)
    return out, f'{out.name.upper()} for {of}; motions take {1e3 * out.duration:.0f} ms longer'


def trajectory_shaper(settings: ShaperSettings) -> tuple[TrajectoryShaper, str]:
    """What shapes trajectories as the settings say, and a line about it; without limits yet if a topic has them.

    Raises ConfigError.
    """
    input_shaper, described = shaper_of(settings)
    limits = read_limits(settings.urdf) if settings.urdf not in ('', DESCRIPTION) else {}
    return TrajectoryShaper(input_shaper, limits, settings.max_step), described


def _modes(settings: ShaperSettings) -> list[tuple[float, float]]:
    """Frequency, Hz, and damping ratio of each mode."""
    if settings.frequency:
        return [(settings.frequency, settings.damping_ratio)]
    path = settings.params_file
    if not path:
        raise ConfigError(f'which mode: give params_file, or frequency and damping_ratio; or shaper: {NONE}')
    values = read_parameter_file(path)
    dynamics = rig_from_values(values, path).dynamics
    out = []
    for name in settings.modes:
        keys = f'{name}_frequency', f'{name}_damping_ratio'
        for key in keys:
            # The default is that of the thesis's link, which is not this one.
            if f'dynamics.{key}' not in values:
                raise ConfigError(f'{path}: has no dynamics.{key}; `psd-deflection identify` finds it')
        out.append((float(getattr(dynamics, keys[0])), float(getattr(dynamics, keys[1]))))
    return out
