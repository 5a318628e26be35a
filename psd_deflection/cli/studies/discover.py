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

REC may also be a table of readings: a .csv with one row for each load that was hung on the link, and no times. Such
tables have no set-up check, law or --next.

All REC together are one experiment. With --each every REC, or .yaml list, is one for itself: DIR/REC gets its files, or
X.parquet a row. REC may then be a pattern, or a .txt file that lists recordings and patterns.

  psd-deflection discover odd.csv --out found
  psd-deflection discover a.csv b.csv --params-file my_rig.yaml --out found
  psd-deflection discover odd.csv --out found --next --limit lengths=0.4,0.5
  psd-deflection discover 'archive/*' --each --executor processes --out found
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from psd_deflection import __version__
from psd_deflection.base.errors import UsageError
from psd_deflection.cli import _next
from psd_deflection.cli._fleet import (
    ERROR,
    TaskResult,
    absolute,
    answer_each,
    each_for_itself,
    each_option,
    recordings_argument,
)
from psd_deflection.cli._options import make_folder, make_writable, namespace_option, refuse, seed, span_options
from psd_deflection.cli._progress import told
from psd_deflection.cli._report import save, save_all, show, show_text, warn
from psd_deflection.model.simulation.catalogue import FOLDERS, effect_folders, effect_names, effects_to_values
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.laws import Law, effect_of, law_text, values_of
from psd_deflection.recordings.recording import WHOLE, Span
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.rig.parameter_files import with_effects_section, with_values
from psd_deflection.run.fleet.parquet import Field
from psd_deflection.studies.discover.discover import Discovery, discover
from psd_deflection.studies.discover.from_recordings import read_observations, read_tables
from psd_deflection.studies.discover.loop import Settled, next_of, settle
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.discover.plants import discover_in
from psd_deflection.studies.discover.readings import Readings, ReadingsPlant
from psd_deflection.studies.discover.report import report_html
from psd_deflection.studies.discover.result import result, sentence
from psd_deflection.studies.study import described, edited_rig_file

STEPS = 8
"""Steps that the progress bar counts: described, signatures, adding, weighing, alternatives, where, report, done.

Planning and further searches go on at its end."""

FIELDS = (
    ERROR,
    Field('verdict', str),
    Field('effects', str),
    Field('unknown', int),
    Field('setup', str),
    Field('gap_before', float, 'm'),
    Field('gap_after', float, 'm'),
    Field('gap_floor', float, 'm'),
    Field('heldout_before', float, 'm'),
    Field('heldout_after', float, 'm'),
    Field('simulations', int),
    Field('result', str),
)
"""Columns of --each. ``result`` is the content of result.json."""

HEAD = ('verdict', 'effects', 'gap before (um)', 'after', 'floor')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    recordings_argument(parser, 'recordings, or .yaml lists of them')
    parser.add_argument(
        '--params-file', metavar='RIG.yaml', help='the rig as it is known (default: the parameters in the recording)'
    )
    parser.add_argument('--out', metavar='DIR', required=True, help='folder for model.yaml, report.html, result.json')
    each_option(parser)
    parser.add_argument(
        '--seed', type=seed, default=0, help='seed of the bootstraps; the same gives the same answer (default 0)'
    )
    parser.add_argument(
        '--without',
        metavar='EFFECT',
        action='append',
        default=[],
        help='do not consider this effect; repeatable',
    )
    parser.add_argument(
        '--adopt',
        metavar='NAME',
        help='if a law is found, write it as the effect NAME to the folder of your effects and into model.yaml',
    )
    _next.add_arguments(parser)
    parser.epilog = _next.HELP
    span_options(parser)
    namespace_option(parser)
    parser.add_argument('--quiet', action='store_true', help='no progress bar')
    parser.add_argument('--json', action='store_true', help='print the content of result.json')


def run(args: argparse.Namespace) -> int:
    """Read, discover, write, and say it in a sentence."""
    for name in args.without:
        if name not in effect_names():
            raise UsageError(f'--without {name}: no effect of that name; there are: {", ".join(effect_names())}')
    if args.params_file is not None:
        # Before the search, which takes its time.
        load_rig(args.params_file)
    asked = SearchOptions(
        absolute(args.params_file), args.namespace, args.seed, tuple(args.without), args.adopt, args.span
    )
    names = each_for_itself(args)
    if names is not None:
        refuse(args, {'next': False}, 'is not for --each')
        return _each(args, names, asked)
    folder = None if args.adopt is None else _adopting(args.adopt)
    limits = _next.limits_from_words(args.limit)
    if args.make_it and not args.next:
        raise UsageError('--run is for --next')
    if not args.next:
        refuse(args, {'limit': []}, 'is for --next')
    if not args.make_it:
        refuse(args, {'effect': [], 'world': [], 'at_most': 3}, 'is for the simulated rig of --next --run')
    out = Path(args.out)
    tables = asked.tables(args.recordings, warn)
    if tables:
        return _tables(args, asked, tables)
    with told('reading', quiet=args.quiet or args.json):
        observations = asked.read(args.recordings, warn)
    make_writable(args.out)
    # Reading took most of what can be foreseen; a search has as many steps as it has effects to weigh.
    hidden = True if args.quiet or args.json else None
    with tqdm(total=STEPS, disable=hidden, file=sys.stderr, bar_format='{l_bar}{bar}| {elapsed}') as bar:

        def progress(words: str) -> None:
            bar.set_description_str(words)
            if bar.n < STEPS - 1:
                bar.update()

        done: Settled | None = None
        if args.make_it:
            rig = asked.rig(observations)
            record = _next.simulated(args, rig, out)
            done = settle(
                observations,
                rig,
                record,
                limits=limits,
                most=args.at_most,
                seed=args.seed,
                without=args.without,
                progress=progress,
            )
            found, plan = done.found, done.open
        else:
            found = asked.discover(observations, progress)
            progress('planning')
            plan = next_of(found, limits) if args.next else None
        progress('report')
        page = report_html(found)
        bar.set_description_str('done')
        bar.update(STEPS - bar.n)
    laws = asked.laws(found)
    adopted: list[Path] = []
    if folder is not None and laws:
        make_folder(str(folder))
        adopted = [folder / f'{law.name}.yaml' for law in laws]
        for law, path in zip(laws, adopted, strict=True):
            save(_law_file(law).encode(), path)
    files = asked.files(observations, found, page)
    if args.next:
        tree = {**json.loads(files['result.json']), 'next': None if plan is None else plan.tree()}
        if done is not None:
            made = [{'file': f'next_{i}.csv', **p.tree()} for i, p in enumerate(done.plans, start=1)]
            tree['run'] = {'outcome': done.outcome, 'sentence': done.sentence, 'recordings': made}
            _next.write_list([(f'next_{i}.csv', p) for i, p in enumerate(done.plans, start=1)], out)
        files['result.json'] = json.dumps(tree, indent=1, allow_nan=False) + '\n'
    how = _next.write_plan(plan, out) if plan is not None and plan.useful and done is None else []
    save_all(files, out)
    if args.json:
        print(files['result.json'].removesuffix('\n'))  # noqa: T201 - no control characters, and its lines may be long
        return 0
    show(sentence(found))
    for finding in found.setup:
        show(f'set-up: {finding.name} {finding.where}: {finding.fix}')
    for effect in found.effects:
        if effect.suggestion is not None:
            show(f'to tell {effect.active.effect.name} from {", ".join(effect.equivalent)}: {effect.suggestion.text}')
    for unknown in found.unknown:
        show(f'unknown: {unknown.signature}')
    for path in adopted:
        show(f'{path.stem} is an effect now: {path}')
    if laws and args.adopt is None:
        show(f'law: {out / "law.yaml"}; --adopt NAME makes it an effect')
    elif args.adopt is not None and not laws:
        show(f'--adopt {args.adopt}: there is no law to adopt')
    if done is not None:
        for i, p in enumerate(done.plans, start=1):
            show(f'{out / f"next_{i}.csv"}: {p.words}')
        show(done.sentence)
    elif plan is not None:
        show('', plan.sentence, '')
        show_text(_next.plan_table(plan))
        show('', *how)
    elif args.next:
        show('No other effect explains the recordings as well: there is nothing to tell apart by a further one.')
    if args.next is False and found.unsettled:
        show('next: psd-deflection discover with these recordings and --next plans the recording that tells')
    elif found.effects and found.verdict == 'effects_found':
        show(f'next: psd-deflection estimator --params-file {out / "model.yaml"} corrects readings for what it can')
    show(f'{found.simulations} forward simulations; see {out / "report.html"}')
    return 0


@dataclass(frozen=True, slots=True)
class SearchOptions:
    """What is asked of each search, as the options say it; goes to a worker."""

    params_file: str | None
    namespace: str | None
    seed: int
    without: tuple[str, ...]
    adopt: str | None = None
    span: Span = WHOLE

    def read(self, recordings: Sequence[str], tell: Callable[[str], None]) -> list[Observation]:
        """The recordings; ``tell`` is told what is odd."""
        given = None if self.params_file is None else load_rig(self.params_file)
        return read_observations(recordings, given, namespace=self.namespace, span=self.span, warn=tell, any_rate=True)

    def tables(self, recordings: Sequence[str], tell: Callable[[str], None]) -> list[Readings]:
        """The tables of readings; none if ``recordings`` are none."""
        given = None if self.params_file is None else load_rig(self.params_file)
        tables = read_tables(recordings, given, tell)
        if tables and self.span != WHOLE:
            raise UsageError('--from, --to: are for recordings; a table of readings has no times')
        return tables

    def rig(self, observations: Sequence[Observation]) -> Rig:
        """The known rig."""
        return observations[0].rig if self.params_file is None else load_rig(self.params_file)

    def discover(
        self, observations: Sequence[Observation], progress: Callable[[str], None] = lambda _: None
    ) -> Discovery:
        """The search."""
        return discover(observations, self.rig(observations), seed=self.seed, without=self.without, progress=progress)

    def laws(self, found: Discovery) -> list[Law]:
        """The laws that were found, by the name that they get."""
        return [] if found.law is None else found.law.adopted(self.adopt or 'law')

    def files(self, observations: Sequence[Observation], found: Discovery, page: str) -> dict[str, str]:
        """The files of --out by their names."""
        laws = self.laws(found)
        effects = _with_law(found, laws) if self.adopt is not None and laws else found.active_effects
        return {
            'model.yaml': _model(self.params_file, self.rig(observations), effects, found.lines),
            'result.json': json.dumps(result(found), indent=1, allow_nan=False) + '\n',
            'report.html': page,
            **{
                f'{law.name if self.adopt is None else law.name.replace(self.adopt, "law", 1)}.yaml': _law_file(law)
                for law in laws
            },
        }


def _tables(args: argparse.Namespace, asked: SearchOptions, tables: Sequence[Readings]) -> int:
    """The search in tables of readings."""
    refuse(args, {'next': False, 'adopt': None}, 'is for recordings: a table of readings has no times')
    make_writable(args.out)
    plant = ReadingsPlant(tables, asked.without)
    with told('searching', quiet=args.quiet or args.json):
        found = discover_in(plant, seed=asked.seed)
    rig = tables[0].rig if asked.params_file is None else load_rig(asked.params_file)
    effects = [*plant.known, *(e.active for e in found.effects)]
    files = {
        'model.yaml': _model(asked.params_file, rig, effects),
        'result.json': json.dumps(result(found), indent=1, allow_nan=False) + '\n',
        'report.html': report_html(found),
    }
    out = Path(args.out)
    save_all(files, out)
    if args.json:
        print(files['result.json'].removesuffix('\n'))  # noqa: T201 - no control characters, and its lines may be long
        return 0
    show(sentence(found))
    for unknown in found.unknown:
        show(f'unknown: {unknown.signature}')
    show(f'{found.simulations} forward simulations; see {out / "report.html"}')
    return 0


def answer_of(path: str, asked: SearchOptions) -> TaskResult:
    """The task for one of many recordings."""
    warnings: list[str] = []
    observations = asked.read([path], warnings.append)
    found = asked.discover(observations)
    files = asked.files(observations, found, report_html(found))
    cells: dict[str, object] = {
        'verdict': found.verdict,
        'effects': ', '.join(e.active.label for e in found.effects),
        'unknown': len(found.unknown),
        'setup': '; '.join(f'{f.name} {f.where}' for f in found.setup),
        'gap_before': found.gap_before,
        'gap_after': found.gap_after,
        'gap_floor': found.gap_floor,
        'heldout_before': found.gap_heldout_before,
        'heldout_after': found.gap_heldout_after,
        'simulations': found.simulations,
        'result': files['result.json'],
    }
    return TaskResult(files, cells, warnings)


def _each(args: argparse.Namespace, names: list[str], asked: SearchOptions) -> int:
    if args.adopt is not None:
        raise UsageError(f'--adopt {args.adopt}: not with --each, which may find many laws; adopt one by itself')
    return answer_each(args, names, partial(answer_of, asked=asked), FIELDS, HEAD, _line)


def _line(cells: Mapping[str, Any]) -> list[str]:
    effects = cells['effects'] or '-'
    return [cells['verdict'], effects, *(f'{cells[key] * 1e6:.2f}' for key in ('gap_before', 'gap_after', 'gap_floor'))]


def _adopting(name: str) -> Path:
    """The folder for the effect ``name``; raises UsageError before a search that could not be adopted."""
    if not name.isidentifier() or name.startswith('_'):
        raise UsageError(f'--adopt {name}: must be a name of letters, digits and underscores, such as base_yields')
    if name in effect_names():
        raise UsageError(f'--adopt {name}: there is an effect of that name; give another')
    folders = effect_folders()
    if not folders:
        raise UsageError(f'--adopt {name}: there is no folder for your effects; set {FOLDERS}')
    return folders[0]


def _law_file(law: Law) -> str:
    return law_text(
        law,
        (
            f'Found by psd-deflection discover {__version__}: no effect of the catalogue explains this.',
            f'Edit it, and put it as NAME.yaml, with name: NAME, into a folder of effects ({FOLDERS}).',
        ),
    )


def _with_law(found: Discovery, laws: Sequence[Law]) -> list[ActiveEffect]:
    """The effects of the model that has the law."""
    beside = [] if found.law is None else [a for a in found.law.beside if a.effect.name in effect_names()]
    return [*found.known, *beside, *(ActiveEffect(effect_of(law), values_of(law)) for law in laws)]


def _model(
    params_file: str | None,
    rig: Rig,
    effects: Sequence[ActiveEffect],
    lines: Mapping[str, object] | None = None,
) -> str:
    """The user's parameter file with the effects, comments kept; without one what describes the rig.

    ``lines``: what was wrong in the rig file, put right.
    """

    def edit(text: str, path: Path) -> str:
        text = with_effects_section(text, effects_to_values(effects), path)
        if not lines:
            return text
        return with_values(text, lines, f'Put right by psd-deflection {__version__}', path)

    return edited_rig_file(params_file, 'model.yaml', lambda: described(rig, effects), edit, warn)
