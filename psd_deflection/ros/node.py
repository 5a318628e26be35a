# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The base class of every node of this package: a lifecycle node with declared parameters, a log (terminal,
``/rosout``, file), an input gate that checks the messages of other nodes, and diagnostics once a second. With the
parameter ``autostart``, on by default, a node configures and activates itself. :func:`serve` runs a node."""

from __future__ import annotations

import abc
import contextlib
import os
import queue
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Generic, NamedTuple, Protocol, TypeVar

from rcl_interfaces.msg import Log, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import await_or_execute
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.logging import LoggingSeverity, get_logging_directory
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.publisher import Publisher

from msg_adapters import DIAGNOSTICS, to_messages
from psd_deflection.base.errors import ConfigError, PsdDeflectionError
from psd_deflection.base.log import ERROR, INFO, WARNING, LogCallback
from psd_deflection.recordings import cdr
from psd_deflection.records import DiagnosticEntry, DiagnosticReport
from psd_deflection.rig.declarations import BY_NAME, FRAME_PREFIX
from psd_deflection.rig.parameters import Section, Value
from psd_deflection.ros.declared import SOURCE, USE_SIM_TIME, DeclaredParameters
from psd_deflection.ros.endpoints import publisher_of
from psd_deflection.ros.gate import GatedNode, InputGate
from psd_deflection.ros.running import SPIN_S, executor_of
from psd_deflection.ros.topics import PUBLISHED, ROSOUT
from psd_deflection.run.diagnostics import OK, STALE
from psd_deflection.run.realtime import Signals, settle

AUTOSTART = BY_NAME['autostart']
MAX_QUEUED_LINES = 1000
"""Log lines that may wait for a slow disk; further lines are missing in the file."""
LOG_CLOSE_S = 0.2
"""Longest wait at the end for the last lines to reach the log file, s: the disk may hang."""
SHUTDOWN_REPLY_S = 0.3
"""Time for DDS to send the reply of ``change_state`` before a node that was shut down ends, s."""
REST_LIMIT_S = 10.0
"""Longest time in which a node may come to rest after a signal, s; see :meth:`BaseNode.at_rest`."""
T = TypeVar('T')
T_co = TypeVar('T_co', covariant=True)


def rcl_log_file() -> Path | None:
    """Return the log file of this process, ``PROGRAM_PID_TIME.log``, or None if rcl writes none."""
    with contextlib.suppress(OSError):
        files = get_logging_directory().glob(f'*_{os.getpid()}_*.log')
        return max(files, key=lambda file: file.stat().st_mtime_ns, default=None)
    return None


class NodeLog:
    """The log callback of a node. A call logs one line on the terminal (by ``log``), on ``/rosout`` and in rcl's file.

    The lines do not pass rcl's logger, which would also print them on the terminal, across the status line that the
    display redraws there. A thread appends them to rcl's file, so that a hanging disk delays nothing.
    """

    def __init__(self, node: Node, log: LogCallback) -> None:
        self._log = log
        self._logger = node.get_logger()
        self._publisher = publisher_of(node, ROSOUT)
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()  # Bound: MAX_QUEUED_LINES.
        self._thread: threading.Thread | None = None
        file = rcl_log_file()
        if file is not None:
            self._thread = threading.Thread(target=self._write, args=(file,), name='log', daemon=True)
            self._thread.start()

    def __call__(self, text: str, level: int = INFO, /) -> None:
        """Log one line, from any thread, unless ``--log-level`` excludes ``level``."""
        severity = LoggingSeverity(level)
        if not self._logger.is_enabled_for(severity):
            return
        message = Log(level=level, name=self._logger.name, msg=text)
        message.stamp.sec, message.stamp.nanosec = divmod(time.time_ns(), 1_000_000_000)
        # File first, terminal last: whoever reads a line on the terminal will find it in the file.
        if self._thread is not None and self._lines.qsize() < MAX_QUEUED_LINES:
            seconds = f'{message.stamp.sec}.{message.stamp.nanosec:09d}'
            self._lines.put(f'[{severity.name}] [{seconds}] [{self._logger.name}]: {text}\n')
        # A thread that outlives the node may still log; the publisher is destroyed by then.
        with contextlib.suppress(RuntimeError):
            self._publisher.publish(message)
        self._log(text, level)

    def close(self) -> None:
        """Write the last lines to the file, within ``LOG_CLOSE_S``."""
        if self._thread is not None:
            self._lines.put(None)  # Ends the thread.
            self._thread.join(LOG_CLOSE_S)

    def _write(self, file: Path) -> None:
        # If the file cannot be written, the node runs on without it. Buffering 1: each line is flushed.
        with contextlib.suppress(OSError), file.open('a', 1, 'utf-8', 'backslashreplace') as stream:
            while (line := self._lines.get()) is not None:
                stream.write(line)


class Health(NamedTuple):
    """The state of one ``part`` of a node: an entry of ``/diagnostics``. ``level``: OK, WARN, ERROR or STALE of
    :mod:`psd_deflection.run.diagnostics`. ``values``: pairs of key and value."""

    part: str
    level: int
    text: str
    values: tuple[tuple[str, str], ...] = ()


class NodeParameters(Protocol[T_co]):
    """The declared parameters of a node, with their present values."""

    @property
    def values(self) -> Mapping[str, Value]:
        """The values by parameter name."""

    @property
    def settings(self) -> T_co:
        """The same values as one object."""


class _ManagedNode(GatedNode):
    """The rclpy lifecycle node; its ``owner`` carries out the transitions."""

    owner: BaseNode[Any]

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self.owner.transition(self.owner.configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self.owner.transition(self.owner.activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self.owner.transition(self.owner.deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self.owner.transition(self.owner.release)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self.owner.transition(self.owner.finish)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        # SUCCESS: the node becomes unconfigured. `owner.error` keeps the exception, which `BaseNode.start` raises.
        self.owner.cleanup()
        return TransitionCallbackReturn.SUCCESS


class BaseNode(abc.ABC, Generic[T]):
    """The base class of every node, with settings of type ``T``: the parameters of the node as one object.

    A subclass implements :meth:`declare` and :meth:`set_up`, and overrides transitions and :meth:`health` as needed.
    The constructor calls ``declare`` and ``set_up``: a subclass assigns what they use before ``super().__init__``.

    ``log``: writes a line to the terminal. ``overrides``: parameter values that take precedence over ROS arguments.
    Raises ConfigError for a rejected parameter, and destroys the rclpy node first.

    ``node``: the rclpy node. ``error``: the exception of the last transition, None if it succeeded. ``active``: whether
    the node is in the state active. ``finished``: whether ``change_state`` has shut the node down.
    """

    SYSTEM_TIME: ClassVar[bool] = False
    """Whether the system clock stamps the measurements, so that ``use_sim_time`` is rejected."""

    def __init__(self, name: str, log: LogCallback, overrides: Mapping[str, object] = MappingProxyType({})) -> None:
        self.error: Exception | None = None
        self.finished = self.active = False
        self._starting = False  # True during an automatic start, whose errors are raised, not logged.
        self._last_contested: frozenset[str] = frozenset()  # `contested_topics` at the last check.
        self._exclusive: list[Publisher] = []  # Bound: one per topic of the node.
        self._diagnostics: Publisher | None = None
        self.node = _make_node(name, overrides)
        self.node.owner = self
        self.log = NodeLog(self.node, log)
        self.gate = self.node.gate = InputGate(self.node, self.log)
        try:
            self.parameters = self.declare()
            self.set_up()
            if self.SYSTEM_TIME:
                self._reject_sim_time()
            self._guard_services()
            # A steady clock: diagnostics continue even if a simulated clock stops or the system clock is set.
            self.node.create_timer(1.0, self._every_second, clock=Clock(clock_type=ClockType.STEADY_TIME))
        except BaseException:
            self.leave()
            raise

    # Methods that a subclass overrides.

    @abc.abstractmethod
    def declare(self) -> NodeParameters[T]:
        """Declare the node's parameters and return them."""

    @abc.abstractmethod
    def set_up(self) -> None:
        """Make publishers, subscriptions and services; the parameters are already declared."""

    def configure(self) -> None:
        """Acquire what the node needs (a port, a file); the node does not publish yet."""
        self.active = False

    def activate(self) -> None:
        """Begin to publish."""
        self.active = True

    def deactivate(self) -> None:
        """Stop publishing, but keep what :meth:`configure` acquired."""
        self.active = False

    def cleanup(self) -> None:
        """Release what :meth:`configure` acquired; called in any state, also twice."""
        self.active = False

    def health(self) -> Iterable[Health]:
        """Return the health of each part of the node; called once a second."""
        return (Health('node', OK if self.active else STALE, 'active' if self.active else 'not active'),)

    def at_rest(self) -> bool:
        """Return whether the node may end; called repeatedly after a signal, for at most ``REST_LIMIT_S``. An override
        may also bring the node to rest: the compensator takes its offsets back to zero."""
        return True

    def exclusive_topics(self) -> Iterable[str]:
        """Return the names of the topics that no other node should publish."""
        return (publisher.topic_name for publisher in self._exclusive)

    # Methods that a subclass calls.

    @property
    def settings(self) -> T:
        """The present parameter values as one object."""
        return self.parameters.settings

    @property
    def frame_prefix(self) -> str:
        """The prefix of every frame name; '' for a node without that parameter."""
        return str(self.parameters.values.get(FRAME_PREFIX, ''))

    def declare_section(
        self, section: Section[T], defaults: T, on_change: Callable[[T], None] = lambda _: None
    ) -> DeclaredParameters[T]:
        """Declare the parameters of ``section``, and ``autostart``; return them. ``defaults``: the values of the
        section, unless ROS arguments give others. ``on_change``: gets the new settings when a parameter is set while
        the node runs, and raises ConfigError to reject them."""
        return DeclaredParameters(self.node, section, section.values(defaults), on_change, (AUTOSTART,))

    def publisher(self, topic: str) -> Publisher:
        """Return a new publisher of ``topic``, a key of :data:`PUBLISHED`. The topic is exclusive to this node, unless
        several may publish it (``/diagnostics``, ``/tf``)."""
        publisher = publisher_of(self.node, topic)
        if not PUBLISHED[topic].common:
            self._exclusive.append(publisher)
        return publisher

    def now_ns(self) -> int:
        """Return the node's time, ns; with ``use_sim_time`` the time of the simulation."""
        return int(self.node.get_clock().now().nanoseconds)

    def full_name(self) -> str:
        """Return ``/NAMESPACE/NAME``."""
        return str(self.node.get_fully_qualified_name())

    def contested_topics(self) -> list[str]:
        """Return the exclusive topics that another node publishes, too."""
        return [topic for topic in self.exclusive_topics() if self.node.count_publishers(topic) > 1]

    def with_node_name(self, report: DiagnosticReport) -> DiagnosticReport:
        """Return ``report`` with this node's name in place of ``psd_deflection`` in the name of each entry."""
        node = self.full_name().removeprefix('/')
        entries = (entry._replace(name=entry.name.replace('psd_deflection', node, 1)) for entry in report.entries)
        return report._replace(entries=tuple(entries))

    # The lifecycle.

    def start(self) -> None:
        """Configure and activate the node if ``autostart`` is set. Raises the error of a failed transition."""
        if not self.node.get_parameter(AUTOSTART.name).value:
            self.log(f'waiting to be configured: ros2 lifecycle set {self.full_name()} configure')
            return
        self._starting = True
        for trigger in (self.node.trigger_configure, self.node.trigger_activate):
            if trigger() != TransitionCallbackReturn.SUCCESS:
                raise self.error or ConfigError('the node does not start')
        self._starting = False

    def release(self) -> None:
        """Carry out the transition ``cleanup``. Apart from :meth:`cleanup`, which other transitions call, too."""
        self.cleanup()

    def finish(self) -> None:
        """Carry out the lifecycle's transition ``shutdown``, after which the node cannot be configured again."""
        self.cleanup()
        self.finished = True
        self.log('shut down by change_state')

    def transition(self, action: Callable[[], None]) -> TransitionCallbackReturn:
        """Carry out one transition by ``action``; log an exception and keep it in ``error``. Return FAILURE for a
        PsdDeflectionError (the state stays), ERROR for any other exception (the node becomes unconfigured)."""
        try:
            action()
        except PsdDeflectionError as error:
            self.error = error
            self._log_error(str(error))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self.error = error
            self._log_error(f'{type(error).__name__}: {error}')
            return TransitionCallbackReturn.ERROR
        self.error = None
        if action == self.activate:
            self._warn_of_missing_prefix()
        return TransitionCallbackReturn.SUCCESS

    def report(self) -> None:
        """Publish :meth:`health` on ``/diagnostics``; the first entry also has the rejections of the input gate."""
        node = self.full_name().removeprefix('/')
        entries = [DiagnosticEntry(f'{node}: {row.part}', row.level, row.text, row.values) for row in self.health()]
        if entries:
            entries[0] = entries[0]._replace(values=(*entries[0].values, *self.gate.values()))
        if self._diagnostics is None:
            self._diagnostics = self.publisher(DIAGNOSTICS)
        for message in to_messages(DiagnosticReport(self.now_ns(), tuple(entries))):
            self._diagnostics.publish(cdr.encode(message.type, message.fields))

    def close(self) -> None:
        """Release everything, and leave the graph."""
        self.cleanup()
        self.leave()

    def leave(self) -> None:
        """Close the log and destroy the rclpy node."""
        self.log.close()
        self.node.destroy_node()

    def _log_error(self, text: str) -> None:
        if not self._starting:
            self.log(text, ERROR)

    def _warn_of_missing_prefix(self) -> None:
        # A node in a namespace probably runs beside others of its kind, whose frames would have the same names.
        names_frames = FRAME_PREFIX in self.parameters.values
        if names_frames and not self.frame_prefix and self.node.get_namespace() != '/':
            self.log('frames have no prefix: if several nodes run, give each its own (frame_prefix)', WARNING)

    def _reject_sim_time(self) -> None:
        """Unset ``use_sim_time``, and from now on reject requests to set it."""
        why = 'what is measured is stamped by the system clock'
        if self.node.get_parameter(USE_SIM_TIME).value:
            self.node.set_parameters([RosParameter(USE_SIM_TIME, value=False)])
            self.log(f'{USE_SIM_TIME} is rejected: {why}', WARNING)

        def check(changed: list[RosParameter]) -> SetParametersResult:
            rejected = any(parameter.name == USE_SIM_TIME and parameter.value for parameter in changed)
            return SetParametersResult(successful=not rejected, reason=f'{USE_SIM_TIME}: {why}' if rejected else '')

        self.node.add_on_set_parameters_callback(check)

    def _guard_services(self) -> None:
        """Wrap the callback of every service: log an exception and reject the request. rclpy's own services raise if an
        active node is asked to activate or if a parameter has an unknown type; unhandled, that would end the node."""

        def guarded(callback: Callable[[Any, Any], Any], name: str) -> Callable[[Any, Any], Any]:
            async def respond(request: Any, response: Any) -> Any:
                try:
                    return await await_or_execute(callback, request, response)
                except Exception as error:
                    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
                    self.log(f'{name}: rejected: {reason}', WARNING)
                    return _reject_parameters(request, response, reason)

            return respond

        for service in self.node.services:
            service.callback = guarded(service.callback, service.service_name)

    def _every_second(self) -> None:
        # Log the rejections that the gate has counted since its last line.
        self.gate.settle()
        contested = frozenset(self.contested_topics())
        for topic in sorted(contested - self._last_contested):
            remedy = 'start one of them in a namespace (-r __ns:=/NAME)'
            self.log(f'another node publishes on {topic} too: {remedy}', WARNING)
        self._last_contested = contested
        self.report()


def _make_node(name: str, overrides: Mapping[str, object]) -> _ManagedNode:
    """Return the rclpy node; the parameters in ROS arguments and ``overrides`` are declared there, unchecked."""
    try:
        return _ManagedNode(
            name,
            automatically_declare_parameters_from_overrides=True,
            parameter_overrides=[RosParameter(key, value=value) for key, value in overrides.items()],
        )
    except ParameterException as error:
        raise ConfigError(f'{SOURCE}: {error}') from None
    except ValueError:
        fault = 'one of them is an empty list, of which ROS cannot tell the type; leave it out for its default'
        raise ConfigError(f'{SOURCE}: {fault}') from None
    except RuntimeError as error:
        # DDS rejects the node: DDS was built without security, or the enclave lacks a permission.
        raise ConfigError('ROS: ' + ' '.join(str(error).split())) from None


def _reject_parameters(request: Any, response: Any, reason: str) -> Any:
    """Return ``response``; if the service sets parameters, each result there is now a rejection for ``reason``."""
    rejected = SetParametersResult(successful=False, reason=reason)
    if hasattr(response, 'results') and hasattr(request, 'parameters'):
        response.results = [rejected for _ in request.parameters]
    elif hasattr(response, 'result'):
        response.result = rejected
    return response


def serve(
    owner: BaseNode[Any],
    signals: Signals,
    should_run: Callable[[], bool] = lambda: True,
    on_start: Callable[[], None] = lambda: None,
) -> None:
    """Start ``owner`` and run its callbacks until a signal, the transition ``shutdown`` or a false ``should_run()``.

    ``should_run``: called after each callback, and every ``SPIN_S`` without one. ``on_start``: called once. After a
    signal the node has ``REST_LIMIT_S`` to come to rest; a second signal ends the wait. Raises what ``start`` raises.
    """
    with executor_of(owner.node) as executor:
        settle()  # Exempts the present objects from garbage collection.
        owner.start()
        on_start()
        while not (signals.stop or owner.finished) and should_run():
            executor.spin_once(timeout_sec=SPIN_S)
        if owner.finished:
            # DDS does not report when a reply is sent, and a reply that is not sent yet is lost with its service.
            deadline = time.monotonic() + SHUTDOWN_REPLY_S
            while not signals.stop and (remaining := deadline - time.monotonic()) > 0.0:
                executor.spin_once(timeout_sec=remaining)
        elif signals.stop:
            signals.stop = False  # A second signal sets it again.
            deadline = time.monotonic() + REST_LIMIT_S
            while not (owner.at_rest() or signals.stop) and time.monotonic() < deadline:
                executor.spin_once(timeout_sec=SPIN_S)
