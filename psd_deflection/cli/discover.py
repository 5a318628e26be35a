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

  psd-deflection discover odd.csv --out found
  psd-deflection discover a.csv b.csv --params-file my_rig.yaml --out found
  psd-deflection discover odd.csv --out found --next --limit lengths=0.4,0.5
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from psd_deflection import __version__
from psd_deflection.cli import _next
from psd_deflection.cli._options import make_folder, namespace_option, refuse, seed
from psd_deflection.cli._progress import told
from psd_deflection.cli._report import save, show, show_text, warn
from psd_deflection.cli._rig_file import rig_file
from psd_deflection.config import Rig, load_rig
from psd_deflection.discovery.discover import Discovery, discover
from psd_deflection.discovery.loop import Settled, next_of, settle
from psd_deflection.discovery.report import report_html
from psd_deflection.discovery.result import model_yaml, result, sentence
from psd_deflection.errors import RecordingError, UsageError
from psd_deflection.parameter_files import with_effects_section, with_values
from psd_deflection.recordings.observations import read_observations
from psd_deflection.simulation.catalogue import FOLDERS, effect_folders, effect_names, effects_to_values
from psd_deflection.simulation.declaration import ActiveEffect
from psd_deflection.simulation.laws import Law, effect_of, law_text, values_of

STEPS = 8
"""Steps that the progress bar counts: described, signatures, adding, weighing, alternatives, where, report, done.

Planning and further searches go on at its end."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('recordings', metavar='REC', nargs='+', help='recordings, or .yaml lists of them')
    parser.add_argument(
        '--params-file', metavar='RIG.yaml', help='the rig as it is known (default: the parameters in the recording)'
    )
    parser.add_argument('--out', metavar='DIR', required=True, help='folder for model.yaml, report.html, result.json')
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
    namespace_option(parser)
    parser.add_argument('--quiet', action='store_true', help='no progress bar')
    parser.add_argument('--json', action='store_true', help='print the content of result.json')


def run(args: argparse.Namespace) -> int:
    """Read, discover, write, and say it in a sentence."""
    given = None if args.params_file is None else load_rig(args.params_file)
    for name in args.without:
        if name not in effect_names():
            raise UsageError(f'--without {name}: no effect of that name; there are: {", ".join(effect_names())}')
    folder = None if args.adopt is None else _adopting(args.adopt)
    limits = _next.limits_from_words(args.limit)
    if args.make_it and not args.next:
        raise UsageError('--run is for --next')
    if not args.next:
        refuse(args, {'limit': []}, 'is for --next')
    if not args.make_it:
        refuse(args, {'effect': [], 'world': [], 'at_most': 3}, 'is for the simulated rig of --next --run')
    with told('reading', quiet=args.quiet or args.json):
        observations = read_observations(args.recordings, given, namespace=args.namespace, warn=warn, any_rate=True)
    out = Path(args.out)
    make_folder(args.out)
    # Before the search, which takes its time.
    if not os.access(out, os.W_OK):
        raise RecordingError(f'--out {out}: cannot be written in; give another folder')
    rig = observations[0].rig if given is None else given
    # Reading took most of what can be foreseen; a search has as many steps as it has effects to weigh.
    hidden = True if args.quiet or args.json else None
    with tqdm(total=STEPS, disable=hidden, file=sys.stderr, bar_format='{l_bar}{bar}| {elapsed}') as bar:

        def progress(words: str) -> None:
            bar.set_description_str(words)
            if bar.n < STEPS - 1:
                bar.update()

        done: Settled | None = None
        if args.make_it:
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
            found = discover(observations, rig, seed=args.seed, without=args.without, progress=progress)
            progress('planning')
            plan = next_of(found, limits) if args.next else None
        progress('report')
        page = report_html(found)
        bar.set_description_str('done')
        bar.update(STEPS - bar.n)
    tree = result(found)
    if args.next:
        tree['next'] = None if plan is None else plan.tree()
    if done is not None:
        made = [{'file': f'next_{i}.csv', **p.tree()} for i, p in enumerate(done.plans, start=1)]
        tree['run'] = {'outcome': done.outcome, 'sentence': done.sentence, 'recordings': made}
        _next.write_list([(f'next_{i}.csv', p) for i, p in enumerate(done.plans, start=1)], out)
    in_json = json.dumps(tree, indent=1, allow_nan=False)
    how = _next.write_plan(plan, out) if plan is not None and plan.useful and done is None else []
    laws = [] if found.law is None else found.law.adopted(args.adopt or 'law')
    adopted: list[Path] = []
    if folder is not None and laws:
        make_folder(str(folder))
        adopted = [folder / f'{law.name}.yaml' for law in laws]
        for law, path in zip(laws, adopted, strict=True):
            save(_law_file(law).encode(), path)
    files = {
        'model.yaml': _model(args.params_file, rig, found, _with_law(found, laws) if adopted else found.active_effects),
        'result.json': in_json + '\n',
        'report.html': page,
        **{
            f'{law.name if args.adopt is None else law.name.replace(args.adopt, "law", 1)}.yaml': _law_file(law)
            for law in laws
        },
    }
    for name, text in files.items():
        save(text.encode(errors='replace'), out / name)
    if args.json:
        print(in_json)  # noqa: T201 - JSON has no control characters, and its lines may be long
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
    show(f'{found.simulations} forward simulations; see {out / "report.html"}')
    return 0


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


def _model(params_file: str | None, rig: Rig, found: Discovery, effects: Sequence[ActiveEffect]) -> str:
    """The user's parameter file with the effects, comments kept; without one what describes the rig.

    What was wrong in the rig file is right in the model.
    """

    def edit(text: str, path: Path) -> str:
        text = with_effects_section(text, effects_to_values(effects), path)
        if not found.lines:
            return text
        return with_values(text, found.lines, f'Put right by psd-deflection {__version__}', path)

    return rig_file(params_file, 'model.yaml', lambda: model_yaml(rig, effects), edit)
