# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What hung on the link of a recording, of a rig that is nearly as its file says: check and calibrate ask here."""

from __future__ import annotations

from dataclasses import dataclass

from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.studies.loads.annotated_times import CorrectedNote
from psd_deflection.studies.loads.plateaus import WrongNote, as_applied, implied_beside_rig, plateaus, wrong_notes
from psd_deflection.studies.loads.sway import SwayingLoad, excluded, swaying_loads
from psd_deflection.studies.loads.unannotated import MANY, UnannotatedTime, unannotated_times, without_times

LoadNote = CorrectedNote | WrongNote | SwayingLoad | UnannotatedTime
"""What was noted of a load otherwise than it was."""


@dataclass(frozen=True, slots=True, eq=False)
class EffectiveLoads:
    """``loads`` (n, 3) N, N, N m, as they acted; ``volts`` (n, 3P) V without the times in which nobody knows; ``notes``
    of what was noted otherwise.
    """

    loads: FloatArray
    volts: FloatArray
    notes: tuple[LoadNote, ...]


def effective_loads(rig: Rig, volts: FloatArray, loads: FloatArray) -> EffectiveLoads:
    """Those of a recording. ``volts`` (n, 3P) V of the PSDs, NaN if a sample is lost; ``loads`` (n, 3) N, N, N m, held,
    at the times at which they acted.
    """
    period = 1.0 / rig.converter.sample_rate_hz
    swayed = swaying_loads(rig, volts, loads)
    steady = excluded(rig, volts, swayed)
    wrong = wrong_notes(rig, steady, loads)
    listed = plateaus(rig, volts, loads)
    if not wrong and sum(p.unannotated for p in listed) >= MANY:
        implied = implied_beside_rig(rig, volts, loads)(listed)
        if unannotated := unannotated_times(implied, len(loads), period):
            # What seemed to sway there was hung and taken off.
            rest = effective_loads(rig, without_times(volts, unannotated), loads)
            return EffectiveLoads(rest.loads, rest.volts, (*unannotated, *rest.notes))
    return EffectiveLoads(as_applied(loads, wrong), steady, (*swayed, *wrong))
