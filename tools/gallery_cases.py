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

    ``message``: what of its answer a person reads first: a pattern of lines, all of which are taken.
    """

    title: str
    about: str
    command: str
    message: str = '.+'


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
        'Pushes along +X and +Y, and a twist; one fault each.',
        'check REC',
        r'^(?:RIGHT|WRONG|CANNOT TELL)[\s\S]*?(?=\n\n)|^note +hum.*',
    ),
    'live': Study(
        'Live page and diagnostics',
        'A gap in a trace: no estimate. `/diagnostics` has the same lines, except those of the spectrum.',
        '',
    ),
    'discover': Study(
        'discover: what is missing from the model?',
        'Forces along X and Y and a torque, 0.6 s each.',
        'discover REC --out OUT',
        r'^(?!warning|see |next: |law: |\d+ forward ).+',
    ),
    'calibrate': Study(
        'calibrate: how does the rig differ from its rig file?',
        'The reference is the true pose; PSD 2 is rotated by 10 mrad.',
        'calibrate REC --out OUT',
        r'^\d+ of .+|^undetermined: .*psd_2\.(?:gain_x|crosstalk_yx|center_x).*;.+',
    ),
    'identify': Study(
        'identify: which modes has the link?',
        'A load is put on and released.',
        'identify REC',
        r'^ΔX: (?!input).+|^Nothing for .+',
    ),
    'validate': Study(
        'validate: does it agree with an independent reference?',
        'The reference is the true pose, with one fault each.',
        'validate REC',
        r'^The (?:clocks|reference).+|^ΔX: .+',
    ),
    'watch': Study(
        'watch: is the rig still its model?',
        '12 s under a constant load. The node with `watch: on` logs the same.',
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
    Case('check_good', 'check', 'Good', PUSHES, ''),
    Case(
        'check_mirrored',
        'check',
        'A mirrored axis',
        f"{PUSHES} --world 'psd_1.axes=[x, -y]'",
        'Paste the line into the rig file, or exchange the two wires.',
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
        'A dead channel',
        PUSHES,
        'Check its cable and plug.',
        held('y2', 0.0),
    ),
    Case(
        'check_unit',
        'check',
        'Loads in another unit',
        PUSHES,
        'Convert the columns to N and N m.',
        scaled({'load_fx': 1000.0, 'load_fy': 1000.0}),
    ),
    Case(
        'check_sign',
        'check',
        'A load with the wrong sign',
        PUSHES,
        'Negate this column. A hanging weight pulls along −Y.',
        scaled({'load_tz': -1.0}),
    ),
    Case(
        'check_few',
        'check',
        'Too few pushes',
        "--loads 'steps:0,0,0;0,2,0;0,0,0:1'",
        'Record these pushes.',
    ),
    Case(
        'check_hum',
        'check',
        'Hum of the mains',
        f'{PUSHES} --effect mains_interference,frequency=50,amplitude_x1=0.02',
        'Remove ground loops; shield the cable.',
    ),
    Case(
        'check_noise',
        'check',
        'More noise than in the rig file',
        f'{PUSHES} --world amplifier.noise=0.02',
        'Check light, cable and gain, or paste the line into the rig file.',
    ),
    Case(
        'check_converter',
        'check',
        'A converter with coarse steps',
        PUSHES,
        'Reduce the range of the converter, or set its bits in the rig file.',
        coarse(0.02),
    ),
    Case(
        'check_light',
        'check',
        'Little light',
        f'{PUSHES} --world amplifier.sum_nominal=1.5',
        'Check laser, aim and the window of the PSD.',
    ),
    Case('live_good', 'live', 'Good', REST, ''),
    Case('live_laser', 'live', 'A laser that is off', REST, 'Check the laser and its path.', dark),
    Case(
        'live_saturated',
        'live',
        'A saturated channel',
        REST,
        'Centre the dot, or lower the gain.',
        held('y1', 9.9996948),
    ),
    Case(
        'live_outside',
        'live',
        'A dot at the edge of the active area',
        REST,
        'Centre the dot; check `active_area` and `sensitivity`.',
        held('x2', 9.985),
    ),
    Case('live_frozen', 'live', 'A frozen detector', REST, 'Restart the device; check its plug.', frozen),
    Case(
        'live_vibration',
        'live',
        'A vibration at 87 Hz',
        REST,
        'Find the fan or pump.',
        line(87.0, {'x1': 0.04, 'x2': 0.04}),
    ),
    Case(
        'live_aliased',
        'live',
        'Aliasing: 1040 Hz appears at 40 Hz',
        REST,
        'Record at another rate. If the line moves, add a low-pass before the converter; otherwise find the vibration.',
        line(1040.0, {'x1': 0.04, 'x2': 0.04}),
    ),
    Case(
        'live_light',
        'live',
        'Ambient light on a detector',
        f'{REST} --effect ambient_light,psd=1,level=1.6,x=0.001',
        'Shade the detector.',
    ),
    Case('discover_good', 'discover', 'Good', SOME_LOADS, ''),
    Case(
        'discover_turned',
        'discover',
        'A rotated PSD',
        f'{SOME_LOADS} --effect sensor_rotation,psd=2,angle=0.01',
        'Use its model.yaml, which corrects the estimates, or align the PSD.',
    ),
    Case(
        'discover_clamp',
        'discover',
        'A loose clamp',
        f'{SOME_LOADS} --effect clamp_friction,width=0.0003',
        'Tighten the clamp. The pose is right, the wrench is not.',
    ),
    Case(
        'discover_gain',
        'discover',
        'Another amplifier gain',
        f'{SOME_LOADS} --effect sensor_gain,psd=1,x=0.03,y=0.03',
        'Use its model.yaml, or correct `psd_1.sensitivity`.',
    ),
    Case(
        'discover_warm_up',
        'discover',
        'A laser that warms up',
        f'{SOME_LOADS} --effect laser_pointing_drift,psd=1,rate_x=2e-6',
        'Let the lasers warm up, take the zero, record again.',
    ),
    Case(
        'discover_late',
        'discover',
        'Loads annotated late',
        "--loads 'steps:0,0,0;20,0,0;0,-20,0;0,0,2;0,0,0:1'",
        'The times of the motion are used. Annotate loads when they act, or with `--ago`.',
        shifted(LOADS, 0.4),
    ),
    Case(
        'calibrate_good',
        'calibrate',
        'Good',
        f'{COMPARED} --effect sensor_rotation,psd=2,angle=0.01',
        'Use its rig.yaml. The ± includes the tolerance of undetermined parameters.',
    ),
    Case(
        'calibrate_one_way',
        'calibrate',
        'Motion in one direction',
        "--true-pose --loads 'steps:0,0,0;0,-20,0;0,0,0:0.6' --effect sensor_rotation,psd=2,angle=0.01",
        'Record the motions that it names.',
    ),
    Case('identify_good', 'identify', 'Good', LET_GO, 'Paste its lines into the rig file.'),
    Case(
        'identify_rest',
        'identify',
        'A link at rest',
        '--loads constant:0,0,0:3',
        'Knock on the link while recording.',
    ),
    Case(
        'identify_two',
        'identify',
        'Two close modes',
        f'{LET_GO} --effect second_bending_mode,frequency=17,damping_ratio=0.02,gain=0.5',
        'Find what rings beside the link (cable, table). Its input shaper suits both.',
    ),
    Case('validate_good', 'validate', 'Good', COMPARED, ''),
    Case(
        'validate_late',
        'validate',
        'A reference with a late clock',
        COMPARED,
        'Repeat with `--align`.',
        shifted(REFERENCE, 0.03),
    ),
    Case(
        'validate_mirrored',
        'validate',
        'A camera with mirrored X',
        COMPARED,
        'Check `camera.view`: image right is +X from outside, −X from the base.',
        scaled({'ref_dx': -1.0}),
    ),
    Case(
        'validate_zero',
        'validate',
        'A stale zero',
        COMPARED,
        'Zero rig and reference with the link unloaded and at rest.',
        moved({'ref_dx': 3e-5, 'ref_dy': -2e-5}, -1.0),
    ),
    Case('watch_good', 'watch', 'Good', HELD, ''),
    Case(
        'watch_bumped',
        'watch',
        'A bumped detector',
        HELD,
        'Check its mount, then take the zero.',
        moved({'x1': 0.01}, 6.0),
    ),
    Case(
        'watch_warm_up',
        'watch',
        'A drifting laser',
        f'{HELD} --effect laser_pointing_drift,psd=1,rate_x=1e-6',
        'Let it warm up, check its mount, then take the zero.',
    ),
    Case(
        'watch_unnoted',
        'watch',
        'An unannotated load',
        "--loads 'steps:0,0,0;0,-1,0:8'",
        'Annotate the load. Without one, check what has slipped.',
        scaled(dict.fromkeys(LOADS, 0.0)),
    ),
)
