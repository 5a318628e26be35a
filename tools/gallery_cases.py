# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The cases of the gallery: how each recording is made, which command is asked, and what a person does then.

What the program says is written nowhere here: it is taken from the run.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Columns = dict[str, npt.NDArray[np.float64]]
"""A CSV recording, column by column."""

LOADS = ('load_fx', 'load_fy', 'load_tz')
DOTS = ('x1', 'y1', 'x2', 'y2')


class Study(NamedTuple):
    """One part of the page. ``command``: REC and OUT stand for the recording and a folder; '' for the live page.

    ``said``: what of its answer a person reads first: a pattern of lines, all of which are taken.
    """

    title: str
    about: str
    command: str
    said: str = '.+'


class Case(NamedTuple):
    """``simulate``: the arguments of that command; ``change``: done to its columns afterwards.

    ``do``: what a person does.
    """

    name: str
    study: str
    title: str
    simulate: str
    do: str
    change: Callable[[Columns], Columns] | None = None


STUDIES = {
    'check': Study(
        'check: is it wired as the rig file says?',
        'The picture is the recording: a push along +X, one along +Y, one turn. Each part below has one fault.',
        'check REC',
        r'^(?:RIGHT|WRONG|CANNOT TELL)[\s\S]*?(?=\n\n)|^note .*',
    ),
    'live': Study(
        'Live page and diagnostics',
        'The picture is the recording as `plot` draws it: where a trace has a gap there is no estimate. The words are '
        'those of the health list of the page; all but those of the spectrum are in `/diagnostics` too.',
        '',
    ),
    'discover': Study(
        'discover: what is missing from the model?',
        'The picture is the recording: forces along X and Y and a torque, 0.6 s each. `discover` says what the rig '
        'file lacks, and how large it is.',
        'discover REC --out OUT',
        r'^(?!warning|see |next: |law: |\d+ forward ).+',
    ),
    'calibrate': Study(
        'calibrate: how does the rig differ from its rig file?',
        'The recording has a reference (here the true pose), and its second PSD is turned by 10 mrad. `calibrate` says '
        'what the motion so far has determined.',
        'calibrate REC --out OUT',
        r'^\d+ of .+|^undetermined: .*psd_2\.(?:gain_x|crosstalk_yx|center_x).*;.+',
    ),
    'identify': Study(
        'identify: which modes has the link?',
        'The picture is the recording: a load is put on and let go.',
        'identify REC',
        r'^(?:ΔX|ΔY|θ): (?!input).+|^Nothing for .+',
    ),
    'validate': Study(
        'validate: does it agree with an independent reference?',
        'The recording has a reference, here the true pose. Each part below has something wrong with the reference or '
        'with the rig.',
        'validate REC',
        r'^The (?:clocks|reference).+|^(?:ΔX|ΔY|θ): .+',
    ),
    'watch': Study(
        'watch: is the rig still its model?',
        'A recording of 12 s under a load that is held. `replay --watch` and the node with `watch: on` say the same.',
        'replay REC --watch',
        r'^  watch: .+',
    ),
}


def scaled(factors: dict[str, float]) -> Callable[[Columns], Columns]:
    """Multiply columns."""
    return lambda columns: columns | {name: factor * columns[name] for name, factor in factors.items()}


def held(channel: str, value: float) -> Callable[[Columns], Columns]:
    """A channel that stands at one value, V."""
    return lambda columns: columns | {channel: np.full_like(columns[channel], value)}


def line(hertz: float, volts: dict[str, float]) -> Callable[[Columns], Columns]:
    """A sine on channels, sampled as it comes: above half the rate it appears at another frequency."""
    return lambda columns: (
        columns | {n: columns[n] + v * np.sin(2.0 * np.pi * hertz * columns['t']) for n, v in volts.items()}
    )


def coarse(step: float) -> Callable[[Columns], Columns]:
    """All channels in steps of so many volts."""
    return lambda columns: (
        columns | {n: step * np.round(columns[n] / step) for n in ('x1', 'y1', 'sum1', 'x2', 'y2', 'sum2')}
    )


PUSHES = "--loads 'steps:0,0,0;2,0,0;0,0,0;0,2,0;0,0,0;0,0,2;0,0,0:1'"
REST = '--loads constant:0,0,0:3'


def dark(columns: Columns) -> Columns:
    """Laser 2 goes off after a second."""
    later = columns['t'] >= 1.0
    rng = np.random.default_rng(1)
    return columns | {n: np.where(later, rng.normal(0.0, 0.002, len(later)), columns[n]) for n in ('x2', 'y2', 'sum2')}


def frozen(columns: Columns) -> Columns:
    """PSD 1 keeps the values that it had after a second."""
    at = int(np.searchsorted(columns['t'], 1.0))
    return columns | {n: np.where(columns['t'] >= 1.0, columns[n][at], columns[n]) for n in ('x1', 'y1', 'sum1')}


def exchanged(columns: Columns) -> Columns:
    """x and y of PSD 1 exchanged."""
    return columns | {'x1': columns['y1'], 'y1': columns['x1']}


SOME_LOADS = "--loads 'steps:0,0,0;20,0,0;0,-20,0;0,0,2;0,0,0:0.6'"
LET_GO = "--loads 'steps:0,0,0;10,10,1;0,0,0:2'"
COMPARED = f'{SOME_LOADS} --true-pose'
HELD = '--loads constant:0,0,0:12'
RATE_HZ = 1000


def shifted(names: tuple[str, ...], seconds: float) -> Callable[[Columns], Columns]:
    """Columns that are late by so long; what was first holds before."""
    late = round(seconds * RATE_HZ)
    return lambda columns: (
        columns | {n: np.concatenate((np.full(late, columns[n][0]), columns[n][:-late])) for n in names}
    )


def moved(offsets: dict[str, float], after: float) -> Callable[[Columns], Columns]:
    """Columns that jump by so much after so many seconds."""
    return lambda columns: columns | {n: columns[n] + offset * (columns['t'] >= after) for n, offset in offsets.items()}


REFERENCE = ('ref_dx', 'ref_dy', 'ref_theta')

CASES: tuple[Case, ...] = (
    Case('check_good', 'check', 'Good', PUSHES, 'Nothing is to be done.'),
    Case(
        'check_mirrored',
        'check',
        'A mirrored axis',
        f"{PUSHES} --world 'psd_1.axes=[x, -y]'",
        'Paste the line into the rig file, or exchange the two wires.',
    ),
    Case(
        'check_exchanged_axes',
        'check',
        'x and y exchanged',
        f"{PUSHES} --world 'psd_2.axes=[y, x]'",
        'Paste the line into the rig file.',
    ),
    Case(
        'check_exchanged_psds',
        'check',
        'The two PSDs exchanged',
        f'{PUSHES} --world psds_exchanged=true',
        'Paste the line, or exchange the plugs.',
    ),
    Case(
        'check_dead',
        'check',
        'A channel that does not answer',
        PUSHES,
        'Look at the cable and the plug of this channel.',
        held('y2', 0.0),
    ),
    Case(
        'check_unit',
        'check',
        'Loads in another unit',
        PUSHES,
        'Loads are in N and N m. Multiply the columns, or mend what writes them.',
        scaled({'load_fx': 1000.0, 'load_fy': 1000.0}),
    ),
    Case(
        'check_sign',
        'check',
        'A load with the wrong sign',
        PUSHES,
        'A weight that hangs pulls along −Y. Turn the sign of this column.',
        scaled({'load_tz': -1.0}),
    ),
    Case(
        'check_few',
        'check',
        'Too few pushes',
        "--loads 'steps:0,0,0;0,2,0;0,0,0:1'",
        'Record the pushes that are named.',
    ),
    Case(
        'check_hum',
        'check',
        'Hum of the mains',
        f'{PUSHES} --effect mains_interference,frequency=50,amplitude_x1=0.02',
        'Look for a ground loop, and for a cable without a screen.',
    ),
    Case(
        'check_noise',
        'check',
        'More noise than the rig file says',
        f'{PUSHES} --world amplifier.noise=0.02',
        'Find its cause (light, cable, gain), or put the line into the rig file, so that the bands are true.',
    ),
    Case(
        'check_converter',
        'check',
        'A converter with coarse steps',
        PUSHES,
        'Set the range of the converter to that of the signal, or its bits in the rig file.',
        coarse(0.02),
    ),
    Case(
        'check_light',
        'check',
        'Little light',
        f'{PUSHES} --world amplifier.sum_nominal=1.5',
        'Look at the laser, the aim of the beam and the window of the PSD.',
    ),
    Case('live_good', 'live', 'Good', REST, 'Nothing is to be done.'),
    Case('live_laser', 'live', 'A laser that is off', REST, 'Look at the laser and at what stands in its beam.', dark),
    Case(
        'live_saturated',
        'live',
        'A channel at the end of the converter',
        REST,
        'Bring the dot back to the middle, or lower the gain.',
        held('y1', 9.9996948),
    ),
    Case(
        'live_outside',
        'live',
        'A dot at the edge of the active area',
        REST,
        'Aim the beam at the middle; look at `active_area` and `sensitivity`.',
        held('x2', 9.985),
    ),
    Case('live_frozen', 'live', 'A detector whose values stand', REST, 'Restart the device; look at its plug.', frozen),
    Case(
        'live_vibration',
        'live',
        'A vibration at 87 Hz',
        REST,
        'Look for a fan or a pump on the bench.',
        line(87.0, {'x1': 0.04, 'x2': 0.04}),
    ),
    Case(
        'live_aliased',
        'live',
        'A line that is aliased: 1040 Hz looks like 40 Hz',
        REST,
        'To the samples it is a motion at 40 Hz. Record at another rate: if the line moves, put a low-pass before the '
        'converter; if it stays, look for what moves.',
        line(1040.0, {'x1': 0.04, 'x2': 0.04}),
    ),
    Case(
        'live_swapped',
        'live',
        'Two channels exchanged',
        "--loads 'steps:0,0,0;0,-20,0:2'",
        'Run `check`.',
        exchanged,
    ),
    Case(
        'live_noise',
        'live',
        'More noise than the rig file says',
        f'{REST} --world amplifier.noise=0.02',
        'Find its cause, or put the noise into the rig file.',
    ),
    Case(
        'live_light',
        'live',
        'Other light on a detector',
        f'{REST} --effect ambient_light,psd=1,level=1.6,x=0.001',
        'Shade the detector.',
    ),
    Case('discover_good', 'discover', 'Good', SOME_LOADS, 'Nothing is to be done.'),
    Case(
        'discover_turned',
        'discover',
        'A turned PSD',
        f'{SOME_LOADS} --effect sensor_rotation,psd=2,angle=0.01',
        'Use the model.yaml that it writes: the estimates are corrected with it. Or turn the PSD back.',
    ),
    Case(
        'discover_clamp',
        'discover',
        'A loose clamp',
        f'{SOME_LOADS} --effect clamp_friction,width=0.0003',
        'Tighten the clamp. The pose is measured rightly meanwhile; the load that is computed of it is not.',
    ),
    Case(
        'discover_gain',
        'discover',
        'Another amplifier than the rig file says',
        f'{SOME_LOADS} --effect sensor_gain,psd=1,x=0.03,y=0.03',
        'Use the model.yaml, or put the gain into `psd_1.sensitivity`.',
    ),
    Case(
        'discover_warm_up',
        'discover',
        'A laser that warms up',
        f'{SOME_LOADS} --effect laser_pointing_drift,psd=1,rate_x=2e-6',
        'Let the lasers warm up, take the zero again, and record again.',
    ),
    Case(
        'discover_late',
        'discover',
        'Loads that were noted late',
        "--loads 'steps:0,0,0;20,0,0;0,-20,0;0,0,2;0,0,0:1'",
        'Nothing is to be done: the times of the motion are taken. Note loads when they hang, or with `--ago`.',
        shifted(LOADS, 0.4),
    ),
    Case(
        'calibrate_good',
        'calibrate',
        'Good for what the estimates need',
        f'{COMPARED} --effect sensor_rotation,psd=2,angle=0.01',
        'Use the rig.yaml that it writes. What stays undetermined has its tolerance in the ±.',
    ),
    Case(
        'calibrate_one_way',
        'calibrate',
        'Pushed one way only',
        "--true-pose --loads 'steps:0,0,0;0,-20,0;0,0,0:0.6' --effect sensor_rotation,psd=2,angle=0.01",
        'Record again with the motions that it names.',
    ),
    Case('identify_good', 'identify', 'Good', LET_GO, 'Paste the lines for the rig file.'),
    Case(
        'identify_rest',
        'identify',
        'A link at rest',
        '--loads constant:0,0,0:3',
        'Record again, and knock on the link while it records.',
    ),
    Case(
        'identify_two',
        'identify',
        'Two modes close to each other',
        f'{LET_GO} --effect second_bending_mode,frequency=17,damping_ratio=0.02,gain=0.5',
        'Look for what rings beside the link (a cable, the table). The input shaper that it names works for both.',
    ),
    Case('validate_good', 'validate', 'Good', COMPARED, 'Nothing is to be done.'),
    Case(
        'validate_late',
        'validate',
        'A reference whose clock is late',
        COMPARED,
        'Compare again with `--align`.',
        shifted(REFERENCE, 0.03),
    ),
    Case(
        'validate_mirrored',
        'validate',
        'A camera that sees X mirrored',
        COMPARED,
        'Look at `camera.view`: from outside, image right is +X; from the base it is −X.',
        scaled({'ref_dx': -1.0}),
    ),
    Case(
        'validate_zero',
        'validate',
        'A zero that is stale',
        COMPARED,
        'Take the zero with the link unloaded and at rest, of rig and reference alike.',
        moved({'ref_dx': 3e-5, 'ref_dy': -2e-5}, -1.0),
    ),
    Case('watch_good', 'watch', 'Good', HELD, 'Nothing is to be done.'),
    Case(
        'watch_bumped',
        'watch',
        'A detector that was bumped',
        HELD,
        'Look at the mount of the channel that it names; then take the zero.',
        moved({'x1': 0.01}, 6.0),
    ),
    Case(
        'watch_warm_up',
        'watch',
        'A laser that wanders',
        f'{HELD} --effect laser_pointing_drift,psd=1,rate_x=1e-6',
        'Let it warm up, then take the zero. Is it fixed to the base?',
    ),
    Case(
        'watch_unnoted',
        'watch',
        'A load that nobody noted',
        "--loads 'steps:0,0,0;0,-1,0:8'",
        'Note the load. If none hangs, look for what has slipped.',
        scaled(dict.fromkeys(LOADS, 0.0)),
    ),
)
