# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find the physical effect that the simulation of a recording lacks, and add it to the model.

REC is a bag folder, an .mcap or a .csv that contains the loads (and the temperatures). You may give
several, or a .yaml list of recordings with the parameters that differ in each:

  - recording: short.csv
    overrides: {link.length: 0.4}

DIR gets model.yaml (the rig with the effects found; use it as --params-file), report.html and
result.json. Where no effect fits, DIR also gets law.yaml: an empirical law for what remains. With --adopt NAME
the law becomes an effect of yours, and model.yaml has it. The exit status is 0 whatever was found.

With --next, DIR also gets next_loads.csv: the loads of the recording that best tells apart the effects that
explain these recordings equally well; simulate --loads takes it. With --run that recording is made on the
simulated rig and searched, and so on, until the answer is unique or no recording within the limits would help.

With --isolable LOADS nothing is recorded: it says which effects a recording of the rig under these loads could tell
apart, each from which size on, and what imitates it. LOADS are words as in simulate --loads.

REC may also be a table of readings: a .csv with one row for each load that was hung on the link, and no times. Such
tables have no set-up check, law or --next.

A table of another machine: --inputs and --outputs name its columns, and the answer is which terms of the inputs
(powers, sines and cosines of angles, products; sizes in the units of the columns) the outputs follow. Rows with
the same text in column --parts are held out together. DIR gets no model.yaml.

All REC together are one experiment. With --each every REC, or .yaml list, is one for itself: DIR/REC gets its files, or
X.parquet a row. REC may then be a pattern, or a .txt file that lists recordings and patterns.

  psd-deflection discover odd.csv --out found
  psd-deflection discover a.csv b.csv --params-file my_rig.yaml --out found
  psd-deflection discover odd.csv --out found --next --limit lengths=0.4,0.5
  psd-deflection discover 'archive/*' --each --executor processes --out found
  psd-deflection discover --isolable thesis:1 --out before
  psd-deflection discover mount.csv --inputs 'az [deg],el [deg]' --outputs 'error [arcsec]' --parts star --out terms
"""

import argparse
import contextlib
import dataclasses
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from psd_deflection import discover_in
from psd_deflection.base.errors import ConfigError, RecordingError, UsageError
from psd_deflection.base.log import Note
from psd_deflection.base.text import plain_number
from psd_deflection.cli._many import FLEET, absolute, each_for_itself, each_option
from psd_deflection.cli._options import (
    in_the_world,
    make_writable,
    namespace_option,
    reject,
    span_options,
    world_option,
)
from psd_deflection.cli._progress import stage
from psd_deflection.cli._report import save, save_all, show, warn
from psd_deflection.cli._values import given_as_option, integer, seed
from psd_deflection.cli.studies._answer import print_answer
from psd_deflection.model.simulation.catalogue import effect_folders, effect_names, with_effects
from psd_deflection.model.simulation.loads import load_history
from psd_deflection.recordings.formats.format import open_sink
from psd_deflection.recordings.observation import Observation, read_observation
from psd_deflection.recordings.replay.simulated_recording import SimulatedRun
from psd_deflection.recordings.spans import FULL
from psd_deflection.recordings.write.parquet import ERROR, Field
from psd_deflection.records import AppliedLoad, Record, TemperatureReading
from psd_deflection.rig.config import Rig, load_rig, replace_values
from psd_deflection.studies.discover.conclusion import Conclusion, adopting_folder
from psd_deflection.studies.discover.experiment import Limits
from psd_deflection.studies.discover.from_recordings import DiscoverOptions
from psd_deflection.studies.discover.isolable import isolable
from psd_deflection.studies.discover.loop import LISTED, SCRIPT, LoopResult, planned, recorded_name, run_loop
from psd_deflection.studies.discover.planning import Plan
from psd_deflection.studies.discover.rehearsal import RehearsalOutcome, rehearsals
from psd_deflection.studies.discover.report import Discovery
from psd_deflection.studies.study import StudyResult

_NEXT_HELP = """\
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


def _next_arguments(parser: argparse.ArgumentParser) -> None:
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


def _limits_of(args: argparse.Namespace) -> Limits:
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


def how_to_record(plan: Plan, out: Path) -> list[str]:
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


def _recorder(args: argparse.Namespace, rig: Rig, out: Path) -> Callable[[Plan, int], Observation]:
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


STEPS = 8
"""Steps that the progress bar counts: described, signatures, adding, weighing, alternatives, where, report, done.

Planning and further searches go on at its end."""

FIELDS = (
    *(ERROR, Field('verdict', str), Field('effects', str), Field('unknown', int), Field('setup', str)),
    *(Field(f'gap_{name}', float, 'm') for name in ('before', 'after', 'floor')),
    *(Field(f'heldout_{name}', float, 'm') for name in ('before', 'after')),
    *(Field('simulations', int), Field('result', str)),
)
"""Columns of --each. ``result`` is the content of result.json."""

HEAD = ('verdict', 'effects', 'gap before (um)', 'after', 'floor')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('recordings', metavar='REC', nargs='*', help='recordings, or .yaml lists of them')
    parser.add_argument(
        '--params-file', metavar='RIG.yaml', help='the rig as it is known (default: the parameters in the recording)'
    )
    parser.add_argument('--out', metavar='DIR', required=True, help='folder for model.yaml, report.html, result.json')
    each_option(parser)
    parser.add_argument(
        '--seed', type=seed, default=0, help='seed of the bootstraps; the same gives the same answer (default 0)'
    )
    parser.add_argument(
        '--without', metavar='EFFECT', action='append', default=[], help='do not consider this effect; repeatable'
    )
    parser.add_argument(
        '--rehearse',
        metavar='N',
        type=integer('--rehearse', 1, 10_000),
        help='measure the confidence: simulate what was found N times, with the loads, gaps and noise of REC, and '
        'search each simulation; the answer reports how often it was found again (N searches; --executor shares them)',
    )
    parser.add_argument(
        '--isolable', metavar='LOADS', help='without REC: which effects a recording under these loads could tell apart'
    )
    parser.add_argument(
        '--adopt',
        metavar='NAME',
        help='if a law is found, write it as the effect NAME to the folder of your effects and into model.yaml',
    )
    group = parser.add_argument_group('a table of another machine')
    group.add_argument('--inputs', metavar='COLUMN,...', help='columns that may determine the outputs')
    group.add_argument('--outputs', metavar='COLUMN,...', help='columns that were measured')
    group.add_argument('--parts', metavar='COLUMN', default='', help='rows with the same text are held out together')
    _next_arguments(parser)
    parser.epilog = _NEXT_HELP
    span_options(parser)
    namespace_option(parser)
    parser.add_argument('--quiet', action='store_true', help='no progress bar')
    parser.add_argument('--json', action='store_true', help='print the content of result.json')


def run(args: argparse.Namespace) -> int:
    """Read, discover, write, and say it in a sentence."""
    asked = _options(args)
    if args.isolable is not None:
        return _before(args, asked)
    if not args.recordings:
        raise UsageError('REC: needed: one recording or several; --isolable LOADS needs none')
    if args.inputs or args.outputs:
        return _in_csv(args)
    names = each_for_itself(args)
    if names is not None:
        reject(args, {'next': False}, 'is not for --each')
        return _each(args, names, asked)
    limits = _limits_of(args)
    if args.adopt is not None:
        try:
            adopting_folder(args.adopt)
        except ConfigError as error:
            raise UsageError(f'--adopt {error}') from None
    if tables := asked.tables(args.recordings, warn):
        reject(args, {'next': False, 'adopt': None}, 'is for recordings of samples, not for readings of a link at rest')
        if args.span != FULL:
            raise UsageError('--from, --to: are for recordings of samples, not for readings of a link at rest')
        make_writable(args.out)
        with stage('searching', quiet=args.quiet or args.json):
            in_tables = asked.discovered_in_tables(tables, warn)
        return _answered(args, in_tables, in_tables.files(), [])
    with stage('reading', quiet=args.quiet or args.json):
        try:
            observations = asked.read(args.recordings, warn)
        except RecordingError as error:
            if 'the header lacks' not in str(error):
                raise
            raise RecordingError(f'{error}; of another machine? Name its columns by --inputs and --outputs') from None
    make_writable(args.out)
    with _progress(args) as progress:
        discovery = _searched(args, asked, observations, limits, progress)
        if args.adopt is not None:
            discovery = discovery.adopt(args.adopt)
        progress('report')
        files = discovery.files()
    return _answered(args, discovery, files, _hints(args, discovery))


def _in_csv(args: argparse.Namespace) -> int:
    """Search one table of another machine."""
    if len(args.recordings) > 1 or not (args.inputs and args.outputs):
        raise UsageError('--inputs, --outputs: both are needed, and one table')
    reject(args, {'adopt': None, 'each': False, 'next': False, 'params_file': None}, 'is for recordings of the rig')
    make_writable(args.out)
    with stage('searching', quiet=args.quiet or args.json):
        columns = {'inputs': args.inputs.split(','), 'outputs': args.outputs.split(',')}
        discovery = discover_in(args.recordings[0], **columns, parts=args.parts, seed=args.seed)
    return _answered(args, discovery, discovery.files(), [])


def _before(args: argparse.Namespace, asked: DiscoverOptions) -> int:
    if args.recordings:
        raise UsageError(f'{args.recordings[0]}: --isolable {args.isolable} needs no recording')
    reject(args, dict.fromkeys(('each', 'next', 'make_it'), False), 'needs a REC')
    reject(args, dict.fromkeys(('adopt', 'namespace', 'rehearse')), 'needs a REC')
    if args.span != FULL:
        raise UsageError('--from, --to: need a REC')
    rig = asked.rig() or load_rig()
    with given_as_option():
        loads = load_history(args.isolable, rig.converter.sample_rate_hz, '--isolable').loads
    make_writable(args.out)
    file = 'the thesis rig' if args.params_file is None else args.params_file
    with _progress(args) as progress:
        answer = isolable(rig, loads, args.isolable, without=args.without, params_file=file, progress=progress)
        progress('report')
        files = answer.files()
    return _answered(args, answer, files, [])


def _options(args: argparse.Namespace) -> DiscoverOptions:
    """What is asked; raises for what is wrong in it before the search, which takes its time."""
    for name in args.without:
        if name not in effect_names():
            raise UsageError(f'--without {name}: no effect of that name; there are: {", ".join(effect_names())}')
    if args.params_file is not None:
        load_rig(args.params_file)
    return DiscoverOptions(
        known=absolute(args.params_file),
        namespace=args.namespace,
        seed=args.seed,
        without=tuple(args.without),
        span=args.span,
    )


@contextlib.contextmanager
def _progress(args: argparse.Namespace) -> Iterator[Callable[[str], None]]:
    # Reading took most of what can be foreseen; a search has as many steps as it has effects to weigh.
    hidden = True if args.quiet or args.json else None
    with tqdm(total=STEPS, disable=hidden, file=sys.stderr, bar_format='{l_bar}{bar}| {elapsed}') as bar:

        def progress(words: str) -> None:
            bar.set_description_str(words)
            if bar.n < STEPS - 1:
                bar.update()

        yield progress
        bar.set_description_str('done')
        bar.update(STEPS - bar.n)


def _searched(
    args: argparse.Namespace,
    asked: DiscoverOptions,
    observations: Sequence[Observation],
    limits: Limits,
    progress: Callable[[str], None],
) -> Discovery | LoopResult:
    search = partial(asked.discovered, progress=progress, notify=warn)
    if args.make_it:
        record = _recorder(args, asked.rig() or observations[0].rig, Path(args.out))
        return run_loop(observations, search, record, limits=limits, most=args.at_most, progress=progress)
    discovery = search(observations)
    progress('planning')
    return planned(discovery, limits) if args.next else discovery


def _rehearsed(args: argparse.Namespace, answer: Conclusion | LoopResult) -> Conclusion | LoopResult:
    """``answer``, which is on the disk already, with its rehearsals: after Ctrl-C, with those that had ended."""
    discovery: Any = answer.discovery if isinstance(answer, LoopResult) else answer
    tasks, outcomes = rehearsals(discovery, args.rehearse), list[RehearsalOutcome]()
    with tqdm(total=args.rehearse, unit=' rehearsals', leave=False, disable=args.quiet or args.json or None) as bar:
        try:
            for outcome in FLEET.results_of(tasks, args.executor) if args.executor else (task() for task in tasks):
                outcomes.append(outcome)
                bar.update()
        except KeyboardInterrupt:
            warn(Note(f'--rehearse {args.rehearse}: interrupted after {len(outcomes)}; the answer is complete'))
    discovery = discovery.rehearsed(outcomes) if outcomes else discovery
    return dataclasses.replace(answer, discovery=discovery) if isinstance(answer, LoopResult) else discovery


def _answered(args: argparse.Namespace, answer: StudyResult, files: Mapping[str, str], hints: Sequence[str]) -> int:
    save_all(files, Path(args.out))
    if args.rehearse is not None and isinstance(answer, Conclusion | LoopResult):
        answer = _rehearsed(args, answer)
        for name, text in answer.files().items():
            save(text.encode(errors='replace'), Path(args.out) / name)
    print_answer(args, answer)
    show(*hints, f'see {Path(args.out) / "report.html"}', aside=args.json)
    return 0


def _hints(args: argparse.Namespace, answer: Discovery | LoopResult) -> list[str]:
    """What to type next."""
    out, discovery = Path(args.out), answer.discovery if isinstance(answer, LoopResult) else answer
    hints = []
    if args.adopt is not None and discovery.model_of_law is None:
        hints.append(f'--adopt {args.adopt}: there is no law to adopt')
    elif args.adopt is not None:
        hints.append(f'{args.adopt} is an effect now: {effect_folders()[0] / args.adopt}.yaml')
    elif discovery.model_of_law is not None:
        hints.append(f'law: {out / "law.yaml"}; --adopt NAME makes it an effect')
    if isinstance(answer, LoopResult):
        if answer.outcome is None and answer.open is not None and answer.open.useful:
            hints += how_to_record(answer.open, out)
    elif discovery.unsettled:
        hints.append(f'next: {_planning(args)} plans the recording that tells {_distinguished(discovery)}')
    if discovery.effects and discovery.verdict == 'effects_found' and not (discovery.unsettled and not args.next):
        hints.append(
            f'next: psd-deflection estimator --params-file {out / "model.yaml"} corrects readings for what it can'
        )
    return hints


def _planning(args: argparse.Namespace) -> str:
    """The same command with --next."""
    words = ['psd-deflection', 'discover', *args.recordings]
    options = [('--params-file', args.params_file), ('--namespace', args.namespace), ('--seed', args.seed or None)]
    options += [*(('--without', name) for name in args.without), *zip(('--from', '--to'), args.span, strict=True)]
    for option, value in options:
        if value is not None:
            text = value.isoformat() if isinstance(value, datetime) else str(value)
            # A time before the first sample would be taken for an option.
            words += [f'{option}={text}'] if text.startswith('-') else [option, text]
    return shlex.join([*words, '--out', str(args.out), '--next'])


def _distinguished(discovery: Discovery) -> str:
    """Each cause that is named from what explains the recordings as well."""
    named = [(e.name, e.equivalent) for e in discovery.effects] + [(f.name, f.equivalent) for f in discovery.setup]
    open_causes = [(name, [c for c in causes if c in discovery.unsettled]) for name, causes in named]
    apart = [f'{name} from {", ".join(causes)}' for name, causes in open_causes if causes]
    return ' and '.join(apart) or f'{", ".join(discovery.unsettled)} apart'


def answer_of(path: str, asked: DiscoverOptions, rehearse: int | None = None) -> Any:
    """The task for one of many recordings, with so many rehearsals; its TaskResult."""
    warnings: list[str] = []
    discovery = asked.discovered(asked.read([path], warnings.append), notify=warnings.append)
    discovery = discovery.rehearse(rehearse) if rehearse else discovery
    files = discovery.files()
    cells: dict[str, object] = {
        'verdict': discovery.verdict,
        'effects': ', '.join(e.active.label for e in discovery.effects),
        'unknown': len(discovery.unknown),
        'setup': '; '.join(f'{f.name} {f.where}' for f in discovery.setup),
        'gap_before': discovery.gap_before,
        'gap_after': discovery.gap_after,
        'gap_floor': discovery.gap_floor,
        'heldout_before': discovery.gap_heldout_before,
        'heldout_after': discovery.gap_heldout_after,
        'simulations': discovery.simulations,
        'result': files['result.json'],
    }
    return FLEET.TaskResult(files, cells, warnings)


def _each(args: argparse.Namespace, names: list[str], asked: DiscoverOptions) -> int:
    if args.adopt is not None:
        raise UsageError(f'--adopt {args.adopt}: not with --each, which may find many laws; adopt one by itself')
    work = partial(answer_of, asked=asked, rehearse=args.rehearse)
    answered: int = FLEET.answer_each(args, names, work, FIELDS, HEAD, _line)
    return answered


def _line(cells: Mapping[str, Any]) -> list[str]:
    effects = cells['effects'] or '-'
    return [cells['verdict'], effects, *(f'{cells[key] * 1e6:.2f}' for key in ('gap_before', 'gap_after', 'gap_floor'))]
