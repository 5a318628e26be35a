# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The node ``chain``: several rigs in one process, their topics below each link's name, and the end effector composed
of them, with all frames on ``/tf``. ``~/zero`` and ``~/record`` act on every link."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from msg_adapters import DEFLECTION_WITH_COVARIANCE, END_EFFECTOR
from msg_adapters.pose_with_covariance_stamped import from_end_effector
from psd_deflection.arms.chains.chain_file import NO_CHAIN, SETTINGS, ChainFile, ChainSettings, read_chain
from psd_deflection.arms.chains.transform import Transform
from psd_deflection.arms.inputs import joints_fault
from psd_deflection.base.errors import ConfigError
from psd_deflection.base.log import WARNING, LogCallback
from psd_deflection.recordings import cdr
from psd_deflection.rig.declarations import BY_NAME
from psd_deflection.rig.parameters import Parameter, Value, check_value
from psd_deflection.ros.declared import SOURCE, DeclaredParameters, reject_unknown
from psd_deflection.ros.node import AUTOSTART, BaseNode, Health, serve
from psd_deflection.ros.running import ros
from psd_deflection.ros.sinks import (
    FramePublisher,
    InputRecorder,
    PublisherSink,
    Zeroed,
    add_rig_services,
    installed,
    static_transforms,
    topics_of,
    transform_message,
)
from psd_deflection.ros.topics import BASE, END, END_REST, JOINT_STATES, PUBLISHED, RECORD, REST, TIP, ZERO
from psd_deflection.run.chain import ChainSession, Composed
from psd_deflection.run.diagnostics import ERROR, OK, STALE, WARN, HealthReporter
from psd_deflection.run.fanout import subscribed
from psd_deflection.run.realtime import Signals, StopRequestedError, Watchdog
from psd_deflection.run.rig_publisher import RigPublisher
from psd_deflection.run.session import Session
from psd_deflection.run.session_texts import why_no_zero, zero_text

NODE_NAME = 'chain'
OF_LINKS = (BY_NAME['record'], BY_NAME['bag_dir'])
"""Parameters of the node that each of its rigs gets."""
CHAIN = Parameter('chain', 'string', '', '', 'chain file with the links')


class ChainNode(BaseNode[ChainSettings]):
    """The node and, while it is configured, its rigs."""

    SYSTEM_TIME = True

    def __init__(
        self, path: str, given: Mapping[str, Value], slopes: str | None, log: LogCallback, signals: Signals
    ) -> None:
        """``path``, ``given``, ``slopes``: as :func:`read_chain` takes them, unless ROS parameters say otherwise."""
        self.chain: ChainSession | None = None
        self._path, self._given, self._slopes = path, given, slopes
        self._signals = signals
        self._sinks: list[PublisherSink] = []  # Bound: the links of the chain.
        self._inputs: list[InputRecorder] = []  # Bound: the links of the chain.
        self._reported: list[RigPublisher] = []  # Bound: the links of the chain.
        self._health: list[HealthReporter] = []
        self._observed = (0, 0)
        self._frames: FramePublisher | None = None
        super().__init__(NODE_NAME, log)

    def declare(self) -> DeclaredParameters[ChainSettings]:
        """Those of a chain, its file, and whether and where its links are recorded."""
        more = (AUTOSTART, *(replace(p, default=self._given.get(p.name, p.default)) for p in OF_LINKS))
        chain = replace(CHAIN, default=self._path)
        known = {p.name: p for p in (*SETTINGS.parameters.values(), *more, chain)}
        given = reject_unknown(self.node, known)
        of_links = {p.name: check_value(p, given[p.name], SOURCE) for p in OF_LINKS if p.name in given}
        path = check_value(chain, given.get(chain.name, self._path), SOURCE)
        if not path:
            raise ConfigError(NO_CHAIN)
        self._file = read_chain(str(path), {**self._given, **of_links}, self._slopes)
        return DeclaredParameters(self.node, SETTINGS, SETTINGS.values(self._file.settings), more=(*more, chain))

    def set_up(self) -> None:
        """Make what is on the graph while the node lives."""
        self._file = file = self._file.with_settings(self.settings)
        node = self.node
        self._end = self.publisher(END_EFFECTOR)
        if installed():
            self._frames = FramePublisher(node)
        else:
            self.log('tf2_msgs is not installed: no frames on /tf', WARNING)
        for name, rig in zip(file.names, file.rigs, strict=True):
            self._sinks.append(PublisherSink(node, topics_of(rig), name))
            self._inputs.append(InputRecorder(node, subscribed(rig), name))
        if any(joint.name for joint in file.joints):
            self.gate.listen(JOINT_STATES, self._joints_fault, self._joints)
        add_rig_services(node, lambda: self.chain, self._zero, ChainSession.record)

    def configure(self) -> None:
        """Open the rigs and let samples flow; nothing is published yet. Raises the errors of a session."""
        file, name = self._file, self.full_name()
        self.chain = chain = self._signals.interruptible(
            lambda: ChainSession(file, self.log, lambda _, rig, reported: Session(rig, reported, name))
        )
        try:
            self._health = [HealthReporter(session) for session in chain.sessions]
            self._reported = []
            for sink, inputs, session in zip(self._sinks, self._inputs, chain.sessions, strict=True):
                session.fanout.sinks.insert(0, sink)
                reported = RigPublisher(sink, session)
                session.fanout.change_sinks.append(reported)
                session.processing.sinks.append(reported)
                self._reported.append(reported)
                inputs.session = session
            self._observed = (0, 0)
            chain.listeners.append(self._composed)
            chain.start()
        except BaseException:
            self.cleanup()
            raise

    def activate(self) -> None:
        """Publish."""
        super().activate()
        for sink in self._sinks:
            sink.active = True
        if self._frames is not None:
            now = time.time_ns()
            self._frames.fix([t for rig in self._file.rigs for t in static_transforms(rig, now)])
        for reported in self._reported:
            reported.notify()
        topics = [self._end.topic_name, *(w.names((DEFLECTION_WITH_COVARIANCE,))[0] for w in self._sinks)]
        self.log(f'publishing {", ".join(topics)} …; services {ZERO} and {RECORD} of {NODE_NAME}')

    def deactivate(self) -> None:
        """Publish no more; the rigs are read on."""
        super().deactivate()
        for sink in self._sinks:
            sink.active = False

    def cleanup(self) -> None:
        """End the rigs."""
        self.deactivate()
        for inputs in self._inputs:
            inputs.session = None
        chain, self.chain = self.chain, None
        self._reported, self._health = [], []
        if chain is not None:
            chain.close()

    def _composed(self, composed: Composed) -> None:
        record = composed.as_record()
        if record is None or not self.active:
            return
        self._end.publish(
            cdr.encode(PUBLISHED[END_EFFECTOR].type, from_end_effector(record, self.frame_prefix + END_REST))
        )
        if self._frames is not None:
            self._frames.move(chain_transforms(self._file, composed))

    def _joints_fault(self, message: Any) -> str:
        return joints_fault(message.name, message.position, {joint.name for joint in self._file.joints})

    def _joints(self, message: Any) -> None:
        if self.chain is not None:
            self.chain.set_angles(dict(zip(message.name, message.position, strict=False)))

    def _zero(self, chain: ChainSession) -> Zeroed:
        taken = chain.zero()
        links = zip(self._file.names, chain.sessions, taken, strict=True)
        texts = (
            f'{name}: not zeroed: {why_no_zero(session.pipeline)}'
            if change is None
            else f'{name}: {zero_text(session.rig)}'
            for name, session, change in links
        )
        return Zeroed(None not in taken, '; '.join(texts))

    def report(self) -> None:
        """Publish the states of the links, which are recorded, and of the end effector."""
        super().report()
        if self.chain is None:
            return
        node = self.full_name().removeprefix('/')
        links = zip(self._file.names, self.chain.sessions, self._health, self._reported, strict=True)
        for name, session, health, reported in links:
            reported.notify(again=False)
            report = health.report(session.acquisition.now_ns())
            entries = (e._replace(name=e.name.replace('psd_deflection', f'{node}/{name}', 1)) for e in report.entries)
            session.fanout.put(report._replace(entries=tuple(entries)))

    def health(self) -> Iterable[Health]:
        """What was composed in the last second."""
        chain = self.chain
        if chain is None:
            return (Health('end effector', STALE, 'not configured'),)
        missing = chain.missing
        before, self._observed = self._observed, (chain.composed, sum(missing.values()))
        new, lacking = (now - then for now, then in zip(self._observed, before, strict=True))
        silent = chain.silent()
        if silent or not new:
            level, text = ERROR, f'no end effector: {silent or "no common time"}'
        elif lacking:
            level, text = WARN, f'{lacking} of {new + lacking} times not composed'
        else:
            level, text = OK, f'{new} composed in a second'
        values = [('composed', str(chain.composed)), *((f'missing {name}', str(n)) for name, n in missing.items())]
        values += [
            (f'angle {j.name}', f'{a:.6f}') for j, a in zip(self._file.joints, chain.angles, strict=True) if j.name
        ]
        return (Health('end effector', level, text, tuple(values)),)


def chain_transforms(file: ChainFile, composed: Composed) -> list[Any]:
    """The TransformStamped of all that moves at one time: clamps, tips, the end effector and its rigid pose."""
    end = composed.end
    if end is None:
        return []
    t_ns = composed.t_ns
    prefix_of_all = file.settings.frame_prefix

    def message(parent: str, child: str, pose: Transform) -> Any:
        x, y, z = pose.position.tolist()
        rotation = dict(zip('xyzw', pose.quaternion.tolist(), strict=True))
        return transform_message(parent, child, t_ns, (x, y, z), rotation)

    out = []
    holder = file.base_frame
    for link, rig, angle, tip in zip(file.chain.links, file.rigs, end.angles, end.tips, strict=True):
        prefix = rig.monitor.frame_prefix
        out.append(message(holder, prefix + BASE, link.base(angle)))
        out.append(message(prefix + REST, prefix + TIP, tip))
        holder = prefix + TIP
    out.append(message(holder, prefix_of_all + END, file.chain.end))
    out.append(message(file.base_frame, prefix_of_all + END_REST, end.rigid))
    return out


def run_chain(
    ros_args: Sequence[str],
    path: str,
    given: Mapping[str, Value],
    slopes: str | None,
    log: LogCallback,
    watch: Callable[[ChainSession], object],
) -> int:
    """Run the node of the chain file ``path`` until SIGINT or SIGTERM. ``watch``: called about ten times a second.

    Raises the errors of the package if the run cannot start, or if a pipeline failed.
    """
    with ros(NODE_NAME, ros_args) as signals:
        owner, watchdog = ChainNode(path, given, slopes, log, signals), Watchdog()

        def runs() -> bool:
            chain = owner.chain
            if chain is not None:
                if not chain.alive:
                    return False
                watch(chain)
            if chain is None or chain.responsive():
                watchdog.alive()
            return True

        try:
            serve(owner, signals, runs, watchdog.ready)
            failed = owner.chain.failed if owner.chain is not None else None
        except StopRequestedError:
            failed = None
        finally:
            watchdog.stopping()
            owner.close()
        if failed is not None:
            raise failed
    return 0
