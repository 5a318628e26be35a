# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Which of the 128 wirings of two PSDs explain how the dots answered to pushes, of free size: the residual is the
share of the squared movement that the expected pattern leaves, 0 to 1. A wrong sign leaves half or more, 25 degrees
a fifth."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from psd_deflection.base.errors import ConfigError
from psd_deflection.model.plate.linear import design_matrix
from psd_deflection.records import CHANNELS, DOT_CHANNELS, FloatArray, dot_names
from psd_deflection.rig.config import Rig
from psd_deflection.rig.wiring import Wiring

_PAIRS = tuple(itertools.product(('x', '-x'), ('y', '-y')))
_AXES = (*_PAIRS, *((y, x) for x, y in _PAIRS))
WIRINGS = tuple(
    Wiring(exchanged, (first, second)) for exchanged in (False, True) for first in _AXES for second in _AXES
)
"""All 128, the nominal one first."""


def wirings_of(file: Wiring) -> Sequence[Wiring]:
    """Return the wirings that are tried of a rig whose file says ``file``: of two PSDs all.

    Of more, those in which at most two PSDs are wired otherwise than ``file`` says, and those in which all are wired
    alike; each with any two PSDs exchanged, and with none.
    """
    count = len(file.axes)
    if count == 2:
        return WIRINGS
    tried = {file.axes: None}
    for first, second in itertools.combinations(range(count), 2):
        for first_axes, second_axes in itertools.product(_AXES, _AXES):
            axes = list(file.axes)
            axes[first], axes[second] = first_axes, second_axes
            tried[tuple(axes)] = None
    tried.update(dict.fromkeys((axes,) * count for axes in _AXES))
    swaps: list[tuple[bool, tuple[int, ...]]] = [(file.exchanged, ()), (not file.exchanged, ())]
    swaps += [(file.exchanged, pair) for pair in itertools.combinations(range(1, count + 1), 2) if pair != (1, 2)]
    return [Wiring(exchanged, axes, crossed) for exchanged, crossed in swaps for axes in tried]


MARGIN = 0.35
"""A wiring whose residual is larger than the best one's by more than this is ruled out."""

LIMIT = 0.35
"""A wiring with a larger residual of any one push does not explain it."""

OBSERVED = 6.0
"""A movement below so many of its standard deviations says nothing."""

DOTS = tuple(CHANNELS[i] for i in DOT_CHANNELS)
_BY_PUSH = {'fx': '+X', 'fy': '+Y', 'tz': '+θ'}


def pattern(rig: Rig) -> FloatArray:
    """Movement of x1 y1 x2 y2 (4, 3) per ΔX, ΔY (1) and θ (m/rad). Raises ConfigError for PSDs at the base."""
    if rig.psds_at_base:
        raise ConfigError(
            'PSDs at the base (arrangement): check knows PSDs on the tip plate only, whose dots move otherwise'
        )
    return design_matrix(rig.centers + rig.zeros)


def scales_of(rig: Rig) -> tuple[float, ...]:
    """Sensitivity of x1 y1 x2 y2 of the PSDs over the amplifier's."""
    return tuple((rig.sensitivities.ravel() / rig.amplifier.sensitivity).tolist())


@dataclass(frozen=True, slots=True, eq=False)
class PushResponse:
    """How the dots answered to one push.

    ``loads``: which of fx, fy, tz it was; several if they always came together. ``channels`` (4,): movement on the
    device's channels x1 y1 x2 y2, m. ``sd`` (4,): its standard deviation, m. ``expected`` (4,): movement of x1 y1 x2 y2
    of the PSDs by the rig file, m; only its direction counts if ``sized`` is False. ``only_twist``: the movement that
    both dots share is ignored, as for a turn by hand, which shifts the tip as well. ``scales``: of x1 y1 x2 y2 of the
    PSDs, their sensitivity over the amplifier's, by which ``channels`` are in metres.
    """

    loads: tuple[str, ...]
    channels: FloatArray
    sd: FloatArray
    expected: FloatArray
    sized: bool = True
    only_twist: bool = False
    scales: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)

    @property
    def name(self) -> str:
        """``+X``, or ``+Y with +θ``."""
        return ' with '.join(_BY_PUSH[load] for load in self.loads)

    @property
    def observed(self) -> bool:
        """Whether it stands out of the noise. What a turn moves both dots alike does not count."""
        moved = _pattern(self.channels, self.only_twist)
        variance = float(np.mean(self.sd**2)) * (2.0 if self.only_twist else 1.0)
        return bool(moved @ moved > OBSERVED**2 * variance)

    def match(self, wiring: Wiring) -> tuple[float, float]:
        """Share of the movement that ``wiring`` leaves unexplained, and the size of the movement over the expected one.

        The size is negative if the push went the other way.
        """
        pattern = _pattern(_dots(wiring, self.channels) * np.array(self.scales), self.only_twist)
        expected = _pattern(self.expected, self.only_twist)
        size = float(pattern @ expected / (expected @ expected))
        residual = pattern - size * expected
        return float(residual @ residual / (pattern @ pattern)), size


def on_channels(wiring: Wiring, dots: FloatArray) -> FloatArray:
    """Movements (4,) of the PSDs' x1 y1 x2 y2 as the device's channels show them."""
    volts = np.zeros((1, 6))
    volts[0, DOT_CHANNELS] = dots
    return wiring.to_device(volts)[0, DOT_CHANNELS]


def _dots(wiring: Wiring, channels: FloatArray) -> FloatArray:
    """Movements of the PSDs' x1 y1 x2 y2 from those of the device's."""
    volts = np.zeros((1, 6))
    volts[0, DOT_CHANNELS] = channels
    return wiring.to_psds(volts)[0, DOT_CHANNELS]


def _pattern(dots: FloatArray, only_twist: bool) -> FloatArray:
    """What of x1 y1 x2 y2 is compared: all, or how the dots move against each other.

    An exchange of the PSDs turns the difference around, every axis map of one PSD acts on it as on the dots.
    """
    return np.array([dots[0] - dots[2], dots[1] - dots[3]]) if only_twist else dots


@dataclass(frozen=True, slots=True)
class WiringFit:
    """A wiring that explains the pushes, if ``reversed_loads`` went the other way; ``residual`` is summed over them."""

    wiring: Wiring
    residual: float
    reversed_loads: tuple[str, ...] = ()


def residuals(
    wiring: Wiring, responses: Sequence[PushResponse], reversed_loads: Sequence[str] = ()
) -> tuple[float, float]:
    """(sum over the pushes, worst push) of the residual, with the sign of some loads turned."""
    shares = []
    for response in responses:
        share, size = response.match(wiring)
        backwards = set(response.loads) <= set(reversed_loads)
        # A movement against the push is not explained at all.
        shares.append(share if (size < 0.0) == backwards else 1.0)
    return sum(shares), max(shares, default=0.0)


def fitting_wirings(responses: Sequence[PushResponse]) -> list[WiringFit]:
    """Return the wirings that explain the pushes about as well as the best one does, best first; [] if none does.

    First with the loads as they are said to be. Only if no wiring explains these, with the sign of loads turned.
    """
    loads_of_responses = [response.loads for response in responses]
    for count in range(len(loads_of_responses) + 1):
        fits: list[WiringFit] = []
        for subset in itertools.combinations(loads_of_responses, count):
            loads = tuple(itertools.chain.from_iterable(subset))
            for wiring in WIRINGS:
                total, worst = residuals(wiring, responses, loads)
                if worst <= LIMIT:
                    fits.append(WiringFit(wiring, total, loads))
        if fits:
            fits.sort(key=lambda c: c.residual)
            return [c for c in fits if c.residual <= fits[0].residual + MARGIN]
    return []


@dataclass(frozen=True, slots=True)
class Difference:
    """One way in which a wiring differs from another: ``name`` channel_sign, axis_swap or psd_swap; ``where``: the
    channel of the device, the PSD of the rig file, or the two PSDs."""

    name: str
    where: str


SWAP = 'psd_1 psd_2'
"""The two PSDs whose exchange the rig file can say."""


def differences(wiring: Wiring, file: Wiring) -> list[Difference]:
    """What of ``wiring`` is not as the rig file has it."""
    out = []
    if wiring.exchanged != file.exchanged:
        out.append(Difference('psd_swap', SWAP))
    if wiring.crossed:
        out.append(Difference('psd_swap', ' '.join(f'psd_{n}' for n in wiring.crossed)))
    now, then = _of_channels(wiring), _of_channels(file)
    for number in range(1, len(file.axes) + 1):
        psd, axis, _ = now[f'x{number}']
        if axis != then[f'x{number}'][1]:
            out.append(Difference('axis_swap', f'psd_{psd}'))
    out += [Difference('channel_sign', c) for c in dot_names(len(file.axes)) if now[c][2] != then[c][2]]
    return out


def _of_channels(wiring: Wiring) -> dict[str, tuple[int, str, bool]]:
    """Of each channel of the device: the PSD, the axis, and whether its sign is turned."""
    out = {}
    for psd, axes in enumerate(wiring.axes, start=1):
        for axis, of in zip('xy', axes, strict=True):
            out[f'{of[-1]}{wiring.input_of(psd)}'] = (psd, axis, of.startswith('-'))
    return out


def parameters(wiring: Wiring, file: Wiring) -> dict[str, object]:
    """Return the parameters of ``wiring`` that are others in the rig file."""
    out: dict[str, object] = {}
    if wiring.exchanged != file.exchanged:
        out['psds_exchanged'] = wiring.exchanged
    for psd, (axes, then) in enumerate(zip(wiring.axes, file.axes, strict=True), start=1):
        if axes != then:
            out[f'psd_{psd}.axes'] = list(axes)
    return out


def fix_of(difference: Difference, wiring: Wiring, right: Mapping[str, object]) -> str:
    """Return the line of the rig file that puts one difference right, or what else does."""
    if difference.name == 'psd_swap' and difference.where != SWAP:
        both = difference.where.replace(' ', ' and ')
        return f'exchange the cables of {both} at the device, or what the rig file says of {both}'
    if difference.name == 'psd_swap':
        return line('psds_exchanged', right['psds_exchanged'])
    if difference.name == 'axis_swap':
        name = f'{difference.where}.axes'
    else:
        name = next(
            f'psd_{psd}.axes'
            for psd in range(1, len(wiring.axes) + 1)
            if wiring.input_of(psd) == int(difference.where[-1])
        )
    return line(name, right[name] if name in right else list(wiring.axes[int(name[4]) - 1]))


def line(name: str, value: object) -> str:
    """``name: value`` as YAML that ROS reads as well, which takes a bare ``y`` for true."""
    if isinstance(value, list):
        text = ', '.join(("'y'" if item == 'y' else str(item)) for item in value)
        return f'{name}: [{text}]'
    return f'{name}: {str(value).lower() if isinstance(value, bool) else value}'
