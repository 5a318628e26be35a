# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Check a rig before you trust its numbers: is it wired as the rig file says, is it quiet, is there light?

Without a recording it is a guide at the bench. It says "push the tip along +X", sees by itself that you push, hold
and let go, and goes on to +Y and to a turn: half a minute, both hands free. With a recording it takes the known
loads in it.

Signs, exchanged axes and exchanged PSDs make 128 wirings of two PSDs. Each is held against the three pushes. You get
the wiring that fits, the lines to paste into the rig file, noise and hum against the rig file, the sums, and drift.
If two causes would look the same, it names both. It changes nothing.

  psd-deflection check                            the simulated rig and hand
  psd-deflection check --world 'psd_1.axes=[-y,x]'   the same, wired wrong
  psd-deflection check --port /dev/ttyACM0 --params-file my_rig.yaml
  psd-deflection check pushes.csv --params-file my_rig.yaml

For a recording: a second of rest, then a load along X alone, one along Y alone, one torque about Z alone, each a few
seconds, noted as load_fx, load_fy, load_tz (CSV) or on /link_tip/load (bag). Ten times the noise is enough.
"""

import argparse
import sys

from psd_deflection.base.errors import UsageError
from psd_deflection.base.log import texts
from psd_deflection.base.text import sanitize
from psd_deflection.cli._options import (
    given_parameters,
    in_the_world,
    parameter_option,
    reject,
    span_options,
    world_option,
)
from psd_deflection.cli._progress import stage
from psd_deflection.cli._report import LONGEST_LINE, show
from psd_deflection.cli.studies._answer import answer, answer_arguments
from psd_deflection.recordings.observation import read_observation
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import rig_at_end
from psd_deflection.recordings.spans import FULL
from psd_deflection.rig.config import load_rig
from psd_deflection.rig.wiring import Wiring
from psd_deflection.run.guided import run_guided
from psd_deflection.studies.check.checkup import check, of_recording
from psd_deflection.studies.check.guide import Guide
from psd_deflection.studies.check.result import Checkup
from psd_deflection.studies.check.wirings import DOTS

BAR = 12


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        'recording', nargs='?', metavar='REC', help='a bag folder, an .mcap or a .csv with known loads; none: guided'
    )
    parser.add_argument(
        '--params-file', metavar='RIG.yaml', help="the rig file to check (default: the recording's rig)"
    )
    span_options(parser)
    answer_arguments(parser, 'report.html and check.json')
    group = parser.add_argument_group('guided (no REC)')
    parameter_option(group, '--port', 'port')
    group.add_argument('--source', help='what the device speaks (default: what source: of the rig says)')
    parameter_option(group, '--baud', 'baud')
    world_option(group)


def run(args: argparse.Namespace) -> int:
    """Check and print."""
    if args.recording is not None:
        reject(args, {'port': None, 'source': None, 'baud': None, 'world': []}, 'is for the guide: give no REC')
        recording = open_recording(args.recording, span=args.span)
        rig = load_rig(args.params_file) if args.params_file else rig_at_end(recording)
        with stage('reading', quiet=args.json):
            observed = read_observation(recording, rig)
        volts = Wiring.from_rig(rig).to_device(observed.volts)
        checkup = check(of_recording(rig, volts, observed.loads, args.recording))
        if not args.json:
            show(f'{args.recording}: {observed.duration:.1f} s')
    else:
        if args.span != FULL:
            raise UsageError('--from, --to: are for a recording: give REC')
        checkup = _guided(args)
    return answer(args, checkup)


def _guided(args: argparse.Namespace) -> Checkup:
    values = given_parameters(args)
    if args.source is not None:
        values['source'] = args.source
    rig = load_rig(args.params_file, values)
    if rig.acquisition.port:
        reject(args, {'world': []}, 'is for the simulated rig: give no --port')
    shown = GuideDisplay(quiet=args.json)
    checkup = run_guided(rig, in_the_world(rig, args.world), texts(shown.log), shown.update)
    shown.end()
    return checkup


class GuideDisplay:
    """Prompts, and one live line below them where there is a terminal."""

    def __init__(self, quiet: bool) -> None:
        self._stream = sys.stderr if quiet else sys.stdout
        self._live = self._stream.isatty()
        self._count = 0

    def log(self, text: str) -> None:
        """A prompt or a message."""
        clear = '\r\x1b[K' if self._live else ''
        print(f'{clear}{sanitize(text, LONGEST_LINE)}', file=self._stream, flush=True)

    def update(self, guide: Guide) -> None:
        """Show how far the dots have moved, and how long the push has been held."""
        self._count += 1
        if not self._live or self._count % 5:
            return
        full = round(guide.progress * BAR)
        moved = '  '.join(f'{c} {v * 1e6:+8.1f}' for c, v in zip(DOTS, guide.moved.tolist(), strict=True))
        print(f'\r\x1b[K  {moved} µm  [{"#" * full}{"." * (BAR - full)}]', end='', file=self._stream, flush=True)

    def end(self) -> None:
        """Clear the live line."""
        if self._live:
            print('\r\x1b[K', end='', file=self._stream, flush=True)
