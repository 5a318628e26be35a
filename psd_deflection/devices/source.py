"""What the reader thread needs from a device, whatever it speaks.

A source turns its device's bytes into events with sample numbers and times; the reader does the
rest alike for all (numbers past 32 bits, blocks, host times, queue, waiting for a device to come
back). What a device does not tell is not made up: :attr:`Source.clock` and :attr:`Source.numbered`
say what its numbers and times are worth.

One source's life: made from the rig; ``open`` (the device is heard out and made ready), ``start``
(samples flow), ``read`` again and again, ``close``. When ``read`` says that the device is gone, the
reader closes it and calls ``reopen`` until it succeeds, with a pause of 0.2 s before each try. ``open``,
``start``, ``read``, ``ping`` and ``reopen`` are called by one thread at a time; ``describe`` and ``give_up``
by any.
"""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import NamedTuple

from psd_deflection.errors import DeviceError
from psd_deflection.protocol.frames import BadFrame, Frame, HelloFrame


class Clock(Enum):
    """What the time of a sample is."""

    DEVICE = 'device'
    """Microseconds of a clock in the device. Host time comes by regression (``timing``)."""

    COUNTED = 'counted'
    """The sample's number times the nominal period, in microseconds: the device has no clock that it
    tells. The regression finds its true rate; a sample lost unseen shifts all later times by one
    period until the regression has followed."""

    HOST = 'host'
    """Nanoseconds of CLOCK_MONOTONIC, taken by the host: a device that answers when it is asked."""

    RECORDED = 'recorded'
    """Nanoseconds of ROS time, as they were recorded."""


class Sample(NamedTuple):
    """One sample of a source that does not speak the contract's frames.

    ``flags``, ``seq``: as in ``protocol.frames.SampleFrame``. ``t``: in the unit of the source's
    :class:`Clock`. ``readings``: x1 y1 sum1 x2 y2 sum2, converter counts (whole, -32768 to 32767)
    or volts if :attr:`Source.volts` says so.
    """

    flags: int
    seq: int
    t: int
    readings: tuple[float, ...]


Event = Sample | Frame
"""What a read gives: samples, HELLO, STATUS, PONG, and :class:`BadFrame` (with a reason) for bytes that are not a valid
frame."""


class Received(NamedTuple):
    """What one read gave: ``events`` in their order, when their last byte was read (CLOCK_MONOTONIC, ns), and the
    number of bytes."""

    events: Sequence[Event]
    read_ns: int
    size: int


class PortClosedError(DeviceError):
    """The port went away while it was open: unplugged, or the device restarted.

    Example: ``/dev/ttyACM0: the device is gone``.
    """


class SourceEndedError(Exception):
    """There is nothing more to read, and nothing went wrong: a recording is at its end."""


class Source(abc.ABC):
    """One device. Made with the rig (``Source(rig)``); raises ConfigError if the rig does not suit it.

    ``name``: its port or file, for messages. ``clock``: what a sample's time is. ``numbered``: whether
    the device numbers its samples, so that a loss on the way is seen; if it does not, the source
    numbers what came, and starts from 0 after each ``open``. ``volts``: whether readings are volts; if not,
    they are converter counts, whatever the device says. It holds from ``open`` on.
    """

    name: str
    clock: Clock = Clock.DEVICE
    numbered: bool = True
    volts: bool = False

    @abc.abstractmethod
    def open(self, timeout: float) -> HelloFrame:
        """Open the device and hear it out, for ``timeout`` s at most; what it says of itself.

        The HELLO has ``serial``, ``firmware``, ``sample_rate_hz``, ``channels`` and
        ``volts_per_count`` (a number, or None for samples in volts); the reader holds it against
        the rig, and it is recorded. Raises DeviceError that names the way out; nothing is left open.
        """

    @abc.abstractmethod
    def start(self) -> None:
        """Let samples flow from now on; what came before is forgotten. Raises DeviceError where it is gone."""

    @abc.abstractmethod
    def read(self, timeout: float) -> Received:
        """What has come; no events after ``timeout`` s.

        Garbage is a ``BadFrame``, never an exception. Raises PortClosedError where the device is
        gone, SourceEndedError at the end of a recording.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Give the port back. May be called more than once, and on a device that is gone."""

    def reopen(self) -> HelloFrame | None:
        """Try to have a device back that went away; None where its HELLO comes later, as an event.

        Raises DeviceError where it is not back yet.
        """
        hello = self.open(REOPEN_S)
        self.start()
        return hello

    def ping(self, cookie: int) -> bool:
        """Ask the device for its time, to be answered by a PongFrame; False where it cannot be asked.

        Raises PortClosedError where it is gone.
        """
        del cookie
        return False

    def wake(self) -> None:  # noqa: B027 - most devices cannot be asked
        """The device has been silent for long: ask it for samples once more. Raises PortClosedError."""

    def give_up(self) -> None:  # noqa: B027 - a source that never waits long has nothing to do
        """Called again and again, by another thread, while the run ends: let ``open``, ``reopen`` or ``read``
        that waits for a device come back, with DeviceError. One that does not is left behind."""

    @abc.abstractmethod
    def describe(self) -> Mapping[str, str]:
        """What it is and how it does, name to text, for the log and for diagnostics."""


REOPEN_S = 0.5
"""How long a device that came back is heard out."""

__all__ = [
    'BadFrame',
    'Clock',
    'Event',
    'HelloFrame',
    'PortClosedError',
    'Received',
    'Sample',
    'Source',
    'SourceEndedError',
]
