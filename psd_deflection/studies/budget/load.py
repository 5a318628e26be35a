# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The load at which a budget is computed if the user names none."""

from __future__ import annotations

import math

import numpy as np

from psd_deflection.model.link import LinkStatics
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.studies.budget.chain import MeasuringChain, measure

SIDEBAR_FORCE = 50.0
"""N: the largest load of the thesis (chapter 5), hung on a sidebar one link length out on +X."""

SHARE = 0.5
"""Part of the way from its zero to the edge of the active area that a dot moves on a rig that is not the thesis's."""


def default_load(rig: Rig) -> tuple[float, float, float]:
    """Return a weight on a sidebar one link length out on +X: Fx N, Fy N, Tz N m.

    For the link and the detectors of the thesis its 50 N. For others as much as moves the first dot ``SHARE`` of the
    way to the edge of its active area, to two figures.
    """
    length = rig.link.length
    if _has_the_thesis_layout(rig):
        return 0.0, -SIDEBAR_FORCE, -SIDEBAR_FORCE * length
    chain = MeasuringChain.of(rig)
    statics = LinkStatics.from_rig(rig)
    # So small a turn that everything is linear in it.
    unit = 1e-6 * length / max(abs(v) for v in statics.deflection(0.0, -1.0, -length))
    pose = np.array(statics.deflection(0.0, -unit, -unit * length))
    moved, zero = (v[0] for v in measure(chain, pose))
    slope = (moved - measure(chain, np.zeros(3))[0][0]) / unit
    room = chain.half_area - np.sign(slope) * zero
    with np.errstate(divide='ignore'):
        force = float(np.min(SHARE * room / np.abs(slope)))
    force = max(force, 0.0)
    if force > 0.0:
        step = 10.0 ** (math.floor(math.log10(force)) - 1)
        force = round(math.floor(force / step) * step, 12)
    return 0.0, -force, -force * length


def _has_the_thesis_layout(rig: Rig) -> bool:
    nominal = load_rig()
    return rig.link == nominal.link and all(
        (a.center, a.height, a.active_area) == (b.center, b.height, b.active_area)
        for a, b in zip(rig.psds, nominal.psds, strict=True)
    )
