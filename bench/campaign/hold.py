"""``make compensate-faults``: how soon the offsets hold after what they follow has gone wrong, over real DDS.

A simulated arm is on the graph. Its deflection comes through a process that stands for the estimator, the positions of
its joints through one that stands for the robot's driver, and the real compensator drives it. Each fault is injected
again and again: a deflection that is not finite, one that jumps, a stale one, none, an estimator that is killed
(SIGKILL), and a DDS that is gone: all that the compensator hears from is killed at once, or stopped (SIGSTOP: the
participants are still there, and nothing comes). Judged is the last time at which an offset changed, and whether they
follow again.

  python -m bench.campaign.hold --times 20
"""

from __future__ import annotations

import argparse
import math
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool

from bench.simulated_arm import SimulatedArm
from psd_deflection.arms.chains.chain_file import read_chain
from psd_deflection.records import FloatArray
from tools.program import PSD_DEFLECTION, ROOT, Program

URDF = ROOT / 'config' / 'two_links.urdf'
NOMINAL = np.array([1.2, 0.6])
PERIOD_S = 0.02
NOISE = 1e-6
HOLD_S = 0.1
"""The offsets must not change later than this after a fault."""

WATCHED_S = 0.4
"""How long offsets are watched after a fault, s. After half a second they follow a deflection that jumped and stays."""
LONGEST_S = 60.0
RELAYED = {
    'estimator': ('/arm/deflection', '/end_effector/deflection', PoseWithCovarianceStamped),
    'driver': ('/arm/joints', '/joint_states', JointState),
}
"""What a process passes on: from the arm, to the compensator, and the type."""

Tell = Callable[[Any], bool]


def faithful(message: Any) -> bool:
    """What is right."""
    return True


def no_number(message: Any) -> bool:
    """A deflection that is not finite."""
    message.pose.pose.position.x = math.nan
    return True


def jumps(message: Any) -> bool:
    """A deflection that is somewhere else."""
    message.pose.pose.position.x += 0.1
    return True


def stale(message: Any) -> bool:
    """A deflection of a second ago."""
    t_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec - 1_000_000_000
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(t_ns, 10**9)
    return True


def silent(message: Any) -> bool:
    """No deflection."""
    return False


FAULTS: dict[str, tuple[Tell, str]] = {
    'not finite': (no_number, 'not finite'),
    'jump': (jumps, 'jumps by'),
    'stale': (stale, 'is older than'),
    'silent': (silent, 'no deflection for'),
}
"""What the arm tells, and what the compensator says then."""

SENT: dict[str, tuple[int, tuple[str, ...]]] = {
    'estimator killed': (signal.SIGKILL, ('estimator',)),
    'DDS killed': (signal.SIGKILL, ('estimator', 'driver')),
    'DDS stopped': (signal.SIGSTOP, ('estimator', 'driver')),
}
"""Faults that are signals, and the processes that get them."""


class Plant:
    """The arm on the graph: it adds the offsets that it hears to its commands, and tells them, its deflection
    and its joints.

    ``tell`` may change what it says of the deflection, and withholds it by False. ``offsets``: all that were heard, and
    ``stamps`` when they came, s.
    """

    def __init__(self, node: Any, topic: str = '/end_effector/deflection', joints: str = '/joint_states') -> None:
        self.arm = SimulatedArm(read_chain(ROOT / 'config' / 'two_links.yaml').chain, NOMINAL, damping=0.1)
        self.arm.force = np.array([0.0, 0.0, -40.0])
        self.rigid = self.arm.chain.rigid(NOMINAL.tolist())
        self.offsets: list[FloatArray] = [np.zeros(2)]
        self.stamps = [0.0]
        self.tell: Tell = faithful
        self._noise = np.random.default_rng(0)
        self._deflections = node.create_publisher(PoseWithCovarianceStamped, topic, 5)
        self._joints = node.create_publisher(JointState, joints, 5)
        node.create_subscription(Float64MultiArray, '/compensator/offsets', self._heard, 5)
        self._applied = node.create_publisher(Float64MultiArray, '/compensator/applied', 5)
        self._then = time.monotonic()
        node.create_timer(PERIOD_S, self._step)

    def _heard(self, message: Any) -> None:
        self.offsets.append(np.array(message.data))
        self.stamps.append(time.time())

    def _step(self) -> None:
        now = time.monotonic()
        self.arm.step(NOMINAL + self.offsets[-1], now - self._then)
        self._then = now
        self._applied.publish(Float64MultiArray(data=self.offsets[-1].tolist()))
        self._joints.publish(JointState(name=['elbow', 'shoulder'], position=self.arm.angles[::-1].tolist()))
        deflection = self.arm.end().deflection
        message = PoseWithCovarianceStamped()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(time.time_ns(), 10**9)
        place, turned = message.pose.pose.position, message.pose.pose.orientation
        place.x, place.y, place.z = (deflection.position + self._noise.normal(size=3) * NOISE).tolist()
        turned.x, turned.y, turned.z, turned.w = deflection.quaternion.tolist()
        message.pose.covariance = (np.eye(6) * NOISE**2).ravel()
        if self.tell(message):
            self._deflections.publish(message)

    def error(self) -> float:
        """Distance of the end effector from its rigid pose, m."""
        return float(np.linalg.norm(self.arm.end().deflected.position - self.rigid.position))


class Relay:
    """The process that stands for one of ``RELAYED``."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._process = self._start()

    def _start(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, '-m', 'bench.campaign.hold', '--relay', self._name], cwd=ROOT)

    def signal(self, number: int) -> None:
        """SIGKILL or SIGSTOP."""
        self._process.send_signal(number)
        if number == signal.SIGKILL:
            self._process.wait()

    def again(self) -> None:
        """Let it go on if it was stopped; another one if it was killed."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGCONT)
        else:
            self._process = self._start()

    def close(self) -> None:
        """Kill it."""
        self._process.kill()
        self._process.wait()


def relay(name: str) -> None:
    """Pass messages on until killed."""
    heard, told, kind = RELAYED[name]
    rclpy.init()
    node = rclpy.create_node(f'stands_for_the_{name}')
    out = node.create_publisher(kind, told, 5)
    node.create_subscription(kind, heard, out.publish, 5, raw=True)
    rclpy.spin(node)


class Campaign:
    """The graph with all of it."""

    def __init__(self) -> None:
        rclpy.init()
        self.node = rclpy.create_node('campaign')
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.plant = Plant(self.node, *(heard for heard, _, _ in RELAYED.values()))
        self.relays = {name: Relay(name) for name in RELAYED}
        arguments = ['compensator', str(URDF), '--tip', 'tool', '--axes', 'x,z', '--drive']
        self.compensator = Program([*PSD_DEFLECTION, *arguments])

    def spin(self, condition: Callable[[], bool], longest_s: float, what: str = '') -> None:
        """Spin until ``condition``, or for ``longest_s``; then it is an error if there is a ``what``."""
        until = time.monotonic() + longest_s
        while not condition():
            if time.monotonic() > until:
                if what:
                    raise RuntimeError(f'waited {longest_s:g} s for {what}\n{self.compensator.text[-1000:]}')
                return
            self.executor.spin_once(timeout_sec=0.02)

    def enable(self) -> None:
        """Let the offsets follow."""
        client = self.node.create_client(SetBool, '/compensator/enable')
        self.spin(client.service_is_ready, LONGEST_S, 'the service')
        answer = client.call_async(SetBool.Request(data=True))
        self.spin(answer.done, LONGEST_S, 'its answer')

    def follows(self) -> bool:
        """Whether the offsets changed in the last tenth of a second; the noise of the deflection sees to that."""
        return len(self.plant.offsets) > 20 and float(np.ptp(self.plant.offsets[-10:], axis=0).max()) > 0.0

    def inject(self, name: str) -> float:
        """One fault: the time after it at which an offset changed last, s (0 if none did)."""
        self.spin(self.follows, LONGEST_S, 'offsets that follow')
        began = time.time()
        number, victims = SENT.get(name, (0, ()))
        for victim in victims:
            self.relays[victim].signal(number)
        if not victims:
            self.plant.tell = FAULTS[name][0]
        self.spin(lambda: False, WATCHED_S)
        changed = np.any(np.diff(self.plant.offsets, axis=0) != 0.0, axis=1)
        last = float(np.array(self.plant.stamps)[1:][changed].max())
        self.plant.tell = faithful
        for victim in victims:
            self.relays[victim].again()
        return max(last - began, 0.0)

    def close(self) -> None:
        """End everything."""
        self.compensator.end()
        for one in self.relays.values():
            one.close()
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown()


def main(argv: list[str] | None = None) -> int:
    """Inject every fault, print a line for each; status 1 if the offsets held too late."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--times', type=int, default=20, help='of each fault')
    parser.add_argument('--only', choices=(*FAULTS, *SENT), help='this fault alone')
    parser.add_argument('--relay', choices=tuple(RELAYED), help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.relay:
        relay(args.relay)
        return 0
    campaign = Campaign()
    late = 0
    try:
        campaign.enable()
        for name in (args.only,) if args.only else (*FAULTS, *SENT):
            times = [campaign.inject(name) for _ in range(args.times)]
            late += sum(t > HOLD_S for t in times)
            print(
                f'{name:18}{len(times):4} times: held after {np.median(times) * 1e3:3.0f} ms, at most '
                f'{max(times) * 1e3:3.0f} ms; followed again each time'
            )
        campaign.spin(campaign.follows, LONGEST_S, 'offsets that follow')
    finally:
        campaign.close()
    print(f'held later than {HOLD_S * 1e3:g} ms: {late}')
    return 1 if late else 0


if __name__ == '__main__':
    sys.exit(main())
