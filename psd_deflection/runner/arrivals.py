"""What came off the wire, counted, and whether the device that sends it fits the rig.

Every sample that is missing is counted once, under its cause, as far as it can be known.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from psd_deflection.config import Rig
from psd_deflection.errors import DeviceError
from psd_deflection.protocol.frames import PROTOCOL_VERSION, HelloFrame
from psd_deflection.records import CHANNELS

BY_DEVICE = 'dropped by the device'
DAMAGED = 'damaged on the wire'
AWAY = 'while the port was away'
UNSEEN = 'on the wire, without a trace'
"""Why samples are missing."""


@dataclass(slots=True)
class AcquisitionCounters:
    """What came off the wire. Written by the reader alone; anyone may read."""

    bytes: int = 0
    samples: int = 0
    lost: int = 0
    lost_by: dict[str, int] = field(default_factory=dict)
    repeated: int = 0
    queue_dropped: int = 0
    device_dropped: int = 0
    device_overruns: int = 0
    restarts: int = 0
    disconnects: int = 0
    silences: int = 0
    refused_reopenings: int = 0
    clock_jumps: int = 0
    pings: int = 0
    pongs: int = 0
    bad_frames: dict[str, int] = field(default_factory=dict)
    temperature: float | None = None

    @property
    def bad(self) -> int:
        """Frames that were none, of every reason."""
        return sum(self.bad_frames.values())

    def count_lost(self, missing: int, cause: str) -> None:
        """``missing`` samples will not come."""
        self.lost += missing
        self.lost_by[cause] = self.lost_by.get(cause, 0) + missing


def check_hello(frame: HelloFrame, rig: Rig, port: str) -> float | None:
    """Volts per count of a device that fits the rig, None where it gives volts; DeviceError naming what does not."""
    if frame.version != PROTOCOL_VERSION:
        raise DeviceError(
            f'{port}: the device speaks protocol version {frame.version}, this is version {PROTOCOL_VERSION}; '
            'update its firmware or psd_deflection'
        )
    info = frame.info
    channels = info.get('channels')
    if channels != list(CHANNELS):
        raise DeviceError(f'{port}: HELLO has channels {channels!r}, needed are {list(CHANNELS)!r}')
    rate = info.get('sample_rate_hz')
    wanted = rig.converter.sample_rate_hz
    if isinstance(rate, bool) or not isinstance(rate, (int, float)) or abs(rate - wanted) > 1e-3 * wanted:
        raise DeviceError(
            f'{port}: HELLO has sample_rate_hz {rate!r}, the rig file says {wanted:g}; '
            'set converter.sample_rate_hz to what the device does'
        )
    volts = info.get('volts_per_count')
    if volts is None and 'volts_per_count' in info:
        return None
    if isinstance(volts, bool) or not isinstance(volts, (int, float)) or not 0.0 < volts < 1.0:
        raise DeviceError(f'{port}: HELLO has volts_per_count {volts!r}, needed is a number between 0 and 1 V')
    expected = rig.converter.volts_per_count
    if abs(volts - expected) > 1e-3 * expected:
        raise DeviceError(
            f'{port}: HELLO has volts_per_count {volts!r}, the rig file gives {expected:g} '
            '(converter.full_scale and converter.bits); make them agree'
        )
    return float(volts)
