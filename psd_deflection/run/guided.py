# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A guided check of a live rig: reads the device while a person (or the simulated hand) pushes the
tip."""

import queue
from collections.abc import Callable

import numpy as np

from psd_deflection.base.errors import DeviceError
from psd_deflection.base.log import LogCallback
from psd_deflection.model.detector import counts_to_volts
from psd_deflection.model.link import LinkStatics
from psd_deflection.rig.config import Rig, replace_values
from psd_deflection.run.acquisition import Acquisition
from psd_deflection.run.arrivals import Arrival, Ended
from psd_deflection.run.simulated_rig import SimulatedRigProcess, simulates
from psd_deflection.studies.check.checkup import CheckProblem, check
from psd_deflection.studies.check.guide import Guide, Phase
from psd_deflection.studies.check.result import Checkup, levels

LOOK_S = 0.2
SILENT_LOOKS = 50
SIMULATED_PUSH = 0.5e-3
"""m: how far the simulated hand moves a dot."""


def run_guided(rig: Rig, world: Rig, log: LogCallback, show: Callable[[Guide], None]) -> Checkup:
    """Lead through the pushes on the device of ``rig``; without a port, on a simulated rig that is really ``world``.

    ``log`` gets the prompts and the lines between them, ``show`` the guide after each chunk of
    samples. Raises DeviceError, ConfigError.
    """
    # A few lost samples do no harm here, and a priority is one more thing to read about.
    rig = replace_values(rig, {'realtime': False})
    process: SimulatedRigProcess | None = None
    if simulates(rig.values):
        process = SimulatedRigProcess(world)
        process.push((0.0, 0.0, 0.0))
        rig = replace_values(rig, {'port': process.port})
        log('No port is given: a simulated rig, and a simulated hand that does what is asked.')
    acquisition = Acquisition(rig, log)
    try:
        acquisition.open()
        acquisition.start()
        return _lead(rig, acquisition, process, log, show)
    finally:
        if process is not None:
            process.hang_up()
        acquisition.stop()
        if process is not None:
            process.close()


def _lead(
    rig: Rig,
    acquisition: Acquisition,
    process: SimulatedRigProcess | None,
    log: LogCallback,
    show: Callable[[Guide], None],
) -> Checkup:
    guide = Guide(rig)
    prompt = ''
    silent = 0
    while guide.phase is not Phase.DONE:
        if guide.prompt() != prompt:
            prompt = guide.prompt()
            log(prompt)
            if process is not None:
                process.push(_simulated_push(rig, guide))
        try:
            item = acquisition.queue.get(timeout=LOOK_S)
        except queue.Empty:
            silent += 1
            if silent >= SILENT_LOOKS:
                raise DeviceError(f'{acquisition.source.name}: no samples for {silent * LOOK_S:g} s') from None
            continue
        silent = 0
        if isinstance(item, Ended):
            raise acquisition.failed or DeviceError(f'{acquisition.source.name}: ended before the check was done')
        if isinstance(item, Arrival):
            raw = item.raw
            scale = raw.volts_per_count
            volts = raw.readings if scale is None else counts_to_volts(raw.readings.astype(np.int32, copy=False), scale)
            reported = guide.feed(volts.astype(float))
            show(guide)
            if reported:
                log(reported)
    drift, sd = guide.drift()
    return check(CheckProblem(rig, guide.pushes, levels(rig, guide.rest()), drift, sd))


def _simulated_push(rig: Rig, guide: Guide) -> tuple[float, float, float]:
    """The load that a helpful hand holds now: N, N, N m."""
    if guide.phase is not Phase.PUSH:
        return (0.0, 0.0, 0.0)
    statics = LinkStatics.from_rig(rig)
    lever = float(abs(rig.centers + rig.zeros).max())
    poses = ((SIMULATED_PUSH, 0.0, 0.0), (0.0, SIMULATED_PUSH, 0.0), (0.0, 0.0, SIMULATED_PUSH / lever))
    return statics.tip_load(*poses[guide.number])
