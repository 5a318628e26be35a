"""The loop closed over real DDS: a simulated arm of two links, its deflection, and the offsets of its joints."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

pytestmark = pytest.mark.ros
pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from geometry_msgs.msg import PoseWithCovarianceStamped  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_srvs.srv import SetBool  # noqa: E402
from trajectory_msgs.msg import JointTrajectory  # noqa: E402

from bench.simulated_arm import SimulatedArm  # noqa: E402
from psd_deflection.chains.chain_file import read_chain  # noqa: E402
from psd_deflection.records import FloatArray  # noqa: E402
from test.ros.conftest import WARNINGS  # noqa: E402
from tools.program import PSD_DEFLECTION, ROOT, Program  # noqa: E402

URDF = ROOT / 'config' / 'two_links.urdf'
NOMINAL = np.array([1.2, 0.6])
PERIOD_S = 0.02


class Plant:
    """The arm on the graph: it adds the offsets that it hears to its commands, and tells its deflection and joints.

    ``tell`` may be set to change or withhold what it says of the deflection.
    """

    def __init__(self, peer: Any) -> None:
        self.arm = SimulatedArm(read_chain(ROOT / 'config' / 'two_links.yaml').chain, NOMINAL, damping=0.1)
        self.arm.force = np.array([0.0, 0.0, -40.0])
        self.rigid = self.arm.chain.rigid(NOMINAL.tolist())
        self.offsets: list[FloatArray] = [np.zeros(2)]
        self.tell: Callable[[Any], bool] = lambda message: True
        self._deflections = peer.node.create_publisher(PoseWithCovarianceStamped, '/end_effector/deflection', 5)
        self._joints = peer.node.create_publisher(JointState, '/joint_states', 5)
        peer.node.create_subscription(
            JointTrajectory,
            '/compensator/offsets',
            lambda message: self.offsets.append(np.array(message.points[0].positions)),
            5,
        )
        self._then = time.monotonic()
        peer.node.create_timer(PERIOD_S, self._step)

    def _step(self) -> None:
        now = time.monotonic()
        self.arm.step(NOMINAL + self.offsets[-1], now - self._then)
        self._then = now
        self._joints.publish(JointState(name=['elbow', 'shoulder'], position=self.arm.angles[::-1].tolist()))
        deflection = self.arm.end().deflection
        message = PoseWithCovarianceStamped()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(time.time_ns(), 10**9)
        place, turned = message.pose.pose.position, message.pose.pose.orientation
        place.x, place.y, place.z = deflection.position.tolist()
        turned.x, turned.y, turned.z, turned.w = deflection.quaternion.tolist()
        message.pose.covariance = (np.eye(6) * 1e-12).ravel()
        if self.tell(message):
            self._deflections.publish(message)

    def error(self) -> float:
        """Distance of the end effector from its rigid pose, m."""
        return float(np.linalg.norm(self.arm.end().deflected.position - self.rigid.position))


@pytest.fixture
def compensator(domain: int) -> Iterator[Program]:
    command = [*PSD_DEFLECTION, 'compensator', str(URDF), '--tip', 'tool', '--axes', 'x,z', '--drive']
    one = Program(command, env={'PYTHONWARNINGS': WARNINGS})
    yield one
    one.end()
    print(*one.lines[-50:], sep='\n')


def test_the_loop_is_closed_held_and_handed_over(compensator: Program, peer: Any) -> None:
    plant = Plant(peer)
    peer.until(lambda: len(plant.offsets) > 20, 'offsets')
    assert not np.any(plant.offsets)
    free = plant.error()
    assert free > 2e-3
    # Closed.
    assert peer.call(SetBool, '/compensator/enable', SetBool.Request(data=True)).success
    peer.until(lambda: plant.error() < 0.02 * free, 'an error of less than 2 %')

    # Held: a deflection that is not finite, one that jumps, and none at all.
    def no_number(message: Any) -> bool:
        message.pose.pose.position.x = math.nan
        return True

    def jumps(message: Any) -> bool:
        message.pose.pose.position.x += 0.1
        return True

    for fault, why in ((no_number, 'not finite'), (jumps, 'jumps by'), (lambda message: False, 'no deflection for')):
        said, held = len(compensator.text), len(plant.offsets)
        plant.tell = fault

        def holds(said: int = said, why: str = why) -> bool:
            return re.search(f'holding: .*{why}', compensator.text[said:]) is not None

        peer.until(holds, why)
        # One step may have been on its way.
        peer.until(lambda held=held: len(plant.offsets) > held + 20, 'offsets that are held')
        assert np.ptp(plant.offsets[held + 10 :], axis=0).max() == 0.0
        said = len(compensator.text)
        plant.tell = lambda message: True
        peer.until(lambda said=said: 'following' in compensator.text[said:], 'following')
    reports = peer.collect(DiagnosticArray, '/diagnostics')
    peer.until(lambda: bool(reports), 'diagnostics')
    assert [s.name for s in reports[0].status] == ['compensator: offsets']
    # Handed over: it ends at no offset.
    compensator.process.send_signal(2)
    peer.until(lambda: not np.any(plant.offsets[-1]), 'no offset')
    steps = np.abs(np.diff(plant.offsets, axis=0)).max()
    assert compensator.wait() == 0
    assert steps < 0.1 * 0.1 * 1.001
