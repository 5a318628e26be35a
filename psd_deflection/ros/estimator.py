# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The node ``estimator``, a lifecycle node: *configured* it reads, estimates and records; *active* it
publishes too, from the pipeline's own thread. The executor serves parameters, services, inputs and the 1 Hz
diagnostics."""

import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from msg_adapters import DEFLECTION, DIAGNOSTICS, SAMPLES, WRENCH, to_messages
from psd_deflection.base.errors import ConfigError
from psd_deflection.base.log import WARNING, LogCallback
from psd_deflection.devices.registry import source_names
from psd_deflection.model.solvers.registry import SOLVERS, check_live, solver_class
from psd_deflection.recordings import cdr
from psd_deflection.records import DiagnosticEntry, DiagnosticReport
from psd_deflection.rig.config import Rig, replace_values, rig_from_values
from psd_deflection.rig.declarations import BY_NAME, QOS_OVERRIDES_PREFIX, ROS_OWN, SIMULATED
from psd_deflection.rig.parameters import Parameter, Value
from psd_deflection.ros.declared import AT_START, SOURCE, descriptor, meant, plain
from psd_deflection.ros.node import BaseNode, serve
from psd_deflection.ros.running import ros
from psd_deflection.ros.sinks import (
    InputRecorder,
    PublisherSink,
    TransformPublisher,
    VoltsPublisher,
    Zeroed,
    add_rig_services,
    installed,
    topics_of,
)
from psd_deflection.run.diagnostics import STALE, HealthReporter
from psd_deflection.run.fanout import subscribed
from psd_deflection.run.monitor.start import Views, start_views
from psd_deflection.run.realtime import Signals, StopRequestedError, Watchdog
from psd_deflection.run.rig_publisher import RigPublisher
from psd_deflection.run.session import Session
from psd_deflection.run.session_texts import why_no_zero, zero_text

if TYPE_CHECKING:
    from psd_deflection.ros.markers import RigMarkers


_READ = 'read when the node is configured'
# Who may set parameters over ROS shall not run programs as the daemon's user, nor send what it sees elsewhere.
_AT_START = {'autostart': AT_START, 'watch_command': AT_START, 'watch_webhook': AT_START}

_SIMULATED = ParameterDescriptor(
    name=SIMULATED,
    description='whether the samples are those of the simulated rig that the node started, because no port is given',
    additional_constraints='set by the node',
)


def rig_of_node(node: Node) -> tuple[Rig, set[str]]:
    """The rig that the node's overrides describe, and their names; its parameters are declared.

    The node was made with ``automatically_declare_parameters_from_overrides``. Raises ConfigError
    for an unknown parameter, a wrong type or a value out of bounds.

    Values from the command line, a launch file or a parameter file reach the node as overrides.
    :func:`rig_from_values` validates them as everywhere else: ``0`` for a length is rejected by name,
    and a whole number is accepted for a ``double``. The descriptors come from the declarations; with
    them rclpy rejects wrong types and values out of range.

    While the node is unconfigured every parameter may be set; configuring reads them. While it is
    configured only the live ones may; the pipeline validates these, because it knows which values
    depend on each other. What was set stays when the node is cleaned up.
    """
    given = {name: plain(parameter) for name, parameter in node.get_parameters_by_prefix('').items()}
    rig = rig_from_values(given, SOURCE)
    shown = _ros_values(rig)
    values = {p.name: (shown[p.name], _descriptor(p)) for p in rig.parameters}
    for name, (value, shown_as) in {**values, SIMULATED: (False, _SIMULATED)}.items():
        # rclpy tells of overrides that nobody declares (a mistyped name) only by declaring them,
        # and then without descriptor and with the type as it was typed.
        if name in given:
            node.undeclare_parameter(name)
        node.declare_parameter(name, value, shown_as, ignore_override=True)
    return rig, set(given)


def _ros_values(rig: Rig) -> dict[str, Any]:
    """The values by name. Signs are written out, because rcl does not read the bare y that `ros2 param dump` writes."""
    signed = {
        f'psd_{n}.axes': [a if a.startswith('-') else f'+{a}' for a in psd.axes]
        for n, psd in enumerate(rig.psds, start=1)
    }
    return {**rig.values, **signed}


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    return descriptor(parameter, _bound_text(parameter), '' if parameter.live else _AT_START.get(parameter.name, _READ))


def _bound_text(parameter: Parameter) -> str:
    """Bounds or choices in words; also those that other rooms' registries add to the declaration."""
    if parameter.name == 'source':
        return f'one of {", ".join(source_names())}'
    if parameter.name == 'solver':
        return f'one of {", ".join(name for name, entry in SOLVERS.items() if not entry.instead)}'
    if parameter.name == 'solvers':
        return f'each one of {", ".join(SOLVERS)}'
    return parameter.bound_text()


def _check_solvers(rig: Rig) -> None:
    check_live(rig.estimator.solver)
    for name in rig.estimator.solvers:
        solver_class(name)


class LiveParameters:
    """Carries out changes of the node's parameters, or rejects them.

    ``settings``: the rig, as the parameters describe it. ``given``: names of those that the user
    has set. ``session``: the one that runs while the node is configured, or None.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._showing = False
        self.settings, self.given = rig_of_node(node)
        self._zeros = self.settings.zeros_by_name
        self.session: Session | None = None
        node.add_pre_set_parameters_callback(lambda changed: meant(node, changed, BY_NAME))
        node.add_on_set_parameters_callback(self._change)

    @property
    def values(self) -> Mapping[str, Value]:
        """By name."""
        return self.settings.values

    @property
    def unzeroed(self) -> Rig:
        """The rig with the zero that it was given, without one that was taken while the node ran."""
        return replace_values(self.settings, self._zeros, SOURCE)

    def show(self) -> None:
        """Set the node's parameters to the present values of the rig, so that a new zero can be read there."""
        session = self.session
        if session is not None:
            live = {p.name: session.rig.values[p.name] for p in session.rig.parameters if p.live}
            self.settings = replace_values(self.settings, live, SOURCE)
        simulated = session is not None and session.simulated
        changed = [
            RosParameter(name, value=value)
            for name, value in {**_ros_values(self.settings), SIMULATED: simulated}.items()
            if plain(self._node.get_parameter(name)) != value
        ]
        self._showing = True
        try:
            self._node.set_parameters(changed)
        finally:
            self._showing = False

    def _change(self, changed: list[RosParameter]) -> SetParametersResult:
        if self._showing:
            return SetParametersResult(successful=True)
        values = {p.name: plain(p) for p in changed if p.name not in ROS_OWN}
        values = {n: v for n, v in values.items() if not n.startswith(QOS_OVERRIDES_PREFIX)}
        try:
            self._take(values)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        except TimeoutError as error:
            return SetParametersResult(successful=False, reason=f'not changed: {error}')
        return SetParametersResult(successful=True)

    def _take(self, values: dict[str, Any]) -> None:
        """Set all of ``values`` or none. Raises ConfigError or, if no data flows, TimeoutError."""
        # A file that `ros2 param dump` wrote names every parameter; only those that differ are
        # changes.
        new = {n: v for n, v in values.items() if v != plain(self._node.get_parameter(n))}
        for name in new:
            if name == SIMULATED:
                raise ConfigError(f'{name}: is set by the node')
            if name in _AT_START:
                raise ConfigError(f'{name}: is {_AT_START[name]}')
        if not new:
            return
        if self.session is None:
            rig = replace_values(self.settings, new, SOURCE)
            _check_solvers(rig)
            self.settings = rig
            self.given |= set(new)
            self._zeros |= {name: rig.values[name] for name in rig.zeros_by_name if name in new}
            return
        fixed = [name for name in new if name not in BY_NAME or not BY_NAME[name].live]
        if fixed:
            node = self._node.get_fully_qualified_name()
            raise ConfigError(
                f'{", ".join(fixed)}: is {_READ}; first ros2 lifecycle set {node} deactivate, then cleanup'
            )
        # All of them or none, between two blocks.
        self.session.change({n: tuple(v) if isinstance(v, list) else v for n, v in new.items()})


NODE_NAME = 'estimator'


class EstimatorNode(BaseNode[Rig]):
    """The node and, while it is configured, its session. Raises ConfigError if the parameters are rejected."""

    SYSTEM_TIME = True

    def __init__(self, overrides: Mapping[str, object], log: LogCallback, signals: Signals) -> None:
        self.session: Session | None = None
        self._signals = signals
        self._health: HealthReporter | None = None
        self._views: Views | None = None
        self._rig_reported: RigPublisher | None = None
        self._markers: RigMarkers | None = None
        self._transforms: TransformPublisher | None = None
        super().__init__(NODE_NAME, log, overrides)

    def declare(self) -> LiveParameters:
        """Those of the rig."""
        self._live = LiveParameters(self.node)
        return self._live

    def set_up(self) -> None:
        """Make what is on the graph while the node lives."""
        add_rig_services(self.node, lambda: self.session, self._zero, lambda session, on: [session.record(on)])
        self._sink = PublisherSink(self.node, topics_of(self.settings))
        self._inputs = InputRecorder(self.node, subscribed(self.settings))

    def exclusive_topics(self) -> Iterable[str]:
        """The estimate: whoever publishes that publishes all the rest."""
        return self._sink.names((DEFLECTION,))

    def _make_views(self, session: Session) -> None:
        """What the parameters ask for beside the messages of the records."""
        shown = session.rig.monitor
        if shown.publish_volts:
            session.processing.sinks.append(VoltsPublisher(self._sink, shown.frame_prefix))
        if shown.publish_tf and installed():
            self._transforms = TransformPublisher(self.node, session.rig)
            session.processing.sinks.append(self._transforms)
        elif shown.publish_tf and 'publish_tf' in self._live.given:
            self.log('tf2_msgs is not installed: no frames on /tf (publish_tf)', WARNING)
        if shown.markers:
            # Imported here: only the markers need visualization_msgs.
            from psd_deflection.ros.markers import RigMarkers

            self._markers = RigMarkers(self.node, session.rig)

    def configure(self) -> None:
        """Open the port and let samples flow; nothing is published yet."""
        node, rig, unzeroed = self.full_name(), self.settings, self._live.unzeroed
        self._sink.offer(topics_of(rig))
        self._inputs.offer(subscribed(rig))
        session = self._signals.interruptible(lambda: Session(rig, self.log, node, unzeroed))
        self.session = session
        try:
            self._live.session = session
            self._live.show()
            self._health = HealthReporter(session)
            session.fanout.sinks.insert(0, self._sink)
            self._rig_reported = RigPublisher(self._sink, session)
            session.fanout.change_sinks.append(self._rig_reported)
            session.processing.sinks.append(self._rig_reported)
            self._make_views(session)
            self._inputs.session = session
            session.start()
            # Its health is put to the fan-out once a second.
            self._views = start_views(session, self.log, reports=False)
        except BaseException:
            self.cleanup()
            raise

    def activate(self) -> None:
        """Publish."""
        super().activate()
        self._sink.active = True
        if self._transforms is not None:
            self._transforms.active = True
        if self._rig_reported is not None:
            self._rig_reported.notify()
        if self._markers is not None:
            self._markers.session = self.session
        domain = os.environ.get('ROS_DOMAIN_ID') or '0'
        node = self.full_name()
        topics = ', '.join(self._sink.names((DEFLECTION, WRENCH, SAMPLES, DIAGNOSTICS)))
        self.log(f'publishing on ROS domain {domain}: {topics} …; services {node}/zero, {node}/record')

    def deactivate(self) -> None:
        """Stop publishing; reading and recording continue."""
        self._silence()
        self.log('not publishing; reading and recording go on')

    def release(self) -> None:
        """End the session, and log it. The parameters keep what changed while it ran."""
        self._live.show()
        self.cleanup()
        self._live.show()
        self.log('not configured: the port is free')

    def cleanup(self) -> None:
        """End the session: the port is free."""
        self._silence()
        self._inputs.session = None
        self._live.session = None
        self._health = None
        self._rig_reported = None
        views, self._views = self._views, None
        if views is not None:
            views.close()
        session, self.session = self.session, None
        if session is not None:
            session.close()
        for view in (self._markers, self._transforms):
            if view is not None:
                view.close()
        self._markers = self._transforms = None

    def _silence(self) -> None:
        super().deactivate()
        self._sink.active = False
        if self._transforms is not None:
            self._transforms.active = False
        if self._markers is not None:
            self._markers.session = None

    def _zero(self, session: Session) -> Zeroed:
        if session.zero() is None:
            return Zeroed(False, f'not zeroed: {why_no_zero(session.pipeline)}')
        self._live.show()
        return Zeroed(True, zero_text(session.rig))

    def report(self) -> None:
        """Publish the states of the session, which are recorded."""
        if self.session is not None and self._health is not None:
            # The page may have taken a zero as well.
            self._live.show()
            if self._rig_reported is not None:
                self._rig_reported.notify(again=False)
            # In the time of the samples, so that a recording has one time even if the system clock
            # is set.
            self.session.fanout.put(self.with_node_name(self._health.report(self.session.acquisition.now_ns())))
            return
        now = time.time_ns()
        entry = DiagnosticEntry('psd_deflection: node', STALE, 'not configured', ())
        (message,) = to_messages(self.with_node_name(DiagnosticReport(now, (entry,))))
        self._sink.put(message.topic, message.type, cdr.encode(message.type, message.fields), now)


def run(
    ros_args: Sequence[str],
    overrides: Mapping[str, object],
    log: LogCallback,
    while_running: Callable[[Session], None] | None = None,
) -> int:
    """Run the node until SIGINT or SIGTERM, however often they come.

    ``overrides``: parameters that take precedence over ``ros_args``. ``while_running`` is called
    about ten times a second, for a display. Raises the errors of the package if the run cannot
    start, or if the pipeline failed.
    """
    with ros(NODE_NAME, ros_args) as signals:
        owner, watchdog = EstimatorNode(overrides, log, signals), Watchdog()

        def runs() -> bool:
            session = owner.session
            if session is not None and not session.processing.alive:
                return False
            if session is None or session.responsive():
                watchdog.alive()
            if while_running is not None and session is not None:
                while_running(session)
            return True

        failed: BaseException | None = None
        try:
            serve(owner, signals, runs, watchdog.ready)
            if owner.session is not None and not owner.session.processing.alive:
                failed = owner.session.failed
        except StopRequestedError:
            pass
        finally:
            watchdog.stopping()
            last = owner.session
            owner.close()
        if failed is None and last is not None:
            # Samples that were dropped here are told at the end.
            failed = last.failed
        if failed is not None:
            raise failed
    return 0
