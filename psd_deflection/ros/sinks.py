# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Connects a session to the graph: publishers of encoded messages, recorded subscriptions, services, transforms."""

import importlib.util
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future as DiskFuture
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from geometry_msgs.msg import Quaternion, TransformStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from msg_adapters import (
    ACCELERATION,
    DIAGNOSTICS,
    LOAD,
    MARK,
    REFERENCE,
    REFERENCE_WITH_COVARIANCE,
    TEMPERATURE,
    TOPIC_TYPES,
    vector3_stamped,
)
from msg_adapters.header import stamp_ns
from msg_adapters.orientation import quaternion
from msg_adapters.string import to_mark
from psd_deflection.base.errors import PsdDeflectionError
from psd_deflection.base.log import null_log
from psd_deflection.model.plate.layout import Vector
from psd_deflection.model.solvers.registry import solver_class
from psd_deflection.recordings import cdr
from psd_deflection.records import DeflectionEstimate, Record, SampleBlock, TemperatureReading
from psd_deflection.rig.config import Rig
from psd_deflection.ros.endpoints import message_class, publisher_of
from psd_deflection.ros.gate import InputGate, frame_fault, quaternion_fault, stamp_fault
from psd_deflection.ros.topics import BASE, PSDS, PUBLISHED, RECORD, REST, TF, TF_STATIC, TIP, VOLTS, ZERO
from psd_deflection.run.fanout import published
from psd_deflection.run.session import Session

STAMP_WITHIN_S = 60.0
"""A stamp further from now is of another clock. A reference may have one: `validate` finds the offset."""
LARGEST_LOAD = 1e6
"""Bound of a force, N, and of a torque, N m."""
COLDEST, HOTTEST = -100.0, 200.0
"""Bounds of a temperature, degrees Celsius: one in kelvin is rejected."""
LARGEST_ACCELERATION = 1e5
"""Bound of a component, m/s^2 or rad/s^2."""

Fields = Mapping[str, Any]


def input_fault(topic: str, fields: Fields, rig: Rig, now_ns: int) -> str:
    """Why the message on ``topic`` cannot be used; '' if it can. ``now_ns``: in the time of the samples.

    A load or a reference in a wrong frame would be a wrong truth for all that follows. Nothing is transformed here:
    rclpy's wheels have no tf2. So the sender gives it in the frame of the rig.
    """
    stamp = fields.get('header', {}).get('stamp', {'sec': 0, 'nanosec': 0})
    return stamp_fault(stamp['sec'], stamp['nanosec']) or _FAULTS[topic](fields, rig, now_ns)


def _load_fault(fields: Fields, rig: Rig, now_ns: int) -> str:
    wrench = fields['wrench']
    where = frame_fault(fields['header']['frame_id'], rig.monitor.frame_prefix + REST)
    if where or (where := _time_fault(fields, now_ns)):
        return where
    for name, axis, value in _components(wrench):
        if not abs(value) <= LARGEST_LOAD:
            return f'{name} {axis} = {value:g}: must be finite and at most {LARGEST_LOAD:g}'
    for name, axis in (('force', 'z'), ('torque', 'x'), ('torque', 'y')):
        if wrench[name][axis]:
            return f'{name} {axis} = {wrench[name][axis]:g}: cannot be used, only force x, force y and torque z can'
    return ''


def _reference_fault(fields: Fields, rig: Rig, now_ns: int) -> str:
    # With a covariance the pose lies one level deeper.
    pose = fields['pose'].get('pose', fields['pose'])
    reach = rig.link.length
    away = math.hypot(pose['position']['x'], pose['position']['y'])
    return (
        frame_fault(fields['header']['frame_id'], rig.monitor.frame_prefix + REST)
        or quaternion_fault([pose['orientation'][axis] for axis in 'xyzw'])
        or ('' if away <= reach else f'a tip {away:g} m away: must be finite and at most the length, {reach:g} m')
    )


def _temperature_fault(fields: Fields, rig: Rig, now_ns: int) -> str:
    celsius = fields['temperature']
    if not COLDEST <= celsius <= HOTTEST:
        return f'{celsius:g} °C: must be {COLDEST:g} to {HOTTEST:g}'
    return _time_fault(fields, now_ns)


def _acceleration_fault(fields: Fields, rig: Rig, now_ns: int) -> str:
    frame, wanted = fields['header']['frame_id'], rig.monitor.frame_prefix + BASE
    if frame != wanted:
        return f'frame_id {frame!r}: must be {wanted}'
    for name, axis, value in _components(fields['accel']):
        if not abs(value) <= LARGEST_ACCELERATION:
            return f'{name} {axis} = {value:g}: must be finite and at most {LARGEST_ACCELERATION:g}'
    return _time_fault(fields, now_ns)


def _mark_fault(fields: Fields, rig: Rig, now_ns: int) -> str:
    try:
        to_mark(fields)
    except ValueError as error:
        return str(error)
    return ''


def _components(vectors: Fields) -> Iterator[tuple[str, str, float]]:
    return ((name, axis, vector[axis]) for name, vector in vectors.items() for axis in 'xyz')


def _time_fault(fields: Fields, now_ns: int) -> str:
    """Why the stamp cannot be of now; 0 means now."""
    t_ns = stamp_ns(fields)
    away_s = abs(t_ns - now_ns) / 1e9 if t_ns else 0.0
    return (
        '' if away_s <= STAMP_WITHIN_S else f'its stamp is {away_s:.3g} s from now: must be within {STAMP_WITHIN_S:g}'
    )


_FAULTS: Mapping[str, Callable[[Fields, Rig, int], str]] = {
    LOAD: _load_fault,
    MARK: _mark_fault,
    REFERENCE: _reference_fault,
    REFERENCE_WITH_COVARIANCE: _reference_fault,
    TEMPERATURE: _temperature_fault,
    ACCELERATION: _acceleration_fault,
}


def topics_of(rig: Rig) -> tuple[str, ...]:
    """The topics that a node of ``rig`` publishes encoded messages on. Raises ConfigError for an unknown solver."""
    for name in rig.estimator.solvers:
        solver_class(name)
    volts = VOLTS[: len(rig.psds)] if rig.monitor.publish_volts else ()
    return (*published(rig), *volts)


class PublisherSink:
    """Publishes encoded messages: a wire of the fan-out. While it is not ``active``, diagnostics alone.

    ``below``: namespace of the topics in that of the node.
    """

    def __init__(self, node: Node, topics: Iterable[str], below: str = '') -> None:
        self.active = False
        self._node = node
        self._below = below
        self._publishers: dict[str, Publisher] = {}  # Bound: our own topics.
        self.offer(topics)

    def offer(self, topics: Iterable[str]) -> None:
        """Publish exactly these topics from now on. Only while no session runs."""
        topics = tuple(topics)
        for topic in [t for t in self._publishers if t not in topics]:
            self._node.destroy_publisher(self._publishers.pop(topic))
        for topic in [t for t in topics if t not in self._publishers]:
            self._publishers[topic] = publisher_of(self._node, topic, self._below)

    def names(self, topics: Iterable[str]) -> list[str]:
        """Names of the topics on the graph, including remapping."""
        return [self._publishers[topic].topic_name for topic in topics]

    def put(self, topic: str, type_name: str, cdr: bytes, t_ns: int) -> None:
        """Publish; the stamp is in the message."""
        if self.active or topic == DIAGNOSTICS:
            self._publishers[topic].publish(cdr)


class VoltsPublisher:
    """A sink of records: each raw sample as plain numbers, which plots draw; the bag has them as ``/psd/samples``."""

    def __init__(self, sink: PublisherSink, frame_prefix: str) -> None:
        self._sink = sink
        self._frame_prefix = frame_prefix
        self._encode = cdr.encoder_of(vector3_stamped.MESSAGE)

    def put(self, record: Record) -> None:
        """Publish the samples of a block."""
        if isinstance(record, SampleBlock) and self._sink.active:
            for psd, topic in enumerate(VOLTS[: record.volts.shape[1] // 3], 1):
                for t_ns, fields in vector3_stamped.from_block(record, psd, self._frame_prefix):
                    self._sink.put(topic, vector3_stamped.MESSAGE.name, self._encode(fields), t_ns)


class InputRecorder(InputGate):
    """Gives the session what other nodes say, as it arrives and if it can be used.

    ``session``: the one that takes it, or None. It counts and says what is rejected. ``below``: as
    of :class:`PublisherWire`.
    """

    def __init__(self, node: Node, topics: Iterable[str], below: str = '') -> None:
        super().__init__(node, null_log)
        self.session: Session | None = None
        self._below = below
        self._subscriptions: dict[str, list[Subscription]] = {}  # Bound: our own topics.
        self.offer(topics)

    def offer(self, topics: Iterable[str]) -> None:
        """Subscribe to exactly these topics from now on. Only while no session runs."""
        topics = tuple(topics)
        for topic in [t for t in self._subscriptions if t not in topics]:
            for subscription in self._subscriptions.pop(topic):
                self._node.destroy_subscription(subscription)
        for topic in [t for t in topics if t not in self._subscriptions]:
            check, take = partial(self._fault, topic), partial(self._take, topic)
            self._subscriptions[topic] = self.listen(topic, check, take, (self._below + topic).removeprefix('/'))

    def unpack(self, kind: Any, encoded: bytes) -> bytes:
        """The message as it came: the session records these bytes."""
        return bytes(encoded)

    def reject(self, topic: str, why: str) -> None:
        """Let the session count it and say why."""
        if self.session is not None:
            self.session.reject_input('/' + topic.removeprefix(self._below).removeprefix('/'), why)

    def _fault(self, topic: str, message: bytes) -> str:
        session = self.session
        if session is None:
            return ''
        fields = cdr.decode(TOPIC_TYPES[topic], message)
        return input_fault(topic, fields, session.rig, session.acquisition.now_ns())

    def _take(self, topic: str, message: bytes) -> None:
        if self.session is None:
            return
        record = self.session.take_input(topic, message)
        if isinstance(record, TemperatureReading):
            try:
                self.session.temperature(record.celsius)
            except TimeoutError as error:
                self.session.reject_input(topic, str(error))


R = TypeVar('R')
NOT_CONFIGURED = 'the node is not configured'


class Zeroed(NamedTuple):
    """Whether a zero was taken, and the zero or why not."""

    taken: bool
    text: str


def add_rig_services(
    node: Node,
    present: Callable[[], R | None],
    zero: Callable[[R], Zeroed],
    record: Callable[[R, bool], Sequence[DiskFuture[Path | None]]],
) -> None:
    """Serve ``~/zero`` and ``~/record``.

    ``present``: what runs, or None while the node is not configured; then both are rejected.
    ``zero`` takes a zero; ``record`` begins (True) or ends recordings, whose answers come from the
    disk. If they raise an error of the package or TimeoutError, the caller gets its text.
    """

    def answer_zero(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = False, f'not zeroed: {NOT_CONFIGURED}'
        if (running := present()) is not None:
            try:
                response.success, response.message = zero(running)
            except (PsdDeflectionError, TimeoutError) as error:
                response.message = f'not zeroed: {error}'
        return response

    async def answer_record(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success, response.message = False, NOT_CONFIGURED
        if (running := present()) is not None:
            try:
                folders = [await _result(asked) for asked in record(running, request.data)]
            except (PsdDeflectionError, TimeoutError) as error:
                response.message = str(error)
                return response
            verb = 'recording to' if request.data else 'recording ended:'
            message = ', '.join(str(folder) for folder in folders if folder is not None)
            response.success = True
            response.message = f'{verb} {message}' if message else 'no recording runs'
        return response

    node.create_service(Trigger, ZERO, answer_zero)
    # In a separate group: while one request waits for the disk, the node serves everything else.
    node.create_service(SetBool, RECORD, answer_record, callback_group=ReentrantCallbackGroup())


async def _result(asked: DiskFuture[Path | None]) -> Path | None:
    """The result of ``asked``, without a thread that waits."""
    answered: Any = Future()
    asked.add_done_callback(lambda _: answered.set_result(None))
    await answered
    return asked.result()


_UPRIGHT = {'x': 0.0, 'y': 0.0, 'z': 0.0, 'w': 1.0}


def installed() -> bool:
    """Whether tf2_msgs is there: it comes with a ROS installation, not with rclpy's wheels."""
    return importlib.util.find_spec('tf2_msgs') is not None


def transform_message(parent: str, child: str, t_ns: int, at: Vector, rotation: dict[str, float]) -> Any:
    """The TransformStamped of ``child`` in ``parent``, m."""
    out = TransformStamped(child_frame_id=child)
    out.header.frame_id = parent
    out.header.stamp.sec, out.header.stamp.nanosec = divmod(t_ns, 1_000_000_000)
    out.transform.translation.x, out.transform.translation.y, out.transform.translation.z = at
    out.transform.rotation = Quaternion(**rotation)
    return out


def static_transforms(rig: Rig, t_ns: int) -> list[Any]:
    """The TransformStamped of the unloaded tip and of the PSDs, which are on the plate or, at the base, fixed."""
    prefix = rig.monitor.frame_prefix
    holder = REST if rig.psds_at_base else TIP
    return [
        transform_message(prefix + BASE, prefix + REST, t_ns, (0.0, 0.0, rig.link.length), _UPRIGHT),
        *(
            transform_message(prefix + holder, prefix + name, t_ns, (*psd.center, psd.height), _UPRIGHT)
            for name, psd in zip(PSDS, rig.psds, strict=False)
        ),
    ]


def tip_transform(rig: Rig, e: DeflectionEstimate) -> Any:
    """The TransformStamped of the tip, true to scale."""
    rotation = quaternion(e.theta, e.phi, e.omega)
    prefix = rig.monitor.frame_prefix
    return transform_message(prefix + REST, prefix + TIP, e.t_ns, (e.dx, e.dy, 0.0), rotation)


class FramePublisher:
    """Publishes TransformStamped on ``/tf`` and ``/tf_static``. Needs tf2_msgs."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._message = message_class(PUBLISHED[TF].type)
        self._moving, self._static = publisher_of(node, TF), publisher_of(node, TF_STATIC)

    def fix(self, transforms: Sequence[Any]) -> None:
        """Publish those that do not move, in place of the ones before."""
        self._static.publish(self._message(transforms=transforms))

    def move(self, transforms: Sequence[Any]) -> None:
        """Publish those that move."""
        self._moving.publish(self._message(transforms=transforms))

    def close(self) -> None:
        """Take the publishers off the graph."""
        for publisher in (self._moving, self._static):
            self._node.destroy_publisher(publisher)


class TransformPublisher:
    """A sink of records: ``/tf`` for each primary estimate while it is ``active``. Needs tf2_msgs."""

    def __init__(self, node: Node, rig: Rig) -> None:
        self.active = False
        self._rig = rig
        self._frames = FramePublisher(node)
        self._frames.fix(static_transforms(rig, time.time_ns()))

    def put(self, record: Record) -> None:
        """Publish where the tip is."""
        if self.active and isinstance(record, DeflectionEstimate) and record.primary:
            self._frames.move([tip_transform(self._rig, record)])

    def close(self) -> None:
        """Take the publishers off the graph."""
        self._frames.close()
