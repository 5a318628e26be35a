"""sensor_msgs/Temperature: degrees Celsius; a variance of 0 says that it is not known."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from msg_adapters.header import Fields, header, stamp_ns
from psd_deflection.records import TemperatureReading

TYPE = 'sensor_msgs/msg/Temperature'
FRAME = 'link_base'


def from_reading(reading: TemperatureReading) -> Fields:
    """Fields of one reading."""
    return {'header': header(reading.t_ns, FRAME), 'temperature': reading.celsius, 'variance': 0.0}


def to_reading(fields: Mapping[str, Any]) -> TemperatureReading:
    """The record of a temperature message."""
    return TemperatureReading(stamp_ns(fields), float(fields['temperature']))
