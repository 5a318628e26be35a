# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What every study's command does with its result: print it, or its JSON, and write its files."""

import argparse
from collections.abc import Callable, Iterable
from types import SimpleNamespace

from psd_deflection.cli._options import make_writable, namespace_option, span_options
from psd_deflection.cli._progress import progress_of, stage
from psd_deflection.cli._report import print_json, save_all, show, warn
from psd_deflection.records import SampleBlock
from psd_deflection.studies.study import Opened, StudyResult, opened


def recording_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare a recording and its rig."""
    parser.add_argument('recording', metavar='REC', help='a bag folder, an .mcap or a .csv')
    parser.add_argument(
        '--params-file', metavar='RIG.yaml', help='use this rig instead of the parameters in the recording'
    )
    span_options(parser)
    namespace_option(parser)


def answer_arguments(parser: argparse.ArgumentParser, files: str) -> None:
    """Declare where the answer goes."""
    parser.add_argument('--out', metavar='DIR', help=f'write {files} into this folder')
    parser.add_argument('--json', action='store_true', help='print the answer as JSON in SI units')


def opened_recording(args: argparse.Namespace) -> Opened:
    """The recording and the rig of ``args``; the folder of --out is made first, before the work."""
    if args.out is not None:
        make_writable(args.out)
    return opened(args.recording, args.params_file, namespace=args.namespace, span=args.span, notify=warn)


def progress(args: argparse.Namespace) -> Callable[[Iterable[SampleBlock]], Iterable[SampleBlock]]:
    """Hands blocks on below a progress bar."""
    return lambda blocks: progress_of(blocks, quiet=args.json)


def answer(args: argparse.Namespace, result: StudyResult) -> int:
    """Print the result and write its files."""
    print_answer(args, result)
    if args.out is not None:
        with stage('drawing', quiet=args.json):
            files = result.files()
        folder = make_writable(args.out)
        save_all(files, folder)
        *names, last = files
        show(f'wrote {", ".join(names)} and {last} into {folder}', aside=args.json)
    return 0


def study_command(study: Callable[[Opened], StudyResult]) -> SimpleNamespace:
    """The command of a study of another package: its docstring is the help, a recording with its rig its input."""

    def add_arguments(parser: argparse.ArgumentParser) -> None:
        recording_arguments(parser)
        answer_arguments(parser, 'the answer as page and JSON')

    def run(args: argparse.Namespace) -> int:
        return answer(args, study(opened_recording(args)))

    return SimpleNamespace(add_arguments=add_arguments, run=run, __doc__=study.__doc__)


def print_answer(args: argparse.Namespace, result: StudyResult) -> None:
    """Print the result for a person or, with --json, for a program."""
    if args.json:
        print_json(result.tree(), indent=1)
    else:
        show(*result.lines())
