"""The node ``chain``: several rigs in one process, and the end effector composed of them.

It publishes ``end_effector/deflection`` in the frame ``end_effector_rest``, each link's topics below the link's name,
and all frames from the base to the end effector on ``/tf``. ``joint_states`` turns the joints that the chain file
names. ``~/zero`` and ``~/record`` act on every link. The executor runs in the main thread; estimates are published by
the pipeline threads.
"""

from __future__ import annotations

import contextlib
import importlib
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future as DiskFuture
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from msg_adapters import DEFLECTION_WITH_COVARIANCE, DIAGNOSTICS, END_EFFECTOR, TOPIC_TYPES, to_messages
from msg_adapters.pose_with_covariance_stamped import from_end_effector
from psd_deflection.arms.chains.chain_file import ChainFile
from psd_deflection.arms.chains.transform import Transform
from psd_deflection.arms.inputs import joints_fault
from psd_deflection.base.errors import PsdDeflectionError, Warned
from psd_deflection.recordings import cdr
from psd_deflection.records import DiagnosticEntry, DiagnosticReport
from psd_deflection.ros.declared import node_with_overrides, refuse_unknown
from psd_deflection.ros.gate import InputGate
from psd_deflection.ros.log import NodeLog
from psd_deflection.ros.names import BASE, END, END_REST, JOINT_STATES, RECORD, REST, TF, TF_STATIC, TIP, ZERO
from psd_deflection.ros.running import SPIN_S, executor_of, ros
from psd_deflection.ros.transforms import installed, static_transforms, transform_message
from psd_deflection.ros.wires import InputRecorder, PublisherWire, message_class, qos, relative, topics_of
from psd_deflection.run.chain import ChainSession, Composed
from psd_deflection.run.diagnostics import ERROR, OK, WARN, HealthReporter
from psd_deflection.run.fanout import subscribed
from psd_deflection.run.realtime import Watchdog, settle
from psd_deflection.run.rig_publisher import RigPublisher
from psd_deflection.run.session import Session, why_no_zero, zero_text
from psd_deflection.run.signals import Signals, StopRequestedError

NODE_NAME = 'chain'
_KIND = TOPIC_TYPES[DEFLECTION_WITH_COVARIANCE]


class ChainNode:
    """The node and its rigs, which are open; :meth:`start` lets samples flow."""

    def __init__(self, file: ChainFile, say: Callable[[str], None], signals: Signals) -> None:
        self.node = node_with_overrides(NODE_NAME)
        self._say: Callable[[str], None] = say
        self._log: NodeLog | None = None
        try:
            refuse_unknown(self.node, {})
            self._say = say = self._log = NodeLog(self.node, say)
            name = self.node.get_fully_qualified_name()
            self.chain = signals.interruptible(
                lambda: ChainSession(file, say, lambda _, rig, told: Session(rig, told, name))
            )
        except BaseException:
            self._leave()
            raise
        try:
            self._offer(file)
        except BaseException:
            self.close()
            raise

    def _offer(self, file: ChainFile) -> None:
        """Everything on the graph."""
        node = self.node
        self._gate = InputGate(node, self._say)
        self._wires: list[PublisherWire] = []
        self._told: list[RigPublisher] = []
        self._health = [HealthReporter(session) for session in self.chain.sessions]
        for link, session in zip(file.names, self.chain.sessions, strict=True):
            wire = PublisherWire(node, topics_of(session.rig), link)
            wire.active = True
            session.fanout.wires.insert(0, wire)
            self._wires.append(wire)
            told = RigPublisher(wire, session)
            session.fanout.change_wires.append(told)
            self._told.append(told)
            InputRecorder(node, subscribed(session.rig), link).session = session
        self._end = node.create_publisher(message_class(_KIND), relative(END_EFFECTOR), qos(END_EFFECTOR))
        self._tf = self._tf_static = None
        if installed():
            self._message = importlib.import_module('tf2_msgs.msg').TFMessage
            self._tf = node.create_publisher(self._message, TF, qos(TF))
            self._tf_static = node.create_publisher(self._message, TF_STATIC, qos(TF_STATIC))
        self.chain.listeners.append(self._composed)
        if any(joint.name for joint in file.joints):
            kind = message_class('sensor_msgs/msg/JointState')
            self._gate.listen(kind, JOINT_STATES, self._joints_fault, self._joints, 10)
        node.create_service(Trigger, ZERO, self._zero)
        # In a separate group: while one request waits for the disk, the node serves everything else.
        node.create_service(SetBool, RECORD, self._record, callback_group=ReentrantCallbackGroup())
        self._seen = (0, 0)
        node.create_timer(1.0, self._report, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def start(self) -> None:
        """Let samples flow. Raises RecordingError."""
        now = time.time_ns()
        if self._tf_static is not None:
            fixed = [t for session in self.chain.sessions for t in static_transforms(session.rig, now)]
            self._tf_static.publish(self._message(transforms=fixed))
        for told in self._told:
            told.tell()
        self.chain.start()
        topics = [self._end.topic_name, *(w.names((DEFLECTION_WITH_COVARIANCE,))[0] for w in self._wires)]
        self._say(f'publishing {", ".join(topics)} …; services {ZERO} and {RECORD} of {NODE_NAME}')

    def _composed(self, composed: Composed) -> None:
        record = composed.as_record()
        if record is None:
            return
        self._end.publish(cdr.encode(_KIND, from_end_effector(record, END_REST)))
        if self._tf is not None:
            self._tf.publish(self._message(transforms=chain_transforms(self.chain, composed)))

    def _joints_fault(self, message: Any) -> str:
        return joints_fault(message.name, message.position, {joint.name for joint in self.chain.file.joints})

    def _joints(self, message: Any) -> None:
        angles = zip(message.name, message.position, strict=False)
        self.chain.turn(dict(angles))

    def _zero(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = False
        try:
            taken = self.chain.zero()
        except (PsdDeflectionError, TimeoutError) as error:
            response.message = f'not zeroed: {error}'
            return response
        links = zip(self.chain.file.names, self.chain.sessions, taken, strict=True)
        response.message = '; '.join(
            f'{name}: not zeroed: {why_no_zero(session.pipeline)}'
            if change is None
            else f'{name}: {zero_text(session.rig)}'
            for name, session, change in links
        )
        response.success = None not in taken
        return response

    async def _record(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success = False
        try:
            folders = [await _answer(asked) for asked in self.chain.record(request.data)]
        except (PsdDeflectionError, TimeoutError) as error:
            response.message = str(error)
            return response
        response.success = True
        said = [str(folder) for folder in folders if folder is not None]
        verb = 'recording to' if request.data else 'recording ended:'
        response.message = f'{verb} {", ".join(said)}' if said else 'no recording runs'
        return response

    def _report(self) -> None:
        chain = self.chain
        self._gate.settle()
        node = self.node.get_fully_qualified_name().removeprefix('/')
        for name, session, health, told in zip(chain.file.names, chain.sessions, self._health, self._told, strict=True):
            told.tell(again=False)
            report = health.report(session.acquisition.now_ns())
            entries = (e._replace(name=e.name.replace('psd_deflection', f'{node}/{name}', 1)) for e in report.entries)
            session.fanout.put(report._replace(entries=tuple(entries)))
        (message,) = to_messages(DiagnosticReport(time.time_ns(), (self._entry(node),)))
        self._wires[0].put(DIAGNOSTICS, message.type, cdr.encode(message.type, message.fields), message.t_ns)

    def _entry(self, node: str) -> DiagnosticEntry:
        chain = self.chain
        missing = chain.missing
        before, self._seen = self._seen, (chain.composed, sum(missing.values()))
        new, lacking = (now - then for now, then in zip(self._seen, before, strict=True))
        silent = chain.silent()
        if silent or not new:
            level, text = ERROR, f'no end effector: {silent or "no common time"}'
        elif lacking:
            level, text = WARN, f'{lacking} of {new + lacking} times not composed'
        else:
            level, text = OK, f'{new} composed in a second'
        values = [('composed', str(chain.composed)), *((f'missing {name}', str(n)) for name, n in missing.items())]
        values += [
            (f'angle {j.name}', f'{a:.6f}') for j, a in zip(chain.file.joints, chain.angles, strict=True) if j.name
        ]
        values += self._gate.values()
        return DiagnosticEntry(f'{node}: end effector', level, text, tuple(values))

    def close(self) -> None:
        """End the rigs, then the node."""
        self.chain.close()
        self._leave()

    def _leave(self) -> None:
        if self._log is not None:
            self._log.close()
        self.node.destroy_node()


async def _answer(asked: DiskFuture[Any]) -> Any:
    """The result of ``asked``, without a thread that waits."""
    answered: Any = Future()
    asked.add_done_callback(lambda _: answered.set_result(None))
    await answered
    return asked.result()


def chain_transforms(chain: ChainSession, composed: Composed) -> list[Any]:
    """The TransformStamped of all that moves at one time: clamps, tips, the end effector and its rigid pose."""
    end = composed.end
    if end is None:
        return []
    file, t_ns = chain.file, composed.t_ns

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
    out.append(message(holder, END, file.chain.end))
    out.append(message(file.base_frame, END_REST, end.rigid))
    return out


def run_chain(
    ros_args: Sequence[str], file: ChainFile, say: Callable[[str], None], watch: Callable[[ChainSession], object]
) -> int:
    """Run the node until SIGINT or SIGTERM. ``watch``: called about ten times a second.

    Raises the errors of the package if the run cannot start, or if a pipeline failed.
    """
    with ros(NODE_NAME, ros_args) as signals, contextlib.suppress(StopRequestedError):
        _spin(file, say, watch, signals)
    return 0


def _spin(
    file: ChainFile, say: Callable[[str], None], watch: Callable[[ChainSession], object], signals: Signals
) -> None:
    if not installed():
        say(Warned('tf2_msgs is not installed: no frames on /tf'))
    owner = ChainNode(file, say, signals)
    watchdog = Watchdog()
    try:
        with executor_of(owner.node) as executor:
            settle()
            owner.start()
            watchdog.ready()
            while not signals.stop and owner.chain.alive:
                executor.spin_once(timeout_sec=SPIN_S)
                if owner.chain.responsive():
                    watchdog.alive()
                watch(owner.chain)
    finally:
        watchdog.stopping()
        owner.close()
    if owner.chain.failed is not None:
        raise owner.chain.failed
