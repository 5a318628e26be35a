# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What every node of this package is: a lifecycle node (REP-2002) with declared parameters, a log on ``/rosout``, a
gate for what other nodes send, and diagnostics once a second. With ``autostart`` it activates itself."""

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

MOST_LINES = 1000
"""Lines that wait for a slow disk; further ones are not in the file."""
JOIN_S = 0.2
"""Time limit for the last lines to reach the disk."""


def rcl_log_file() -> Path | None:
    """The file of this process, ``PROGRAM_PID_TIME.log``; None if rcl writes none (``--disable-external-lib-logs``)."""
    with contextlib.suppress(OSError):
        return max(
            get_logging_directory().glob(f'*_{os.getpid()}_*.log'), key=lambda f: f.stat().st_mtime_ns, default=None
        )
    return None


class NodeLog:
    """Call it with a line. ``log`` puts it on the terminal; what ``--log-level`` leaves out goes nowhere.

    The terminal's lines do not go through the ROS log, because the live line is among them. So the
    lines are put on ``/rosout`` and into the file here, as rcl does with those of other nodes. A thread
    writes the file: a disk that hangs holds up nothing.
    """

    def __init__(self, node: Node, log: LogCallback) -> None:
        self._log = log
        self._logger = node.get_logger()
        self._publisher = publisher_of(node, ROSOUT)
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()  # Bound: MOST_LINES.
        self._thread: threading.Thread | None = None
        file = rcl_log_file()
        if file is not None:
            self._thread = threading.Thread(target=self._write, args=(file,), name='log', daemon=True)
            self._thread.start()

    def __call__(self, text: str, level: int = INFO, /) -> None:
        """Log one line, from any thread."""
        severity = LoggingSeverity(level)
        if not self._logger.is_enabled_for(severity):
            return
        line = Log(level=level, name=self._logger.name, msg=text)
        line.stamp.sec, line.stamp.nanosec = divmod(time.time_ns(), 1_000_000_000)
        # The terminal comes last: who reads a line there finds it in the file.
        if self._thread is not None and self._lines.qsize() < MOST_LINES:
            seconds = f'{line.stamp.sec}.{line.stamp.nanosec:09d}'
            self._lines.put(f'[{severity.name}] [{seconds}] [{self._logger.name}]: {text}\n')
        # An abandoned thread may log a line after the node is gone.
        with contextlib.suppress(RuntimeError):
            self._publisher.publish(line)
        self._log(text, level)

    def close(self) -> None:
        """Write the last lines."""
        if self._thread is not None:
            self._lines.put(None)
            self._thread.join(JOIN_S)

    def _write(self, file: Path) -> None:
        # The daemon measures on without a log.
        with contextlib.suppress(OSError), file.open('a', 1, 'utf-8', 'backslashreplace') as stream:
            while (line := self._lines.get()) is not None:
                stream.write(line)


ANSWER_S = 0.3
"""Time for the last answer of a service to leave, s."""
END_S = 10.0
"""Longest time that a node may take to come to rest after a signal, s."""
AUTOSTART = BY_NAME['autostart']
T = TypeVar('T')
T_co = TypeVar('T_co', covariant=True)


class Health(NamedTuple):
    """The state of one ``part`` of a node. ``level``: as :mod:`psd_deflection.run.diagnostics` has them."""

    part: str
    level: int
    text: str
    values: tuple[tuple[str, str], ...] = ()


class NodeParameters(Protocol[T_co]):
    """The declared parameters of a node, as they are now: by name, and as its settings."""

    @property
    def values(self) -> Mapping[str, Value]:
        """By name."""

    @property
    def settings(self) -> T_co:
        """All of them."""


class _ManagedNode(GatedNode):
    """Hands its transitions to the :class:`BaseNode` that owns it."""

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
        # The error stays in `error`: the caller that starts the node reports it.
        self.owner.cleanup()
        return TransitionCallbackReturn.SUCCESS


class BaseNode(abc.ABC, Generic[T]):
    """The base of every node, whose settings are a ``T``.

    A node overrides :meth:`declare`, :meth:`set_up`, what its lifecycle does, and :meth:`health`.

    ``log``: gets each line for the terminal. ``overrides``: parameters that take precedence over those of ROS's
    arguments. Before ``super().__init__`` a node keeps what :meth:`set_up` needs. Raises ConfigError if a parameter is
    rejected; then nothing of the node is left.

    ``parameters``: the declared ones. ``active``: between activation and deactivation. ``finished``: ended for good by
    ``change_state``.
    """

    SYSTEM_TIME: ClassVar[bool] = False
    """What it measures is stamped by the system clock, so it rejects ``use_sim_time``."""

    def __init__(self, name: str, log: LogCallback, overrides: Mapping[str, object] = MappingProxyType({})) -> None:
        self.error: Exception | None = None
        self.finished = self.active = False
        self._starting = False
        self._other_publishers: frozenset[str] = frozenset()
        self._published: list[Publisher] = []  # Bound: our own topics.
        self._diagnostics: Publisher | None = None
        self.node = _made(name, overrides)
        self.node.owner = self
        self.log = NodeLog(self.node, log)
        self.gate = self.node.gate = InputGate(self.node, self.log)
        try:
            self.parameters = self.declare()
            self.set_up()
            self._reject_sim_time()
            self._survive_requests()
            # A steady clock: health is published even if a simulated clock stops or the system clock is set.
            self.node.create_timer(1.0, self._every_second, clock=Clock(clock_type=ClockType.STEADY_TIME))
        except BaseException:
            self.leave()
            raise

    # What a node overrides.

    @abc.abstractmethod
    def declare(self) -> NodeParameters[T]:
        """Declare the node's parameters."""

    @abc.abstractmethod
    def set_up(self) -> None:
        """Make publishers, subscriptions and services; the parameters are declared."""

    def configure(self) -> None:
        """Take what the node needs (a port, a file); it is not active yet."""
        self.active = False

    def activate(self) -> None:
        """Begin to publish."""
        self.active = True

    def deactivate(self) -> None:
        """Stop publishing; keep what :meth:`configure` took."""
        self.active = False

    def cleanup(self) -> None:
        """Give back what :meth:`configure` took, whatever the state is; it may be called twice."""
        self.active = False

    def health(self) -> Iterable[Health]:
        """The state of each part, once a second."""
        return (Health('node', OK if self.active else STALE, 'active' if self.active else 'not active'),)

    def at_rest(self) -> bool:
        """Whether the node may end after a signal; asked ten times a second, for at most ``END_S``."""
        return True

    def watched(self) -> Iterable[str]:
        """Names of the topics that no other node should publish."""
        return (publisher.topic_name for publisher in self._published)

    # What a node uses.

    @property
    def settings(self) -> T:
        """The parameters as they are now."""
        return self.parameters.settings

    @property
    def frame_prefix(self) -> str:
        """Put before each name of a frame; '' for a node that names no frames."""
        return str(self.parameters.values.get(FRAME_PREFIX, ''))

    def declared(
        self, section: Section[T], given: T, changed: Callable[[T], None] = lambda _: None
    ) -> DeclaredParameters[T]:
        """The parameters of ``section``, at the values of ``given``, and ``autostart``."""
        return DeclaredParameters(self.node, section, section.values(given), changed, (AUTOSTART,))

    def publisher(self, topic: str) -> Publisher:
        """The publisher of ``topic``, by its row; no other node should publish it unless it is common to all."""
        made = publisher_of(self.node, topic)
        if not PUBLISHED[topic].common:
            self._published.append(made)
        return made

    def now_ns(self) -> int:
        """The node's time: that of the simulation with ``use_sim_time``."""
        return int(self.node.get_clock().now().nanoseconds)

    def full_name(self) -> str:
        """``/NAMESPACE/NAME``."""
        return str(self.node.get_fully_qualified_name())

    def other_publishers(self) -> list[str]:
        """The topics of :meth:`watched` that another node publishes, too."""
        return [topic for topic in self.watched() if self.node.count_publishers(topic) > 1]

    def named(self, report: DiagnosticReport) -> DiagnosticReport:
        """``report`` with this node's name, as diagnostic_updater names its own, to distinguish two rigs."""
        node = self.full_name().removeprefix('/')
        entries = (e._replace(name=e.name.replace('psd_deflection', node, 1)) for e in report.entries)
        return report._replace(entries=tuple(entries))

    def start(self) -> None:
        """Configure and activate, if ``autostart`` is set. Raises the error of a failed transition."""
        if not self.node.get_parameter(AUTOSTART.name).value:
            self.log(f'waiting to be configured: ros2 lifecycle set {self.full_name()} configure')
            return
        self._starting = True
        for trigger in (self.node.trigger_configure, self.node.trigger_activate):
            if trigger() != TransitionCallbackReturn.SUCCESS:
                raise self.error or ConfigError('the node does not start')
        self._starting = False

    def release(self) -> None:
        """Back to unconfigured."""
        self.cleanup()

    def finish(self) -> None:
        """End for good: a node that was shut down cannot be configured any more."""
        self.cleanup()
        self.finished = True
        self.log('shut down by change_state')

    def transition(self, action: Callable[[], None]) -> TransitionCallbackReturn:
        """Run one transition; an error is logged, kept in ``error``, and leaves the state unchanged."""
        try:
            action()
        except PsdDeflectionError as error:
            self.error = error
        except Exception as error:
            self.error = error
            self._notify_error(f'{type(error).__name__}: {error}')
            return TransitionCallbackReturn.ERROR
        else:
            self.error = None
            self._notify_frames(action)
            return TransitionCallbackReturn.SUCCESS
        self._notify_error(str(self.error))
        return TransitionCallbackReturn.FAILURE

    def report(self) -> None:
        """Publish what :meth:`health` says."""
        node = self.full_name().removeprefix('/')
        entries = [DiagnosticEntry(f'{node}: {h.part}', h.level, h.text, h.values) for h in self.health()]
        if entries:
            entries[0] = entries[0]._replace(values=(*entries[0].values, *self.gate.values()))
        if self._diagnostics is None:
            self._diagnostics = self.publisher(DIAGNOSTICS)
        for message in to_messages(DiagnosticReport(self.now_ns(), tuple(entries))):
            self._diagnostics.publish(cdr.encode(message.type, message.fields))

    def close(self) -> None:
        """Give back everything, and leave the graph."""
        self.cleanup()
        self.leave()

    def leave(self) -> None:
        """Leave the graph."""
        self.log.close()
        self.node.destroy_node()

    # Its own.

    def _notify_error(self, text: str) -> None:
        # At the start it is raised, and the caller reports it.
        if not self._starting:
            self.log(text, ERROR)

    def _notify_frames(self, action: Callable[[], None]) -> None:
        names_frames = FRAME_PREFIX in self.parameters.values
        if action == self.activate and names_frames and not self.frame_prefix and self.node.get_namespace() != '/':
            self.log('frames have no prefix: where several run, give each its own (frame_prefix)', WARNING)

    def _reject_sim_time(self) -> None:
        if not self.SYSTEM_TIME:
            return
        why = 'what is measured is stamped by the system clock'
        if self.node.get_parameter(USE_SIM_TIME).value:
            self.node.set_parameters([RosParameter(USE_SIM_TIME, value=False)])
            self.log(f'{USE_SIM_TIME} is rejected: {why}', WARNING)

        def check(changed: list[RosParameter]) -> SetParametersResult:
            wanted = any(p.name == USE_SIM_TIME and p.value for p in changed)
            return SetParametersResult(successful=not wanted, reason=f'{USE_SIM_TIME}: {why}' if wanted else '')

        self.node.add_on_set_parameters_callback(check)

    def _survive_requests(self) -> None:
        """Answer a failed request and log the error, instead of ending the node.

        rclpy raises in its own services if an active node is asked to activate, or if a parameter has an
        unknown type. The executor would raise that in the main thread and end the measurement.
        """

        def survivor(carry_out: Callable[[Any, Any], Any], name: str) -> Callable[[Any, Any], Any]:
            async def answer(request: Any, response: Any) -> Any:
                try:
                    return await await_or_execute(carry_out, request, response)
                except Exception as error:
                    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
                    self.log(f'{name}: rejected: {reason}', WARNING)
                    return _rejection(request, response, reason)

            return answer

        for service in self.node.services:
            service.callback = survivor(service.callback, service.service_name)

    def _every_second(self) -> None:
        self.gate.settle()
        other_publishers = frozenset(self.other_publishers())
        for topic in sorted(other_publishers - self._other_publishers):
            remedy = 'start one of them in a namespace (-r __ns:=/NAME)'
            self.log(f'another node publishes on {topic} too: {remedy}', WARNING)
        self._other_publishers = other_publishers
        self.report()


def _made(name: str, overrides: Mapping[str, object]) -> _ManagedNode:
    """The node, which has all that was given to it as parameters."""
    try:
        return _ManagedNode(
            name,
            automatically_declare_parameters_from_overrides=True,
            parameter_overrides=[RosParameter(key, value=value) for key, value in overrides.items()],
        )
    except ParameterException as error:
        raise ConfigError(f'{SOURCE}: {error}') from None
    except ValueError:
        raise ConfigError(
            f'{SOURCE}: one of them is an empty list, of which ROS cannot tell the type; leave it out for its default'
        ) from None
    except RuntimeError as error:
        # DDS rejects: it was built without security, or the enclave has no permission.
        raise ConfigError('ROS: ' + ' '.join(str(error).split())) from None


def _rejection(request: Any, response: Any, reason: str) -> Any:
    """``response``, in which each parameter that was to be set has the reason why it is not."""
    rejected = SetParametersResult(successful=False, reason=reason)
    if hasattr(response, 'results') and hasattr(request, 'parameters'):
        response.results = [rejected for _ in request.parameters]
    elif hasattr(response, 'result'):
        response.result = rejected
    return response


def serve(
    owner: BaseNode[Any],
    signals: Signals,
    runs: Callable[[], bool] = lambda: True,
    started: Callable[[], None] = lambda: None,
) -> None:
    """Start the node and serve it until a signal comes, it was shut down, or it does not run any more.

    ``runs``: asked ten times a second. ``started``: called once. After a signal the node comes to rest, unless a second
    one comes. Raises the error of a start that failed.
    """
    with executor_of(owner.node) as executor:
        settle()
        owner.start()
        started()
        while not (signals.stop or owner.finished) and runs():
            executor.spin_once(timeout_sec=SPIN_S)
        if owner.finished:
            # DDS does not say when the answer has left. If the service goes first, it is lost.
            until = time.monotonic() + ANSWER_S
            while not signals.stop and (left := until - time.monotonic()) > 0.0:
                executor.spin_once(timeout_sec=left)
        elif signals.stop:
            signals.stop = False
            until = time.monotonic() + END_S
            while not (owner.at_rest() or signals.stop) and time.monotonic() < until:
                executor.spin_once(timeout_sec=SPIN_S)
