"""The node ``estimator``: publishes what the pipeline gives, from the pipeline's own thread.

A message is encoded once; the same bytes are published and recorded. The executor in the main
thread serves parameters, services, inputs and the 1 Hz diagnostics, nothing faster.
"""

from __future__ import annotations

import importlib
import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool, Trigger

from msg_adapters import INPUTS, TOPIC_TYPES, solver_topic
from psd_deflection.errors import ConfigError, PsdDeflectionError
from psd_deflection.monitor.start import start_monitor
from psd_deflection.records import DiagnosticReport
from psd_deflection.ros.parameters import rig_of_node, watch
from psd_deflection.runner.health import HealthReporter
from psd_deflection.runner.session import Session

NODE_NAME = 'estimator'
DEPTH = 10
SAMPLES_DEPTH = 50
"""A second of raw blocks: a subscriber that stutters misses none."""

SPIN_S = 0.1
"""How long a signal may wait to be seen."""


def message_class(type_name: str) -> Any:
    """The class of ``pkg/msg/Name``."""
    package, _, name = type_name.split('/')
    return getattr(importlib.import_module(f'{package}.msg'), name)


class PublisherWire:
    """Publishes encoded messages: a wire of the fan-out."""

    def __init__(self, node: Node, topics: Mapping[str, str]) -> None:
        options = QoSOverridingOptions.with_default_policies()
        self._publishers: dict[str, Publisher] = {}
        for topic, type_name in topics.items():
            depth = SAMPLES_DEPTH if topic == '/psd/samples' else DEPTH
            qos = QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE)
            self._publishers[topic] = node.create_publisher(
                message_class(type_name), topic, qos, qos_overriding_options=options
            )

    def put(self, topic: str, type_name: str, cdr: bytes, t_ns: int) -> None:
        """Publish; the stamp is in the message."""
        self._publishers[topic].publish(cdr)


class EstimatorNode:
    """Node and session together. Raises the errors of both where the run cannot start."""

    def __init__(self, overrides: Mapping[str, object], say: Callable[[str], None] | None) -> None:
        try:
            self.node = Node(
                NODE_NAME,
                automatically_declare_parameters_from_overrides=True,
                parameter_overrides=[RosParameter(name, value=value) for name, value in overrides.items()],
            )
        except ParameterException as error:
            raise ConfigError(f'ROS parameters: {error}') from None
        try:
            logger = self.node.get_logger()
            self._say = say or logger.info
            rig = rig_of_node(self.node, {})
            self.session = Session(rig, self._say)
        except BaseException:
            self.node.destroy_node()
            raise
        try:
            self._join_ros()
            self._monitor = start_monitor(self.session, self._say)
        except BaseException:
            self.session.close()
            self.node.destroy_node()
            raise

    def _join_ros(self) -> None:
        node, session = self.node, self.session
        outputs = {topic: kind for topic, kind in TOPIC_TYPES.items() if topic not in INPUTS}
        outputs.update({solver_topic(s): TOPIC_TYPES['/link_tip/deflection'] for s in session.rig.estimator.solvers})
        try:
            session.fanout.wires.insert(0, PublisherWire(node, outputs))
            for topic in INPUTS:
                self._record_input(topic)
        except (InvalidQosOverridesError, ValueError) as error:
            raise ConfigError(f'ROS parameters: qos_overrides: {error}') from None
        watch(node, session)
        node.create_service(Trigger, '~/zero', self._zero)
        node.create_service(SetBool, '~/record', self._record)
        self._health = HealthReporter(session)
        node.create_timer(1.0, self._report)

    def _record_input(self, topic: str) -> None:
        """Known loads, references and temperatures go into the recording as they come."""
        type_name = TOPIC_TYPES[topic]
        session, clock = self.session, self.node.get_clock()

        def received(message: bytes) -> None:
            session.recorder.put(topic, type_name, bytes(message), clock.now().nanoseconds)

        self.node.create_subscription(
            message_class(type_name),
            topic,
            received,
            QoSProfile(depth=SAMPLES_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT),
            raw=True,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def _zero(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            change = self.session.zero()
        except TimeoutError as error:
            response.success, response.message = False, f'not zeroed: {error}'
            return response
        if change is None:
            response.success, response.message = False, 'not zeroed: no good block yet'
            return response
        (x1, y1), (x2, y2) = (psd.zero for psd in self.session.rig.psds)
        text = f'unloaded dots (mm): psd_1 ({x1 * 1e3:.4f}, {y1 * 1e3:.4f}), psd_2 ({x2 * 1e3:.4f}, {y2 * 1e3:.4f})'
        self._say(text)
        response.success, response.message = True, text
        return response

    def _record(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        try:
            folder = self.session.record(request.data)
        except (PsdDeflectionError, TimeoutError) as error:
            response.success, response.message = False, str(error)
            return response
        response.success = True
        verb = 'recording to' if request.data else 'recording ended:'
        response.message = f'{verb} {folder}' if folder is not None else 'no recording was made'
        self._say(response.message)
        return response

    def _report(self) -> None:
        report: DiagnosticReport = self._health.report(self.node.get_clock().now().nanoseconds)
        self.session.fanout.put(report)

    def close(self) -> None:
        """End the session, then the node."""
        if self._monitor is not None:
            self._monitor.close()
        self.session.close()
        self.node.destroy_node()


def run(
    ros_args: Sequence[str],
    overrides: Mapping[str, object],
    say: Callable[[str], None] | None = None,
    while_running: Callable[[Session], None] | None = None,
) -> int:
    """Run the node until SIGINT or SIGTERM, however often they come.

    ``overrides``: parameters that take precedence over ``ros_args``. ``while_running`` is called
    about ten times a second, for a display. Raises the errors of the package where the run cannot
    start, or where the pipeline failed.
    """
    stop = threading.Event()
    previous = {s: signal.signal(s, lambda *_: stop.set()) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        try:
            rclpy.init(args=[NODE_NAME, *ros_args], signal_handler_options=SignalHandlerOptions.NO)
        except RuntimeError as error:
            raise ConfigError('ROS arguments: ' + str(error).splitlines()[0]) from None
        try:
            estimator = EstimatorNode(overrides, say)
            executor = SingleThreadedExecutor()
            executor.add_node(estimator.node)
            try:
                estimator.session.start()
                while not stop.is_set() and estimator.session.processing.alive:
                    executor.spin_once(timeout_sec=SPIN_S)
                    if while_running is not None:
                        while_running(estimator.session)
            finally:
                executor.remove_node(estimator.node)
                executor.shutdown(timeout_sec=0.5)
                estimator.close()
            if estimator.session.failed is not None:
                raise estimator.session.failed
        finally:
            rclpy.try_shutdown()
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    return 0
