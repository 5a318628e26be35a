# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Real rclpy and real DDS: a domain of its own for each worker, and the daemon as a process."""

import contextlib
import math
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from test.run.conftest import ScriptedDevice
from tools.program import PSD_DEFLECTION, ROOT, WAIT_S, Program, ros_domain

pytest.importorskip('rclpy', reason='the ROS tests need rclpy: pip install .[ros]')

import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile

WARNINGS = "error,ignore:module 'sre_parse' is deprecated:DeprecationWarning,"
WARNINGS += "ignore:module 'sre_constants' is deprecated:DeprecationWarning"

BLOCK_NS = 20_000_000
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
ASK_AGAIN_S = 20.0
"""An answer that has not come by then is lost."""
SEND_AGAIN_S = 1.0
"""A message is sent again after it: a node that is late loses some, and one that is flooded rejects them as a flood."""


@pytest.fixture(scope='session')
def domain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """A ROS_DOMAIN_ID that no other test on this machine uses."""
    with ros_domain() as candidate:
        os.environ['ROS_DOMAIN_ID'] = str(candidate)
        # A participant that restarts beside another is not heard any more, now and then, through Fast DDS's shared
        # memory (eProsima/Fast-DDS#5053). These tests restart a daemon beside a peer, and kill some.
        os.environ['FASTDDS_BUILTIN_TRANSPORTS'] = 'UDPv4'
        os.environ['ROS_LOG_DIR'] = str(tmp_path_factory.mktemp('ros_log'))
        os.environ['XDG_STATE_HOME'] = str(tmp_path_factory.mktemp('state'))
        yield candidate


PATIENT = f"""
import sys
from psd_deflection.cli.main import main
from psd_deflection.run import acquisition
acquisition.SILENCE_S = {WAIT_S}
sys.exit(main())
"""
"""Our program, which waits longer for a first answer of its device than any test does."""


@pytest.fixture
def launch(domain: int) -> Iterator[Callable[..., Program]]:
    """Start a command, ours unless it is another ``program``; it ends with the test."""
    started: list[Program] = []

    def begin(*words: str, program: Sequence[str] = PSD_DEFLECTION, cwd: Path = ROOT) -> Program:
        started.append(Program([*program, *words], cwd, env={'PYTHONWARNINGS': WARNINGS}))
        return started[-1]

    yield begin
    for child in started:
        child.end(signal.SIGTERM)
        print(*child.lines[-50:], sep='\n')


@pytest.fixture
def start(launch: Callable[..., Program]) -> Callable[..., Program]:
    """Start a daemon; it ends with the test."""

    def begin(*arguments: str, script: str = '') -> Program:
        program = (sys.executable, '-c', script) if script else PSD_DEFLECTION
        return launch('estimator', *arguments, program=program)

    return begin


def stamp(message: Any) -> int:
    """Of a message's header, ns."""
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


class Peer:
    """A second participant: collects messages, calls services."""

    def __init__(self) -> None:
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node('peer', context=self.context)
        self.executor = rclpy.executors.SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self._clients: dict[str, Any] = {}

    def collect(self, kind: Any, topic: str, qos: Any = 200) -> list[Any]:
        """A list that fills while :meth:`until` spins."""
        got: list[Any] = []
        self.node.create_subscription(kind, topic, got.append, qos)
        return got

    def zero(self) -> Any:
        """The answer of ``~/zero`` once it is taken: while the simulated rig rings under its load it is rejected."""
        from std_srvs.srv import Trigger

        answers: list[Any] = []

        def taken() -> bool:
            answers.append(self.call(Trigger, '/estimator/zero', Trigger.Request()))
            return bool(answers[-1].success)

        self.until(taken, 'a zero of a link at rest')
        return answers[-1]

    def until(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + WAIT_S
        while not condition():
            if time.monotonic() > deadline:
                pytest.fail(f'waited {WAIT_S:g} s for {what}')
            self.executor.spin_once(timeout_sec=0.1)

    def until_sent(self, send: Callable[[], object], condition: Callable[[], bool], what: str) -> None:
        """Until ``condition``; ``send`` is called at once and each ``SEND_AGAIN_S``."""
        next_time = -math.inf

        def sent() -> bool:
            nonlocal next_time
            if time.monotonic() >= next_time:
                send()
                next_time = time.monotonic() + SEND_AGAIN_S
            return condition()

        self.until(sent, what)

    def until_of_now(self, messages: list[Any], what: str) -> None:
        """Until the last message is of a block that began after this call: not of those that are on their way."""
        now = time.time_ns()
        self.until(lambda: bool(messages) and stamp(messages[-1]) > now + BLOCK_NS, what)

    def call(self, kind: Any, name: str, request: Any) -> Any:
        """The answer. DDS loses one that is sent before the server has found this new client: it is asked again. There
        is one client for each service: DDS now and then loses one that comes and goes often."""
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
        client = self._clients[name]
        self.until(client.service_is_ready, name)
        asked = [(time.monotonic(), client.call_async(request))]

        def answered() -> bool:
            if time.monotonic() - asked[-1][0] > ASK_AGAIN_S:
                asked.append((time.monotonic(), client.call_async(request)))
            return any(future.done() for _, future in asked)

        self.until(answered, f'the answer of {name}')
        return next(future for _, future in asked if future.done()).result()

    def change(self, node: str, transition: int) -> bool:
        """Whether a transition of the node succeeded."""
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(self.call(ChangeState, f'{node}/change_state', request).success)

    def set(self, node: str, name: str, value: object) -> Any:
        """What the node answers when a parameter is set."""
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        return self.call(SetParameters, f'{node}/set_parameters', request).results[0]

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def peer(domain: int) -> Iterator[Peer]:
    with contextlib.closing(Peer()) as made:
        yield made


@pytest.fixture(scope='session')
def simulated_port(domain: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The port of ``psd-deflection simulate --serve``, run alone: a rig at rest, however late a test looks at it.

    A link: the number of its terminal is given to the next one that anybody opens, and a daemon that has lost its
    device asks for it again by name.
    """
    link = str(tmp_path_factory.mktemp('rig') / 'simulated_port')
    rig = Program([*PSD_DEFLECTION, 'simulate', '--serve', '--link', link, '--loads', 'constant:0,0,0:1'])
    rig.until('port: ')
    yield link
    assert rig.end() == 0


@pytest.fixture
def device(tmp_path: Path) -> Iterator[ScriptedDevice]:
    """A device whose every byte the test writes."""
    scripted = ScriptedDevice(tmp_path / 'port')
    yield scripted
    scripted.unplug()
