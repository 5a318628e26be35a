"""A million messages of any content against the nodes that move an arm: no step, no death, no leak.

  python -m bench.campaign.messages 1000000

The compensator follows while they come, by what is right between them; the shaper has trajectories under way. Each
message goes through the real callback of the node in this process, as DDS would hand it over, at the speed of the
processor. Before that some hundred go over real DDS to the processes of ``compensator``, ``shaper`` and ``chain``.

The content is that of a grammar: numbers that are not finite, huge, denormal; stamps before 1970 and ahead of us;
frames, names and lists of wrong sizes; rotations that are none; and encoded messages that are cut or damaged.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import resource
import struct
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.publisher import Publisher
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64, Float64MultiArray
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from bench.steps import largest_step
from psd_deflection.arms.compensation.arm import read_arm
from psd_deflection.arms.compensation.compensator import CompensatorSettings, State
from psd_deflection.arms.compensation.shaping import ShaperSettings
from psd_deflection.base.log import unsaid
from psd_deflection.records import FloatArray
from psd_deflection.ros.compensator import CompensatorNode
from psd_deflection.ros.shaper import ShaperNode
from tools.program import PSD_DEFLECTION, ROOT, Program

URDF = ROOT / 'config' / 'two_links.urdf'
NAMES = ['shoulder', 'elbow']
JOINTS = [1.2, 0.6]
MOST_STEP = 1.0 + 1e-6
MOST_GROWTH = 30e6
"""Bytes that the process may grow by after the first tenth."""
SPIN_EVERY = 50
"""Messages after which the node's timers have their turn."""
BIG = (float('nan'), float('inf'), -float('inf'), 1e300, -1e308, 5e-324, 1e-200, -0.0, 1e4, 10.0, 1.0, -1.0)


class Stranger:
    """Messages of any content, by chance."""

    def __init__(self, seed: int) -> None:
        self._chance = random.Random(seed)
        self.makes: Mapping[str, Callable[[], Any]] = {
            '/end_effector/deflection': self.deflection,
            '/joint_states': self.joints,
            '/compensator/applied': self.applied,
            '/compensator/robot_running': lambda: Bool(data=self._chance.random() < 0.9),
            '/compensator/speed_scaling': lambda: Float64(data=self.number(1.0)),
            '/shaper/trajectory': self.trajectory,
        }

    def number(self, usual: float) -> float:
        """One that is as usual, or not."""
        kind = self._chance.random()
        if kind < 0.6:
            return usual + self._chance.gauss(0.0, 0.02)
        if kind < 0.9:
            return self._chance.choice(BIG)
        (out,) = struct.unpack('<d', self._chance.randbytes(8))
        return float(out)

    def stamp(self) -> Time:
        """Of now, mostly."""
        now = time.time_ns()
        seconds, rest = divmod(now + self._chance.choice((0, 0, 0, 0, -(10**9), 10**8, 3600 * 10**9)), 10**9)
        if self._chance.random() < 0.1:
            return Time(sec=self._chance.choice((0, -1, -(2**31), 2**31 - 1)), nanosec=self._chance.getrandbits(32))
        return Time(sec=seconds, nanosec=rest)

    def deflection(self) -> Any:
        """A pose."""
        chance, out = self._chance, good_deflection()
        out.header.stamp = self.stamp()
        out.header.frame_id = chance.choice(('', '', 'end_effector_rest', 'world', 'ä' * 50))
        place, turned = out.pose.pose.position, out.pose.pose.orientation
        place.x, place.y, place.z = (self.number(1e-3) for _ in range(3))
        if chance.random() < 0.5:
            turned.x, turned.y, turned.z, turned.w = (self.number(0.0) for _ in range(4))
        if chance.random() < 0.5:
            out.pose.covariance = [self.number(0.0) * chance.choice((1.0, 1e-9)) for _ in range(36)]
        return out

    def joints(self) -> Any:
        """Joints."""
        chance = self._chance
        names = chance.choice((NAMES, NAMES, NAMES[::-1], NAMES[:1], ['elbow'] * 2, ['', 'x'], [], self._names()))
        count = len(names) if chance.random() < 0.8 else chance.randrange(5)
        out = JointState(name=names, position=[self.number(chance.choice(JOINTS)) for _ in range(count)])
        out.header.stamp = self.stamp()
        return out

    def _names(self) -> list[str]:
        return [f'joint {self._chance.getrandbits(40)}' for _ in range(self._chance.choice((3, 50)))]

    def applied(self) -> Any:
        """Offsets."""
        count = self._chance.choice((2, 2, 2, 0, 1, 3))
        return Float64MultiArray(data=[self.number(0.0) for _ in range(count)])

    def trajectory(self) -> Any:
        """A trajectory."""
        chance = self._chance
        out = JointTrajectory(joint_names=chance.choice((NAMES, NAMES, NAMES, ['z'], [], ['a', 'a'])))
        out.header.stamp = chance.choice((Time(), Time(), self.stamp()))
        orders = chance.choice((1, 2, 2, 3))
        at = 0.0
        for _ in range(chance.choice((0, 1, 1, 2, 3))):
            at += chance.choice((0.0, 0.1, 0.2, 0.5))
            sec, nanosec = divmod(round(at * 1e9), 10**9)
            point = JointTrajectoryPoint(positions=[self.number(q) for q in JOINTS])
            point.time_from_start.sec, point.time_from_start.nanosec = sec - (chance.random() < 0.02), nanosec
            point.velocities = [self.number(0.0) if chance.random() < 0.05 else 0.0 for _ in range(2)][
                : orders > 1 and 2
            ]
            point.accelerations = [0.0, 0.0][: orders > 2 and 2]
            point.effort = chance.choice(([], [], [0.0, 0.0], [1.0, 0.0]))
            out.points.append(point)
        return out

    def encoded(self, topics: list[str]) -> tuple[str, bytes]:
        """A topic with a message for it, which may be damaged on the way."""
        chance = self._chance
        topic = chance.choice(topics)
        content = bytearray(serialize_message(self.makes[topic]()))
        if chance.random() < 0.05:
            kind = chance.randrange(3)
            if kind == 0:
                del content[chance.randrange(len(content)) :]
            elif kind == 1:
                content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
            else:
                content = bytearray(chance.randbytes(chance.randrange(200)))
        return topic, bytes(content)


def good_deflection() -> Any:
    """A deflection of now."""
    out = PoseWithCovarianceStamped()
    out.header.stamp.sec, out.header.stamp.nanosec = divmod(time.time_ns(), 10**9)
    out.pose.pose.position.x, out.pose.pose.position.z = 1e-3, 2e-3
    out.pose.pose.orientation.w = 1.0
    out.pose.covariance = (np.eye(6) * 1e-12).ravel()
    return out


class Listener:
    """What a node publishes in this process: every command with the time at which it left."""

    def __init__(self, topic: str) -> None:
        self.stamps: list[float] = []
        self.commands: list[FloatArray] = []
        self.step = 0.0
        first = Publisher.publish

        def publish(publisher: Any, message: Any) -> None:
            if publisher.topic_name == topic:
                self.heard(message)
            first(publisher, message)

        Publisher.publish = publish

    def heard(self, message: Any) -> None:
        """Keep the last two, and the largest step."""
        self.stamps = [*self.stamps[-1:], time.monotonic()]
        self.commands = [*self.commands[-1:], np.array(message.data)]
        self.step = max(self.step, largest_step(self.stamps, self.commands, CompensatorSettings().max_rate))


def memory() -> int:
    """Bytes that the process has now."""
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * resource.getpagesize()


class Heard:
    """The trajectories that the shaper lets through: finite, in order, begun where the one before is."""

    def __init__(self) -> None:
        self.count = 0
        first = Publisher.publish

        def publish(publisher: Any, message: Any) -> None:
            if publisher.topic_name == '/shaper/shaped' and message.points:
                self.heard(message)
            first(publisher, message)

        Publisher.publish = publish

    def heard(self, message: Any) -> None:
        """AssertionError if a controller could not follow it."""
        self.count += 1
        states = np.array([[*p.positions, *p.velocities, *p.accelerations] for p in message.points])
        times = np.array([p.time_from_start.sec + p.time_from_start.nanosec / 1e9 for p in message.points])
        if not np.all(np.isfinite(states)) or np.any(np.diff(times) <= 0.0) or list(message.joint_names) != NAMES:
            raise AssertionError(f'passed on: {message}')
        if message.header.stamp.sec <= 0:
            raise AssertionError(f'begins at no time: {message.header}')


class Inside:
    """The compensator in follow and the shaper in this process."""

    def __init__(self, seed: int) -> None:
        rclpy.init(args=['messages'])
        # A busy machine is late, and what is right would be stale.
        settings = CompensatorSettings(axes=('x', 'z'), joints=tuple(NAMES), good=1, stale=1.0)
        self.listener, self.shaped = Listener('/compensator/offsets'), Heard()
        self.compensator = CompensatorNode(read_arm(URDF, 'tool'), settings, unsaid, True)
        self.shaper = ShaperNode(ShaperSettings(frequency=12.0), unsaid)
        self._executor = SingleThreadedExecutor()
        self._inputs: dict[str, list[Any]] = {}
        for owner in (self.compensator, self.shaper):
            self._executor.add_node(owner.node)
            owner.start()
            for one in owner.node.subscriptions:
                self._inputs.setdefault(one.topic_name, []).append(one.callback)
        self._stranger = Stranger(seed)
        self.states: Counter[State] = Counter()
        self._enable(True)

    def _enable(self, wanted: bool) -> None:
        (service,) = [s for s in self.compensator.node.services if s.service_name == '/compensator/enable']
        self.ask = service.callback
        result = self.ask(SetBool.Request(data=wanted), SetBool.Response())
        if hasattr(result, 'send'):
            with contextlib.suppress(StopIteration):
                result.send(None)

    def hand(self, topic: str, content: bytes) -> None:
        """A message, as DDS hands it over."""
        for callback in self._inputs[topic]:
            callback(content)

    def good(self) -> None:
        """What is right: the robot runs, and the deflection is followed."""
        held = self.listener.commands[-1].tolist() if self.listener.commands else [0.0, 0.0]
        joints = JointState(name=NAMES, position=JOINTS)
        joints.header.stamp = good_deflection().header.stamp
        for topic, message in (
            ('/compensator/robot_running', Bool(data=True)),
            ('/compensator/speed_scaling', Float64(data=1.0)),
            ('/compensator/applied', Float64MultiArray(data=held)),
            ('/joint_states', joints),
            ('/end_effector/deflection', good_deflection()),
        ):
            self.hand(topic, serialize_message(message))

    def spin(self) -> None:
        """Let timers have their turn."""
        for _ in range(4):
            self._executor.spin_once(timeout_sec=0.0)
        self.compensator.runs()

    def run(self, count: int) -> int:
        """So many strange messages; the bytes by which the process grew after the first tenth."""
        topics, chance, begun = list(self._inputs), random.Random(1), 0
        topics = [t for t in topics if t in self._stranger.makes]
        for number in range(count):
            if number % SPIN_EVERY == 0:
                self.spin()
                self.states[self.compensator.command.state] += 1
                if chance.random() < 0.02:
                    self._enable(chance.random() < 0.1)
                else:
                    self._enable(True)
            if number % 6 == 0:
                self.good()
                self.good()
            self.hand(*self._stranger.encoded(topics))
            if number == count // 10:
                begun = memory()
            if number % (count // 100 or 1) == 0:
                print(
                    f'{number} messages, {self.states[State.FOLLOWING]} of {self.states.total()} times following, '
                    f'{memory() / 1e6:.0f} MB, largest step {self.listener.step:.4f}',
                    file=sys.stderr,
                    flush=True,
                )
        return memory() - begun

    def close(self) -> None:
        """Leave."""
        for owner in (self.compensator, self.shaper):
            owner.close()
        self._executor.shutdown()
        rclpy.try_shutdown()


def over_dds(count: int, seed: int) -> int:
    """Send ``count`` of them to the processes of the nodes; how many of these are not there any more."""
    chain = ROOT / 'config' / 'two_links.yaml'
    nodes = {
        'compensator': [str(URDF), '--tip', 'tool', '--axes', 'x,z', '--drive'],
        'shaper': ['--frequency', '12'],
        'chain': [str(chain)],
    }
    programs = {name: Program([*PSD_DEFLECTION, name, *words]) for name, words in nodes.items()}
    rclpy.init(args=['stranger'])
    node = rclpy.create_node('stranger')
    stranger = Stranger(seed)
    senders = {topic: node.create_publisher(type(make()), topic, 50) for topic, make in stranger.makes.items()}
    for sender in senders.values():
        until = time.monotonic() + 60.0
        while sender.get_subscription_count() == 0 and time.monotonic() < until:
            time.sleep(0.05)
    for _ in range(count):
        topic, content = stranger.encoded(list(senders))
        # DDS itself does not send what is too short.
        with contextlib.suppress(RuntimeError):
            senders[topic].publish(content)
        time.sleep(0.002)
    time.sleep(2.0)
    gone = [name for name, one in programs.items() if one.process.poll() is not None]
    for name, one in programs.items():
        status = one.end()
        print(f'{name}: after {count} messages over DDS status {status}')
        if status:
            gone.append(name)
            print(one.text[-2000:])
    node.destroy_node()
    rclpy.try_shutdown()
    return len(gone)


def main() -> int:
    """Exit status 0 if nothing leapt, ended or grew."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('count', type=int, nargs='?', default=1_000_000)
    parser.add_argument('--dds', type=int, default=2000, help='how many of them go over DDS before')
    parser.add_argument('--seed', type=int, default=1)
    args = parser.parse_args()
    gone = over_dds(args.dds, args.seed) if args.dds else 0
    inside = Inside(args.seed)
    began = time.monotonic()
    try:
        grown = inside.run(args.count)
    finally:
        inside.close()
    took = time.monotonic() - began
    followed = inside.states[State.FOLLOWING] / max(inside.states.total(), 1)
    refused = inside.compensator.gate.refused.total() + inside.shaper.gate.refused.total()
    print(
        f'{args.count} messages in {took:.0f} s, {refused} refused at the gate; {inside.shaped.count} trajectories '
        f'shaped; the offsets followed {followed:.0%} of the time; largest step {inside.listener.step:.4f} of '
        f'max_rate * dt; {grown / 1e6:+.1f} MB after the first tenth; nodes that ended: {gone}'
    )
    return 1 if gone or inside.listener.step > MOST_STEP or grown > MOST_GROWTH or not followed else 0


if __name__ == '__main__':
    sys.exit(main())
