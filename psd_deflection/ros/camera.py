"""The node ``camera``: images in, ``/reference/deflection`` out, with its covariance and the reasons of refused frames.

It subscribes to ``image`` (sensor_msgs/Image) and ``image/compressed`` (sensor_msgs/CompressedImage), and takes the
lens from ``camera_info`` if no parameter ``camera.matrix`` says it. The executor runs in the main thread; of the frames
that come while one is measured, all but the last are dropped.
"""

from __future__ import annotations

import collections
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions

from msg_adapters import DIAGNOSTICS, REFERENCE, REFERENCE_WITH_COVARIANCE, TOPIC_TYPES, to_messages
from psd_deflection.base.errors import ConfigError
from psd_deflection.camera.answer import FrameAnswer, Status
from psd_deflection.camera.footage import decoded, of_ros_image
from psd_deflection.camera.opencv import opencv
from psd_deflection.camera.reference import CameraReference
from psd_deflection.camera.settings import settings_from
from psd_deflection.camera.targets import target_of
from psd_deflection.recordings import cdr
from psd_deflection.records import DiagnosticEntry, DiagnosticReport, Record, ReferencePose
from psd_deflection.ros.log import NodeLog
from psd_deflection.ros.wires import message_class, relative

NODE_NAME = 'camera'
STATUS = 'psd_deflection: camera'
_DEPTH = 10
_OK, _WARN, _ERROR, _STALE = range(4)


class CameraNode:
    """The node. Raises ConfigError if a parameter is refused or OpenCV is missing."""

    def __init__(self, overrides: Mapping[str, object], say: Callable[[str], None]) -> None:
        opencv()
        self._say: Callable[[str], None] = say
        self._log: NodeLog | None = None
        self._reference: CameraReference | None = None
        self._info: Any = None
        self._since: collections.Counter[str] = collections.Counter()
        self._last: FrameAnswer | None = None
        self.node = Node(
            NODE_NAME,
            automatically_declare_parameters_from_overrides=True,
            parameter_overrides=[RosParameter(name, value=value) for name, value in overrides.items()],
        )
        try:
            given = self.node.get_parameters_by_prefix('')
            values = {name: _plain(p.value) for name, p in given.items() if name.partition('.')[0] not in _NOT_OURS}
            self.settings = settings_from(values, 'ROS parameters')
            self._log = NodeLog(self.node, say)
            self._say = self._log
            # Reliable: a subscriber may ask for less, as the estimator does.
            self._publishers = {
                topic: self.node.create_publisher(
                    message_class(TOPIC_TYPES[topic]),
                    relative(topic),
                    _DEPTH,
                    qos_overriding_options=QoSOverridingOptions.with_default_policies(),
                )
                for topic in (REFERENCE, REFERENCE_WITH_COVARIANCE, DIAGNOSTICS)
            }
            newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
            for topic, kind, take in (
                ('image', 'sensor_msgs/msg/Image', self._image),
                ('image/compressed', 'sensor_msgs/msg/CompressedImage', self._compressed),
                ('camera_info', 'sensor_msgs/msg/CameraInfo', self._take_info),
            ):
                self.node.create_subscription(message_class(kind), topic, take, newest)
            self.node.create_timer(1.0, self._report, clock=Clock(clock_type=ClockType.STEADY_TIME))
        except BaseException:
            self.node.destroy_node()
            raise
        topics = ', '.join(self._publishers[t].topic_name for t in (REFERENCE, REFERENCE_WITH_COVARIANCE))
        self._say(f'waiting for images on {self.node.resolve_topic_name("image")}; publishing {topics}')

    def _take_info(self, message: Any) -> None:
        self._info = message

    def _image(self, message: Any) -> None:
        image = of_ros_image(
            message.height,
            message.width,
            message.encoding,
            bool(message.is_bigendian),
            message.step,
            bytes(message.data),
        )
        self._take(message.header.stamp, image)

    def _compressed(self, message: Any) -> None:
        self._take(message.header.stamp, decoded(np.frombuffer(message.data, dtype=np.uint8), opencv()))

    def _take(self, stamp: Any, image: Any) -> None:
        t_ns = stamp.sec * 1_000_000_000 + stamp.nanosec + round(self.settings.exposure * 0.5e9)
        if self._reference is None:
            self._begin()
        if self._reference is not None:
            for answer in self._reference.take(t_ns, image):
                self._publish(answer)

    def _begin(self) -> None:
        settings = self.settings
        if not settings.matrix and self._info is not None and self._info.k[0] > 0.0:
            k, d = tuple(map(float, self._info.k)), tuple(map(float, self._info.d))
            try:
                settings = replace(settings, matrix=k, distortion=d)
            except (ConfigError, ValueError) as error:
                self._say(f'camera_info is not used: {error}')
        if not settings.matrix:
            self._say('camera.matrix is not given and there is no camera_info: distortion is not corrected')
        self._reference = CameraReference(settings, target_of)

    def _publish(self, answer: FrameAnswer) -> None:
        self._since[str(answer.status)] += 1
        record = answer.as_record()
        if record is not None:
            self._last = answer
            self._send(ReferencePose(record.t_ns, record.dx, record.dy, record.theta))
            self._send(record)

    def _send(self, record: Record) -> None:
        for message in to_messages(record):
            self._publishers[message.topic].publish(cdr.encode(message.type, message.fields))

    def _report(self) -> None:
        since, self._since = self._since, collections.Counter()
        frames, good = sum(since.values()), since.pop(str(Status.OK), 0)
        values = [('frames/s', str(frames)), ('answers/s', str(good))]
        values += [(f'refused: {reason}', str(count)) for reason, count in since.most_common()]
        if self._last is not None and self._last.covariance is not None:
            names = (('sd dx (m)', 0), ('sd dy (m)', 1), ('sd theta (rad)', 2))
            values += [(name, f'{math.sqrt(float(self._last.covariance[i, i])):.3g}') for name, i in names]
        if self._reference is not None and self._reference.rest is not None:
            values.append(('turn of the camera (rad)', f'{self._reference.turn:.6f}'))
        worst = since.most_common(1)
        if not frames:
            waits = self._reference is not None and self._reference.rest is None
            level, text = (_WARN, 'the rest is not known yet') if waits else (_STALE, 'no images')
        elif worst:
            level, text = (_WARN if good else _ERROR), f'{frames - good} of {frames} frames refused: {worst[0][0]}'
        else:
            level, text = _OK, f'{good} answers/s'
        self._send(DiagnosticReport(time.time_ns(), (DiagnosticEntry(STATUS, level, text, tuple(values)),)))

    def close(self) -> None:
        """Leave the graph."""
        if self._log is not None:
            self._log.close()
        self.node.destroy_node()


_NOT_OURS = {'use_sim_time', 'qos_overrides', 'start_type_description_service'}


def _plain(value: Any) -> object:
    """A parameter's value; arrays as lists."""
    return list(value) if hasattr(value, '__len__') and not isinstance(value, str) else value


def run_camera(ros_arguments: list[str], overrides: Mapping[str, object], say: Callable[[str], None]) -> None:
    """Measure until Ctrl-C. Raises ConfigError."""
    rclpy.init(args=['camera', *ros_arguments], signal_handler_options=SignalHandlerOptions.ALL)
    node: CameraNode | None = None
    try:
        node = CameraNode(overrides, say)
        executor = SingleThreadedExecutor()
        executor.add_node(node.node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        if node is not None:
            node.close()
        rclpy.try_shutdown()
