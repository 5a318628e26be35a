# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``make campaign NAME=hold``: what the compensator and the shaper do when something goes wrong, over real DDS."""

import argparse
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64, Float64MultiArray

from bench.campaign.plant import DEFLECTIONS, FOLLOW_ERROR, JOINTS, LOAD, LONGEST_S, MAX_RATE, Graph, faithful
from bench.campaign.shaper_faults import action_faults, shaper_faults
from blind.campaign import conclude, options
from psd_deflection.ros.running import TRANSPORTS
from tools.program import ROOT

HOLD_S = 0.2  # The offsets must not change later than this after a fault.
RELEASE_S = 0.2  # They must be back at zero so long after the time that ``MAX_RATE`` needs.
WITHIN = 1.0 + 1e-6  # The largest step over what the rate allows.
TRIES = 5
WATCHED_S = 0.4
"""How long offsets are watched after a fault, s. After half a second they follow a deflection that jumped and stays."""
RELAYED = {
    'estimator': ('/arm/deflection', '/end_effector/deflection', PoseWithCovarianceStamped),
    'driver': ('/arm/joints', '/joint_states', JointState),
}
"""What a process passes on: from the arm, to the compensator, and the type."""
SENT: dict[str, tuple[int, tuple[str, ...]]] = {
    'estimator killed': (signal.SIGKILL, ('estimator',)),
    'DDS killed': (signal.SIGKILL, ('estimator', 'driver')),
    'DDS stopped': (signal.SIGSTOP, ('estimator', 'driver')),
}
"""Faults that are signals, and the processes that get them."""
ROBOT = ('protective stop', 'speed scaling 0', 'controller ended', 'joints do not follow', 'another publisher')
"""Faults of the robot and its controller."""
COMPENSATOR, CONTROLLER, SHAPER, ACTION = 'compensator', 'controller', 'shaper', 'action'  # All of their faults.
OWN = ('killed and started again', 'an error of its own')  # Faults of the compensator.


class Relay:
    """The process that stands for one of ``RELAYED``."""

    def __init__(self, name: str) -> None:
        self._name, self._killed = name, False
        self._process = self._start()

    def _start(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, '-m', 'bench.campaign.hold', '--relay', self._name], cwd=ROOT)

    def signal(self, number: int) -> None:
        """SIGKILL or SIGSTOP. The campaign's own arm moves on: nobody waits for the end of the process."""
        self._process.send_signal(number)
        self._killed = number == signal.SIGKILL

    def again(self) -> None:
        """Let it go on if it was stopped; another one if it was killed."""
        if self._killed:
            self._process.wait()
            self._process, self._killed = self._start(), False
        else:
            self._process.send_signal(signal.SIGCONT)

    def close(self) -> None:
        self._process.kill()
        self._process.wait()


def relay(name: str) -> None:
    heard, reported, kind = RELAYED[name]
    rclpy.init()
    node = rclpy.create_node(f'stands_for_the_{name}')
    out = node.create_publisher(kind, reported, 5)
    node.create_subscription(kind, heard, out.publish, 5, raw=True)
    rclpy.spin(node)


class Injected(NamedTuple):
    """One fault: s after it at which an offset changed last; s that it took to release, and that it may take. NaN: does
    not apply."""

    held: float
    released: float = math.nan
    allowed: float = math.nan


class Campaign(Graph):
    def __init__(self) -> None:
        super().__init__(*(topic for topic, _, _ in RELAYED.values()))
        self._robot_runs = self.node.create_publisher(Bool, '/compensator/robot_running', 5)
        self._scaling = self.node.create_publisher(Float64, '/compensator/speed_scaling', 5)
        self._scale = 1.0
        self.node.create_timer(0.05, lambda: self._scaling.publish(Float64(data=self._scale)))
        self.relays = {name: Relay(name) for name in RELAYED}
        self.repeated = 0

    def follows(self) -> bool:
        """Whether the offsets changed of late; the noise of the deflection sees to that."""
        plant = self.plant
        fresh = len(plant.offsets) > 20 and time.time() - plant.stamps[-1] < 0.1
        return fresh and float(np.ptp(plant.offsets[-10:], axis=0).max()) > 0.0 and bool(np.any(plant.offsets[-1]))

    def inject(self, name: str) -> Injected:
        """One fault, from offsets that follow to offsets that follow; again if the campaign itself was late."""
        for _ in range(TRIES):
            out, late = self._once(name)
            if not late:
                break
            self.repeated += 1
        return out

    def _once(self, name: str) -> tuple[Injected, bool]:
        """What was found, and whether the campaign was late."""
        self.spin(LONGEST_S, self.follows, f'offsets that follow before: {name}')
        # They are to be far from zero.
        self.spin(LONGEST_S, lambda: self.plant.error() < 1e-4, 'the rigid pose')
        self.plant.late = False
        if name in OWN:
            return self._own(name), False
        began, end = time.time(), self._begin(name)
        self.spin(WATCHED_S)
        held = max(self._changed_last() - began, 0.0)
        if name == 'joints do not follow':
            held = max(self._changed_last() - self._beyond(began), 0.0)
        # To a controller that does not tell what it applies, nothing is said.
        out = self._release(held) if name != 'controller ended' else Injected(held)
        late = self.plant.late
        end()
        self.enable()
        self.spin(LONGEST_S, self.follows, f'offsets that follow after: {name}')
        return out, late

    def _begin(self, name: str) -> Callable[[], object]:
        plant = self.plant
        if name in SENT:
            number, victims = SENT[name]
            for victim in victims:
                self.relays[victim].signal(number)
            return lambda: self._again(victims)
        if name in DEFLECTIONS:
            plant.notify = DEFLECTIONS[name][0]
        elif name in JOINTS:
            plant.notify_joints = JOINTS[name][0]
        elif name == 'speed scaling 0':
            self._scale, plant.stands = 0.0, True
            self._scaling.publish(Float64(data=0.0))
        elif name == 'another publisher':
            other_publisher = self.node.create_publisher(Float64MultiArray, '/compensator/offsets', 5)
            return lambda: self.node.destroy_publisher(other_publisher)
        else:
            plant.stands = True
            plant.arm.force *= 1.4
            plant.applies = name != 'controller ended'
            if name == 'protective stop':
                self._robot_runs.publish(Bool(data=False))
        return self._mend

    def _again(self, victims: Sequence[str]) -> None:
        for victim in victims:
            self.relays[victim].again()

    def _mend(self) -> None:
        plant = self.plant
        if not plant.applies:
            # It starts again, without offsets.
            plant.held = np.zeros(2)
        plant.notify = plant.notify_joints = faithful
        plant.stands, plant.applies, self._scale = False, True, 1.0
        plant.arm.force = np.array(LOAD)
        self._robot_runs.publish(Bool(data=True))

    def _release(self, held: float) -> Injected:
        asked, largest = time.time(), float(np.abs(self.plant.offsets[-1]).max())
        self.enable(False)
        self.spin(LONGEST_S, lambda: not np.any(self.plant.offsets[-1]), 'no offset')
        return Injected(held, self.plant.stamps[-1] - asked, largest / MAX_RATE + RELEASE_S)

    def _own(self, name: str) -> Injected:
        plant, began = self.plant, time.time()
        if name == 'an error of its own':
            largest = float(np.abs(plant.offsets[-1]).max())
            self.flag.touch()
            self.spin(LONGEST_S, lambda: self.compensator.process.poll() is not None, 'its end')
            self.spin(1.0, lambda: not np.any(plant.offsets[-1]))
            failed = float(self.flag.read_text())
            self.flag.unlink()
            out = Injected(math.nan, plant.stamps[-1] - failed, largest / MAX_RATE + RELEASE_S)
        else:
            self.compensator.process.kill()
            self.compensator.wait()
            out = Injected(max(self._changed_last() - began, 0.0))
        self.start_again()
        self.spin(LONGEST_S, self.follows, f'offsets that follow after: {name}')
        return out

    def _changed_last(self) -> float:
        changed = np.any(np.diff(self.plant.offsets, axis=0) != 0.0, axis=1)
        return float(np.array(self.plant.stamps)[1:][changed].max())

    def _beyond(self, began: float) -> float:
        """When the offsets had moved by what joints must be seen to follow, after ``began``."""
        stamps, offsets = np.array(self.plant.stamps), np.array(self.plant.offsets)
        after = stamps >= began
        moved = np.abs(offsets[after] - offsets[after][:1]).max(axis=1) >= FOLLOW_ERROR
        return float(stamps[after][moved][0]) if moved.any() else math.inf

    def close(self) -> None:
        for relay in self.relays.values():
            relay.close()
        super().close()


HOLDS_S = 10.0  # The compensator must find a wrong sign or scale within this time of its enabling, s.
WAY_OUT_S = 0.5
"""Offsets must be back at zero so long after the time that ``MAX_RATE`` needs, s: the way out begins with a signal."""
ENABLINGS = 5
DROOP = 0.005  # rad
CREEP = 1e-9  # How far a command may be from the first one after ``ENABLINGS`` enablings, rad.
Outcome = tuple[bool, str]
"""Whether the compensator did what it must, and with which figure."""


def _hold(graph: Graph, share: float) -> Outcome:
    """Enable against a controller that adds ``share`` of what it reports; the offsets must hold."""
    plant = graph.plant
    plant.share = share
    graph.start_again()
    graph.spin(HOLDS_S, lambda: 'of its offset' in graph.compensator.text)
    held = 'of its offset' in graph.compensator.text
    largest = float(np.abs(plant.held).max())
    graph.enable(False)
    graph.spin(LONGEST_S, lambda: not plant.held.any(), 'no offset')
    return held, f'largest offset {largest * 1e3:.2f} mrad'


def _droop(graph: Graph) -> Outcome:
    """Enable again and again where servos droop; no step, and afterwards the command of before."""
    plant = graph.plant
    plant.droop, plant.commands = DROOP, True
    graph.start_again('--output', 'commands', enabled=False)
    for _ in range(ENABLINGS):
        count = len(plant.offsets)
        graph.enable()
        graph.spin(LONGEST_S, lambda n=count: len(plant.offsets) > n + 30, 'commands')  # type: ignore[misc]
        graph.enable(False)
        graph.spin(WAY_OUT_S + LONGEST_S / 10.0, lambda: float(np.abs(plant.held).max()) < CREEP)
    crept = float(np.abs(plant.held).max())
    return crept < CREEP, f'crept {crept * 1e3:.3g} mrad'


def _followed(graph: Graph, breaks: str = 'health') -> float:
    """Start and enable; return the largest offset, rad, as soon as it compensates the load."""
    graph.start_again(breaks=breaks)
    graph.spin(LONGEST_S, lambda: graph.plant.error() < 1e-4, 'the rigid pose')
    return float(np.abs(graph.plant.held).max())


def _way_out(graph: Graph) -> Outcome:
    """Ctrl-C while what the way out needs fails; the offsets must go back all the same."""
    largest = _followed(graph, 'take_in')
    graph.flag.touch()
    began = time.time()
    graph.compensator.send(signal.SIGINT)
    graph.spin(LONGEST_S, lambda: graph.compensator.process.poll() is not None, 'its end')
    graph.spin(1.0, lambda: not graph.plant.held.any())
    graph.flag.unlink()
    took, allowed = graph.plant.stamps[-1] - began, largest / MAX_RATE + WAY_OUT_S
    right = not graph.plant.held.any() and took <= allowed
    return right, f'released in {took * 1e3:.0f} ms of {allowed * 1e3:.0f} ms'


def _restarted(graph: Graph) -> Outcome:
    """Kill it and start it again: it must report the offsets that the controller has, and take them back on request."""
    _followed(graph)
    graph.compensator.send(signal.SIGKILL)
    graph.compensator.wait()
    graph.start_again(enabled=False)
    graph.spin(HOLDS_S, lambda: 'the controller applies' in graph.compensator.text)
    reported, held = 'the controller applies' in graph.compensator.text, graph.plant.held.any()
    graph.enable(False)
    graph.spin(LONGEST_S / 10.0, lambda: not graph.plant.held.any())
    taken_back = not graph.plant.held.any()
    words = ('' if reported else 'not reported ') + ('' if taken_back else 'not taken back')
    return (bool(reported and held and taken_back), words or 'reported and taken back')


CONTROLLER_FAULTS: Mapping[str, Callable[[Graph], Outcome]] = {
    'controller of wrong sign': lambda graph: _hold(graph, -1.0),
    'controller of double scale': lambda graph: _hold(graph, 2.0),
    'servos that droop': _droop,
    'an error in the way out': _way_out,
    'restart with offsets held': _restarted,
}


def controller_faults(name: str, times: int) -> tuple[int, float]:
    """Inject one fault so often and print a line; return how often it went wrong, and the largest step."""
    graph = Graph()
    wrong, worst, texts = 0, 0.0, []
    try:
        for _ in range(times):
            graph.compensator.end()
            plant = graph.plant
            plant.share, plant.droop, plant.commands, plant.held = 1.0, 0.0, False, np.zeros(2)
            plant.arm.force = np.array(LOAD)
            first = len(plant.offsets)
            right, text = CONTROLLER_FAULTS[name](graph)
            wrong += not right
            texts.append(text)
            worst = max(worst, plant.step(first))
    finally:
        graph.close()
    step = f'largest step {worst:.3f} of max_rate * dt'
    print(f'{name:26}{times:4} times: wrong {wrong}; last: {texts[-1]}; {step}', flush=True)
    return wrong, worst


def main(argv: list[str] | None = None) -> int:
    """Inject every fault, print a line for each; status 1 if one was not met as it must be."""
    names = (*DEFLECTIONS, *JOINTS, *ROBOT, *SENT, *OWN)
    parser = options(__doc__)
    parser.add_argument('--times', type=int, default=20, help='of each fault')
    all_of = (COMPENSATOR, CONTROLLER, SHAPER, ACTION)
    only = (*names, *CONTROLLER_FAULTS, *all_of)
    parser.add_argument('--only', nargs='+', choices=only, default=all_of, help='these faults alone')
    parser.add_argument('--relay', choices=tuple(RELAYED), help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    # As our nodes do: relays are killed, and would leave the campaign deaf.
    os.environ.setdefault(TRANSPORTS, 'UDPv4')
    if args.relay:
        relay(args.relay)
        return 0
    wanted = names if COMPENSATOR in args.only else [name for name in args.only if name in names]
    missed, worst = compensator_faults(wanted, args.times) if wanted else (0, 0.0)
    for name in CONTROLLER_FAULTS if CONTROLLER in args.only else [n for n in args.only if n in CONTROLLER_FAULTS]:
        failed, step = controller_faults(name, args.times)
        missed, worst = missed + failed, max(worst, step)
    for name, faults in ((SHAPER, shaper_faults), (ACTION, action_faults)):
        worst = max(worst, faults(args.times) if name in args.only else 0.0)
    return conclude(f'largest step of all: {worst:.3f} of what the rate allows', not missed and worst <= WITHIN)


def compensator_faults(names: Sequence[str], times: int) -> tuple[int, float]:
    """Inject each of them so often, and print a line for each. How often it held or released later than it must, and
    the largest step over what the rate allows."""
    late = slow = 0
    worst, campaign = 0.0, Campaign()
    try:
        campaign.enable()
        for name in names:
            heard, campaign.repeated = len(campaign.plant.offsets), 0
            reactions = [campaign.inject(name) for _ in range(times)]
            held = [r.held for r in reactions if not math.isnan(r.held)]
            released = [r for r in reactions if not math.isnan(r.released)]
            late += sum(t > HOLD_S for t in held)
            slow += sum(r.released > r.allowed for r in released)
            step = campaign.plant.step(heard - 1)
            worst = max(worst, step)
            times_words = f'{len(reactions):4} times (and {campaign.repeated} repeated)'
            took, may = (_most([getattr(r, word) for r in released]) for word in ('released', 'allowed'))
            words = f'held after {_most(held)}; released in {took} of {may}; largest step {step:.3f} of max_rate * dt'
            print(f'{name:24}{times_words}: {words}', flush=True)
    finally:
        campaign.close()
    print(f'held later than {HOLD_S * 1e3:g} ms: {late}; released later than offset/max_rate + 0.2 s: {slow}')
    return late + slow, worst


def _most(times: list[float]) -> str:
    return f'{max(times) * 1e3:4.0f} ms' if times else '   -   '


if __name__ == '__main__':
    sys.exit(main())
