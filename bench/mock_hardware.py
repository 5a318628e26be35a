# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compensator and shaper with the real controllers of ros2_control, on hardware that is mocked."""

import subprocess
import time
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from control_msgs.action import FollowJointTrajectory
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.action import ActionClient
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from bench.campaign.plant import LONGEST_S, NAMES, NOMINAL, PERIOD_S, URDF, Spun, message_of, move_to
from bench.simulated_arm import SimulatedArm
from psd_deflection.arms.chains.chain_file import read_chain
from psd_deflection.records import FloatArray
from tools.program import ROOT, Program

HERE = ROOT / 'bench' / 'ros2_control'
FASTEST = 4.0  # Bound of the shaped motion, rad/s: it goes at most 0.4 rad in 0.4 s, from a motion of as much.
STATES_S = 0.002  # Time between two messages of the joints.


class Arm(Spun):
    """The arm on the graph: the mock's joints, with a deflection under a load. ``positions``: all joints that came."""

    def __init__(self) -> None:
        super().__init__('mock_hardware')
        self.bent = SimulatedArm(read_chain(ROOT / 'config' / 'two_links.yaml').chain, NOMINAL)
        self.bent.force = np.array([0.0, 0.0, -20.0])
        self.positions: list[FloatArray] = []
        self._noise = np.random.default_rng(0)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._description = self.node.create_publisher(String, '/robot_description', latched)
        text, hardware = URDF.read_text(), (HERE / 'hardware.xml').read_text()
        self._description.publish(String(data=text.replace('</robot>', hardware + '</robot>')))
        self._deflections = self.node.create_publisher(PoseWithCovarianceStamped, '/end_effector/deflection', 5)
        self.given = self.node.create_publisher(JointTrajectory, '/shaper/trajectory', 5)
        self.goals = ActionClient(self.node, FollowJointTrajectory, '/shaper/follow_joint_trajectory')
        self.node.create_subscription(JointState, '/joint_states', self._joints, 50)
        self.node.create_timer(PERIOD_S, self._bend)

    def _joints(self, message: Any) -> None:
        at = dict(zip(message.name, message.position, strict=True))
        if set(NAMES) <= at.keys():
            self.positions.append(np.array([at[name] for name in NAMES]))

    def _bend(self) -> None:
        if not self.positions:
            return
        self.bent.angles = self.positions[-1].copy()
        self.bent.settle()
        message = message_of(self.bent.end().deflection, self._noise)
        message.header.frame_id = 'end_effector_rest'
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(time.time_ns(), 10**9)
        self._deflections.publish(message)

    def error(self, rigid: FloatArray) -> float:
        """Distance of the end effector from where it would be on a rigid arm with its joints at ``rigid``, m."""
        wanted = self.bent.chain.rigid(rigid.tolist()).position
        return float(np.linalg.norm(self.bent.end().deflected.position - wanted))

    def step(self, since: int) -> float:
        """The largest step of the joints from one message to the next, rad."""
        return float(np.abs(np.diff(self.positions[since:], axis=0)).max())


def run(*words: str) -> None:
    subprocess.run(words, check=True, timeout=LONGEST_S)


def started(*words: str, until: str) -> Program:
    out = Program(words)
    out.until(until)
    return out


def shaped(arm: Arm, programs: list[Program]) -> None:
    """Trajectories that replace each other, through the shaper. SystemExit if the joints make a step."""
    action = ['--action', '/joint_trajectory_controller/follow_joint_trajectory']
    words = ['ros2', 'run', 'psd_deflection', 'shaper', '--frequency', '12', *action, '--ros-args', '-r']
    remap = '~/shaped:=/joint_trajectory_controller/joint_trajectory'
    programs.append(started(*words, remap, until='publishing /joint_trajectory_controller/joint_trajectory'))
    arm.spin(LONGEST_S, lambda: arm.given.get_subscription_count() > 0, 'the shaper')
    since, chance = len(arm.positions), np.random.default_rng(1)
    for _ in range(20):
        arm.given.publish(move(chance))
        arm.spin(float(chance.uniform(0.1, 0.4)))
    arm.spin(1.0)
    evaluated(arm, since, 'shaper')
    since = len(arm.positions)
    followed(arm, chance)
    arm.spin(1.0)
    evaluated(arm, since, 'action of the shaper')


def move(chance: np.random.Generator) -> JointTrajectory:
    return move_to(NOMINAL + chance.uniform(-0.2, 0.2, 2), 0.4)


def followed(arm: Arm, chance: np.random.Generator) -> None:
    """Goals that replace each other, a cancelled one, one of no joint. SystemExit if one ends otherwise."""
    arm.spin(LONGEST_S, arm.goals.server_is_ready, "the shaper's action")

    def came(future: Any, what: str) -> Any:
        arm.spin(LONGEST_S, future.done, what)
        return future.result()

    def ends(handle: Any) -> Any:
        return came(handle.get_result_async(), 'the result of a goal')

    def sent(trajectory: JointTrajectory) -> Any:
        goal = FollowJointTrajectory.Goal(trajectory=trajectory)
        return came(arm.goals.send_goal_async(goal), 'the answer to a goal')

    handles = []
    for _ in range(20):
        handles.append(sent(move(chance)))
        arm.spin(float(chance.uniform(0.1, 0.4)))
    results = [ends(handle) for handle in handles]
    if results[-1].status != GoalStatus.STATUS_SUCCEEDED:
        raise SystemExit(f'action: the last goal did not succeed: {results[-1]}')
    handle = sent(move(chance))
    arm.spin(0.3)
    arm.spin(LONGEST_S, handle.cancel_goal_async().done, 'the answer to the cancel request')
    if ends(handle).status != GoalStatus.STATUS_CANCELED:
        raise SystemExit('action: a cancelled goal did not end so')
    bad = ends(sent(JointTrajectory(joint_names=['z'], points=move(chance).points)))
    if (bad.status, bad.result.error_code) != (GoalStatus.STATUS_ABORTED, FollowJointTrajectory.Result.INVALID_GOAL):
        raise SystemExit(f'action: a goal of too few joints: {bad}')


def evaluated(arm: Arm, since: int, what: str) -> None:
    """SystemExit if the joints made a step since then, or did not move."""
    moved, step = float(np.ptp(arm.positions[since:], axis=0).max()), arm.step(since)
    print(f'{what}: the joints moved {moved:.3f} rad, the largest step is {step:.5f} rad')
    # A message of the joints may be missed.
    if moved < 0.05 or step > 5.0 * FASTEST * STATES_S:
        raise SystemExit(f'{what}: a step, or no motion')


def compensated(arm: Arm, programs: list[Program]) -> None:
    """The arm keeps its pose under its load. SystemExit if it does not, or if a command makes a step."""
    switch = ('--deactivate', 'joint_trajectory_controller', '--activate', 'forward_position_controller')
    run('ros2', 'control', 'switch_controllers', *switch)
    words = ['urdf:=' + str(URDF), 'tip:=tool', 'axes:=[x, z]', 'drive:=true', 'output:=commands']
    remap = 'commands:=/forward_position_controller/commands'
    launch = ['ros2', 'launch', 'psd_deflection', 'compensator.launch.py']
    programs.append(started(*launch, *words, remap, until='once it is enabled'))
    arm.spin(0.5)
    begun, since = arm.positions[-1], len(arm.positions)
    before = arm.error(begun)
    client = arm.node.create_client(SetBool, '/compensator/enable')
    arm.spin(LONGEST_S, client.service_is_ready, 'the service')
    arm.spin(LONGEST_S, client.call_async(SetBool.Request(data=True)).done, 'its answer')
    arm.spin(LONGEST_S, lambda: arm.error(begun) < 0.05 * before, 'the rigid pose')
    arm.spin(LONGEST_S, client.call_async(SetBool.Request(data=False)).done, 'its answer')
    arm.spin(LONGEST_S, lambda: bool(np.abs(arm.positions[-1] - begun).max() < 1e-4), 'no offset')
    step = arm.step(since)
    print(f'compensator: {before * 1e3:.2f} mm without; the largest step of the joints is {step:.5f} rad')
    # 0.1 rad/s and 10 ms; two commands may come within one cycle of a busy machine.
    if step > 5.0 * 0.1 * 0.01:
        raise SystemExit('compensator: a step')


def main() -> None:
    arm, programs = Arm(), list[Program]()
    try:
        control = ['ros2', 'run', 'controller_manager', 'ros2_control_node', '--ros-args', '--params-file']
        described = '~/robot_description:=/robot_description'
        programs.append(Program([*control, str(HERE / 'controllers.yaml'), '-r', described]))
        spawn = ['ros2', 'run', 'controller_manager', 'spawner']
        run(*spawn, 'joint_state_broadcaster', 'joint_trajectory_controller')
        run(*spawn, '--inactive', 'forward_position_controller')
        arm.spin(LONGEST_S, lambda: len(arm.positions) > 100, 'the joints')
        shaped(arm, programs)
        compensated(arm, programs)
    finally:
        for program in reversed(programs):
            program.end()
            print(*program.lines[-20:], sep='\n')
        arm.close()


if __name__ == '__main__':
    main()
