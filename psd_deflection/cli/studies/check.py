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

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from psd_deflection.base.errors import printable
from psd_deflection.base.tables import columns
from psd_deflection.cli._options import given_parameters, in_the_world, parameter_option, refuse, world_option
from psd_deflection.cli._progress import told
from psd_deflection.cli._report import LONGEST_LINE, print_json, show
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import rig_at_end
from psd_deflection.records import CHANNELS
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.rig.wiring import Wiring
from psd_deflection.run.guided import run_guided
from psd_deflection.studies.check.checkup import CANNOT_TELL, RIGHT, TELLING_DRIFT, Checkup, check
from psd_deflection.studies.check.guide import Guide
from psd_deflection.studies.check.levels import levels
from psd_deflection.studies.check.responses import responses
from psd_deflection.studies.check.wirings import DOTS, WIRINGS, line, on_channels
from psd_deflection.studies.discover.from_recordings import read_observation

NAMES = {
    'channel_sign': 'sign turned',
    'axis_swap': 'x and y exchanged',
    'psd_swap': 'exchanged',
    'load_sign': 'sign turned',
    'load_unit': 'other unit',
    'stuck_channel': 'dead',
    'noise_level': 'noise',
    'load_coverage': 'not seen',
}
WIRED = ('channel_sign', 'axis_swap', 'psd_swap')
BAR = 12


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        'recording', nargs='?', metavar='REC', help='a bag folder, an .mcap or a .csv with known loads; none: guided'
    )
    parser.add_argument(
        '--params-file', metavar='RIG.yaml', help="the rig file to check (default: the recording's rig)"
    )
    parser.add_argument('--json', action='store_true', help='for programs: one JSON object')
    group = parser.add_argument_group('guided (no REC)')
    parameter_option(group, '--port', 'port')
    group.add_argument('--source', help='what the device speaks (default: what source: of the rig says)')
    parameter_option(group, '--baud', 'baud')
    world_option(group)


def run(args: argparse.Namespace) -> int:
    """Check and print."""
    if args.recording is not None:
        refuse(args, {'port': None, 'source': None, 'baud': None, 'world': []}, 'is for the guide: give no REC')
        rig, found, title = _of_recording(args)
    else:
        rig, found, title = _guided(args)
    if args.json:
        print_json(as_json(found), indent=1)
        return 0
    show(*title, *report(rig, found))
    return 0


def _of_recording(args: argparse.Namespace) -> tuple[Rig, Checkup, list[str]]:
    rig = load_rig(args.params_file) if args.params_file else rig_at_end(open_recording(args.recording))
    with told('reading', quiet=args.json):
        seen = read_observation(args.recording, rig)
    volts = Wiring.from_rig(rig).to_device(seen.volts)
    answered = responses(rig, volts, seen.loads)
    found = check(rig, answered.pushes, levels(rig, volts), answered.drift, answered.drift_sd)
    return rig, found, [f'{args.recording}: {seen.duration:.1f} s']


def _guided(args: argparse.Namespace) -> tuple[Rig, Checkup, list[str]]:
    values = given_parameters(args)
    if args.source is not None:
        values['source'] = args.source
    rig = load_rig(args.params_file, values)
    if rig.acquisition.port:
        refuse(args, {'world': []}, 'is for the simulated rig: give no --port')
    shown = GuideDisplay(quiet=args.json)
    found = run_guided(rig, in_the_world(rig, args.world), shown.say, shown.update)
    shown.end()
    return rig, found, []


class GuideDisplay:
    """Prompts, and one live line below them where there is a terminal."""

    def __init__(self, quiet: bool) -> None:
        self._stream = sys.stderr if quiet else sys.stdout
        self._live = self._stream.isatty()
        self._turn = 0

    def say(self, text: str) -> None:
        """A prompt or a message."""
        clear = '\r\x1b[K' if self._live else ''
        print(f'{clear}{printable(text, LONGEST_LINE)}', file=self._stream, flush=True)

    def update(self, guide: Guide) -> None:
        """Show how far the dots have moved, and how long the push has been held."""
        self._turn += 1
        if not self._live or self._turn % 5:
            return
        full = round(guide.progress * BAR)
        moved = '  '.join(f'{c} {v * 1e6:+8.1f}' for c, v in zip(DOTS, guide.moved.tolist(), strict=True))
        print(f'\r\x1b[K  {moved} µm  [{"#" * full}{"." * (BAR - full)}]', end='', file=self._stream, flush=True)

    def end(self) -> None:
        """Clear the live line."""
        if self._live:
            print('\r\x1b[K', end='', file=self._stream, flush=True)


def report(rig: Rig, found: Checkup) -> list[str]:
    """The check in lines of text."""
    out = ['', *_pushes(rig, found), '', _verdict(found)]
    out += [f'  {text}' for text in _findings(found)]
    if found.lines:
        out += ['', 'Lines for the rig file, below ros__parameters:', '']
        out += [f'    {line(name, value)}' for name, value in found.lines.items()]
    return [*out, '', *_levels(rig, found), *(f'look at  {note}' for note in found.notes)]


def _pushes(rig: Rig, found: Checkup) -> list[str]:
    """How each channel answered, beside what the rig file expects of it."""
    rows = [['push', *(f'{c} µm' for c in DOTS), '', *DOTS, 'size']]
    for push, size in zip(found.pushes, found.sizes, strict=True):
        expected = on_channels(Wiring.from_rig(rig), push.expected)
        told_size = f'{abs(size):.2f}' if push.sized and math.isfinite(size) else ''
        words = [_arrow(v, float(np.linalg.norm(expected))) for v in expected.tolist()]
        rows.append([push.name, *(f'{v * 1e6:+.1f}' for v in push.channels.tolist()), '  rig file:', *words, told_size])
    if not any(row[-1] for row in rows[1:]):
        rows = [row[:-1] for row in rows]
    return columns(rows).splitlines()


def _arrow(value: float, size: float) -> str:
    """A direction: + or -, or 0 for next to nothing."""
    return '0' if abs(value) < 0.1 * size else '+' if value > 0.0 else '-'


def _verdict(found: Checkup) -> str:
    fit = len(found.found)
    if found.verdict == RIGHT:
        return f'RIGHT: of {len(WIRINGS)} wirings only that of the rig file fits.'
    if found.verdict == CANNOT_TELL:
        if not fit:
            return 'CANNOT TELL: these pushes fit no wiring.'
        return f'CANNOT TELL: the rig file fits, and so do {fit - 1} other wirings of {len(WIRINGS)}.'
    if not any(f.name in WIRED for f in found.findings):
        return 'WRONG, but not in the wiring: that of the rig file fits.' if fit == 1 else 'WRONG:'
    fits = f'one wiring of {len(WIRINGS)} fits' if fit == 1 else f'{fit} wirings of {len(WIRINGS)} fit'
    return f'WRONG: {fits}, and that of the rig file does not.'


def _findings(found: Checkup) -> list[str]:
    if not found.findings:
        return []
    rows = []
    for f in found.findings:
        where = f.where.replace(' ', ' and ') if f.name == 'psd_swap' else f.where
        rows.append((f'{where}: {NAMES[f.name]}', f.fix))
    width = max(len(what) for what, _ in rows)
    out = [f'{what:<{width}}   {fix}' for what, fix in rows]
    also = dict.fromkeys(text for f in found.findings for text in f.equivalent)
    return [*out, *(f'or else: {_other(text)}' for text in also)]


def _other(text: str) -> str:
    name, _, loads = text.partition(' of ')
    if name != 'load_sign':
        return text
    ways = {'fx': '+X', 'fy': '+Y', 'tz': '+θ'}
    pushes = ', '.join(ways[load] for load in loads.split())
    return f'the rig file is right, and {pushes} went the other way (sign of the load); this would look the same'


def _levels(rig: Rig, found: Checkup) -> list[str]:
    measured = found.levels
    noise = '  '.join(f'{c} {v * 1e3:.2f}' for c, v in zip(CHANNELS, measured.noise.tolist(), strict=True))
    drift = '  '.join(
        f'{c} {v * 60e6:+.1f} +- {sd * 60e6:.1f}'
        for c, v, sd in zip(DOTS, found.drift.tolist(), found.drift_sd.tolist(), strict=True)
    )
    drift += '  µm a minute'
    if found.drift_sd.max() > TELLING_DRIFT:
        drift = 'too short a time to tell'
    hum = 'none at 50 or 60 Hz'
    if measured.hum.max() > 0.0:
        sizes = '  '.join(f'{c} {v * 1e3:.1f}' for c, v in zip(CHANNELS, measured.hum.tolist(), strict=True))
        hum = f'{sizes}  mV at {measured.hum_hz:g} Hz'
    sums = '  '.join(f'{name} {v:.2f}' for name, v in zip(('sum1', 'sum2'), measured.sums.tolist(), strict=True))
    return [
        f'noise    {noise}  mV rms a sample (rig file {measured.stated * 1e3:.2f})',
        f'hum      {hum}',
        f'light    {sums}  V (rig file {rig.amplifier.sum_nominal:g})',
        f'drift    {drift}',
    ]


def as_json(found: Checkup) -> dict[str, Any]:
    """What ``--json`` prints: SI units."""
    measured = found.levels
    return {
        'verdict': found.verdict,
        'setup': [
            {
                'name': f.name,
                'where': f.where,
                'value': f.value,
                'fix': f.fix,
                'evidence': f.evidence,
                'equivalent': list(f.equivalent),
            }
            for f in found.findings
        ],
        'lines': dict(found.lines),
        'wirings_that_fit': [_wiring_json(c.wiring) for c in found.found],
        'pushes': [
            {
                'loads': list(p.loads),
                'seen': p.seen,
                'channels': _by(DOTS, p.channels.tolist()),
                'sd': _by(DOTS, p.sd.tolist()),
                'size': size if p.sized else None,
            }
            for p, size in zip(found.pushes, found.sizes, strict=True)
        ],
        'noise': {**_by(CHANNELS, measured.noise.tolist()), 'rig_file': measured.stated},
        'hum': {'hz': measured.hum_hz, **_by(CHANNELS, measured.hum.tolist())},
        'sums': measured.sums.tolist(),
        'drift': _by(DOTS, found.drift.tolist()),
        'drift_sd': _by(DOTS, found.drift_sd.tolist()),
        'notes': list(found.notes),
    }


def _wiring_json(wiring: Wiring) -> dict[str, object]:
    axes = {f'psd_{psd}.axes': list(own) for psd, own in enumerate(wiring.axes, start=1)}
    return {'psds_exchanged': wiring.exchanged, **axes}


def _by(names: Sequence[str], values: Sequence[float]) -> dict[str, float]:
    return dict(zip(names, values, strict=True))
