"""``psd-deflection``: finds the command and turns our errors into one line and an exit status.

Each command is a module of this package with ``add_arguments(parser)`` and ``run(args) -> int``; it is
imported only when it is asked for, so that ``--help`` stays quick.
"""

from __future__ import annotations

import argparse
import difflib
import importlib
import os
import sys
from collections.abc import Collection, Sequence

from psd_deflection import __version__
from psd_deflection.errors import PsdDeflectionError

COMMANDS: dict[str, str] = {
    'estimator': 'acquire, estimate, publish on ROS 2 and record (the daemon)',
    'monitor': 'serve a live page: of the rig, or of a recording that plays',
    'replay': 'run a recording through the same pipeline',
    'simulate': 'simulate the rig: as a recording, or as a device on a pseudo-terminal',
    'discover': 'name what the simulation lacks to explain a recording, and add it',
    'devices': 'list serial ports, say what answers on each, suggest the parameters',
    'plot': 'draw a recording: PNG, SVG, PDF or HTML',
    'info': 'say what is in a recording',
    'convert': 'write the samples of a recording as a CSV, an .mcap or a bag',
    'recover': 'make a recording whole that a crash left without its end',
    'budget': 'error budget: what each cause does to dX, dY and theta (chapter 3)',
    'design': 'size the link and place the sensors (appendix B, condition numbers)',
    'compare-methods': 'how far each method is off, and where the figures of Table 5.1 come from',
    'params': 'list every parameter with unit, bounds and default',
    'completion': 'print what makes your shell complete these commands',
}
"""Command name to one-line summary; the module is ``psd_deflection.cli.NAME`` (``-`` as ``_``)."""

USAGE = 2
"""Exit status of a command line that was not understood; argparse has the same."""

ROS_OPTIONS = ('-p', '--param', '-r', '--remap')
"""What ROS 2 takes behind --ros-args and people type without it."""

EPILOG = """\
A first look, without hardware:   psd-deflection estimator
What it measured, once more:      psd-deflection replay RECORDING --compare
Each command explains itself:     psd-deflection COMMAND --help
"""


INTERRUPTED = 130
"""What a shell gives a program that Ctrl-C ended."""


def make_parser(chosen: Collection[str]) -> argparse.ArgumentParser:
    """The whole command line; the arguments of the commands ``chosen`` only, since the others' modules stay unread."""
    parser = argparse.ArgumentParser(
        prog='psd-deflection',
        description='Tip deflection and twist of a flexible link from two position sensing detectors.',
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('--version', action='version', version=f'psd-deflection {__version__}')
    commands = parser.add_subparsers(dest='command', metavar='COMMAND', required=True)
    for name, summary in COMMANDS.items():
        sub = commands.add_parser(
            name, help=summary, description=summary, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        if name in chosen:
            module = importlib.import_module('psd_deflection.cli.' + name.replace('-', '_'))
            sub.description = module.__doc__
            module.add_arguments(sub)
            sub.set_defaults(run=module.run, refuse=sub.error)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status (``psd_deflection.errors`` lists them; 130: Ctrl-C)."""
    try:
        return _run(list(sys.argv[1:] if argv is None else argv))
    except KeyboardInterrupt:
        print('psd-deflection: interrupted', file=sys.stderr)
        return INTERRUPTED


def _run(argv: list[str]) -> int:
    chosen = [a for a in argv if not a.startswith('-')][:1]
    if chosen and chosen[0] not in COMMANDS:
        close = difflib.get_close_matches(chosen[0], COMMANDS, 1)
        hint = f'did you mean {close[0]}?' if close else '`psd-deflection --help` lists them'
        print(f'psd-deflection: no command {chosen[0]!r}; {hint}', file=sys.stderr)
        return USAGE
    parser = make_parser(chosen)
    # `ros2 run` and `ros2 launch` add arguments of their own: they are for rclpy, not for argparse.
    own, ros_arguments = _split_ros_arguments(argv)
    args, unknown = parser.parse_known_args(own)
    if unknown:
        # The parser of the whole program would answer with its own usage, which names none of the command's options.
        args.refuse(f'unrecognized arguments: {" ".join(unknown)}{_ros_hint(unknown)}')
    args.ros_arguments = ros_arguments
    out: str | None = getattr(args, 'out', None)
    # What was there before is another run's, and this one has not written into it.
    fresh = out is not None and not os.path.lexists(out)
    try:
        return int(args.run(args))
    except KeyboardInterrupt:
        if out is None or not fresh or not os.path.lexists(out):
            raise
        print(
            f'psd-deflection {args.command}: interrupted; {out} holds only what came before',
            file=sys.stderr,
        )
        return INTERRUPTED
    except PsdDeflectionError as error:
        print(f'psd-deflection {args.command}: {error}', file=sys.stderr)
        return error.exit_status
    except BrokenPipeError:
        # `psd-deflection ... | head` is not an error; keep the interpreter's own flush quiet too.
        sys.stderr.close()
        return 0


def _ros_hint(unknown: Sequence[str]) -> str:
    meant = any(a in ROS_OPTIONS or ':=' in a for a in unknown)
    return '; ROS arguments go behind --ros-args' if meant else ''


def _split_ros_arguments(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    own: list[str] = []
    for_ros: list[str] = []
    inside = False
    for argument in argv:
        if argument == '--ros-args':
            inside = True
        (for_ros if inside else own).append(argument)
        if argument == '--':
            inside = False
    return own, for_ros


def estimator() -> int:
    """Console script of ``ros2 run psd_deflection estimator`` (colcon)."""
    return main(['estimator', *sys.argv[1:]])


def replay() -> int:
    """Console script of ``ros2 run psd_deflection replay`` (colcon)."""
    return main(['replay', *sys.argv[1:]])


def simulate() -> int:
    """Console script of ``ros2 run psd_deflection simulate`` (colcon)."""
    return main(['simulate', *sys.argv[1:]])


def discover() -> int:
    """Console script of ``ros2 run psd_deflection discover`` (colcon)."""
    return main(['discover', *sys.argv[1:]])
