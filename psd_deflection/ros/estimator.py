# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The node ``estimator``: publishes the pipeline's records, from the pipeline's own thread.

A message is encoded once; the same bytes are published and recorded. The executor in the main
thread serves parameters, services, inputs and the 1 Hz diagnostics, nothing faster.

It is a lifecycle node (REP-2002 states). *Configured*, it has the port, reads, estimates and
records; *active*, it publishes as well. Deactivation stops publishing and nothing else, cleanup
frees the port. With ``autostart`` (the default) it does both steps itself and behaves like an
ordinary node.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from msg_adapters import DEFLECTION, DIAGNOSTICS, SAMPLES, WRENCH, to_messages
from psd_deflection.base.log import WARNING, LogCallback
from psd_deflection.recordings import cdr
from psd_deflection.records import DiagnosticEntry, DiagnosticReport
from psd_deflection.rig.config import Rig
from psd_deflection.ros.node import BaseNode, serve
from psd_deflection.ros.parameters import LiveParameters
from psd_deflection.ros.running import ros
from psd_deflection.ros.services import Zeroed, add_rig_services
from psd_deflection.ros.sinks import InputRecorder, PublisherSink, VoltsPublisher, topics_of
from psd_deflection.ros.transforms import TransformPublisher, installed
from psd_deflection.run.diagnostics import STALE, HealthReporter
from psd_deflection.run.fanout import subscribed
from psd_deflection.run.monitor.start import Views, start_views
from psd_deflection.run.realtime import Watchdog
from psd_deflection.run.rig_publisher import RigPublisher
from psd_deflection.run.session import Session
from psd_deflection.run.session_texts import why_no_zero, zero_text
from psd_deflection.run.signals import Signals, StopRequestedError

if TYPE_CHECKING:
    from psd_deflection.ros.markers import RigMarkers

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

    def watched(self) -> Iterable[str]:
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
            self.session.fanout.put(self.named(self._health.report(self.session.acquisition.now_ns())))
            return
        now = time.time_ns()
        entry = DiagnosticEntry('psd_deflection: node', STALE, 'not configured', ())
        (message,) = to_messages(self.named(DiagnosticReport(now, (entry,))))
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
