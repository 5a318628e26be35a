# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Opens a port by its name: a serial port of this machine, or a port of the network by its scheme."""

import contextlib
import errno
import select
import sys
import threading
from pathlib import Path

import serial

from psd_deflection.base.errors import DeviceError
from psd_deflection.devices.port import WRITE_S, DescriptorPort, OpenPort, network_address
from psd_deflection.devices.source import PortClosedError
from psd_deflection.devices.udp_port import Datagrams

MAX_EMPTY_READS = 1000
"""After this many reads in a row that are ready but return no byte, the port counts as gone."""


class SerialPort(DescriptorPort):
    """A serial port. Raises DeviceError with its name if it cannot be opened.

    pyserial opens, locks and configures the port; reading one byte at a time through it would cost a
    quarter of a core at 1 kHz, so the bytes are read from the descriptor.
    """

    def __init__(self, name: str, baud: int, rtscts: bool = False, given_up: threading.Event | None = None) -> None:
        super().__init__(name, given_up)
        try:
            self._serial = serial.Serial(name, baud, timeout=0, write_timeout=WRITE_S, exclusive=True, rtscts=rtscts)
        except serial.SerialException as error:
            raise DeviceError(f'{name}: {_why(error, name)}') from None
        except (OSError, ValueError) as error:
            raise DeviceError(f'{name}: cannot be opened at {baud} baud ({error})') from None
        self._fd = self._serial.fileno()
        self._empty_reads = 0
        if sys.platform == 'linux':
            # Only some drivers have a latency timer to shorten; for the others pyserial raises ValueError.
            with contextlib.suppress(ValueError):
                self._serial.set_low_latency_mode(True)
        self.discard_input()

    def _came(self, received: bytes) -> None:
        """A read that was ready and returned no bytes: the line hung up, or another program took them."""
        if received:
            self._empty_reads = 0
        elif self._is_gone():
            raise PortClosedError(f'{self.name}: the device is gone')

    def _is_gone(self) -> bool:
        self._empty_reads += 1
        poll = select.poll()
        poll.register(self._fd, select.POLLIN)
        closed = any(mask & (select.POLLHUP | select.POLLERR | select.POLLNVAL) for _, mask in poll.poll(0))
        return closed or self._empty_reads > MAX_EMPTY_READS

    def discard_input(self) -> None:
        """Discard unread bytes: they are older than their time of reading."""
        import termios

        # A terminal that is gone raises termios.error, which is not an OSError.
        with contextlib.suppress(OSError, termios.error, serial.SerialException):
            self._serial.reset_input_buffer()

    def write(self, frame: bytes) -> None:
        """Send to the device; PortClosedError if it is gone or takes nothing for a second."""
        try:
            self._serial.write(frame)
        except (serial.SerialException, OSError) as error:
            raise PortClosedError(f'{self.name}: cannot be written to ({error})') from None

    def close(self) -> None:
        """Give the port back."""
        # A port that was pulled out has nothing left to close.
        with contextlib.suppress(OSError):
            self._serial.close()


def _why(error: serial.SerialException, name: str) -> str:
    number = error.errno if error.errno is not None else getattr(error.__context__, 'errno', None)
    if number == errno.ENOENT or not Path(name).exists():
        return 'no such port; `psd-deflection devices` lists those that are there'
    if number in (errno.EAGAIN, errno.EBUSY) or 'exclusively lock' in str(error):
        return 'another program has the port open; close it (on Linux: `fuser NAME` names it)'.replace('NAME', name)
    if number in (errno.EACCES, errno.EPERM):
        return 'no permission; join the group that owns it (`sudo usermod -aG dialout $USER`, then log in anew)'
    if number in (errno.ENOTTY, errno.EINVAL, errno.EISDIR) or 'configure port' in str(error):
        return 'not a serial port'
    return f'cannot be opened ({error})'


def open_port(
    name: str,
    baud: int,
    *,
    rtscts: bool = False,
    given_up: threading.Event | None = None,
    datagrams: Datagrams | None = None,
) -> OpenPort:
    """Open the port ``name`` at ``baud`` (if it has a line speed), with ``rtscts`` (if it has those lines).

    ``given_up``: ends every wait for it once it is set, that for a connection too. ``datagrams``: what is wanted of
    them, for ``udp://``.
    Raises DeviceError with the name if it cannot be opened, ConfigError if it is no name of a port.
    """
    address = network_address(name)
    if address is None:
        return SerialPort(name, baud, rtscts, given_up)
    if address.scheme == 'socket':
        from psd_deflection.devices.tcp_port import TcpPort

        return TcpPort(name, address, given_up)
    if address.scheme == 'udp':
        from psd_deflection.devices.udp_port import UdpPort

        return UdpPort(name, address, datagrams, given_up)
    from psd_deflection.devices.tcp_port import Rfc2217Port

    return Rfc2217Port(name, address, baud, rtscts=rtscts, given_up=given_up)
