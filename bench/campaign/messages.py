# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Messages of any content against every input of the five nodes: no end, no leak, and no step of what moves an arm."""

import argparse
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import rclpy
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import deserialize_message
from std_srvs.srv import SetBool

from bench.campaign.attacked import NODES, Attacked, good_of
from bench.campaign.strange import Stranger
from blind.campaign import options
from tools.program import ROOT

MOST_GROWTH = 30e6  # Bytes that the process may grow by after the first tenth.
SPIN_EVERY = 50  # Messages after which the node's timers have their turn.
ASK_EVERY = 500  # Messages after which a service is asked.
AS_GIVEN_AFTER = 200  # Messages after which the parameters that a request has set are set back.
ANSWER_S = 30.0  # Longest time for the answer of a service, s.
SET_TYPES = (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 77)  # Types of a parameter, and one that is none.


class EndedError(Exception):
    """Something that came in has ended a node."""


def memory() -> int:
    """Bytes that this process has now."""
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * resource.getpagesize()


class Inside:
    """A node in this process, and who attacks it. Raises EndedError when it has ended."""

    def __init__(self, name: str, seed: int, folder: Path) -> None:
        # Each has its own namespace: some have inputs of the same name, and all may run at once.
        rclpy.init(args=['messages', '--ros-args', '-r', f'__ns:=/{name}'])
        self.attacked: Attacked = NODES[name](folder)
        self._node = self.attacked.owner.node
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self.attacked.hand = lambda topic, content: self.hand(f'/{name}{topic}', content)
        self.attacked.owner.start()
        self._stranger, self._chance = Stranger(seed), random.Random(seed)
        self._as_given = self._node.get_parameters_by_prefix('')
        self.number, self.asked, self.undecodable = 0, 0, 0
        self.sent: Counter[str] = Counter()

    def inputs(self) -> dict[str, list[Any]]:
        out: dict[str, list[Any]] = {}
        for subscription in self._node.subscriptions:
            out.setdefault(subscription.topic_name, []).append(subscription)
        return out

    def hand(self, topic: str, content: bytes) -> None:
        for subscription in self.inputs().get(topic, ()):
            if subscription.raw:
                message = content
            else:
                try:
                    message = deserialize_message(content, subscription.msg_type)
                except (RuntimeError, UnicodeDecodeError):
                    # DDS does not hand over what it cannot decode.
                    continue
            try:
                subscription.callback(message)
            except BaseException as error:
                raise EndedError(f'{topic}: {type(error).__name__}: {error}: {content[:3000].hex()}') from error

    def _attack(self, inputs: dict[str, list[Any]]) -> None:
        topic = self._chance.choice(list(inputs))
        kind = inputs[topic][0].msg_type
        content, damaged = self._stranger.encode(self._stranger.change(good_of(topic, kind)()))
        if damaged and inputs[topic][0].raw:
            try:
                deserialize_message(content, kind)
            except (RuntimeError, UnicodeDecodeError, MemoryError):
                self.undecodable += 1
        self.sent[topic] += 1
        self.hand(topic, content)

    def _ask(self) -> None:
        service = self._chance.choice(list(self._node.services))
        self.asked += 1
        request = service.srv_type.Request()
        if isinstance(request, ChangeState.Request):
            # Down and up again: what is asked in between has no node to ask.
            for transition in (4, 3):
                request.transition.id = transition
                self._answer(service, request)
            return
        if isinstance(request, SetBool.Request):
            request.data = self._chance.random() < 0.5
        elif isinstance(request, SetParameters.Request | SetParametersAtomically.Request):
            request.parameters = [self._parameter() for _ in range(self._chance.choice((0, 1, 1, 1, 2, 20)))]
        elif hasattr(request, 'names'):
            request.names = [self._name() for _ in range(self._chance.choice((0, 1, 3, 100)))]
        else:
            self._stranger.change(request, 1.0)
        self._answer(service, request)

    def _set_back(self) -> None:
        changed = [p for name, p in self._as_given.items() if self._node.get_parameter(name).value != p.value]
        if changed:
            self._node.set_parameters(changed)

    def _name(self) -> str:
        known = self._chance.random() < 0.8
        return self._chance.choice(list(self._as_given)) if known else self._stranger.text('x')

    def _parameter(self) -> Any:
        out = ParameterMessage(name=self._name())
        given = self._as_given.get(out.name)
        if given is not None:
            out.value = given.to_parameter_msg().value
        kind = out.value.type
        self._stranger.change(out.value, self._chance.choice((0.2, 1.0)))
        out.value.type = kind if self._chance.random() < 0.8 else self._chance.choice(SET_TYPES)
        return out

    def _answer(self, service: Any, request: Any) -> None:
        task = self._executor.create_task(service.callback, request, service.srv_type.Response())
        until = time.monotonic() + ANSWER_S
        while not task.done():
            self._executor.spin_once(timeout_sec=0.05)
            if time.monotonic() > until:
                raise EndedError(f'{service.service_name}: no answer in {ANSWER_S:g} s to {request}'[:3000])
        if task.exception() is not None:
            raise EndedError(f'{service.service_name}: {task.exception()!r}: {request}'[:3000])

    def spin(self) -> None:
        try:
            for _ in range(4):
                self._executor.spin_once(timeout_sec=0.0)
            self.attacked.runs()
        except BaseException as error:
            raise EndedError(f'beside the messages: {type(error).__name__}: {error}') from error

    def run(self, seconds: float) -> int:
        """Strange messages for so long; the bytes by which the process grew after the first tenth."""
        begun, reported, inputs, start = 0, 0.0, self.inputs(), time.monotonic()
        while (share := (time.monotonic() - start) / seconds) < 1.0:
            if self.number % SPIN_EVERY == 0:
                self.spin()
                inputs = self.inputs()
            if self.number % ASK_EVERY == ASK_EVERY - 1:
                self._ask()
            if self.number % ASK_EVERY == AS_GIVEN_AFTER:
                self._set_back()
            if self.number % self.attacked.every == 0:
                self.attacked.right()
            self._attack(inputs)
            self.number += 1
            if not begun and share >= 0.1:
                begun = memory()
            if share >= reported:
                reported += 0.05
                print(f'{self._node.get_name()}: {self.reported()}', file=sys.stderr, flush=True)
        return memory() - begun

    def reported(self) -> str:
        return (
            f'{self.number} messages on {len(self.sent)} inputs and {self.asked} requests, '
            f'{self.attacked.rejected()} rejected of which {self.undecodable} could not be decoded, '
            f'{memory() / 1e6:.0f} MB; {self.attacked.summary()}'
        )

    def close(self) -> None:
        self.attacked.close()
        self._executor.shutdown()
        rclpy.try_shutdown()


def attack(name: str, args: argparse.Namespace) -> int:
    with tempfile.TemporaryDirectory() as place:
        os.environ.update({'ROS_LOG_DIR': place, 'XDG_STATE_HOME': place})
        inside = Inside(name, args.seed, Path(place))
        try:
            grown, faults = inside.run(60.0 * args.minutes), inside.attacked.faults()
            if grown > MOST_GROWTH:
                faults.append(f'it grew by {grown / 1e6:.1f} MB')
            if inside.attacked.rejected() < inside.undecodable:
                faults.append(f'of {inside.undecodable} that cannot be decoded it counts {inside.attacked.rejected()}')
            print(f'{name}: {inside.reported()}; {grown / 1e6:+.1f} MB after the first tenth')
            for topic, count in sorted(inside.sent.items()):
                print(f'{name}:   {topic} {count}')
        finally:
            inside.close()
    print(*(f'{name}: WRONG: {fault}\n' for fault in faults), sep='', end='')
    return 1 if faults else 0


def main() -> int:
    parser = options(__doc__)
    parser.add_argument('--minutes', type=float, default=10.0, help='for each node')
    parser.add_argument('--node', choices=[*NODES, 'all'], default='all')
    parser.add_argument('--seed', type=int, default=1)
    args = parser.parse_args()
    if args.node != 'all':
        return attack(args.node, args)
    same = [f'--minutes={args.minutes}', f'--seed={args.seed}']
    command = [sys.executable, '-m', 'bench.campaign.messages', *same]
    each = [subprocess.Popen([*command, '--node', name], cwd=ROOT) for name in NODES]
    return max(abs(process.wait()) for process in each)


if __name__ == '__main__':
    sys.exit(main())
