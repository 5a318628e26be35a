# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The check of a rig: wiring, loads, noise and light against its rig file."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from psd_deflection.base.errors import RecordingError
from psd_deflection.model.link import LinkStatics
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.records import CHANNELS, DOT_CHANNELS, FloatArray
from psd_deflection.rig.config import Rig, check_two_psds
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.check.result import (
    CANNOT_TELL,
    RIGHT,
    SIGNIFICANT_DRIFT,
    SUM_FACTOR,
    WRONG,
    Checkup,
    Finding,
    Levels,
    levels,
)
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
    pattern,
    residuals,
    scales_of,
)
from psd_deflection.studies.loads.alignment import LatePsd, aligned
from psd_deflection.studies.loads.annotated_times import CorrectedNote, correct_loads
from psd_deflection.studies.loads.effective import LoadNote, effective_loads
from psd_deflection.studies.loads.steps import link_motion

LOADS = ('fx', 'fy', 'tz')
TOGETHER = 0.95
"""Loads whose expected poses are correlated more than this count as one."""

FEWEST_BLOCKS = 8
LEAST_MOVED = 1e-6
"""Combinations of the simulated dots that move by less than this share of the largest say nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Responses:
    """``pushes``: one for each load that was applied. ``drift``, ``drift_sd`` (4,): m/s, of the device's channels."""

    pushes: tuple[PushResponse, ...]
    drift: FloatArray
    drift_sd: FloatArray


def responses(rig: Rig, volts: FloatArray, loads: FloatArray) -> Responses:
    """``volts`` (n, 6) of the device's channels, NaN if a sample is lost; ``loads`` (n, 3), N, N, N m, held.

    Raises RecordingError if there are too few blocks.

    The simulation has the plate's geometry and the ringing of both modes. So what is left of a regression on its dots
    is wiring, gain, noise and drift. Each channel is a combination of the four simulated dots, whatever the wiring is;
    a constant and a straight line in time are fitted with them: where the dots were before load, and drift. The
    movement by a load is that combination of the dots that the load alone moves, at rest. Loads that always came
    together cannot be determined apart and count as one.
    """
    size, period = rig.estimator.block_size, 1.0 / rig.converter.sample_rate_hz
    n = len(volts) // size
    dots = block_means(volts[: n * size, DOT_CHANNELS], n) * rig.amplifier.sensitivity
    present = np.isfinite(dots).all(axis=1)
    if int(present.sum()) < FEWEST_BLOCKS:
        raise RecordingError(f'{int(present.sum())} blocks of samples: at least {FEWEST_BLOCKS} are needed')
    static = loads @ LinkStatics.from_rig(rig).compliance
    poses = link_motion(rig, loads)
    means, held = (p[: n * size].reshape(n, size, 3).mean(axis=1) for p in (poses, static))
    shown = _simulated(rig, loads)[: n * size].reshape(n, size, 4).mean(axis=1)
    t = np.arange(n) * size * period
    design = np.column_stack((shown - shown[present].mean(axis=0), np.ones(n), t - t.mean()))[present]
    slopes, covariance, variance = least_squares_fit(design, dots[present])
    pushes = []
    for group in load_groups(held[present], means[present], pattern(rig)):
        most = int(np.argmax(np.abs(held[present][:, group[0]])))
        alone = np.zeros((2, 3))
        alone[1, group] = loads[: n * size].reshape(n, size, 3).mean(axis=1)[present][most, group]
        before, after = _simulated(rig, alone, at_rest=True)
        # The way that the push is named.
        expected = np.sign(alone[1, group[0]]) * (after - before)
        moved = np.append(expected, (0.0, 0.0))
        names = tuple(LOADS[k] for k in group)
        sd = np.sqrt(moved @ covariance @ moved * variance)
        pushes.append(PushResponse(names, moved @ slopes, sd, expected, scales=scales_of(rig)))
    return Responses(tuple(pushes), slopes[-1], np.sqrt(covariance[-1, -1] * variance))


def _simulated(rig: Rig, loads: FloatArray, *, at_rest: bool = False) -> FloatArray:
    """Dots x1 y1 x2 y2 (n, 4), m, under ``loads`` (n, 3), N, N, N m; ``at_rest``: at rest under each."""
    return np.asarray(ForwardModel(rig, steady=at_rest).run(loads).true_dots.T)


def block_means(samples: FloatArray, n: int) -> FloatArray:
    """Means (n, c) over the samples that are there; NaN for a block without any."""
    parts = samples.reshape(n, -1, samples.shape[1])
    there = np.isfinite(parts)
    count = there.sum(axis=1)
    total = np.where(there, parts, 0.0).sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def load_groups(poses: FloatArray, moved: FloatArray, per_pose: FloatArray) -> list[list[int]]:
    """The applied loads, those together that always came together. ``poses`` (n, 3): held; ``moved`` (n, 3): rung."""
    size = np.minimum(np.ptp(poses, axis=0), np.ptp(moved, axis=0)) * np.linalg.norm(per_pose, axis=0)
    applied = [int(i) for i in np.argsort(-size) if size[i] > 0.0]
    out: list[list[int]] = []
    for i in applied:
        for group in out:
            if abs(np.corrcoef(poses[:, i], poses[:, group[0]])[0, 1]) > TOGETHER:
                group.append(i)
                break
        else:
            out.append([i])
    return sorted((sorted(group) for group in out), key=lambda group: group[0])


def least_squares_fit(design: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Slopes (k, c) of ``values`` (n, c) on ``design`` (n, k), their spread (k, k) per variance, the variances (c,).

    The variances count the correlation of one block's rest with the next one's, so that hum, ringing and drift widen
    them.
    """
    size = np.abs(design).max(axis=0)
    # The four dots in one unit: their proportions count.
    size[:4] = size[:4].max()
    size[size == 0.0] = 1.0
    inverse = np.linalg.pinv(design / size, rcond=LEAST_MOVED) / size[:, None]
    slopes = inverse @ values
    rest = values - design @ slopes
    variance = (rest**2).sum(axis=0) / max(len(design) - design.shape[1], 1)
    ahead = (rest[1:] * rest[:-1]).sum(axis=0) / np.maximum((rest**2).sum(axis=0), np.finfo(float).tiny)
    colour = np.clip(ahead, 0.0, 0.98)
    return slopes, inverse @ inverse.T, variance * (1.0 + colour) / (1.0 - colour)


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
    not noted. ``late``: PSDs that are on another clock.
    """

    rig: Rig
    pushes: Sequence[PushResponse]
    levels: Levels
    drift: FloatArray
    drift_sd: FloatArray
    source: str = ''
    notes: Sequence[LoadNote] = ()
    late: Sequence[LatePsd] = ()


def of_recording(rig: Rig, volts: FloatArray, loads: FloatArray, source: str = '') -> CheckProblem:
    """Return the problem of a recording: ``volts`` (n, 6) of the device's channels, ``loads`` (n, 3), N, N, N m, held.

    Raises ConfigError for a rig of more than two PSDs.
    """
    check_two_psds(rig, 'check')
    wiring = Wiring.from_rig(rig)
    on_one_clock, apart = aligned(rig, wiring.to_psds(volts), loads)
    moved = wiring.to_device(on_one_clock)
    corrected = correct_loads(rig, moved[:, list(DOT_CHANNELS)] * rig.amplifier.sensitivity, loads)
    late: Sequence[CorrectedNote] = ()
    if corrected is not None:
        loads, late = corrected.loads, corrected.notes
        moved = np.where(corrected.unused[:, None], np.nan, moved)
    effective = effective_loads(rig, wiring.to_psds(moved), loads)
    moved = np.where(np.isfinite(effective.volts).any(axis=1, keepdims=True), moved, np.nan)
    answered = responses(rig, moved, effective.loads)
    notes = (*late, *effective.notes)
    return CheckProblem(
        rig, answered.pushes, levels(rig, volts), answered.drift, answered.drift_sd, source, notes, apart
    )


def check(problem: CheckProblem) -> Checkup:
    """Hold the pushes, the noise and the light against the rig file."""
    rig, pushes, measured = problem.rig, problem.pushes, problem.levels
    file = Wiring.from_rig(rig)
    observed = tuple(p for p in pushes if p.observed)
    dead = [*measured.stuck, *(c for c in _dead(observed) if c not in measured.stuck)]
    wirings = fitting_wirings(observed) if observed else []
    notes = [note_finding(n, problem.source) for n in problem.notes]
    findings = list(notes)
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
    # Pushes that are not there yet are no mistake, nor are times as people note them.
    wrong = light or problem.late or any((f in notes or f.name != 'load_coverage') and not f.by_hand for f in findings)
    verdict = WRONG if wrong else RIGHT if determined else CANNOT_TELL
    sizes = tuple(p.match(best.wiring)[1] if p.observed else math.nan for p in pushes)
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
        late=tuple(problem.late),
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
    gained = residuals(file, observed, best.reversed_loads)[0] - best.residual
    also = _same_to_first_order(file, observed, best)
    if (alternatives := len(wirings) - 1) > 0:
        also += (f'{alternatives} other wiring{"s" if alternatives > 1 else ""}, which these pushes cannot tell apart',)
    findings, right = wiring_findings(best.wiring, file, gained, also)
    if len(wirings) == 1:
        lines.update(right)
    return findings


def _same_to_first_order(file: Wiring, observed: Sequence[PushResponse], best: WiringFit) -> tuple[str, ...]:
    """Return whether the rig file's wiring explains the pushes as well if some went the other way than was said."""
    rotated = tuple(load for p in observed if p.match(file)[1] < 0.0 for load in p.loads)
    total, worst = residuals(file, observed, rotated)
    same = worst <= LIMIT and total <= best.residual + MARGIN
    return (f'load_sign of {" ".join(rotated)}',) if same else ()


def _load_findings(observed: Sequence[PushResponse], wiring: WiringFit) -> list[Finding]:
    out = [
        Finding('load_sign', load, -1.0, f'load_{load} in the recording has the wrong sign')
        for load in wiring.reversed_loads
    ]
    sizes = np.full(3, math.nan)
    for p in observed:
        if p.sized:
            sizes[[_LOADS.index(load) for load in p.loads]] = p.match(wiring.wiring)[1]
    return out + unit_findings(sizes)[0]


def _level_findings(rig: Rig, measured: Levels, wiring: Wiring, lines: dict[str, object]) -> list[Finding]:
    """Return the noise of each PSD's x and y, and the converter's steps, against the rig file."""
    columns = [wiring.columns[c] for c in DOT_CHANNELS]
    # Steps hide a noise that is smaller than they are.
    hidden = [CHANNELS[c] in measured.stuck or measured.noise[c] < measured.steps[c] for c in columns]
    noise = [math.nan if unseen else measured.noise[c] for c, unseen in zip(columns, hidden, strict=True)]
    findings, right = noise_findings(rig, np.array(noise), measured.steps[columns].reshape(2, 2))
    steps, bits = step_findings(rig, measured.steps)
    lines |= right | bits
    return [*findings, *steps]


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
    drifting = (per_minute > 5.0) & (np.abs(drift) > 5.0 * drift_sd)
    if drifting.any() and drift_sd.max() <= SIGNIFICANT_DRIFT:
        worst = int(np.argmax(np.where(drifting, per_minute, 0.0)))
        out.append(f'drift: {drift[worst] * 60e6:+.1f} µm a minute on {DOTS[worst]}; let lasers and amplifier warm up')
    return out
