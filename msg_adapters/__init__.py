"""Record to message field dict and back: one file a message, no logic; serves rclpy and MCAP alike.

:func:`to_messages` says which record goes to which topics; the fields are plain dicts with the
names of the ROS message definitions, so that nothing here needs ROS.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from msg_adapters import (
    diagnostic_array,
    point_cloud2,
    point_stamped,
    pose_stamped,
    pose_with_covariance_stamped,
    temperature,
    wrench_stamped,
)
from psd_deflection.records import (
    AppliedLoad,
    BlockStatus,
    DeflectionEstimate,
    DiagnosticReport,
    ParameterChange,
    Record,
    ReferencePose,
    SampleBlock,
    SpotMeans,
    TemperatureReading,
    TipLoad,
)

SAMPLES = '/psd/samples'
SPOTS = ('/psd_1/spot', '/psd_2/spot')
DEFLECTION = '/link_tip/deflection'
DEFLECTION_WITH_COVARIANCE = '/link_tip/deflection_with_covariance'
WRENCH = '/link_tip/wrench'
DIAGNOSTICS = '/diagnostics'
LOAD = '/link_tip/load'
REFERENCE = '/reference/deflection'
TEMPERATURE = '/environment/temperature'

TOPIC_TYPES: Mapping[str, str] = {
    SAMPLES: point_cloud2.TYPE,
    SPOTS[0]: point_stamped.TYPE,
    SPOTS[1]: point_stamped.TYPE,
    DEFLECTION: pose_stamped.TYPE,
    DEFLECTION_WITH_COVARIANCE: pose_with_covariance_stamped.TYPE,
    WRENCH: wrench_stamped.TYPE,
    DIAGNOSTICS: diagnostic_array.TYPE,
    LOAD: wrench_stamped.TYPE,
    REFERENCE: pose_stamped.TYPE,
    TEMPERATURE: temperature.TYPE,
}
"""Every fixed topic and its type; each solver adds :func:`solver_topic`, a PoseStamped."""

INPUTS = (LOAD, REFERENCE, TEMPERATURE)
"""The topics that the node subscribes to."""

_MEASURED = (BlockStatus.OK, BlockStatus.OUTSIDE_ACTIVE_AREA, BlockStatus.NOT_SOLVED)
"""The dots of these blocks were seen. With the laser lost or a channel saturated, the mean is not
where the dot was, and of too few samples it is not the mean of the block: nothing is published."""


class Message(NamedTuple):
    """One message: ``type`` as ``pkg/msg/Name``, ``t_ns`` its header's stamp, ``fields`` a dict."""

    topic: str
    type: str
    t_ns: int
    fields: dict[str, Any]


def solver_topic(solver: str) -> str:
    """Where one solver's own answer goes."""
    return f'/link_tip/{solver}/deflection'


def to_messages(record: Record) -> tuple[Message, ...]:
    """Every message that a record is published and recorded as; none where there is nothing to say."""
    return tuple(messages(record))


def messages(record: Record) -> Iterator[Message]:
    """:func:`to_messages`, each made only when it is asked for: the first waits for no other."""
    if not isinstance(record, DeflectionEstimate):
        yield from _messages(record)
        return
    t_ns = record.t_ns
    fields = pose_stamped.from_estimate(record)
    if record.primary:
        # The one that a controller waits for goes first.
        yield Message(DEFLECTION, pose_stamped.TYPE, t_ns, fields)
    yield Message(solver_topic(record.solver), pose_stamped.TYPE, t_ns, fields)
    if record.primary:
        with_covariance = pose_with_covariance_stamped.from_estimate(record)
        yield Message(DEFLECTION_WITH_COVARIANCE, pose_with_covariance_stamped.TYPE, t_ns, with_covariance)


def _messages(record: Record) -> tuple[Message, ...]:
    if isinstance(record, SampleBlock):
        return tuple(
            Message(SAMPLES, point_cloud2.TYPE, int(part.t_ns[0]), point_cloud2.from_block(part))
            for part in point_cloud2.parts(record)
        )
    if isinstance(record, ParameterChange):
        return ()
    t_ns = record.t_ns
    if isinstance(record, SpotMeans):
        if record.status not in _MEASURED or not all(map(math.isfinite, record.dots)):
            return ()
        return tuple(
            Message(topic, point_stamped.TYPE, t_ns, point_stamped.from_spot(record, psd))
            for psd, topic in enumerate(SPOTS, 1)
        )
    if isinstance(record, TipLoad):
        return (Message(WRENCH, wrench_stamped.TYPE, t_ns, wrench_stamped.from_load(record)),)
    if isinstance(record, AppliedLoad):
        return (Message(LOAD, wrench_stamped.TYPE, t_ns, wrench_stamped.from_load(record)),)
    if isinstance(record, ReferencePose):
        return (Message(REFERENCE, pose_stamped.TYPE, t_ns, pose_stamped.from_reference(record)),)
    if isinstance(record, TemperatureReading):
        return (Message(TEMPERATURE, temperature.TYPE, t_ns, temperature.from_reading(record)),)
    if isinstance(record, DiagnosticReport):
        return (Message(DIAGNOSTICS, diagnostic_array.TYPE, t_ns, diagnostic_array.from_report(record)),)
    raise TypeError(f'no message for a {type(record).__name__}')


def from_fields(topic: str, fields: Mapping[str, Any]) -> AppliedLoad | ReferencePose | TemperatureReading:
    """The record of a message on one of ``INPUTS``. Raises ValueError for any other topic."""
    if topic == LOAD:
        return wrench_stamped.to_applied_load(fields)
    if topic == REFERENCE:
        return pose_stamped.to_reference(fields)
    if topic == TEMPERATURE:
        return temperature.to_reading(fields)
    raise ValueError(f'{topic} is not an input')
