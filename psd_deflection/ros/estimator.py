"""The node ``estimator``: publishes the pipeline's records, from the pipeline's own thread.

A message is encoded once; the same bytes are published and recorded. The executor in the main
thread serves parameters, services, inputs and the 1 Hz diagnostics, nothing faster.

It is a lifecycle node (REP-2002 states). *Configured*, it has the port, reads, estimates and
records; *active*, it publishes as well. Deactivation stops publishing and nothing else, cleanup
frees the port. With ``autostart`` (the default) it does both steps itself and behaves like an ordinary
node.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import await_or_execute
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos_overriding_options import InvalidQosOverridesError
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from msg_adapters import DEFLECTION, DIAGNOSTICS, to_messages
from psd_deflection.base.errors import ConfigError, Failed, PsdDeflectionError, Warned
from psd_deflection.recordings import cdr
from psd_deflection.records import DiagnosticEntry, DiagnosticReport
from psd_deflection.rig.config import Rig
from psd_deflection.ros.log import NodeLog
from psd_deflection.ros.names import RECORD, ZERO
from psd_deflection.ros.parameters import LiveParameters
from psd_deflection.ros.running import SPIN_S, executor_of, ros
from psd_deflection.ros.transforms import TransformPublisher, installed
from psd_deflection.ros.wires import InputRecorder, PublisherWire, VoltsPublisher, topics_of
from psd_deflection.run.diagnostics import STALE, HealthReporter
from psd_deflection.run.fanout import subscribed
from psd_deflection.run.monitor.start import Views, start_views
from psd_deflection.run.realtime import Watchdog, settle
from psd_deflection.run.rig_publisher import RigPublisher
from psd_deflection.run.session import Session, why_no_zero, zero_text
from psd_deflection.run.signals import Signals, StopRequestedError

if TYPE_CHECKING:
    from psd_deflection.ros.markers import RigMarkers

NODE_NAME = 'estimator'

ANSWER_S = 0.3
"""Time for the last answer of a service to leave, s."""


class _ManagedNode(LifecycleNode):  # type: ignore[misc]
    """Hands its transitions to the :class:`EstimatorNode` that owns it."""

    owner: EstimatorNode

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


class EstimatorNode:
    """The node and, while it is configured, its session. Raises ConfigError if the parameters are refused."""

    def __init__(self, overrides: Mapping[str, object], say: Callable[[str], None], signals: Signals) -> None:
        self.session: Session | None = None
        self.error: Exception | None = None
        self.finished = False
        self._signals = signals
        self._starting = False
        self._alone = True
        self._health: HealthReporter | None = None
        self._views: Views | None = None
        self._rig_told: RigPublisher | None = None
        self._markers: RigMarkers | None = None
        self._transforms: TransformPublisher | None = None
        try:
            self.node = _ManagedNode(
                NODE_NAME,
                automatically_declare_parameters_from_overrides=True,
                parameter_overrides=[RosParameter(name, value=value) for name, value in overrides.items()],
            )
        except ParameterException as error:
            raise ConfigError(f'ROS parameters: {error}') from None
        except ValueError:
            raise ConfigError(
                'ROS parameters: one of them is an empty list, of which ROS cannot tell the type; '
                'leave it out for its default'
            ) from None
        except RuntimeError as error:
            # DDS refuses: it was built without security, or the enclave has no permission.
            raise ConfigError('ROS: ' + ' '.join(str(error).split())) from None
        self.node.owner = self
        try:
            self._log = NodeLog(self.node, say)
            self._say = self._log
            self._live = LiveParameters(self.node)
            self.node.create_service(Trigger, ZERO, self._zero)
            # In a separate group: while one request waits for the disk, the node serves everything else.
            self.node.create_service(SetBool, RECORD, self._record, callback_group=ReentrantCallbackGroup())
            self._survive_requests()
            self._wire, self._inputs = self._wires(self._live.rig)
            # A steady clock: health is published even if a simulated clock stops or the system clock is set.
            self.node.create_timer(1.0, self._report, clock=Clock(clock_type=ClockType.STEADY_TIME))
        except BaseException:
            self.node.destroy_node()
            raise

    def _wires(self, rig: Rig) -> tuple[PublisherWire, InputRecorder]:
        try:
            return PublisherWire(self.node, topics_of(rig)), InputRecorder(self.node, subscribed(rig))
        except (InvalidQosOverridesError, ValueError, RuntimeError) as error:
            raise ConfigError(f'ROS parameters: qos_overrides: {error}') from None

    def _make_views(self, session: Session) -> None:
        """What the parameters ask for beside the messages of the records."""
        shown = session.rig.monitor
        if shown.publish_volts:
            session.processing.sinks.append(VoltsPublisher(self._wire, shown.frame_prefix))
        if shown.publish_tf and installed():
            self._transforms = TransformPublisher(self.node, session.rig)
            session.processing.sinks.append(self._transforms)
        elif shown.publish_tf and 'publish_tf' in self._live.given:
            self._say(Warned('tf2_msgs is not installed: no frames on /tf (publish_tf)'))
        if shown.markers:
            # Imported here: only the markers need visualization_msgs.
            from psd_deflection.ros.markers import RigMarkers

            self._markers = RigMarkers(self.node, session.rig)

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
                    self._say(Warned(f'{name}: refused: {reason}'))
                    return response

            return answer

        for service in self.node.services:
            service.callback = survivor(service.callback, service.service_name)

    def transition(self, action: Callable[[], None]) -> TransitionCallbackReturn:
        """Run one transition; an error is logged, kept in ``error``, and leaves the state unchanged."""
        try:
            action()
        except PsdDeflectionError as error:
            self.error = error
        except Exception as error:
            self.error = error
            self._tell_error(f'{type(error).__name__}: {error}')
            return TransitionCallbackReturn.ERROR
        else:
            self.error = None
            return TransitionCallbackReturn.SUCCESS
        self._tell_error(str(self.error))
        return TransitionCallbackReturn.FAILURE

    def _tell_error(self, text: str) -> None:
        # At the start it is raised, and the caller reports it.
        if not self._starting:
            self._say(Failed(text))

    def start(self) -> None:
        """Configure and activate, if ``autostart`` is set. Raises the error of a failed transition."""
        if self.node.get_parameter('use_sim_time').value:
            self._say(Warned('use_sim_time is true: what is measured is stamped by the system clock all the same'))
        if not self._live.rig.acquisition.autostart:
            self._say(f'waiting to be configured: ros2 lifecycle set {self.node.get_fully_qualified_name()} configure')
            return
        self._starting = True
        for trigger in (self.node.trigger_configure, self.node.trigger_activate):
            if trigger() != TransitionCallbackReturn.SUCCESS:
                raise self.error or ConfigError('the node does not start')
        self._starting = False

    def configure(self) -> None:
        """Open the port and let samples flow; nothing is published yet."""
        node, rig, unzeroed = self.node.get_fully_qualified_name(), self._live.rig, self._live.unzeroed
        self._wire.offer(topics_of(rig))
        self._inputs.listen(subscribed(rig))
        session = self._signals.interruptible(lambda: Session(rig, self._say, node, unzeroed))
        self.session = session
        try:
            self._live.session = session
            self._live.show()
            self._health = HealthReporter(session)
            session.fanout.wires.insert(0, self._wire)
            self._rig_told = RigPublisher(self._wire, session)
            session.fanout.change_wires.append(self._rig_told)
            self._make_views(session)
            self._inputs.session = session
            session.start()
            # Its health is put to the fan-out once a second.
            self._views = start_views(session, self._say, reports=False)
        except BaseException:
            self.cleanup()
            raise

    def activate(self) -> None:
        """Publish."""
        self._wire.active = True
        if self._transforms is not None:
            self._transforms.active = True
        if self._rig_told is not None:
            self._rig_told.tell()
        if self._markers is not None:
            self._markers.session = self.session
        if self.node.get_namespace() != '/' and not self._live.rig.monitor.frame_prefix:
            self._say('frames have no prefix: where several rigs run, give each its own (frame_prefix)')
        domain = os.environ.get('ROS_DOMAIN_ID') or '0'
        node = self.node.get_fully_qualified_name()
        topics = ', '.join(self._wire.names((DEFLECTION, '/link_tip/wrench', '/psd/samples', DIAGNOSTICS)))
        self._say(f'publishing on ROS domain {domain}: {topics} …; services {node}/zero, {node}/record')

    def deactivate(self) -> None:
        """Stop publishing; reading and recording continue."""
        self._silence()
        self._say('not publishing; reading and recording go on')

    def release(self) -> None:
        """End the session, and log it. The parameters keep what changed while it ran."""
        self._live.show()
        self.cleanup()
        self._live.show()
        self._say('not configured: the port is free')

    def finish(self) -> None:
        """End for good: a node that was shut down cannot be configured any more."""
        self.cleanup()
        self.finished = True
        self._say('shut down by change_state')

    def cleanup(self) -> None:
        """End the session: the port is free."""
        self._silence()
        self._inputs.session = None
        self._live.session = None
        self._health = None
        self._rig_told = None
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
        self._wire.active = False
        if self._transforms is not None:
            self._transforms.active = False
        if self._markers is not None:
            self._markers.session = None

    def _zero(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = False
        if self.session is None:
            response.message = 'not zeroed: the node is not configured'
            return response
        try:
            change = self.session.zero()
        except (PsdDeflectionError, TimeoutError) as error:
            response.message = f'not zeroed: {error}'
            return response
        if change is None:
            response.message = f'not zeroed: {why_no_zero(self.session.pipeline)}'
            return response
        self._live.show()
        response.success, response.message = True, zero_text(self.session.rig)
        return response

    async def _record(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success = False
        if self.session is None:
            response.message = 'the node is not configured'
            return response
        try:
            asked = self.session.record(request.data)
            answered: Any = Future()
            asked.add_done_callback(lambda _: answered.set_result(None))
            await answered
            folder = asked.result()
        except (PsdDeflectionError, TimeoutError) as error:
            response.message = str(error)
            return response
        response.success = True
        verb = 'recording to' if request.data else 'recording ended:'
        response.message = f'{verb} {folder}' if folder is not None else 'no recording runs'
        return response

    def _look_for_others(self) -> None:
        (topic,) = self._wire.names((DEFLECTION,))
        alone = self.node.count_publishers(topic) <= 1
        if self._alone and not alone:
            self._say(
                Warned(f'another node publishes on {topic} too: start one of them in a namespace (-r __ns:=/NAME)')
            )
        self._alone = alone

    def _report(self) -> None:
        self._look_for_others()
        if self.session is not None and self._health is not None:
            # The page may have taken a zero as well.
            self._live.show()
            if self._rig_told is not None:
                self._rig_told.tell(again=False)
            # In the time of the samples, so that a recording has one time even if the system clock is set.
            self.session.fanout.put(self._named(self._health.report(self.session.acquisition.now_ns())))
            return
        now = time.time_ns()
        entry = DiagnosticEntry('psd_deflection: node', STALE, 'not configured', ())
        (message,) = to_messages(self._named(DiagnosticReport(now, (entry,))))
        self._wire.put(message.topic, message.type, cdr.encode(message.type, message.fields), now)

    def _named(self, report: DiagnosticReport) -> DiagnosticReport:
        """``report`` with this node's name, as diagnostic_updater names its own, to distinguish two rigs."""
        node = self.node.get_fully_qualified_name().removeprefix('/')
        entries = (e._replace(name=e.name.replace('psd_deflection', node, 1)) for e in report.entries)
        return report._replace(entries=tuple(entries))

    def close(self) -> None:
        """End the session, then the node."""
        self.cleanup()
        self._log.close()
        self.node.destroy_node()


def run(
    ros_args: Sequence[str],
    overrides: Mapping[str, object],
    say: Callable[[str], None],
    while_running: Callable[[Session], None] | None = None,
) -> int:
    """Run the node until SIGINT or SIGTERM, however often they come.

    ``overrides``: parameters that take precedence over ``ros_args``. ``while_running`` is called
    about ten times a second, for a display. Raises the errors of the package if the run cannot
    start, or if the pipeline failed.
    """
    with ros(NODE_NAME, ros_args) as signals:
        estimator = EstimatorNode(overrides, say, signals)
        failed: BaseException | None = None
        watchdog = Watchdog()
        try:
            with executor_of(estimator.node) as executor:
                settle()
                estimator.start()
                watchdog.ready()
                while not (signals.stop or estimator.finished):
                    executor.spin_once(timeout_sec=SPIN_S)
                    session = estimator.session
                    if session is not None and not session.processing.alive:
                        failed = session.failed
                        break
                    if session is None or session.responsive():
                        watchdog.alive()
                    if while_running is not None and session is not None:
                        while_running(session)
                if estimator.finished:
                    # DDS does not say when the answer has left. If the service goes first, it is lost.
                    until = time.monotonic() + ANSWER_S
                    while not signals.stop and (left := until - time.monotonic()) > 0.0:
                        executor.spin_once(timeout_sec=left)
        except StopRequestedError:
            pass
        finally:
            watchdog.stopping()
            estimator.close()
        if failed is not None:
            raise failed
    return 0
