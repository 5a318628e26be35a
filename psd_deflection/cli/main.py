# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``psd-deflection``: finds the command and turns our errors into one line and an exit status.

Each command is a module of this package with ``add_arguments(parser)`` and ``run(args) -> int``; it is
imported only when it is asked for, so that ``--help`` stays quick. Its docstring is its help. Another package adds such
a module by an entry point of the group ``psd_deflection.commands``, or a study, a function of
``psd_deflection.studies.study.Opened`` that returns a ``StudyResult``, by one of ``psd_deflection.studies``.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import importlib
import itertools
import os
import re
import shutil
import signal
import sys
import textwrap
import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import TYPE_CHECKING, Any

from psd_deflection import __version__
from psd_deflection.base.errors import (
    EXIT_STATUSES,
    INTERRUPTED,
    ConfigError,
    MachineError,
    PsdDeflectionError,
    RecordingError,
    SomeFailedError,
    UsageError,
)
from psd_deflection.base.plugins import loaded, not_installed
from psd_deflection.base.text import did_you_mean, sanitize
from psd_deflection.cli._report import LONGEST_LINE

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

# Our matrices are small, or tall and narrow: more threads spin more than they compute. Before numpy is imported.
os.environ.setdefault('OMP_NUM_THREADS', '1')

_SUMMARIES: dict[str, str] = {
    'estimator': 'acquire, estimate, publish on ROS 2 and record (the daemon)',
    'chain': 'several links in series: the deflection of the end effector',
    'compensator': 'joint offsets that put a deflected end effector back (a ROS node)',
    'shaper': 'shape joint trajectories so that they do not ring the link (a ROS node)',
    'monitor': 'serve a web page that shows the rig live, or plays a recording',
    'echo': 'print what a running daemon measures, without ROS',
    'zero': 'make a running daemon take the zero, without ROS',
    'record': 'start or stop a recording of a running daemon, without ROS',
    'mark': 'mark this moment in the recording of a running daemon, without ROS',
    'load': 'note a known load that acts on the tip from now on, for the recording',
    'replay': 'compute the estimates of a recording again, as the daemon did',
    'simulate': 'simulate the rig: write a recording, or act as a device',
    'discover': 'find the physical effect that the simulation of a recording lacks',
    'calibrate': 'estimate how the real rig differs from its rig file, with a reference or known loads',
    'effects': 'list the effects that can be simulated and discovered, or explain one',
    'camera': 'measure the tip by a camera: a reference beside the PSDs; print its target',
    'check': 'check the wiring of a rig: guided by hand, or from a recording with known loads',
    'validate': 'compare the estimates of a recording with a camera, a stage or a tracker',
    'identify': 'find the modes of the link, and the input shaper that does not ring them',
    'devices': 'list the serial ports and the devices on them, and suggest parameters',
    'plot': 'draw a recording as PNG, SVG, PDF or HTML',
    'info': 'summarise a recording',
    'convert': 'convert a recording to CSV, MCAP, a bag or Rerun',
    'recover': 'repair a recording that a crash cut off',
    'budget': 'compute the error budget: what each cause adds to the error of ΔX, ΔY and θ',
    'certificate': 'write a calibration certificate: U at stated poses, with every input of it',
    'design': 'compute link stiffness and compare sensor placements',
    'thesis': 'what concerns the thesis alone: compare its methods, explain its Table 5.1',
    'params': 'list every parameter with unit, bounds and default',
    'completion': 'print a completion script for bash, zsh or tcsh',
}

FOLDERS = ('', 'run', 'recordings', 'studies')
"""Where commands lie: in ``cli`` itself and in folders of it."""

_HERE = Path(__file__).parent
_FILES = {
    file.partition('.')[0]
    for folder in FOLDERS
    for file in os.listdir(_HERE / folder)  # noqa: PTH208 - every start
}

COMMANDS = {name: summary for name, summary in _SUMMARIES.items() if name.replace('-', '_') in _FILES}
"""Command name to one-line summary; the module is ``NAME.py`` (``-`` as ``_``) in one of ``FOLDERS``. An optional room
that is not there has none."""

GROUPS: dict[str, tuple[str, ...]] = {
    'run': ('estimator', 'monitor', 'chain', 'echo', 'zero', 'load', 'mark', 'record'),
    'rig': ('devices', 'check', 'params', 'design', 'budget'),
    'recording': ('replay', 'plot', 'info', 'convert', 'recover'),
    'truth': ('camera', 'validate', 'calibrate', 'certificate'),
    'model': ('simulate', 'discover', 'effects', 'thesis'),
    'motion': ('identify', 'compensator', 'shaper'),
}
"""Commands by what one wants to do, in the order of the help; those of no group come last."""

PLUG_INS = ('psd_deflection.commands', 'psd_deflection.studies')
"""Groups of entry points by which other packages add a command: a module, or the function of a study."""

ROS_OPTIONS = ('-p', '--param', '-r', '--remap')
"""What ROS 2 takes behind --ros-args and people type without it."""

STATUS_WORDS = (
    *('done', 'differs', 'command line', 'parameter or package', 'recording', 'device', 'geometry', 'daemon'),
    *('some failed', 'samples dropped', 'machine', 'Ctrl-C'),
)
"""Each exit status in two words, in the order of ``EXIT_STATUSES``."""

EPILOG = """\
  psd-deflection estimator --demo    try it without hardware
  psd-deflection COMMAND --help      what a command does, its options, examples

exit status: """ + ', '.join(f'{n} {words}' for n, words in zip(EXIT_STATUSES, STATUS_WORDS, strict=True))

_NEGATIVE = re.compile(r'^-[\d.][\d.,eE+-]*$')
_WIDEST = 100
AGAIN_S = 0.05
"""After so long, s, an interrupt that was dropped comes again."""

_REJECTED_OUTPUT = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG)


class _Help(argparse.RawDescriptionHelpFormatter):
    """Wraps paragraphs to the width of the terminal; indented lines stay as they are."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, width=min(shutil.get_terminal_size().columns - 2, _WIDEST))

    def _format_action(self, action: argparse.Action) -> str:
        """The commands in their groups; everything else as argparse has it."""
        names = [sub.dest for sub in self._iter_indented_subactions(action)]
        if not names:
            return super()._format_action(action)
        grouped = {name for group in GROUPS.values() for name in group}
        other_groups = {
            'shell': [name for name in names if name in COMMANDS and name not in grouped],
            'plug-ins': [name for name in names if name not in COMMANDS],
        }
        wide = max(map(len, GROUPS)) + 4
        ours = {title: [name for name in group if name in COMMANDS] for title, group in GROUPS.items()}
        lines = [(f'  {title}'.ljust(wide), group) for title, group in {**ours, **other_groups}.items() if group]
        return ''.join(
            textwrap.fill(', '.join(g), self._width, initial_indent=t, subsequent_indent=' ' * wide) + '\n'
            for t, g in lines
        )

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        out = []
        for indented, lines in itertools.groupby(text.splitlines(), lambda line: line.startswith(' ') or not line):
            if indented:
                out += [indent + line for line in lines]
            else:
                out += textwrap.wrap(
                    ' '.join(lines), width, initial_indent=indent, subsequent_indent=indent, break_on_hyphens=False
                )
        return '\n'.join(out)


def plugged_in() -> dict[str, EntryPoint]:
    """The commands of other packages by their names; one that has the name of ours is left out."""
    from importlib.metadata import entry_points

    points = (point for group in PLUG_INS for point in entry_points(group=group))
    return {point.name: point for point in sorted(points, key=lambda p: p.name) if point.name not in COMMANDS}


def make_parser(
    chosen: Collection[str],
    value: type[argparse.Action] | None = None,
    plug_ins: Mapping[str, EntryPoint] = MappingProxyType({}),
) -> argparse.ArgumentParser:
    """The parser of all commands; only the ``chosen`` ones have arguments, so that other modules are not imported.

    ``plug_ins``: see :func:`plugged_in`. Raises ConfigError if one that is chosen cannot be loaded.
    """
    parser = argparse.ArgumentParser(
        prog='psd-deflection',
        description='Tip deflection and twist of a flexible link from position sensing detectors.',
        epilog=EPILOG,
        formatter_class=_Help,
    )
    parser.add_argument('--version', action='version', version=f'psd-deflection {__version__}')
    commands = parser.add_subparsers(title='commands', dest='command', metavar='COMMAND', required=True)
    for name, summary in {**COMMANDS, **{name: f'of {point.value}' for name, point in plug_ins.items()}}.items():
        sub = commands.add_parser(name, help=summary, description=summary, formatter_class=_Help)
        # `-5,20` and `-2.9e1` are values, which argparse takes for options; it has no public way to be told.
        sub._negative_number_matcher = _NEGATIVE  # noqa: SLF001
        if value is not None:
            sub.register('action', None, value)
        if name in chosen:
            module = _plug_in(plug_ins[name]) if name in plug_ins else module_of(name)
            sub.description = module.__doc__
            module.add_arguments(sub)
            options = tuple(sub._option_string_actions)  # noqa: SLF001
            sub.set_defaults(run=module.run, reject=sub.error, known_options=options)
    return parser


def module_of(name: str) -> ModuleType:
    """The module of a command, one of ``COMMANDS``."""
    file = name.replace('-', '_')
    folder = next(folder for folder in FOLDERS if (_HERE / folder / f'{file}.py').exists())
    return importlib.import_module('.'.join(filter(None, ('psd_deflection.cli', folder, file))))


def _plug_in(point: EntryPoint) -> Any:
    """The command of another package. Raises ConfigError if it cannot be loaded or is none."""
    at = f'command {point.name!r}: {point.value}'
    command: Any = loaded(f'{at} cannot be loaded', point.load)
    if point.group == 'psd_deflection.studies' and callable(command):
        from psd_deflection.cli.studies._answer import study_command

        return study_command(command)
    if not (callable(getattr(command, 'add_arguments', None)) and callable(getattr(command, 'run', None))):
        raise ConfigError(f'{at}: has no add_arguments(parser) and run(args)')
    return command


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status (``psd_deflection.base.errors`` lists them)."""
    status = 0
    if sys.stderr is None:
        # `2>&-`: print() would write messages for the standard error to stdout.
        sys.stderr = Path(os.devnull).open('w', encoding='utf-8')  # noqa: SIM115 - open as long as the program
    with contextlib.suppress(AttributeError, ValueError):
        # A Δ that the terminal cannot encode must not cause an error.
        sys.stdout.reconfigure(errors='replace')  # type: ignore[union-attr]
    try:
        try:
            with _no_interrupt_lost():
                status = _run(list(sys.argv[1:] if argv is None else argv))
        finally:
            # Flush here, where an error can still be reported, not at the interpreter's exit.
            if sys.stdout is not None:
                sys.stdout.flush()
    except KeyboardInterrupt:
        _notify('psd-deflection: interrupted')
        return INTERRUPTED
    except BrokenPipeError:
        # `psd-deflection ... | head` is not an error.
        _discard_output()
    except (MemoryError, RuntimeError) as error:
        machine = _lack_of(error)
        if machine is None:
            raise
        _notify(f'psd-deflection: {machine}')
        return machine.exit_status
    except OSError as error:
        if error.errno not in _REJECTED_OUTPUT or error.filename is not None:
            raise
        _discard_output()
        rejected = RecordingError(f'the standard output cannot be written ({error.strerror})')
        _notify(f'psd-deflection: {rejected}')
        return rejected.exit_status
    return status


def _lack_of(error: MemoryError | RuntimeError) -> MachineError | None:
    """What the machine lacks, if that is what went wrong."""
    if isinstance(error, MemoryError):
        return MachineError('too little memory; see the limits of the shell (ulimit -v), the container or the unit')
    if str(error) == "can't start new thread":
        return MachineError('no further thread; see the limits of the shell (ulimit -u, -v), the container or the unit')
    return None


def _notify(line: str) -> None:
    """Print on the standard error; if that cannot be written, only the exit status reports the error."""
    with contextlib.suppress(OSError):
        # It may hold words of a file or of a device.
        print(sanitize(line, LONGEST_LINE), file=sys.stderr)


def _discard_output() -> None:
    """Discard the rest of its buffer, else the interpreter fails on it again at exit."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def _run(argv: list[str]) -> int:
    # `ros2 run` and `ros2 launch` add arguments for rclpy, which argparse must not see.
    arguments, ros_arguments = _split_ros_arguments(argv)
    chosen = [a for a in argv if a and not a.startswith('-')][:1]
    try:
        parser = _parser_of(arguments, chosen)
        if not argv:
            parser.print_help()
            return 0
        args, unknown = parser.parse_known_args(arguments)
    except (UsageError, ConfigError) as error:
        _notify(f'{" ".join(["psd-deflection", *chosen])}: {error}')
        return error.exit_status
    if unknown:
        # Let the subcommand's parser report the error, so that its own usage is printed.
        hint = _ros_hint(unknown) or _option_hint(unknown, args.known_options)
        args.reject(f'unrecognized arguments: {" ".join(unknown)}{hint}')
    args.ros_arguments = ros_arguments
    return _answer(args)


def _parser_of(arguments: list[str], chosen: list[str]) -> argparse.ArgumentParser:
    """The parser that knows the command ``chosen``, which is none or one. Raises UsageError for an unknown command."""
    _reject_empty(arguments)
    # Looked for only if they may be meant: it takes longer than a short command of ours.
    plug_ins = {} if chosen and chosen[0] in COMMANDS else plugged_in()
    names = {*COMMANDS, *plug_ins}
    if chosen and chosen[0] not in names:
        hint = did_you_mean(chosen[0], names) or '; `psd-deflection --help` lists them'
        raise UsageError(f'no command {chosen.pop()!r}{hint}')
    return make_parser(chosen, plug_ins=plug_ins)


def _answer(args: argparse.Namespace) -> int:
    """Run the command; its exit status. An output that is not finished is set aside."""
    out: str | None = getattr(args, 'out', None)
    # An output that existed before belongs to another run; this one has not written to it.
    fresh = out is not None and not os.path.lexists(out)
    unfinished = Path(out) if out is not None and fresh else None
    try:
        with _ended_like_ctrl_c() if fresh else contextlib.nullcontext():
            return int(args.run(args))
    except KeyboardInterrupt:
        aside = set_aside(unfinished) if unfinished else ''
        if not aside:
            raise
        _notify(f'psd-deflection {args.command}: interrupted{aside}')
        return INTERRUPTED
    except SomeFailedError as error:
        # The others are done, and their output is complete.
        _notify(f'psd-deflection {args.command}: {error}')
        return error.exit_status
    except (PsdDeflectionError, ModuleNotFoundError) as error:
        rejected = not_installed(error) if isinstance(error, ModuleNotFoundError) else error
        if rejected is None:
            raise
        aside = set_aside(unfinished) if unfinished else ''
        _notify(f'psd-deflection {args.command}: {rejected}{aside}')
        return rejected.exit_status


@contextlib.contextmanager
def _no_interrupt_lost() -> Iterator[None]:
    """Python drops an exception of a finaliser, also that of a signal that came during one: it comes again."""
    before = sys.unraisablehook

    def reported(dropped: sys.UnraisableHookArgs) -> None:
        if issubclass(dropped.exc_type, KeyboardInterrupt):
            again = threading.Timer(AGAIN_S, _interrupt)
            again.daemon = True
            again.start()
        else:
            before(dropped)

    sys.unraisablehook = reported
    try:
        yield
    finally:
        sys.unraisablehook = before


def _interrupt() -> None:
    if hasattr(signal, 'pthread_kill'):
        # This ends a wait too.
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:
        signal.raise_signal(signal.SIGINT)


@contextlib.contextmanager
def _ended_like_ctrl_c() -> Iterator[None]:
    """Treat `timeout` and a closed terminal like Ctrl-C, so that no unfinished output looks complete."""
    before = {}
    # Only the main thread may set signal handlers.
    with contextlib.suppress(ValueError):
        # Windows has no SIGHUP.
        for number in (signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, 'SIGHUP') else [])):
            if signal.getsignal(number) is signal.SIG_DFL:
                before[number] = signal.signal(number, signal.default_int_handler)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def set_aside(out: Path) -> str:
    """Rename an unfinished output, so that it does not look complete; return its new place as text.

    An empty folder is deleted; else it becomes ``NAME.partial``, or ``NAME.partial2`` and so on.
    """
    try:
        if out.is_dir() and not any(out.iterdir()):
            out.rmdir()
            return ''
        if not os.path.lexists(out):
            return ''
        names = (out.with_name(f'{out.name}.partial{n}') for n in ('', *range(2, 1000)))
        partial = next(p for p in names if not os.path.lexists(p))
        out.rename(partial)
    except (OSError, StopIteration):
        return f'; {out} holds only what came before'
    return f'; {partial} holds what came before'


def _reject_empty(argv: Sequence[str]) -> None:
    """Raise UsageError for an empty argument, as from a variable that is not set in a script."""
    for before, argument in itertools.pairwise(['', *argv]):
        option, equals, value = argument.partition('=')
        if argument == '' or (option.startswith('--') and equals and not value):
            where = option or (before if before.startswith('--') else 'an argument')
            raise UsageError(f'{where} is empty (a variable that is not set?)')


def _ros_hint(unknown: Sequence[str]) -> str:
    meant = any(a in ROS_OPTIONS or ':=' in a for a in unknown)
    return '; ROS arguments go behind --ros-args' if meant else ''


def _option_hint(unknown: Sequence[str], known: Collection[str]) -> str:
    """``; did you mean --from?`` for the first option that is spelt nearly right."""
    typed = (a.partition('=')[0] for a in unknown if a.startswith('--'))
    return next((hint for a in typed if (hint := did_you_mean(a, known))), '')


def _split_ros_arguments(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    arguments: list[str] = []
    for_ros: list[str] = []
    inside = False
    for argument in argv:
        if argument == '--ros-args':
            inside = True
        (for_ros if inside else arguments).append(argument)
        if argument == '--':
            inside = False
    return arguments, for_ros


def __getattr__(name: str) -> Callable[[], int]:
    """The console script ``psd_deflection.cli.main:NAME`` of a colcon build, for `ros2 run psd_deflection NAME`."""
    if name in COMMANDS:
        return lambda: main([name, *sys.argv[1:]])
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
