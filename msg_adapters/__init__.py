# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Converts records to dicts of message fields and back, one file per message; used by rclpy and MCAP.

:data:`TOPICS` says which record goes to which topics; the fields are plain dicts with the
names of the ROS message definitions, so that nothing here needs ROS.
"""

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
    Mark,
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

Input = AppliedLoad | BaseAcceleration | Mark | ReferencePose | ReferenceWithCovariance | TemperatureReading

SAMPLES = '/psd/samples'
DEFLECTION = '/link_tip/deflection'
DEFLECTION_WITH_COVARIANCE = '/link_tip/deflection_with_covariance'
SOLVER = '/link_tip/{solver}/deflection'
"""Each solver's own answer."""
WRENCH = '/link_tip/wrench'
VELOCITY = '/link_tip/velocity'
FILTERED = '/link_tip/filtered/deflection'
DIAGNOSTICS = '/diagnostics'
RIG = '/link_tip/rig'
LOAD = '/link_tip/load'
MARK = '/link_tip/mark'
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


class Delivery(NamedTuple):
    """QoS of a topic: messages kept for a slow subscriber, and whether a late one gets the last message."""

    depth: int = 10
    reliable: bool = True
    latched: bool = False


RELIABLE = Delivery()
LATCHED = Delivery(depth=1, latched=True)
"""A late subscriber gets the last message (durability transient local)."""
SECOND_OF_BLOCKS = 50
"""A second of raw blocks: a subscriber that pauses for less misses none."""
BEST_EFFORT = Delivery(SECOND_OF_BLOCKS, reliable=False)
"""Of an input: a publisher may be of either kind."""

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
    if estimate.on_own_topic:
        yield name.format(solver=estimate.solver), estimate.t_ns, estimate


def _of_psd(psd: int) -> Callable[[str, SpotMeans], Iterator[Item]]:
    """Of one PSD, if its dot was seen. With a fault of one the dots of the others are good if they were used."""

    def items(name: str, spots: SpotMeans) -> Iterator[Item]:
        if not spots.published:
            return
        measured = spots.status in _MEASURED
        lost = not measured and (not spots.excluded or psd in spots.excluded)
        if psd <= len(spots.sums) and not lost and all(map(math.isfinite, spots.dots)):
            yield name, spots.t_ns, spots

    return items


class Topic(NamedTuple):
    """One topic, or one for each solver (``{solver}``): the message on it and the record that it is made of.

    ``description``: what is on it, for the documentation. ``fields``: of a record, or of what ``items`` makes
    of it. ``to_record``: back again, for a topic that the node subscribes to. ``delivery``: how it is
    published, or subscribed to if it is an input. ``items``: the messages of a record. ``common``: has
    one name for all nodes of a graph, whatever their namespaces.
    """

    name: str
    description: str
    message: MessageType
    record: type[Any]
    fields: Callable[[Any], Fields]
    to_record: Callable[[Mapping[str, Any]], Input] | None = None
    delivery: Delivery = RELIABLE
    items: Callable[[str, Any], Iterator[Item]] = _one
    common: bool = False


TOPICS = (
    Topic(
        SAMPLES,
        'every raw sample, one message per block, stamped with its first sample: '
        'a table (volts, no x, y, z), not a cloud to draw',
        point_cloud2.MESSAGE,
        SampleBlock,
        point_cloud2.from_block,
        delivery=Delivery(SECOND_OF_BLOCKS),
        items=_parts,
    ),
    *(
        Topic(
            name,
            'the dot of each PSD (m)',
            point_stamped.MESSAGE,
            SpotMeans,
            partial(point_stamped.from_spot, psd=n),
            items=_of_psd(n),
        )
        for n, name in enumerate(spot_topics(MOST_PSDS), start=1)
    ),
    # A controller waits for this message: it comes first.
    Topic(
        DEFLECTION,
        'ΔX, ΔY (m) and rotation, in `link_tip_rest`; stamp = middle of the block',
        pose_stamped.MESSAGE,
        DeflectionEstimate,
        pose_stamped.from_estimate,
        items=_of_primary,
    ),
    Topic(
        SOLVER,
        "each solver's own answer",
        pose_stamped.MESSAGE,
        DeflectionEstimate,
        pose_stamped.from_estimate,
        items=_of_solver,
    ),
    Topic(
        DEFLECTION_WITH_COVARIANCE,
        'the deflection with its covariance',
        pose_with_covariance_stamped.MESSAGE,
        DeflectionEstimate,
        pose_with_covariance_stamped.from_estimate,
        items=_of_primary,
    ),
    Topic(
        WRENCH,
        'the tip load that would cause this deflection, by the link model and the effects in the rig file',
        wrench_stamped.MESSAGE,
        TipLoad,
        wrench_stamped.from_load,
    ),
    Topic(
        VELOCITY,
        "with `filter: modal`: the tip's velocity ([Motion](motion.md))",
        twist_stamped.MESSAGE,
        TipMotion,
        twist_stamped.from_motion,
    ),
    Topic(
        FILTERED,
        "with `filter: modal`: the pose at the block's last sample, coasting through what is lost",
        pose_with_covariance_stamped.MESSAGE,
        TipMotion,
        pose_with_covariance_stamped.from_estimate,
    ),
    Topic(
        DIAGNOSTICS,
        'once a second: the health of each part, as rates, losses and their causes, clock, latency, lasers',
        diagnostic_array.MESSAGE,
        DiagnosticReport,
        diagnostic_array.from_report,
        common=True,
    ),
    Topic(
        RIG,
        'all parameters, the zero and what the device says of itself, as JSON; sent again when one changes, '
        'and every 10 s with `memory`: what the pipeline remembers before `block`, '
        'so that a recorder that joined late replays bit for bit from there',
        string.MESSAGE,
        RigState,
        string.from_rig,
        delivery=LATCHED,
    ),
    Topic(
        LOAD,
        'a known load at the tip, in `link_tip_rest`; holds until the next',
        wrench_stamped.MESSAGE,
        AppliedLoad,
        wrench_stamped.from_load,
        wrench_stamped.to_applied_load,
        # It holds until the next: a lost message would be a wrong label of all that follows.
        Delivery(SECOND_OF_BLOCKS),
    ),
    Topic(
        MARK,
        'a mark ("bumped it here"), at the time of its arrival (by page or command: of the click, or of the '
        "command's start); at most 200 printable characters",
        string.MESSAGE,
        Mark,
        string.from_mark,
        string.to_mark,
        # It is set once.
        Delivery(SECOND_OF_BLOCKS),
    ),
    Topic(
        ACCELERATION,
        "with `filter: modal`: acceleration of the link's base, in `link_base` "
        '([Motion](motion.md#a-link-on-a-base-that-moves))',
        accel_stamped.MESSAGE,
        BaseAcceleration,
        accel_stamped.from_base,
        accel_stamped.to_base,
        BEST_EFFORT,
    ),
    Topic(
        REFERENCE,
        'an independent measurement of the tip, in `link_tip_rest`',
        pose_stamped.MESSAGE,
        ReferencePose,
        pose_stamped.from_reference,
        pose_stamped.to_reference,
        BEST_EFFORT,
    ),
    Topic(
        REFERENCE_WITH_COVARIANCE,
        'the reference with its covariance',
        pose_with_covariance_stamped.MESSAGE,
        ReferenceWithCovariance,
        pose_with_covariance_stamped.from_estimate,
        pose_with_covariance_stamped.to_reference,
        BEST_EFFORT,
    ),
    Topic(
        TEMPERATURE,
        'the temperature of the rig, °C',
        temperature.MESSAGE,
        TemperatureReading,
        temperature.from_reading,
        temperature.to_reading,
        BEST_EFFORT,
    ),
)
"""Every topic of a rig's records, in the order in which the messages of one are sent: a new one is one entry here.

The topics that carry no record (frames, markers, a robot's joints) are in :mod:`psd_deflection.ros.topics`, with these.
"""

TOPIC_TYPES: Mapping[str, str] = {t.name: t.message.name for t in TOPICS if t.name != SOLVER}
MESSAGE_TYPES: Mapping[str, MessageType] = {t.message.name: t.message for t in TOPICS}
INPUTS = tuple(t.name for t in TOPICS if t.to_record is not None)
"""The topics that the node subscribes to; :data:`FILTER_INPUTS` only with a filter."""

FILTER_TOPICS = (VELOCITY, FILTERED)
"""Published if the rig asks for the filter."""

FILTER_INPUTS = (ACCELERATION,)
"""Subscribed to if the rig asks for the filter."""

BY_NAME: Mapping[str, Topic] = {t.name: t for t in TOPICS}
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
    entry = BY_NAME.get(topic)
    if entry is None or entry.to_record is None:
        raise ValueError(f'{topic} is not an input')
    return entry.to_record(fields)
