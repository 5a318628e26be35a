# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The gate for what a device says of itself: whether it fits the rig, and whether it is still the same device."""

from __future__ import annotations

from psd_deflection.base.errors import DeviceError
from psd_deflection.devices.device import psds_of
from psd_deflection.devices.protocol.frames import PROTOCOL_VERSION, HelloFrame
from psd_deflection.devices.protocol.words import device_words, finite
from psd_deflection.records import channel_names
from psd_deflection.rig.config import Rig


class AnotherDeviceError(DeviceError):
    """A device with another serial number answers where the first one did.

    Example: ``/dev/ttyACM0: another device answers there, serial number 'B' and not 'A'``.
    """


class HelloGate:
    """Takes the HELLOs of one run.

    The first one has to fit ``rig``. Each later one has to fit it too, and has the same ``serial`` and
    ``volts_per_count``: the kept zero and the recording are the first one's. The other keys may change.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self.hello: HelloFrame | None = None
        # None: readings are volts. The rig's until a device has said it.
        self.volts_per_count: float | None = rig.converter.volts_per_count

    def take(self, frame: HelloFrame, port: str, *, volts: bool) -> None:
        """Make ``frame`` the present HELLO. ``volts``: whether the source's readings are volts.

        Raises AnotherDeviceError if the serial number is another one, DeviceError naming what does not fit; the
        HELLO before it then stays.
        """
        if frame.version != PROTOCOL_VERSION:
            raise DeviceError(
                f'{port}: the device speaks protocol version {frame.version}, this is version {PROTOCOL_VERSION}; '
                'update its firmware or psd_deflection'
            )
        # A source may be a plug-in with words of its own making.
        info = device_words(frame.info)
        self._check_names(info, port)
        self._check_converter(info, port)
        volts_per_count = self._scale(info, port, volts)
        if self.hello is not None and volts_per_count != self.volts_per_count:
            raise DeviceError(
                f'{port}: HELLO has volts_per_count {info.get("volts_per_count")!r} now and had '
                f'{self.volts_per_count!r} before; samples are scaled as before, and the next start takes the new one'
            )
        self.hello, self.volts_per_count = HelloFrame(frame.version, info), volts_per_count

    def _check_names(self, info: dict[str, object], port: str) -> None:
        first = None if self.hello is None else self.hello.info['serial']
        serial = info.get('serial')
        if isinstance(serial, str) and first is not None and serial != first:
            raise AnotherDeviceError(
                f'{port}: another device answers there, serial number {serial!r} and not {first!r}'
            )
        for key in ('serial', 'firmware'):
            if not isinstance(info.get(key), str):
                raise DeviceError(f'{port}: HELLO has {key} {info.get(key)!r}, needed is a text')

    def _check_converter(self, info: dict[str, object], port: str) -> None:
        psds, wanted_psds = psds_of(info), len(self._rig.psds)
        if type(psds) is not int or psds != wanted_psds:
            raise DeviceError(
                f'{port}: HELLO has psds {psds!r}, the rig file has {wanted_psds} PSDs; describe each PSD of the '
                'device (psd_N.center)'
            )
        channels, needed = info.get('channels'), list(channel_names(wanted_psds))
        if channels != needed:
            raise DeviceError(f'{port}: HELLO has channels {channels!r}, needed are {needed!r}')
        rate = finite(info.get('sample_rate_hz'))
        wanted = self._rig.converter.sample_rate_hz
        if rate is None or abs(rate - wanted) > 1e-3 * wanted:
            raise DeviceError(
                f'{port}: HELLO has sample_rate_hz {info.get("sample_rate_hz")!r}, the rig file says {wanted:g}; '
                'set converter.sample_rate_hz to what the device does'
            )

    def _scale(self, info: dict[str, object], port: str, volts: bool) -> float | None:
        given = info.get('volts_per_count')
        if volts and given is None and 'volts_per_count' in info:
            return None
        scale = finite(given)
        if volts or scale is None or not 0.0 < scale < 1.0:
            needed = 'null, since its samples are volts' if volts else 'a number between 0 and 1 V'
            raise DeviceError(f'{port}: HELLO has volts_per_count {given!r}, needed is {needed}')
        expected = self._rig.converter.volts_per_count
        if abs(scale - expected) > 1e-3 * expected:
            raise DeviceError(
                f'{port}: HELLO has volts_per_count {given!r}, the rig file gives {expected:g} '
                '(converter.full_scale and converter.bits); make them agree'
            )
        return scale
