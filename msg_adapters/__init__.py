"""Converts records to dicts of message fields and back, one file per message; used by rclpy and MCAP.

:data:`TOPICS` says which record goes to which topics; the fields are plain dicts with the
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
    MOST_PSDS,
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
SOLVER = '/link_tip/{solver}/deflection'
"""Each solver's own answer."""
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


Item = tuple[str, int, Any]
"""A message to be made: its topic, its stamp (ns), and what its fields are made of."""

_MEASURED = (BlockStatus.OK, BlockStatus.OUTSIDE_ACTIVE_AREA, BlockStatus.NOT_SOLVED)
"""Blocks whose dots are published. If the laser is lost, a channel is saturated or samples are too
few, the mean is not the place of the dot, and nothing is published.
"""


def _one(name: str, record: Any) -> Iterator[Item]:
    """One message for each record."""
    yield name, record.t_ns, record


def _parts(name: str, block: SampleBlock) -> Iterator[Item]:
    """One for each part of a block: a message has its samples within some seconds."""
    return ((name, int(part.t_ns[0]), part) for part in point_cloud2.parts(block))


def _of_primary(name: str, estimate: DeflectionEstimate) -> Iterator[Item]:
    """Of the primary estimate alone."""
    if estimate.primary:
        yield name, estimate.t_ns, estimate


def _of_solver(name: str, estimate: DeflectionEstimate) -> Iterator[Item]:
    """Of each estimate, on its solver's topic."""
    yield name.format(solver=estimate.solver), estimate.t_ns, estimate


def _of_psd(psd: int) -> Callable[[str, SpotMeans], Iterator[Item]]:
    """Of one PSD, if its dot was seen. With a fault of one the dots of the others are good if they were used."""

    def items(name: str, spots: SpotMeans) -> Iterator[Item]:
        measured = spots.status in _MEASURED
        lost = not measured and (not spots.left_out or psd in spots.left_out)
        if psd <= len(spots.sums) and not lost and all(map(math.isfinite, spots.dots)):
            yield name, spots.t_ns, spots

    return items


class Topic(NamedTuple):
    """One topic, or one for each solver (``{solver}``): the message on it and the record that it is made of.

    ``fields``: of a record, or of what ``items`` makes of it. ``to_record``: back again, for a topic that the node
    subscribes to. ``latched``: a late subscriber gets the last message (durability transient local). ``items``: the
    messages of a record.
    """

    name: str
    message: MessageType
    record: type[Any]
    fields: Callable[[Any], Fields]
    to_record: Callable[[Mapping[str, Any]], Input] | None = None
    latched: bool = False
    items: Callable[[str, Any], Iterator[Item]] = _one


TOPICS = (
    Topic(SAMPLES, point_cloud2.MESSAGE, SampleBlock, point_cloud2.from_block, items=_parts),
    *(
        Topic(name, point_stamped.MESSAGE, SpotMeans, partial(point_stamped.from_spot, psd=n), items=_of_psd(n))
        for n, name in enumerate(spot_topics(MOST_PSDS), start=1)
    ),
    # A controller waits for this message: it comes first.
    Topic(DEFLECTION, pose_stamped.MESSAGE, DeflectionEstimate, pose_stamped.from_estimate, items=_of_primary),
    Topic(SOLVER, pose_stamped.MESSAGE, DeflectionEstimate, pose_stamped.from_estimate, items=_of_solver),
    Topic(
        DEFLECTION_WITH_COVARIANCE,
        pose_with_covariance_stamped.MESSAGE,
        DeflectionEstimate,
        pose_with_covariance_stamped.from_estimate,
        items=_of_primary,
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
"""Every topic of a rig's records, in the order in which the messages of one are sent: a new one is one line here."""

TOPIC_TYPES: Mapping[str, str] = {t.name: t.message.name for t in TOPICS if t.name != SOLVER}
MESSAGE_TYPES: Mapping[str, MessageType] = {t.message.name: t.message for t in TOPICS}
INPUTS = tuple(t.name for t in TOPICS if t.to_record is not None)
"""The topics that the node subscribes to; :data:`FILTER_INPUTS` only with a filter."""

FILTER_TOPICS = (VELOCITY, FILTERED)
"""Published if the rig asks for the filter."""

FILTER_INPUTS = (ACCELERATION,)
"""Subscribed to if the rig asks for the filter."""

LATCHED = tuple(t.name for t in TOPICS if t.latched)

_BY_NAME = {t.name: t for t in TOPICS}
ROWS: dict[type[Any], tuple[Topic, ...]] = {ParameterChange: ()}
ROWS |= {kind: tuple(t for t in TOPICS if t.record is kind) for kind in {t.record for t in TOPICS}}
"""The topics of each kind of record; a change of parameters has none."""


class Message(NamedTuple):
    """One message: ``type`` as ``pkg/msg/Name``, ``t_ns`` its header's stamp, ``fields`` a dict."""

    topic: str
    type: str
    t_ns: int
    fields: dict[str, Any]


def solver_topic(solver: str) -> str:
    """The topic of one solver's own answer."""
    return SOLVER.format(solver=solver)


def to_messages(record: Record, frame_prefix: str = '') -> tuple[Message, ...]:
    """Every message that a record is published and recorded as; an empty tuple if there is none.

    ``frame_prefix``: put before the name of the messages' frame.
    """
    return tuple(messages(record, frame_prefix))


def messages(record: Record, frame_prefix: str = '') -> Iterator[Message]:
    """:func:`to_messages` as a generator: the first message does not wait for the others.

    Messages that are made alike of the same share their fields.
    """
    try:
        rows = ROWS[type(record)]
    except KeyError:
        raise TypeError(f'no message for a {type(record).__name__}') from None
    made: tuple[object, object] = (None, None)
    fields: Fields = {}
    for row in rows:
        for name, t_ns, item in row.items(row.name, record):
            if made[0] is not row.fields or made[1] is not item:
                made, fields = (row.fields, item), row.fields(item)
                header = fields.get('header', {})
                if frame_prefix and header.get('frame_id'):
                    header['frame_id'] = frame_prefix + header['frame_id']
            yield Message(name, row.message.name, t_ns, fields)


def from_fields(topic: str, fields: Mapping[str, Any]) -> Input:
    """The record of a message on one of ``INPUTS``. Raises ValueError for another topic, and if it cannot be used."""
    found = _BY_NAME.get(topic)
    if found is None or found.to_record is None:
        raise ValueError(f'{topic} is not an input')
    return found.to_record(fields)
