"""Converts records to dicts of message fields and back, one file per message; used by rclpy and MCAP.

:func:`to_messages` decides which record goes to which topics; the fields are plain dicts with the
names of the ROS message definitions, so that nothing here needs ROS.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

from msg_adapters import (
    accel_stamped,
    diagnostic_array,
    point_cloud2,
    point_stamped,
    pose_stamped,
    pose_with_covariance_stamped,
    string,
    temperature,
    twist_stamped,
    wrench_stamped,
)
from msg_adapters.header import Fields
from msg_adapters.message_type import MessageType
from psd_deflection.records import (
    AppliedLoad,
    BaseAcceleration,
    BlockStatus,
    DeflectionEstimate,
    DiagnosticReport,
    ParameterChange,
    Record,
    ReferencePose,
    ReferenceWithCovariance,
    RigState,
    SampleBlock,
    SpotMeans,
    TemperatureReading,
    TipLoad,
    TipMotion,
)

Input = AppliedLoad | BaseAcceleration | ReferencePose | ReferenceWithCovariance | TemperatureReading

SAMPLES = '/psd/samples'
DEFLECTION = '/link_tip/deflection'
DEFLECTION_WITH_COVARIANCE = '/link_tip/deflection_with_covariance'
VELOCITY = '/link_tip/velocity'
FILTERED = '/link_tip/filtered/deflection'
DIAGNOSTICS = '/diagnostics'
RIG = '/link_tip/rig'
LOAD = '/link_tip/load'
ACCELERATION = '/link_base/acceleration'
REFERENCE = '/reference/deflection'
REFERENCE_WITH_COVARIANCE = '/reference/deflection_with_covariance'
TEMPERATURE = '/environment/temperature'
END_EFFECTOR = '/end_effector/deflection'
"""Of a chain of links (``pose_with_covariance_stamped.from_end_effector``); no rig publishes it."""


def spot_topics(psds: int) -> tuple[str, ...]:
    """The topic of each PSD's dot."""
    return tuple(f'/psd_{n}/spot' for n in range(1, psds + 1))


SPOTS = spot_topics(2)
"""Of the PSDs that every rig has."""


class Topic(NamedTuple):
    """One topic: the message on it and the record that it is made of.

    ``fields``: of a record. ``to_record``: back again, for a topic that the node subscribes to.
    ``latched``: a late subscriber gets the last message (durability transient local).
    """

    name: str
    message: MessageType
    record: type[Any]
    fields: Callable[[Any], Fields]
    to_record: Callable[[Mapping[str, Any]], Input] | None = None
    latched: bool = False


TOPICS = (
    Topic(SAMPLES, point_cloud2.MESSAGE, SampleBlock, point_cloud2.from_block),
    Topic(SPOTS[0], point_stamped.MESSAGE, SpotMeans, partial(point_stamped.from_spot, psd=1)),
    Topic(SPOTS[1], point_stamped.MESSAGE, SpotMeans, partial(point_stamped.from_spot, psd=2)),
    Topic(DEFLECTION, pose_stamped.MESSAGE, DeflectionEstimate, pose_stamped.from_estimate),
    Topic(
        DEFLECTION_WITH_COVARIANCE,
        pose_with_covariance_stamped.MESSAGE,
        DeflectionEstimate,
        pose_with_covariance_stamped.from_estimate,
    ),
    Topic('/link_tip/wrench', wrench_stamped.MESSAGE, TipLoad, wrench_stamped.from_load),
    Topic(VELOCITY, twist_stamped.MESSAGE, TipMotion, twist_stamped.from_motion),
    Topic(FILTERED, pose_with_covariance_stamped.MESSAGE, TipMotion, pose_with_covariance_stamped.from_estimate),
    Topic(DIAGNOSTICS, diagnostic_array.MESSAGE, DiagnosticReport, diagnostic_array.from_report),
    Topic(RIG, string.MESSAGE, RigState, string.from_rig, latched=True),
    Topic(LOAD, wrench_stamped.MESSAGE, AppliedLoad, wrench_stamped.from_load, wrench_stamped.to_applied_load),
    Topic(ACCELERATION, accel_stamped.MESSAGE, BaseAcceleration, accel_stamped.from_base, accel_stamped.to_base),
    Topic(REFERENCE, pose_stamped.MESSAGE, ReferencePose, pose_stamped.from_reference, pose_stamped.to_reference),
    Topic(
        REFERENCE_WITH_COVARIANCE,
        pose_with_covariance_stamped.MESSAGE,
        ReferenceWithCovariance,
        pose_with_covariance_stamped.from_estimate,
        pose_with_covariance_stamped.to_reference,
    ),
    Topic(TEMPERATURE, temperature.MESSAGE, TemperatureReading, temperature.from_reading, temperature.to_reading),
)
"""Every fixed topic: a new message is one line here. Each solver adds :func:`solver_topic`, a PoseStamped,
each PSD beyond the second one of :func:`spot_topics`, a PointStamped."""

TOPIC_TYPES: Mapping[str, str] = {t.name: t.message.name for t in TOPICS}
MESSAGE_TYPES: Mapping[str, MessageType] = {t.message.name: t.message for t in TOPICS}
INPUTS = tuple(t.name for t in TOPICS if t.to_record is not None)
"""The topics that the node subscribes to; :data:`FILTER_INPUTS` only with a filter."""

FILTER_TOPICS = (VELOCITY, FILTERED)
"""Published if the rig asks for the filter."""

FILTER_INPUTS = (ACCELERATION,)
"""Subscribed to if the rig asks for the filter."""

LATCHED = tuple(t.name for t in TOPICS if t.latched)

_BY_NAME = {t.name: t for t in TOPICS}
_OF_RECORD = {kind: tuple(t for t in TOPICS if t.record is kind) for kind in {t.record for t in TOPICS}}

_MEASURED = (BlockStatus.OK, BlockStatus.OUTSIDE_ACTIVE_AREA, BlockStatus.NOT_SOLVED)
"""Blocks whose dots are published. If the laser is lost, a channel is saturated or samples are too
few, the mean is not the place of the dot, and nothing is published.
"""


class Message(NamedTuple):
    """One message: ``type`` as ``pkg/msg/Name``, ``t_ns`` its header's stamp, ``fields`` a dict."""

    topic: str
    type: str
    t_ns: int
    fields: dict[str, Any]


def solver_topic(solver: str) -> str:
    """The topic of one solver's own answer."""
    return f'/link_tip/{solver}/deflection'


def to_messages(record: Record, frame_prefix: str = '') -> tuple[Message, ...]:
    """Every message that a record is published and recorded as; an empty tuple if there is none.

    ``frame_prefix``: put before the name of the messages' frame.
    """
    return tuple(messages(record, frame_prefix))


def messages(record: Record, frame_prefix: str = '') -> Iterator[Message]:
    """:func:`to_messages` as a generator: the first message does not wait for the others."""
    named = None
    for message in _messages(record):
        # Topics may share their fields.
        if frame_prefix and message.fields is not named:
            named = message.fields
            header = named.get('header', {})
            if header.get('frame_id'):
                header['frame_id'] = frame_prefix + header['frame_id']
        yield message


def _messages(record: Record) -> Iterator[Message]:
    if not isinstance(record, DeflectionEstimate):
        yield from _of_topics(record)
        return
    t_ns = record.t_ns
    fields = pose_stamped.from_estimate(record)
    if record.primary:
        # A controller waits for this message: send it first.
        yield Message(DEFLECTION, pose_stamped.MESSAGE.name, t_ns, fields)
    yield Message(solver_topic(record.solver), pose_stamped.MESSAGE.name, t_ns, fields)
    if record.primary:
        with_covariance = pose_with_covariance_stamped.from_estimate(record)
        yield Message(DEFLECTION_WITH_COVARIANCE, pose_with_covariance_stamped.MESSAGE.name, t_ns, with_covariance)


def _of_topics(record: Record) -> tuple[Message, ...]:
    if isinstance(record, SampleBlock):
        return tuple(
            Message(SAMPLES, point_cloud2.MESSAGE.name, int(part.t_ns[0]), point_cloud2.from_block(part))
            for part in point_cloud2.parts(record)
        )
    if isinstance(record, ParameterChange):
        return ()
    if isinstance(record, SpotMeans):
        return _of_spots(record)
    try:
        topics = _OF_RECORD[type(record)]
    except KeyError:
        raise TypeError(f'no message for a {type(record).__name__}') from None
    return tuple(Message(t.name, t.message.name, record.t_ns, t.fields(record)) for t in topics)


def _of_spots(spots: SpotMeans) -> tuple[Message, ...]:
    if not all(map(math.isfinite, spots.dots)) or not (spots.status in _MEASURED or spots.left_out):
        return ()
    # With a fault of one PSD the dots of the others are good if the estimate was made of them.
    lost = () if spots.status in _MEASURED else spots.left_out
    seen = [n for n in range(1, len(spots.sums) + 1) if n not in lost]
    kind = point_stamped.MESSAGE.name
    return tuple(Message(f'/psd_{n}/spot', kind, spots.t_ns, point_stamped.from_spot(spots, n)) for n in seen)


def from_fields(topic: str, fields: Mapping[str, Any]) -> Input:
    """The record of a message on one of ``INPUTS``. Raises ValueError for another topic, and if it cannot be used."""
    found = _BY_NAME.get(topic)
    if found is None or found.to_record is None:
        raise ValueError(f'{topic} is not an input')
    return found.to_record(fields)
