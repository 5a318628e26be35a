# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The check of a rig: wiring, loads, noise and light against its rig file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from psd_deflection.records import CHANNELS, DOT_CHANNELS, FloatArray
from psd_deflection.rig.config import Rig, check_two_psds
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.check.levels import SUM_FACTOR, Levels, levels
from psd_deflection.studies.check.responses import responses
from psd_deflection.studies.check.result import CANNOT_TELL, RIGHT, SIGNIFICANT_DRIFT, WRONG, Checkup, Finding
from psd_deflection.studies.check.shared_findings import (
    noise_findings,
    note_finding,
    step_findings,
    unit_findings,
    wiring_findings,
)
from psd_deflection.studies.check.wirings import (
    DOTS,
    LIMIT,
    MARGIN,
    PushResponse,
    WiringFit,
    differences,
    fitting_wirings,
    misfit,
)
from psd_deflection.studies.loads.annotated_times import CorrectedNote, correct_loads
from psd_deflection.studies.loads.effective import LoadNote, effective_loads

DEAD = 0.1
"""A channel that moves less than this share of every push does not answer."""

SIZE_FACTOR = 1.1
"""Report a movement that differs from the expected one by more than this factor."""

ALONE = {'fx': 'a load along X alone', 'fy': 'a load along Y alone', 'tz': 'a torque about Z alone'}
_LOADS = tuple(ALONE)


@dataclass(frozen=True, slots=True, eq=False)
class CheckProblem:
    """``pushes``: how the channels answered. ``levels``: noise, hum and light. ``drift``,
    ``drift_sd`` (4,): m/s, of the device's channels x1 y1 x2 y2. ``source``: the recording, '' at
    the bench. ``notes``: of loads that hung at another time than noted, that swayed, that were others, or that were
    not noted.
    """

    rig: Rig
    pushes: Sequence[PushResponse]
    levels: Levels
    drift: FloatArray
    drift_sd: FloatArray
    source: str = ''
    notes: Sequence[LoadNote] = ()


def of_recording(rig: Rig, volts: FloatArray, loads: FloatArray, source: str = '') -> CheckProblem:
    """Return the problem of a recording: ``volts`` (n, 6) of the device's channels, ``loads`` (n, 3), N, N, N m, held.

    Raises ConfigError for a rig of more than two PSDs.
    """
    check_two_psds(rig, 'check')
    corrected = correct_loads(rig, volts[:, list(DOT_CHANNELS)] * rig.amplifier.sensitivity, loads)
    late: Sequence[CorrectedNote] = ()
    moved = volts
    if corrected is not None:
        loads, late = corrected.loads, corrected.notes
        moved = np.where(corrected.unused[:, None], np.nan, volts)
    wiring = Wiring.from_rig(rig)
    effective = effective_loads(rig, wiring.to_psds(moved), loads)
    moved = np.where(np.isfinite(effective.volts).any(axis=1, keepdims=True), moved, np.nan)
    answered = responses(rig, moved, effective.loads)
    notes = (*late, *effective.notes)
    return CheckProblem(rig, answered.pushes, levels(rig, volts), answered.drift, answered.drift_sd, source, notes)


def check(problem: CheckProblem) -> Checkup:
    """Hold the pushes, the noise and the light against the rig file."""
    rig, pushes, measured = problem.rig, problem.pushes, problem.levels
    file = Wiring.from_rig(rig)
    observed = tuple(p for p in pushes if p.observed)
    dead = [*measured.stuck, *(c for c in _dead(observed) if c not in measured.stuck)]
    wirings = fitting_wirings(observed) if observed else []
    findings = [note_finding(n, problem.source) for n in problem.notes]
    lines: dict[str, object] = {}
    for channel in dead:
        findings.append(Finding('stuck_channel', channel, None, f'{channel} does not answer: look at its cable'))
    best = min(wirings, key=lambda c: len(differences(c.wiring, file)), default=WiringFit(file, 0.0))
    if not dead and wirings:
        findings += _wiring_findings(file, observed, wirings, best, lines)
        findings += _load_findings(observed, best)
    findings += _level_findings(rig, measured, best.wiring, lines)
    light = _light(rig, measured, best.wiring)
    determined = not dead and len(wirings) == 1
    if not determined and not dead:
        findings += _coverage(pushes, observed, wirings)
    # Pushes that are not there yet are no mistake.
    wrong = light or problem.notes or any(f.name != 'load_coverage' for f in findings)
    verdict = WRONG if wrong else RIGHT if determined else CANNOT_TELL
    sizes = tuple(p.misfit(best.wiring)[1] if p.observed else math.nan for p in pushes)
    return Checkup(
        rig=rig,
        verdict=verdict,
        findings=tuple(findings),
        values=lines,
        pushes=tuple(pushes),
        sizes=sizes,
        wirings=tuple(wirings),
        levels=measured,
        drift=problem.drift,
        drift_sd=problem.drift_sd,
        light=light,
        notes=tuple(_notes(problem, best.wiring, sizes)),
        source=problem.source,
    )


def _dead(observed: Sequence[PushResponse]) -> list[str]:
    """Channels that answer to no push although pushes along X and along Y moved others."""
    if not {('fx',), ('fy',)} <= {p.loads for p in observed}:
        return []
    share = np.max([np.abs(p.channels) / np.linalg.norm(p.channels) for p in observed if not p.only_twist], axis=0)
    return [name for name, most in zip(DOTS, share.tolist(), strict=True) if most < DEAD]


def _wiring_findings(
    file: Wiring,
    observed: Sequence[PushResponse],
    wirings: Sequence[WiringFit],
    best: WiringFit,
    lines: dict[str, object],
) -> list[Finding]:
    """How ``best`` differs from the rig file's wiring; nothing if that explains the pushes too."""
    if any(c.wiring == file for c in wirings):
        return []
    gained = misfit(file, observed, best.reversed_loads)[0] - best.misfit
    also = _same_to_first_order(file, observed, best)
    if (alternatives := len(wirings) - 1) > 0:
        also += (f'{alternatives} other wiring{"s" if alternatives > 1 else ""}, which these pushes cannot tell apart',)
    findings, right = wiring_findings(best.wiring, file, gained, also)
    if len(wirings) == 1:
        lines.update(right)
    return findings


def _same_to_first_order(file: Wiring, observed: Sequence[PushResponse], best: WiringFit) -> tuple[str, ...]:
    """Return whether the rig file's wiring explains the pushes as well if some went the other way than was said."""
    rotated = tuple(load for p in observed if p.misfit(file)[1] < 0.0 for load in p.loads)
    total, worst = misfit(file, observed, rotated)
    same = worst <= LIMIT and total <= best.misfit + MARGIN
    return (f'load_sign of {" ".join(rotated)}',) if same else ()


def _load_findings(observed: Sequence[PushResponse], wiring: WiringFit) -> list[Finding]:
    out = [
        Finding('load_sign', load, -1.0, f'load_{load} in the recording has the wrong sign')
        for load in wiring.reversed_loads
    ]
    sizes = np.full(3, math.nan)
    for p in observed:
        if p.sized:
            sizes[[_LOADS.index(load) for load in p.loads]] = p.misfit(wiring.wiring)[1]
    return out + unit_findings(sizes)[0]


def _level_findings(rig: Rig, measured: Levels, wiring: Wiring, lines: dict[str, object]) -> list[Finding]:
    """Return the noise of each PSD's x and y, and the converter's steps, against the rig file."""
    columns = [wiring.columns[c] for c in DOT_CHANNELS]
    # Steps hide a noise that is smaller than they are.
    hidden = [CHANNELS[c] in measured.stuck or measured.noise[c] < measured.steps[c] for c in columns]
    noise = [math.nan if unseen else measured.noise[c] for c, unseen in zip(columns, hidden, strict=True)]
    found, right = noise_findings(rig, np.array(noise), measured.steps[columns].reshape(2, 2))
    steps, bits = step_findings(rig, measured.steps)
    lines |= right | bits
    return [*found, *steps]


def _light(rig: Rig, measured: Levels, wiring: Wiring) -> dict[str, str]:
    """Sums beyond the rig file's limits: below them no block has an estimate, above them each is in doubt."""
    out = {}
    low, high = rig.estimator.sum_min, rig.estimator.sum_max
    for psd in (1, 2):
        number = wiring.input_of(psd)
        level = float(measured.sums[number - 1])
        if low <= level <= high or f'sum{number}' in measured.stuck:
            continue
        text = (
            f'too little: sum {level:.2f} V, below sum_min {low:g} V, so no block will have an estimate; '
            'look at the laser, its aim and the window, or whether sum is on this input'
        )
        if level > high:
            text = (
                f'too much: sum {level:.2f} V, above sum_max {high:g} V, so the estimates are in doubt; '
                'look for other light, or for a wrong gain'
            )
        out[f'psd_{psd}'] = text
    return out


def _coverage(
    pushes: Sequence[PushResponse], observed: Sequence[PushResponse], wirings: Sequence[WiringFit]
) -> list[Finding]:
    missing = [load for load in ALONE if (load,) not in {p.loads for p in observed}]
    weak = [p.name for p in pushes if not p.observed]
    if observed and not wirings:
        text = 'no wiring explains these pushes: push one way at a time, along +X, along +Y, then turn about +θ'
    elif weak:
        verb = 'does' if len(weak) == 1 else 'do'
        text = f'{" and ".join(weak)} {verb} not stand out of the noise: push harder'
    elif len(missing) == 1:
        text = f'record again with {ALONE[missing[0]]} too'
    else:
        text = f'record again, one after the other: {", ".join(ALONE[load] for load in missing or ALONE)}'
    return [Finding('load_coverage', ' '.join(missing) or 'fx fy tz', None, text)]


def _notes(problem: CheckProblem, wiring: Wiring, sizes: Sequence[float]) -> list[str]:
    rig, measured, drift, drift_sd = problem.rig, problem.levels, problem.drift, problem.drift_sd
    out = []
    for push, size in zip(problem.pushes, sizes, strict=True):
        if push.sized and math.isfinite(size) and not 1.0 / SIZE_FACTOR <= abs(size) <= SIZE_FACTOR:
            out.append(
                f'{push.name}: the dots move {abs(size):.2f} times what the rig file expects; see its link and '
                'amplifier.sensitivity (`psd-deflection discover` names the cause)'
            )
    nominal = rig.amplifier.sum_nominal
    for psd in (1, 2):
        level = float(measured.sums[wiring.input_of(psd) - 1])
        sound = rig.estimator.sum_min <= level <= rig.estimator.sum_max
        if sound and not 1.0 / SUM_FACTOR <= level / nominal <= SUM_FACTOR:
            out.append(f'psd_{psd}: sum {level:.2f} V, the rig file says {nominal:g} V; see amplifier.sum_nominal')
    if measured.hum.max() > 0.0:
        worst = int(np.argmax(measured.hum))
        names = ('x1', 'y1', 'sum1', 'x2', 'y2', 'sum2')
        out.append(
            f'hum: {measured.hum[worst] * 1e3:.1f} mV at {measured.hum_hz:g} Hz on {names[worst]}; '
            'look at shielding and ground'
        )
    per_minute = np.abs(drift) * 60e6
    far = (per_minute > 5.0) & (np.abs(drift) > 5.0 * drift_sd)
    if far.any() and drift_sd.max() <= SIGNIFICANT_DRIFT:
        worst = int(np.argmax(np.where(far, per_minute, 0.0)))
        out.append(f'drift: {drift[worst] * 60e6:+.1f} µm a minute on {DOTS[worst]}; let lasers and amplifier warm up')
    return out
