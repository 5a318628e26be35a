# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Loads held one after the other, what a device reads under them, and what each study says of their notes."""

from typing import NamedTuple

import numpy as np

from psd_deflection.model.simulation.catalogue import effect_names
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.recordings.observation import Observation
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import load_rig, replace_values
from psd_deflection.studies.calibrate.from_recordings import with_effective_loads
from psd_deflection.studies.calibrate.observation import CalibrationRun
from psd_deflection.studies.check.checkup import check, of_recording
from psd_deflection.studies.check.result import Checkup
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.discover.report import Discovery

RIG = load_rig()
LEVELS = np.array(
    [(0, 0, 0), (0, -20, 0), (0, -50, 0), (0, -50, -29), (30, 0, 0), (40, -40, 20), (0, -30, 0), (0, 0, 0)], float
)
DWELL = 4000
"""Samples for which each is held."""
HELD = np.repeat(LEVELS, DWELL, axis=0)
T = np.arange(len(HELD)) / 1000.0
FEW = ('sensor_rotation', 'sensor_gain', 'bending_stiffness', 'load_direction', 'creep')
OTHERS = tuple(name for name in effect_names() if name not in FEW)
"""What a search leaves out where a test is about loads and words."""


def read(acting: FloatArray, seed: int = 3, /, **true: object) -> FloatArray:
    """Return the readings (n, 6), V, under ``acting`` loads of a rig that differs by ``true`` from the rig file."""
    rig = replace_values(RIG, {name.replace('__', '.'): value for name, value in true.items()})
    return np.asarray(RigSimulator(rig, seed).step(acting).counts * RIG.converter.volts_per_count, dtype=np.float64)


def annotated_as(number: int, load: tuple[float, float, float]) -> FloatArray:
    """Return the loads with another one noted for hold ``number``."""
    out = HELD.copy()
    out[number * DWELL : (number + 1) * DWELL] = load
    return out


class Answers(NamedTuple):
    """The answers of the three studies to one recording; ``log``: what calibrate logs of its loads."""

    checked: Checkup
    run: CalibrationRun
    log: list[str]
    discovery: Discovery


def answers(volts: FloatArray, annotated: FloatArray) -> Answers:
    """Return what check, calibrate and discover say of a recording named x."""
    log: list[str] = []
    run = CalibrationRun('x', np.arange(len(annotated)) / 1000.0, volts, np.zeros(0), np.zeros((0, 3)), annotated)
    discovery = discover([Observation('x', RIG, volts, annotated)], without=OTHERS)
    return Answers(
        check(of_recording(RIG, volts, annotated, 'x')), with_effective_loads(run, RIG, log.append), log, discovery
    )
