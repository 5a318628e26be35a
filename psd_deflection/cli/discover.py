"""Find the physical effect that the simulation of a recording lacks, and add it to the model.

REC is a bag folder, an .mcap or a .csv that contains the loads (and the temperatures). You may give
several, or a .yaml list of recordings with the parameters that differ in each:

  - recording: short.csv
    overrides: {link.length: 0.4}

DIR gets model.yaml (the rig with the effects found; use it as --params-file), report.html and
result.json. The exit status is 0 whatever was found.

  psd-deflection discover odd.csv --out found
  psd-deflection discover a.csv b.csv --params-file my_rig.yaml --out found
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

from tqdm import tqdm

from psd_deflection import __version__
from psd_deflection.cli._options import make_folder, namespace_option, seed
from psd_deflection.cli._progress import told
from psd_deflection.cli._report import save, show, warn
from psd_deflection.cli._rig_file import rig_file
from psd_deflection.config import Rig, load_rig
from psd_deflection.discovery.discover import Discovery, discover
from psd_deflection.discovery.report import report_html
from psd_deflection.discovery.result import model_yaml, result, sentence
from psd_deflection.errors import RecordingError, UsageError
from psd_deflection.parameter_files import with_effects_section, with_values
from psd_deflection.recordings.observations import read_observations
from psd_deflection.simulation.catalogue import effect_names, effects_to_values

STEPS = 8
"""Steps that the progress bar counts: described, signatures, adding, weighing, alternatives, where, report, done."""


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
    namespace_option(parser)
    parser.add_argument('--quiet', action='store_true', help='no progress bar')
    parser.add_argument('--json', action='store_true', help='print the content of result.json')


def run(args: argparse.Namespace) -> int:
    """Read, discover, write, and say it in a sentence."""
    given = None if args.params_file is None else load_rig(args.params_file)
    for name in args.without:
        if name not in effect_names():
            raise UsageError(f'--without {name}: no effect of that name; there are: {", ".join(effect_names())}')
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

        found = discover(observations, rig, seed=args.seed, without=args.without, progress=progress)
        progress('report')
        page = report_html(found)
        bar.set_description_str('done')
        bar.update(STEPS - bar.n)
    in_json = json.dumps(result(found), indent=1, allow_nan=False)
    files = {
        'model.yaml': _model(args.params_file, rig, found),
        'result.json': in_json + '\n',
        'report.html': page,
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
    show(f'{found.simulations} forward simulations; see {out / "report.html"}')
    return 0


def _model(params_file: str | None, rig: Rig, found: Discovery) -> str:
    """The user's parameter file with the effects, comments kept; without one what describes the rig.

    What was wrong in the rig file is right in the model.
    """

    def edit(text: str, path: Path) -> str:
        text = with_effects_section(text, effects_to_values(found.active_effects), path)
        if not found.lines:
            return text
        return with_values(text, found.lines, f'Put right by psd-deflection {__version__}', path)

    return rig_file(params_file, 'model.yaml', lambda: model_yaml(rig, found.active_effects), edit)
