# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``discover --next`` and ``--run``: the limits in words, what to type, recordings of a simulated rig."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from psd_deflection.base.errors import UsageError
from psd_deflection.base.numbers import plain_number
from psd_deflection.cli._options import in_the_world, reject, world_option
from psd_deflection.cli._values import given_as_option, integer
from psd_deflection.model.simulation.effect_words import with_effects
from psd_deflection.recordings.replay.simulated_run import SimulatedRun
from psd_deflection.recordings.write.sinks import open_sink
from psd_deflection.records import AppliedLoad, Record, TemperatureReading
from psd_deflection.rig.config import Rig, replace_values
from psd_deflection.studies.discover.experiment import Limits
from psd_deflection.studies.discover.from_recordings import read_observation
from psd_deflection.studies.discover.loop import LISTED, SCRIPT, recorded_name
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.discover.planning import Plan

HELP = """\
limits of --next (--limit NAME=VALUE), with what holds if they are not given:
  force=50         largest force, N
  torque=29.25     largest torque, N m; 0 if there is none but by the sidebar
  sidebar=0.585    farthest place of a weight from the link, m; 0 for none
  sideways=yes     whether forces may pull along X and up; no: weights only
  sweep=150        highest frequency of an exciter, Hz; 0 for none
  swing=10         how far the temperature can be raised and lowered, K
  lengths=...      links that can be mounted, m, such as 0.4,0.5 (default: 0.7
                   of the rig's; none: lengths=)
  rates=           further sample rates, Hz, such as 2000
  seconds=60       longest recording
"""
_BOUNDS = {
    'force': (0.0, 1e5),
    'torque': (0.0, 1e5),
    'sidebar': (0.0, 100.0),
    'sweep': (0.0, 1e5),
    'swing': (0.0, 100.0),
    'seconds': (5.0, 600.0),
}
_LISTS = {'lengths': (0.01, 100.0), 'rates': (10.0, 1e5)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    group = parser.add_argument_group('the next recording')
    group.add_argument('--next', action='store_true', help='plan the recording that best tells apart what is left')
    group.add_argument(
        '--limit', metavar='NAME=VALUE', action='append', default=[], help='what the rig can do, see below; repeatable'
    )
    group.add_argument(
        '--run',
        # ``run`` is the command itself.
        dest='make_it',
        action='store_true',
        help='make the planned recordings on the simulated rig, until the answer is unique or no recording would help',
    )
    group.add_argument(
        '--at-most',
        type=integer('--at-most', 1, 20),
        default=3,
        metavar='N',
        help='recordings that --run makes (default 3)',
    )
    group.add_argument(
        '--effect', metavar='NAME,KEY=VALUE,...', action='append', default=[], help='of the simulated rig; repeatable'
    )
    world_option(group)


def limits(args: argparse.Namespace) -> Limits:
    """The limits of --limit. Raises UsageError for options that do not belong together."""
    if args.make_it and not args.next:
        raise UsageError('--run is for --next')
    if not args.next:
        reject(args, {'limit': []}, 'is for --next')
    if not args.make_it:
        reject(args, {'effect': [], 'world': [], 'at_most': 3}, 'is for the simulated rig of --next --run')
    return limits_from_words(args.limit)


def limits_from_words(words: Sequence[str]) -> Limits:
    """The limits of ``--limit``. Raises UsageError naming the word and its bounds."""
    given: dict[str, Any] = {}
    for word in words:
        name, equals, text = word.partition('=')
        names = [f.name for f in dataclasses.fields(Limits)]
        if not equals or name not in names:
            raise UsageError(f'--limit {word}: must be NAME=VALUE with one of {", ".join(names)}')
        if name == 'sideways':
            if text not in ('yes', 'no'):
                raise UsageError(f'--limit {word}: must be yes or no')
            given[name] = text == 'yes'
            continue
        low, high = {**_BOUNDS, **_LISTS}[name]
        try:
            values = tuple(plain_number(t) for t in text.split(',')) if text else ()
        except ValueError:
            values = (float('nan'),)
        if not all(low <= v <= high for v in values) or (name in _BOUNDS and len(values) != 1):
            kind = 'numbers' if name in _LISTS else 'a number'
            raise UsageError(f'--limit {word}: must be {kind} of at least {low:g} and at most {high:g}')
        given[name] = values if name in _LISTS else values[0]
    return dataclasses.replace(Limits(), **given)


def how(plan: Plan, out: Path) -> list[str]:
    """What to type to make a planned recording, whose loads are in the folder ``out``."""
    words = ['psd-deflection', 'simulate', '--out', str(out / 'next.csv'), '--loads', str(out / SCRIPT)]
    if plan.setting.swing:
        words += ['--temperature', ','.join(f'{k:g}' for k in plan.setting.knots)]
    for name, value in plan.setting.changes.items():
        words += ['--world', f'{name}={value}']
    return [
        f'load script: {out / SCRIPT}; save the recording as {out / "next.csv"}; on the simulated rig:',
        f'  {shlex.join(words)}',
        f'then search again in the recordings so far and {out / LISTED}',
    ]


def simulated(args: argparse.Namespace, rig: Rig, out: Path) -> Callable[[Plan, int], Observation]:
    """Makes a planned recording on the simulated rig: ``rig`` with what --effect and --world say.

    Raises UsageError for a bad option, before anything is recorded.
    """
    with given_as_option():
        with_effects(in_the_world(rig, args.world), args.effect, '--effect')

    def record(plan: Plan, number: int) -> Observation:
        known = replace_values(rig, plan.setting.changes) if plan.setting.changes else rig
        true = with_effects(in_the_world(known, args.world), args.effect, '--effect')
        loads = plan.loads
        warm = plan.setting.temperature(len(loads))
        kinds: list[type[Record]] = [AppliedLoad]
        kinds += [TemperatureReading] * (warm is not None)
        path = out / recorded_name(number)
        run = SimulatedRun(true, known, loads, warm, args.seed + number)
        with contextlib.closing(open_sink(path, known.flat(), samples_with=kinds, psds=len(known.psds))) as sink:
            for each in run.records(0):
                sink.put(each)
        return read_observation(path, known)

    return record
