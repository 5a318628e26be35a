# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the reader thread needs from a device, for any protocol.

A source turns its device's bytes into events with sample numbers and times. The reader does the rest, in
the same way for all sources: numbers beyond 32 bits, blocks, host times, the queue, and reopening a device.
A source invents nothing that its device does not send: :attr:`Source.clock` and :attr:`Source.numbered`
tell where its times and numbers come from.

The life of a source: made from the rig; ``open`` (waits for the device's HELLO and prepares it), ``start``
(samples flow), ``read`` repeatedly, ``close``. When ``read`` reports that the device is gone, the
reader closes it and calls ``reopen`` until it succeeds, with a pause of 0.2 s before each try. ``open``,
``start``, ``read``, ``ping`` and ``reopen`` are called by one thread at a time; ``describe`` and ``give_up``
by any.
"""

import abc
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import NamedTuple

from psd_deflection.base.errors import DeviceError
from psd_deflection.devices.protocol.frames import BadFrame, Frame, HelloFrame


class Clock(Enum):
    """The kind of time that a sample carries."""

    DEVICE = 'device'
    """Microseconds of a clock in the device. Host time comes by regression (``timing``)."""

    COUNTED = 'counted'
    """The sample's number times the nominal period, in microseconds: the device sends no time. The
    regression finds its true rate; an undetected lost sample shifts all later times by one period until
    the regression has adapted."""

    HOST = 'host'
    """Nanoseconds of CLOCK_MONOTONIC, read by the host when it polls the device."""

    RECORDED = 'recorded'
    """Nanoseconds of ROS time, as recorded."""


class Sample(NamedTuple):
    """One sample of a source that does not speak the frames of ``docs/protocol.md``.

    ``flags``, ``seq``: as in ``devices.protocol.frames.SampleFrame``. ``t``: in the unit of the source's
    :class:`Clock`. ``readings``: x1 y1 sum1 x2 y2 sum2 ...; volts if :attr:`Source.volts` is True, else
    converter counts (whole, of at most 32 bits).
    """

    flags: int
    seq: int
    t: int
    readings: tuple[float, ...]


class Notice(NamedTuple):
    """Something beside the device's data that a person should be told once: ``text``, one line."""

    text: str


Event = Sample | Frame | Notice
"""What a read gives: samples, HELLO, STATUS, PONG, :class:`BadFrame` (with a reason) for bytes that are not a valid
frame, and :class:`Notice`."""


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
    """The source ended without an error: a recording is at its end."""


class Source(abc.ABC):
    """One device. Made with the rig (``Source(rig)``); raises ConfigError if the rig does not suit it.

    ``name``: its port or file, for messages. ``clock``: the kind of a sample's time. ``numbered``: whether
    the device numbers its samples, so that losses on the wire are detected. If it does not, the source
    numbers the samples that came, from 0 after each ``open``. ``volts``: whether readings are volts. If not,
    they are converter counts, whatever the device says. It is valid once ``open`` has returned.
    """

    name: str
    clock: Clock = Clock.DEVICE
    numbered: bool = True
    volts: bool = False

    @abc.abstractmethod
    def open(self, timeout: float) -> HelloFrame:
        """Open the device, wait for its description at most ``timeout`` s, and return it as a HELLO.

        The HELLO has ``serial``, ``firmware``, ``sample_rate_hz``, ``channels``,
        ``volts_per_count`` (a number, or None if :attr:`volts`) and, if there are more than two, ``psds``.
        The reader compares it with the rig, and it is recorded. Raises DeviceError that says what to do; then nothing
        is left open.
        """

    @abc.abstractmethod
    def start(self) -> None:
        """Let samples flow from now on and discard older ones. Raises DeviceError if the device is gone."""

    @abc.abstractmethod
    def read(self, timeout: float) -> Received:
        """Return what has arrived; no events after ``timeout`` s.

        Malformed data is a ``BadFrame``, never an exception. Raises PortClosedError if the device is
        gone, SourceEndedError at the end of a recording.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Close the port. May be called more than once, and if the device is gone."""

    def reopen(self) -> HelloFrame | None:
        """Try to reopen a device that went away; None if its HELLO comes later, as an event.

        Raises DeviceError if it is not back yet.
        """
        hello = self.open(REOPEN_S)
        self.start()
        return hello

    def ping(self, cookie: int) -> bool:
        """Ask the device for its time; the answer is a PongFrame. False if the device has no such command.

        Raises PortClosedError if it is gone.
        """
        del cookie
        return False

    def wake(self) -> None:  # noqa: B027 - most devices cannot be asked
        """Ask a device that has been silent for long to send samples again. Raises PortClosedError."""

    def give_up(self) -> None:  # noqa: B027 - a source that never waits long has nothing to do
        """Make an ``open``, ``reopen`` or ``read`` that waits for the device return, with DeviceError.

        Another thread calls it repeatedly while the run ends; a reader that still hangs is abandoned."""

    @abc.abstractmethod
    def describe(self) -> Mapping[str, str]:
        """Description and state, name to text, for the log and for diagnostics."""


REOPEN_S = 0.5
"""How long to wait for the HELLO of a device that came back, s."""

__all__ = [
    'BadFrame',
    'Clock',
    'Event',
    'HelloFrame',
    'Notice',
    'PortClosedError',
    'Received',
    'Sample',
    'Source',
    'SourceEndedError',
]
