# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The declaration of a device, one file and a line in ``registry``: how it is made (its
:class:`~psd_deflection.devices.source.Source`), simulated and recognised on a port."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, Protocol

from psd_deflection.devices.protocol.text_lines import positive
from psd_deflection.rig.declarations import LEAST_BITS, MOST_BITS

if TYPE_CHECKING:
    from psd_deflection.devices.rig_feed import RigFeed
    from psd_deflection.devices.source import Source
    from psd_deflection.rig.config import Rig

PSDS = 'psds'
"""Key of a HELLO: the number of PSDs, 2 if it is absent."""

PROTOCOL_BITS = 16
"""Bits of a count unless the device says otherwise."""

OUTPUT_LIMIT = 4096
"""Bytes that a simulated device buffers for a host that does not read: about 0.12 s of our own frames."""


class LineDevice(Protocol):
    """A simulated device without a serial line or a clock of its own; times are host nanoseconds since power-up."""

    def greeting(self) -> bytes:
        """Bytes sent when a host opens the port."""

    def due_in_ns(self, since_power_up_ns: int) -> int:
        """Time until the next bytes are due, ns; 0 or less: they are due now."""

    def receive(self, received: bytes, since_power_up_ns: int) -> bytes:
        """Replies to the host's bytes."""

    def take(self, since_power_up_ns: int, room: int = OUTPUT_LIMIT) -> bytes:
        """Bytes that are due, at most about ``room``."""


class PowerUp(NamedTuple):
    """How a simulated device starts. ``skew_ppm``: its clock is too fast by this much, 1e-6.

    ``first_seq``: its first sample number, to simulate a device that has run for a long time. A device
    without a clock or without sample numbers ignores them.
    """

    skew_ppm: float = 0.0
    first_seq: int = 0


class Answer(NamedTuple):
    """A device's answer to a probe.

    ``text``: for people. ``parameters``: values that fit the device, besides ``source`` and ``port``.
    ``usable``: False for a model that cannot measure; ``text`` says why.
    """

    text: str
    parameters: Mapping[str, object] = {}
    usable: bool = True


class ProtocolProbe(Protocol):
    """Listens on one port for one device's protocol. ``promising``: samples of the device have come."""

    promising: bool

    def feed(self, piece: bytes) -> Answer | None:
        """The device's answer, once ``piece`` completes it."""


@dataclass(frozen=True, slots=True)
class Probe:
    """How ``psd-deflection devices`` recognises a device. A probe must not start, stop or set anything.

    ``listen``: makes an :class:`ProtocolProbe`, given the line speed. ``question``: bytes that the device answers,
    empty if it sends unasked. ``baud``: the speed that the device may need instead of 115200.
    ``first``: it must be asked before the others, because a question in another protocol confuses it.
    ``ports``: how many ports make one device; ``together``: the parameters that such a set needs in addition.
    """

    listen: Callable[[int], ProtocolProbe]
    question: bytes = b''
    baud: int = 115_200
    first: bool = False
    ports: int = 1
    together: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Device:
    """One kind of device. ``name``: its name for ``source:``. ``help``: a short description.

    ``make``: makes its source, not yet opened, from a rig; raises ConfigError if the rig does not suit it.
    ``simulate``: makes its twins, one per port, that measure the rig of the feed; None if it cannot be simulated.
    ``probe``: None if it cannot be recognised on a port. ``most_psds``: it has inputs for so many.
    """

    name: str
    help: str
    make: Callable[[Rig], Source]
    simulate: Callable[[RigFeed, PowerUp], Sequence[LineDevice]] | None = None
    probe: Probe | None = None
    most_psds: int = 2


def described(rig: Rig) -> dict[str, object]:
    """What a simulated device says beside ``volts_per_count``: bits and PSDs if they are not the usual ones."""
    bits, psds = rig.converter.bits, len(rig.psds)
    return ({'bits': bits} if bits != PROTOCOL_BITS else {}) | described_psds(psds)


def described_psds(psds: int) -> dict[str, object]:
    """What a HELLO says of the number of PSDs: nothing if there are two."""
    return {PSDS: psds} if psds != 2 else {}


def psds_of(info: Mapping[str, object]) -> object:
    """The number of PSDs that a HELLO says; whatever a stranger put there."""
    return info.get(PSDS, 2)


def converter_parameters(info: Mapping[str, object]) -> dict[str, object]:
    """The ``converter.*`` parameters that a device's description ``info`` contains."""
    out: dict[str, object] = {}
    rate, volts = positive(info.get('sample_rate_hz')), positive(info.get('volts_per_count'))
    if rate is not None:
        out['converter.sample_rate_hz'] = rate
    if volts is not None:
        bits = info.get('bits', PROTOCOL_BITS)
        if not isinstance(bits, int) or not LEAST_BITS <= bits <= MOST_BITS:
            bits = PROTOCOL_BITS
        if bits != PROTOCOL_BITS:
            out['converter.bits'] = bits
        out['converter.full_scale'] = round(volts * 2.0 ** (bits - 1), 6)
    return out
