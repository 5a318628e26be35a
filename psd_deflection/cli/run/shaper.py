"""Shapes joint trajectories, so that a motion does not ring the link: a ROS node.

It reads trajectories on /shaper/trajectory and publishes them on /shaper/shaped, to which you remap your controller's
topic. Begin and end are those that were given; the motion takes longer by a fraction of a period of the link. The mode
comes from the rig file that `identify` wrote, or from --frequency and --damping-ratio. With --urdf a trajectory beyond
the limits of the joints is refused.

  psd-deflection shaper --params-file modes/rig.yaml
  psd-deflection shaper --frequency 14 --damping-ratio 0.02 --shaper ei
  ros2 run psd_deflection shaper --params-file modes/rig.yaml --urdf arm.urdf

docs/shaping.md describes it.
"""

from __future__ import annotations

import argparse
import importlib.util

from psd_deflection.arms.compensation.arm import read_limits
from psd_deflection.arms.compensation.trajectory import TrajectoryShaper
from psd_deflection.arms.shapers import KINDS, Shaper, in_series, recommended, shaper
from psd_deflection.base.errors import ConfigError, UsageError
from psd_deflection.cli._display import Display
from psd_deflection.cli._options import number
from psd_deflection.rig.config import rig_from_values
from psd_deflection.rig.parameter_files import read_parameter_file

MODES = ('bending', 'torsion')
RECOMMENDED, NONE = 'recommended', 'none'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('--params-file', metavar='RIG.yaml', help='rig file with the modes, as `identify` writes it')
    parser.add_argument(
        '--modes', metavar='NAME', default=MODES[0], help='modes of the rig file: bending, torsion or both (bending)'
    )
    parser.add_argument(
        '--frequency',
        type=number('--frequency', 0.1, 1000.0),
        metavar='VALUE',
        help='Hz, of a mode, instead of a rig file',
    )
    parser.add_argument(
        '--damping-ratio', type=number('--damping-ratio', 0.0, 0.9), metavar='VALUE', help='of that mode'
    )
    parser.add_argument(
        '--shaper',
        metavar='NAME',
        default=RECOMMENDED,
        help=f'{", ".join(KINDS)}; {NONE}: pass trajectories through; default: the shortest that leaves '
        '5 %% at most if the frequency is 5 %% off',
    )
    parser.add_argument('--urdf', metavar='ARM.urdf', help='refuse trajectories beyond the limits of its joints')
    parser.add_argument(
        '--max-step',
        type=number('--max-step', 1e-6, 10.0),
        default=0.05,
        metavar='VALUE',
        help='refuse a trajectory that begins further from where the joints are, rad or m (default 0.05)',
    )
    parser.add_argument('--ros-args', action='store_true', help='arguments after this go to ROS')


def run(args: argparse.Namespace) -> int:
    """Run until Ctrl-C."""
    chosen, described = shaper_of(args)
    limits = read_limits(args.urdf) if args.urdf is not None else {}
    if importlib.util.find_spec('rclpy') is None:
        raise ConfigError("rclpy is not installed: source your ROS 2, or `pip install 'psd_deflection[ros]'`")
    from psd_deflection.ros.shaper import run_shaper

    return run_shaper(args.ros_arguments, TrajectoryShaper(chosen, limits, args.max_step), described, Display().say)


def shaper_of(args: argparse.Namespace) -> tuple[Shaper, str]:
    """The shaper that the options ask for, and a line about it. Raises UsageError, ConfigError."""
    if args.shaper not in (*KINDS, RECOMMENDED, NONE):
        raise UsageError(f'--shaper {args.shaper}: must be one of {", ".join((*KINDS, RECOMMENDED, NONE))}')
    if args.shaper == NONE:
        return Shaper(NONE, (0.0,), (1.0,)), 'trajectories pass through unchanged (--shaper none)'
    modes = _modes(args)
    found = []
    for frequency, damping in modes:
        one = (
            recommended(frequency, 0.0, damping)
            if args.shaper == RECOMMENDED
            else shaper(args.shaper, frequency, damping)
        )
        found.append(one)
    out = in_series(found)
    of = ' and '.join(f'{frequency:g} Hz, damping ratio {damping:g}' for frequency, damping in modes)
    return out, f'{out.name.upper()} for {of}; motions take {1e3 * out.duration:.0f} ms longer'


def _modes(args: argparse.Namespace) -> list[tuple[float, float]]:
    """Frequency, Hz, and damping ratio of each mode."""
    if (args.frequency is None) != (args.damping_ratio is None):
        raise UsageError('--frequency and --damping-ratio: must be given together')
    if args.frequency is not None:
        if args.params_file is not None:
            raise UsageError('--frequency and --params-file: must not be given together')
        return [(args.frequency, args.damping_ratio)]
    if args.params_file is None:
        raise UsageError('which mode: give --params-file, or --frequency and --damping-ratio; or --shaper none')
    names = args.modes.split(',')
    for name in names:
        if name not in MODES or names.count(name) > 1:
            raise UsageError(f'--modes {args.modes}: must be of {", ".join(MODES)}, none twice')
    values = read_parameter_file(args.params_file)
    dynamics = rig_from_values(values, args.params_file).dynamics
    out = []
    for name in names:
        keys = f'{name}_frequency', f'{name}_damping_ratio'
        for key in keys:
            # The default is that of the thesis's link, which is not this one.
            if f'dynamics.{key}' not in values:
                raise ConfigError(f'{args.params_file}: has no dynamics.{key}; `psd-deflection identify` finds it')
        out.append((float(getattr(dynamics, keys[0])), float(getattr(dynamics, keys[1]))))
    return out
