"""The shaper over real DDS: a trajectory in, the shaped one out, played on the simulated arm."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from rclpy.duration import Duration  # noqa: E402
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint  # noqa: E402

from bench.damping import END, FREQUENCY, MOVE_S, NAMES, RATIO, START, move, played  # noqa: E402
from psd_deflection.arms.compensation.trajectory import checked  # noqa: E402
from test.ros.conftest import WARNINGS, stamp  # noqa: E402
from tools.program import PSD_DEFLECTION, ROOT, Program  # noqa: E402

ZVD = ('--frequency', str(FREQUENCY), '--damping-ratio', str(RATIO), '--shaper', 'zvd')
URDF = ROOT / 'config' / 'two_links.urdf'


@pytest.fixture
def node(domain: int) -> Iterator[Program]:
    one = Program([*PSD_DEFLECTION, 'shaper', *ZVD], env={'PYTHONWARNINGS': WARNINGS})
    yield one
    status = one.end()
    print(*one.lines[-50:], sep='\n')
    assert status == 0


def message(*points: JointTrajectoryPoint, names: tuple[str, ...] = NAMES) -> JointTrajectory:
    return JointTrajectory(joint_names=list(names), points=list(points))


def point(seconds: float, positions: list[float]) -> JointTrajectoryPoint:
    at = Duration(nanoseconds=round(1e9 * seconds)).to_msg()
    return JointTrajectoryPoint(time_from_start=at, positions=positions, velocities=[0.0] * len(positions))


def test_a_move_is_shaped_and_a_bad_one_refused(node: Program, peer: Any) -> None:
    node.until('publishing /shaper/shaped: ZVD for 12 Hz, damping ratio 0.02; motions take 83 ms longer')
    heard = peer.collect(JointTrajectory, '/shaper/shaped')
    reports = peer.collect(DiagnosticArray, '/diagnostics')
    given = peer.node.create_publisher(JointTrajectory, '/shaper/trajectory', 5)
    peer.until(lambda: given.get_subscription_count() > 0, 'the shaper')
    peer.until(lambda: peer.node.count_publishers('/shaper/shaped') > 0, 'its answers')

    # Refused.
    given.publish(message(point(0.0, [1.0])))
    node.until('trajectory refused: point 0 has 1 positions, must be 2')
    late = message(point(0.0, START.tolist()))
    late.header.stamp.sec = 1
    given.publish(late)
    node.until('trajectory refused: its stamp is .* s old')
    peer.until(lambda: any('was refused: its stamp' in r.status[0].message for r in reports), 'diagnostics')

    good = message(point(0.0, START.tolist()), point(MOVE_S, END.tolist()))
    # Shaped: stamp and frame are kept, and the link is at rest when the joints are.
    good.header.stamp = peer.node.get_clock().now().to_msg()
    good.header.frame_id = 'arm'

    def answered() -> bool:
        # The first one may leave before DDS has connected both ways.
        if not heard:
            good.header.stamp = peer.node.get_clock().now().to_msg()
            given.publish(good)
        return bool(heard)

    peer.until(answered, 'the shaped trajectory')
    shaped = heard[0]
    assert shaped.joint_names == list(NAMES)
    assert shaped.header.frame_id == 'arm'
    assert stamp(shaped) > 0
    assert list(shaped.points[0].positions) == START.tolist()
    assert list(shaped.points[-1].positions) == END.tolist()
    times = [p.time_from_start.sec + p.time_from_start.nanosec / 1e9 for p in shaped.points]
    arrived = checked(NAMES, times, [[p.positions, p.velocities, p.accelerations] for p in shaped.points])
    assert arrived.duration == pytest.approx(MOVE_S + 0.0834, abs=1e-3)
    assert played(arrived) < 0.05 * played(move())
    reports.clear()
    peer.until(lambda: any('ZVD for 12 Hz' in r.status[0].message for r in reports), 'diagnostics')
    values = {v.key: v.value for v in reports[-1].status[0].values}
    assert (values['shaper'], values['delay (s)'], values['trajectories refused']) == ('zvd', '0.0834', '2')

    # A stop goes through.
    heard.clear()
    given.publish(message())
    peer.until(lambda: any(not h.points for h in heard), 'the stop')
