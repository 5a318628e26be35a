# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/Temperature: degrees Celsius; a variance of 0 says that it is not known."""

from collections.abc import Mapping
from typing import Any

from msg_adapters.header import Fields, header, stamp_ns
from msg_adapters.message_type import MessageType
from psd_deflection.records import TemperatureReading

MESSAGE = MessageType(
    'sensor_msgs/msg/Temperature',
    'RIHS01_72514a14126ab9f8a9abec974c78e5610a367b59db5da355ff1fb982d5bad4b8',
    'std_msgs/Header header\nfloat64 temperature\nfloat64 variance\n',
)
FRAME = 'link_base'


def from_reading(reading: TemperatureReading) -> Fields:
    """Fields of one reading."""
    return {'header': header(reading.t_ns, FRAME), 'temperature': reading.celsius, 'variance': 0.0}


def to_reading(fields: Mapping[str, Any]) -> TemperatureReading:
    """The record of a temperature message."""
    return TemperatureReading(stamp_ns(fields), float(fields['temperature']))
