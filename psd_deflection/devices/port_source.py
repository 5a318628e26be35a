"""Common base of the sources on one serial port: give up, close, and refuse use before the port is open."""

from __future__ import annotations

from psd_deflection.base.errors import DeviceError
from psd_deflection.devices.serial_port import SerialPort
from psd_deflection.devices.source import Source


class PortSource(Source):
    """A source on one port. ``_port`` is the open port, None if it is closed."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._port: SerialPort | None = None

    def _opened(self) -> SerialPort:
        if self._port is None:
            raise DeviceError(f'{self.name}: not open')
        return self._port

    def give_up(self) -> None:
        """Stop waiting for the device."""
        # Another thread may close it meanwhile.
        port = self._port
        if port is not None:
            port.give_up()

    def close(self) -> None:
        """Give the port back."""
        port, self._port = self._port, None
        if port is not None:
            port.close()
