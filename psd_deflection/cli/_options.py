# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Checks of option values: a mistake ends with status 2, before anything is read or written."""

import argparse
import contextlib
import functools
import importlib.util
import os
import re
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar

from psd_deflection.base.errors import ConfigError, MachineError, RecordingError, UsageError
from psd_deflection.base.foreign_yaml import YamlError, parse_yaml
from psd_deflection.base.text import plain_number
from psd_deflection.cli._values import given_as_option
from psd_deflection.recordings.formats.format import formats
from psd_deflection.recordings.spans import FULL, MARK_WORD, Bound
from psd_deflection.recordings.write.parquet import ENDING, is_parquet
from psd_deflection.rig.config import Rig, replace_values, rig_from_values
from psd_deflection.rig.declarations import BY_NAME
from psd_deflection.rig.parameter_files import read_parameter_file
from psd_deflection.rig.parameters import Parameter, Section, Value, check_value
from psd_deflection.run.realtime import SHARED_MEMORY, shared_memory_left

_FOREIGN = """
.7z .arrow .avi .bag .bmp .bz2 .db .db3 .eps .feather .gif .gz .h5 .hdf .hdf5 .htm .html .jpeg .jpg .json .jsonl .log
.mat .md .mp4 .nc .npy .npz .ods .parquet .pdf .pickle .pkl .png .ps .rar .rrd .sqlite .sqlite3 .svg .tar .tdms .tgz
.tif .tiff .toml .tsv .txt .ulg .webp .xls .xlsx .xml .xz .yaml .yml .zip .zst
"""
FOREIGN = frozenset(_FOREIGN.split())
"""Endings of other kinds of files. Any other ending is part of a folder's name, as in ``run_0.5N``."""

N = TypeVar('N', int, float)
S = TypeVar('S')

LONGEST_SPAN_S = 1e8
"""Bound of --from and --to, s: three years."""
PICTURES = ('.png', '.svg', '.pdf')


def parameter_option(parser: argparse._ActionsContainer, option: str, name: str, *older: str) -> None:
    """Add ``option``, which sets the parameter ``name``; help, type and default come from its declaration.

    ``older``: names that it had once, which still work.

    :func:`given_parameters` returns the given values.
    """
    p = BY_NAME[name]
    text = p.description + (f' (default {p.default})' if p.default != '' else '')
    parser.add_argument(
        option,
        *older,
        dest=name,
        type=int if p.kind == 'integer' else str,
        metavar='N' if p.kind == 'integer' else option.rpartition('-')[2].upper(),
        help=text.replace('%', '%%'),
    )


def section_options(parser: argparse._ActionsContainer, section: Section[Any]) -> None:
    """Add an option for each parameter of a section, as it is declared; a list is written X,Y."""
    for declared in section.parameters.values():
        unit = f', {declared.unit}' if declared.unit else ''
        default = declared.default
        text = ','.join(map(str, default)) if isinstance(default, list) else f'{default}'
        text = text.lower() if isinstance(default, bool) else text
        bounds = f', {declared.bound_text()}' if declared.choices is not None else ''
        parser.add_argument(
            f'--{declared.name.replace("_", "-")}',
            dest=declared.name,
            type=functools.partial(_of_section, declared),
            default=default,
            metavar='X,Y' if isinstance(default, list) else 'VALUE',
            nargs='?' if isinstance(default, bool) else None,
            const=True if isinstance(default, bool) else None,
            help=f'{declared.description}{unit}{bounds} (default {text or "none"})'.replace('%', '%%'),
        )


def _of_section(declared: Parameter, text: str) -> Value:
    option = f'--{declared.name.replace("_", "-")}'
    value: object = text
    if declared.kind.endswith('_array'):
        value = text.split(',')
    elif declared.kind == 'integer' and re.fullmatch(r'[+-]?[0-9]{1,18}', text):
        value = int(text)
    elif declared.kind == 'double':
        with contextlib.suppress(ValueError):
            value = float(text)
    elif declared.kind == 'bool':
        value = {'true': True, 'false': False}.get(text.lower(), text)
    try:
        return check_value(declared, value, 'options')
    except ConfigError as error:
        raise UsageError(str(error).removeprefix('options: ').replace(declared.name, option, 1)) from None


def of_options(args: argparse.Namespace, section: Section[S]) -> S:
    """The settings that the options of :func:`section_options` give. Raises UsageError if they do not fit together."""
    with given_as_option(*(p.name for p in section.parameters.values())):
        return section.of({p.name: getattr(args, p.name) for p in section.parameters.values()})


def given_parameters(args: argparse.Namespace) -> dict[str, object]:
    """Values of the given options that set parameters; ``--record FOLDER`` sets ``bag_dir`` as well.

    Raises UsageError for a value that cannot be.
    """
    values = {name: v for name, v in vars(args).items() if name in BY_NAME and v is not None and v is not False}
    folder = values.get('record')
    if folder is not None:
        values['record'] = True
    if folder:
        values['bag_dir'] = folder
    with given_as_option():
        rig_from_values(values, 'command line')
    return values


def foxglove_option(parser: argparse._ActionsContainer) -> None:
    """Add --foxglove, where that server is installed."""
    if importlib.util.find_spec('psd_deflection.run.monitor.foxglove') is not None:
        parser.add_argument(
            '--foxglove', action='store_true', help='serve the messages to Foxglove as well, and print the address'
        )


DEMO = 'without a port: weights hang on the simulated rig in turn, so that there is motion to look at'


def reject_demo(args: argparse.Namespace) -> None:
    """Raise UsageError if --demo is given for a real device, on which it would do nothing."""
    if args.demo and args.port is not None:
        raise UsageError('--demo is for the simulated rig: leave out --port')


def over_file(params_file: str | None, given: Mapping[str, object]) -> dict[str, object]:
    """The flat values of ``params_file``, if there is one, with the ``given`` ones on top. Raises ConfigError."""
    if params_file is None:
        return dict(given)
    values = {**read_parameter_file(params_file), **given}
    # Reject them here, where the file's name is known.
    rig_from_values(values, params_file)
    return values


def namespace_option(parser: argparse._ActionsContainer) -> None:
    """Add ``--namespace``, for the commands that read a recording."""
    parser.add_argument(
        '--namespace',
        metavar='/NAME',
        help='namespace of the recorded node, for a bag of several rigs (the only one is found by itself)',
    )


def span_options(parser: argparse._ActionsContainer) -> None:
    """Add --from and --to, for a part of a recording: ``args.span``."""
    parser.set_defaults(span=FULL)
    for at, (option, words) in enumerate((('--from', 'from'), ('--to', 'up to'))):
        parser.add_argument(
            option,
            action=_SpanEnd,
            at=at,
            dest='span',
            metavar='TIME',
            help=f'only what was recorded {words} this time: s from the first sample, a time as 2026-11-24T14:03:10, '
            'or mark:TEXT',
        )


class _SpanEnd(argparse.Action):
    """Reads one end of ``span``."""

    def __init__(self, *args: Any, at: int, **named: Any) -> None:
        super().__init__(*args, **named)
        self._at = at

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        ends = list(namespace.span)
        ends[self._at] = _bound(str(option), values)
        namespace.span = tuple(ends)


def _bound(option: str, text: str) -> Bound:
    if text.startswith(MARK_WORD):
        return text
    try:
        seconds = plain_number(text)
    except ValueError:
        try:
            return datetime.fromisoformat(text).astimezone()
        except (ValueError, OverflowError, OSError):
            raise UsageError(
                f'{option} {text}: must be s from the first sample, a time such as 2026-11-24T14:03:10, or mark:TEXT'
            ) from None
    if not abs(seconds) <= LONGEST_SPAN_S:
        raise UsageError(f'{option} {text}: must be at most {LONGEST_SPAN_S:g} s')
    return seconds


def world_option(parser: argparse._ActionsContainer) -> None:
    """Add --world, which :func:`in_the_world` reads."""
    parser.add_argument(
        '--world',
        metavar='NAME=VALUE',
        action='append',
        default=[],
        help='what a parameter really is on the simulated rig, if the rig file has it wrong; repeatable: '
        "--world 'psd_1.axes=[x, -y]'",
    )


def in_the_world(rig: Rig, words: Sequence[str]) -> Rig:
    """The simulated rig: ``rig`` with the values of --world. Raises UsageError."""
    values: dict[str, object] = {}
    for word in words:
        name, equals, text = word.partition('=')
        if not equals:
            raise UsageError(f'--world {word}: must be NAME=VALUE')
        try:
            values[name.strip()] = parse_yaml(text)
        except YamlError as error:
            raise UsageError(f'--world {word}: {error}') from None
    with given_as_option():
        return replace_values(rig, values, '--world')


def recording_name(*other_suffixes: str, to_look_at: bool = False) -> Callable[[str], str]:
    """Reads the --out of a recording, whose ending may be one of ``other_suffixes``; what it gives raises UsageError.

    ``to_look_at``: whether it may be of a format that cannot be read back.
    """

    def read(text: str) -> str:
        suffix = Path(text).suffix.lower()
        if suffix in FOREIGN and suffix not in other_suffixes:
            written = (f for f in formats() if f.write and (to_look_at or f.read))
            endings = [*(ending for f in written for ending in f.suffixes), *other_suffixes]
            if suffix in endings:
                return text
            files = ', '.join(f'X{ending}' for ending in endings)
            raise UsageError(f'--out {text}: {suffix} cannot be written; use {files} or a bag folder (X)')
        return text

    return read


def parquet_name(text: str) -> str:
    """The --out of a table of many recordings; raises UsageError."""
    if not is_parquet(text):
        raise UsageError(f'--out {text}: the name must end in {ENDING}')
    return text


def picture_name(*suffixes: str) -> Callable[[str], str]:
    """Reads the --out of a picture by its ending; what it gives raises UsageError."""

    def read(text: str) -> str:
        if Path(text).suffix.lower() not in suffixes:
            raise UsageError(f'--out {text}: the name must end in {", ".join(suffixes[:-1])} or {suffixes[-1]}')
        return text

    return read


def picture_or_folder(*suffixes: str) -> Callable[[str], str]:
    """Reads an --out that is a picture by its ending, or a folder, which has none; what it gives raises UsageError."""
    picture = picture_name(*suffixes)
    return lambda text: text if not Path(text).suffix or Path(text).is_dir() else picture(text)


def need_folder(out: Path) -> None:
    """Raise RecordingError, before the work is done, if the folder of ``out`` does not exist."""
    if not out.parent.is_dir():
        raise RecordingError(f'--out {out}: cannot be written (there is no folder {out.parent})')


def make_folder(out: str) -> Path:
    """The folder of --out, made if it is not there. Raises RecordingError."""
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(f'--out {out}: cannot be made a folder ({error.strerror or error})') from None
    return folder


def make_writable(out: str) -> Path:
    """As :func:`make_folder`, before work that takes its time: RecordingError also if nothing can be written there."""
    folder = make_folder(out)
    if not os.access(folder, os.W_OK):
        raise RecordingError(f'--out {out}: cannot be written in; give another folder')
    return folder


def reject(args: argparse.Namespace, defaults: Mapping[str, object], why: str) -> None:
    """Raise UsageError if one of the options ``defaults`` has another value: it would be ignored silently."""
    for name, default in defaults.items():
        if getattr(args, name) != default:
            raise UsageError(f'--{name.replace("_", "-")} {why}')


NEEDED_BYTES = 65_536
"""The tracing of ROS 2 maps two pages of shared memory as it is imported; without room the system ends it by SIGBUS."""


def require_ros(otherwise: str = '') -> None:
    """Raise ConfigError if rclpy is not installed, MachineError if shared memory is full. ``otherwise``: what to do
    instead, from ', ' on."""
    if importlib.util.find_spec('rclpy') is None:
        raise ConfigError(
            f"rclpy is not installed: source your ROS 2, or `pip install 'psd_deflection[ros]'`{otherwise}"
        )
    free = shared_memory_left()
    if free < NEEDED_BYTES:
        raise MachineError(
            f'{SHARED_MEMORY} has {free} bytes left, ROS 2 needs {NEEDED_BYTES}: delete what nobody uses there, or '
            f'make it larger (docker run --shm-size){otherwise}'
        )
