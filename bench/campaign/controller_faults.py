# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The part of :mod:`bench.campaign.hold` where the controller does something else than it reports, or keeps offsets."""

import signal
import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from bench.campaign.plant import LOAD, LONGEST_S, MAX_RATE, Graph

HOLDS_S = 10.0  # The compensator must find a wrong sign or scale within this time of its enabling, s.
RELEASE_S = 0.5
"""Offsets must be back at zero so long after the time that ``MAX_RATE`` needs, s: the way out begins with a signal."""
ENABLINGS = 5
DROOP = 0.005  # rad
CREEP = 1e-9  # How far a command may be from the first one after ``ENABLINGS`` enablings, rad.


class Outcome(NamedTuple):
    """``right``: whether the compensator did what it must. ``text``: with which figure."""

    right: bool
    text: str


def _hold(graph: Graph, share: float) -> Outcome:
    """Enable against a controller that adds ``share`` of what it reports; the offsets must hold."""
    plant = graph.plant
    plant.share = share
    graph.start()
    graph.until_ready()
    graph.enable()
    graph.spin(lambda: 'of its offset' in graph.compensator.text, HOLDS_S)
    held = 'of its offset' in graph.compensator.text
    largest = float(np.abs(plant.held).max())
    graph.enable(False)
    graph.spin(lambda: not plant.held.any(), LONGEST_S, 'no offset')
    return Outcome(held, f'largest offset {largest * 1e3:.2f} mrad')


def _droop(graph: Graph) -> Outcome:
    """Enable again and again where servos droop; no step, and afterwards the command of before."""
    plant = graph.plant
    plant.droop, plant.commands = DROOP, True
    graph.start('--output', 'commands')
    graph.until_ready()
    for _ in range(ENABLINGS):
        count = len(plant.offsets)
        graph.enable()
        graph.spin(lambda n=count: len(plant.offsets) > n + 30, LONGEST_S, 'commands')  # type: ignore[misc]
        graph.enable(False)
        graph.spin(lambda: float(np.abs(plant.held).max()) < CREEP, RELEASE_S + LONGEST_S / 10.0)
    crept = float(np.abs(plant.held).max())
    return Outcome(crept < CREEP, f'crept {crept * 1e3:.3g} mrad')


def _followed(graph: Graph, breaks: str = 'health') -> float:
    """Start and enable; return the largest offset, rad, as soon as it compensates the load."""
    graph.start(breaks=breaks)
    graph.until_ready()
    graph.enable()
    graph.spin(lambda: graph.plant.error() < 1e-4, LONGEST_S, 'the rigid pose')
    return float(np.abs(graph.plant.held).max())


def _way_out(graph: Graph) -> Outcome:
    """Ctrl-C while what the way out needs fails; the offsets must go back all the same."""
    largest = _followed(graph, 'take_in')
    graph.flag.touch()
    began = time.time()
    graph.compensator.send(signal.SIGINT)
    graph.spin(lambda: graph.compensator.process.poll() is not None, LONGEST_S, 'its end')
    graph.spin(lambda: not graph.plant.held.any(), 1.0)
    graph.flag.unlink()
    took, allowed = graph.plant.stamps[-1] - began, largest / MAX_RATE + RELEASE_S
    right = not graph.plant.held.any() and took <= allowed
    return Outcome(right, f'released in {took * 1e3:.0f} ms of {allowed * 1e3:.0f} ms')


def _restarted(graph: Graph) -> Outcome:
    """Kill it and start it again: it must report the offsets that the controller has, and take them back on request."""
    _followed(graph)
    graph.compensator.send(signal.SIGKILL)
    graph.compensator.wait()
    graph.start()
    graph.until_ready()
    graph.spin(lambda: 'the controller applies' in graph.compensator.text, HOLDS_S)
    reported, held = 'the controller applies' in graph.compensator.text, graph.plant.held.any()
    graph.enable(False)
    graph.spin(lambda: not graph.plant.held.any(), LONGEST_S / 10.0)
    taken_back = not graph.plant.held.any()
    words = ('' if reported else 'not reported ') + ('' if taken_back else 'not taken back')
    return Outcome(bool(reported and held and taken_back), words or 'reported and taken back')


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
            outcome = CONTROLLER_FAULTS[name](graph)
            wrong += not outcome.right
            texts.append(outcome.text)
            worst = max(worst, plant.step(first))
    finally:
        graph.close()
    step = f'largest step {worst:.3f} of max_rate * dt'
    print(f'{name:26}{times:4} times: wrong {wrong}; last: {texts[-1]}; {step}', flush=True)
    return wrong, worst
