# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The graph of a campaign: a simulated arm, and the compensator as a program, whose own errors a file switches on."""

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import SetBool

from bench.campaign.plant import Plant
from tools.program import ROOT, Program

URDF = ROOT / 'config' / 'two_links.urdf'
LONGEST_S = 60.0
ASK_AGAIN_S = 5.0
READY = 'once it is enabled'  # What the compensator logs when it can be enabled.

BREAKS = """
import sys, time
from pathlib import Path
from psd_deflection.cli.main import main
from psd_deflection.ros.compensator import CompensatorNode
from psd_deflection.ros.gate import InputGate
flag, owner = Path(sys.argv[1]), {'health': CompensatorNode, 'take_in': InputGate}[sys.argv[2]]
original = getattr(owner, sys.argv[2])
def failing(*given):
    if flag.exists():
        if not flag.read_text():
            flag.write_text(repr(time.time()))
        raise {'health': RuntimeError, 'take_in': MemoryError}[sys.argv[2]]('an error of its own')
    return original(*given)
setattr(owner, sys.argv[2], failing)
sys.exit(main(sys.argv[3:]))
"""
"""Our program. A method fails as soon as the file exists that is its first argument: ``health``, which ends the node by
an error, or ``take_in``, which its way out needs as well."""


class Graph:
    """A node of the campaign, the arm, and the compensator, which ``start`` starts. ``topics``: the arm's outputs."""

    def __init__(self, *topics: str) -> None:
        rclpy.init()
        self.node = rclpy.create_node('campaign')
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.plant = Plant(self.node, *topics)
        self.flag = Path(tempfile.mkdtemp()) / 'flag'
        self.compensator = self.start()

    def start(self, *arguments: str, breaks: str = 'health') -> Program:
        """Start the compensator with further arguments; ``breaks``: what fails once ``flag`` exists."""
        base = ['compensator', '--urdf', str(URDF), '--tip', 'tool', '--axes', 'x,z', '--drive']
        self.compensator = Program([sys.executable, '-c', BREAKS, str(self.flag), breaks, *base, *arguments])
        return self.compensator

    def spin(self, condition: Callable[[], bool], longest_s: float, what: str = '') -> None:
        """Spin until ``condition``, or for ``longest_s``; then it is an error if there is a ``what``."""
        until = time.monotonic() + longest_s
        while not condition():
            if time.monotonic() > until:
                if what:
                    raise RuntimeError(f'waited {longest_s:g} s for {what}\n{self.compensator.text[-1000:]}')
                return
            self.executor.spin_once(timeout_sec=0.02)

    def until_ready(self) -> None:
        """Spin until the compensator can be enabled."""
        self.spin(lambda: READY in self.compensator.text, LONGEST_S, 'the node')

    def enable(self, wanted: bool = True) -> None:
        """Let the offsets follow, or let them go."""
        client = self.node.create_client(SetBool, '/compensator/enable')
        self.spin(client.service_is_ready, LONGEST_S, 'the service')
        requests: list[Any] = []

        def answered() -> bool:
            # DDS loses a request to a service that it has just found.
            if not requests or time.monotonic() - began > ASK_AGAIN_S * len(requests):
                requests.append(client.call_async(SetBool.Request(data=wanted)))
            return any(request.done() for request in requests)

        began = time.monotonic()
        self.spin(answered, LONGEST_S, 'its answer')
        self.node.destroy_client(client)

    def close(self) -> None:
        self.compensator.end()
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.try_shutdown()
