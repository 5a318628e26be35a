"""Whether the device that says HELLO fits the rig."""

from __future__ import annotations

from psd_deflection.config import Rig
from psd_deflection.errors import DeviceError
from psd_deflection.protocol.frames import PROTOCOL_VERSION, HelloFrame
from psd_deflection.records import CHANNELS


def check_hello(frame: HelloFrame, rig: Rig, port: str) -> float | None:
    """Volts per count of a device that fits the rig, None if it gives volts; DeviceError naming what does not."""
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
