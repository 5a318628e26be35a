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
    """One part of the page."""

    title: str
    about: str


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
    ),
    'live': Study(
        'Live page and diagnostics',
        'The picture is the recording as `plot` draws it: where a trace has a gap there is no estimate. The words are '
        'those of `/diagnostics` and of the health list of the page.',
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
        'No sentence says it: to the samples it is a motion at 40 Hz. The spectrum of the page shows a line where no '
        'mode is; it moves if you sample at another rate. Put a low-pass before the converter.',
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
)
