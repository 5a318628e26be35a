# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The gate for what a device says of itself, and the pinger that asks for its time now and then."""

import random

from psd_deflection.base.errors import DeviceError
from psd_deflection.devices.device import psds_of
from psd_deflection.devices.protocol.frames import PROTOCOL_VERSION, HelloFrame
from psd_deflection.devices.protocol.words import device_words, finite
from psd_deflection.devices.source import Source
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


PING_S = (0.1, 0.4)
"""Bounds of the random time between two pings: their phase to the samples must not repeat."""

UNANSWERED = 20
"""After this many unanswered pings in a row the device does not support them, and gets no more."""

MOST_UNDER_WAY = 100
"""Pings that may still be answered."""

ANSWER_NS = 20_000_000
"""An answer is awaited for this time; it may come later."""


class Pinger:
    """Keeps the last pings under way: an answer that is seconds late shows how late the line is."""

    def __init__(self) -> None:
        self._random = random.Random()
        self._next_s = 0.0
        self._unanswered = 0
        self._under_way: dict[int, int] = {}  # Bound: MOST_UNDER_WAY.
        self._sent_ns: int | None = None

    def is_due(self, now_s: float) -> bool:
        """Whether the next ping is due."""
        return self._unanswered < UNANSWERED and now_s >= self._next_s

    def awaits(self, now_ns: int) -> bool:
        """Whether an answer may come at any moment. ``now_ns``: CLOCK_MONOTONIC."""
        return self._sent_ns is not None and now_ns - self._sent_ns < ANSWER_NS

    def ask(self, source: Source, now_s: float, sent_ns: int) -> bool:
        """Ping ``source``; False if it cannot be asked. ``sent_ns``: CLOCK_MONOTONIC.

        Raises PortClosedError.
        """
        self._next_s = now_s + self._random.uniform(*PING_S)
        cookie = self._random.getrandbits(63)
        if not source.ping(cookie):
            self._unanswered = UNANSWERED
            return False
        self._unanswered += 1
        self._under_way = dict([*self._under_way.items()][1 - MOST_UNDER_WAY :])
        self._under_way[cookie] = self._sent_ns = sent_ns
        return True

    def answered(self, cookie: int) -> int | None:
        """When the ping with this cookie was sent, ns; None if it is none of those under way."""
        sent_ns = self._under_way.pop(cookie, None)
        if sent_ns is not None:
            self._unanswered = 0
            self._sent_ns = None if sent_ns == self._sent_ns else self._sent_ns
        return sent_ns
