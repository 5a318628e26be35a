# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The recording is checked before the physics: each of 128 wirings of two PSDs (of more: two wired otherwise, or all)
is held against the whole recording, with free sizes of the loads that tell their signs and units; another than the rig
file's must leave ten times less."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from psd_deflection.model.simulation.catalogue import sort_effects
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.recordings.observation import Observation
from psd_deflection.records import FloatArray, dot_channels
from psd_deflection.rig.config import Rig, replace_values
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.check.result import Finding
from psd_deflection.studies.check.shared_findings import LOADS, unit_findings, wiring_findings
from psd_deflection.studies.check.wirings import differences, line, wirings_of
from psd_deflection.studies.discover.hidden import RIG_NUMBERS, zero_moved
from psd_deflection.studies.discover.search.fit import Fit
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.thresholds import SMALL_MOVE
from psd_deflection.studies.loads.plate_motion import dots_of
from psd_deflection.studies.loads.thresholds import AS_GOOD, EXACT, FINE_SECONDS, MANYFOLD, ONE_DELAY_S


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Movement:
    """Sums over block means: ``squared`` of the readings; ``cross`` (3, 2P, 2P): load, simulated dot, device's channel;
    ``load_products`` (3, 3): of the simulated movements, load by load; ``noise``: variance of a block's mean, m^2.
    """

    squared: float
    cross: FloatArray
    load_products: FloatArray
    noise: float


def _moved(rig: Rig, base: Sequence[ActiveEffect], loads: FloatArray, temperature: FloatArray | None) -> FloatArray:
    """Dots (2P, n), m, as the volts of the simulation show them."""
    chunk = ForwardModel(rig, sort_effects(base)).expect(loads, temperature)
    return dots_of(rig, chunk.volts)


def _blocks(rows: FloatArray, size: int) -> FloatArray:
    """Means over the samples that are there, (k, blocks); NaN for a block with less than half of them."""
    n = rows.shape[1] // size
    cut = rows[:, : n * size].reshape(len(rows), n, size)
    there = np.isfinite(cut)
    count = there.sum(axis=2)
    return np.where(count >= size // 2, np.where(there, cut, 0.0).sum(axis=2) / np.maximum(count, 1), np.nan)


def movement_sums(observations: Sequence[Observation], base: Sequence[ActiveEffect]) -> _Movement:
    """Return the sums over blocks of what dots and simulated loads moved, m^2."""
    count = 2 * observations[0].psds
    squared, cross, load_products = 0.0, np.zeros((3, count, count)), np.zeros((3, 3))
    for o in observations:
        size, physics = o.rig.estimator.block_size, Physics.of(o.rig)
        device = Wiring.from_rig(o.rig).to_device(o.volts)[:, dot_channels(o.psds)].T
        block_means = _blocks(device * o.rig.amplifier.sensitivity, size)
        still = _moved(o.rig, base, np.zeros_like(o.loads), o.temperature)
        alone = []
        for k, compliance in enumerate((physics.force_compliance, physics.force_compliance, physics.torque_compliance)):
            only = np.zeros_like(o.loads)
            # Loads in a wrong unit may be thousands of times too large: the link is moved a little, in proportion.
            share = SMALL_MOVE / max(compliance * float(np.abs(o.loads[:, k]).max()), SMALL_MOVE)
            only[:, k] = share * o.loads[:, k]
            alone.append(_blocks(_moved(o.rig, base, only, o.temperature) - still, size) / share)
        there = np.isfinite(block_means).all(axis=0)
        if there.sum() < 4:
            continue
        block_means = block_means[:, there] - block_means[:, there].mean(axis=1, keepdims=True)
        moves = np.stack(alone)[:, :, there]
        moves = moves - moves.mean(axis=2, keepdims=True)
        # The volts of one PSD may have a sensitivity of their own; the channels are compared by the amplifier's.
        moves = moves / (o.rig.sensitivities.reshape(-1, 1) / o.rig.amplifier.sensitivity)
        squared += float((block_means**2).sum())
        cross += np.einsum('kdt,ct->kdc', moves, block_means)
        load_products += np.einsum('kdt,jdt->kj', moves, moves)
    first = observations[0].rig
    noise = float(np.mean(first.noises[:, :2] ** 2)) * first.amplifier.sensitivity**2 / first.estimator.block_size
    return _Movement(squared, cross, load_products, noise)


def load_sizes(m: _Movement, wiring: Wiring) -> tuple[float, FloatArray]:
    """What ``wiring`` leaves of the movement, and the size of each load (3,) over the annotated one; NaN for none."""
    dots = dot_channels(len(wiring.axes))
    columns = [dots.index(wiring.columns[c]) for c in dots]
    signs = np.array(wiring.signs)[list(dots)]
    along = np.einsum('d,kd->k', signs, m.cross[:, range(len(dots)), columns])
    # A load in kN or mN is a million times weaker or stronger than the others.
    applied = np.diag(m.load_products) > 1e-18 * float(np.diag(m.load_products).max())
    sizes = np.full(3, np.nan)
    if not applied.any():
        return m.squared, sizes
    at = np.flatnonzero(applied)
    f = m.load_products[np.ix_(at, at)]
    scale = np.sqrt(np.diag(f))
    sizes[at] = np.linalg.lstsq(f / np.outer(scale, scale), along[at] / scale, rcond=1e-6)[0] / scale
    residual = max(m.squared - float(along[at] @ sizes[at]), 0.0)
    # A load that moved nothing that stands out has no size.
    with np.errstate(invalid='ignore'):
        sizes[sizes**2 * np.diag(m.load_products) < MANYFOLD**2 * m.noise + 1e-3 * residual] = np.nan
    return residual, sizes


def _over_simulated(observations: Sequence[Observation], base: Sequence[ActiveEffect]) -> FloatArray:
    """Size of each load (3,) over that of ``observations``, which is nearly right; 1 for one that moves nothing."""
    squares, along = np.zeros((3, 3)), np.zeros(3)
    for o in observations:
        size = o.rig.estimator.block_size
        simulated = _moved(o.rig, base, o.loads, o.temperature)
        rest = _blocks((o.volts[:, dot_channels(o.psds)] * o.rig.sensitivities.ravel()).T - simulated, size)
        slopes = []
        for more in np.eye(3):
            larger = _moved(o.rig, base, o.loads * (1.0 + EXACT * more), o.temperature)
            slopes.append(_blocks(larger - simulated, size) / EXACT)
        there = np.isfinite(rest).all(axis=0)
        if there.sum() < 4:
            continue
        a, b = np.stack(slopes)[:, :, there], rest[:, there]
        a, b = a - a.mean(axis=2, keepdims=True), b - b.mean(axis=1, keepdims=True)
        squares += np.einsum('kct,jct->kj', a, a)
        along += np.einsum('kct,ct->k', a, b)
    scale = np.sqrt(np.where(np.diag(squares) > 0.0, np.diag(squares), 1.0))
    return np.asarray(1.0 + np.linalg.lstsq(squares / np.outer(scale, scale), along / scale, rcond=1e-6)[0] / scale)


def correct_wiring(
    observations: Sequence[Observation], base: Sequence[ActiveEffect]
) -> tuple[list[Observation], list[Finding], dict[str, object]]:
    """The recordings as they would be if wiring, signs and units were right; what was wrong; lines for the rig file."""
    file = Wiring.from_rig(observations[0].rig)
    m = movement_sums(observations, base)
    if m.squared <= 0.0 or float(np.trace(m.load_products)) <= 0.0:
        return list(observations), [], {}
    noise = noise_energy(observations)
    tried = []
    for wiring in wirings_of(file):
        residual, sizes = load_sizes(m, wiring)
        tried.append((residual + noise, wiring, sizes))
    best = min(residual for residual, _, _ in tried)
    as_good = [
        (_changes(w, file, s), residual, i) for i, (residual, w, s) in enumerate(tried) if residual <= AS_GOOD * best
    ]
    _, residual, chosen = min(as_good)
    _, wiring, sizes = tried[chosen]
    stated, stated_sizes = next((x, s) for x, w, s in tried if w == file)
    # With the wiring and the signs of the rig file: a load that pulled the wrong way explains nothing.
    plain = stated if not np.any(stated_sizes < 0.0) else m.squared + noise
    findings: list[Finding] = []
    lines: dict[str, object] = {}
    crossed: tuple[int, ...] = ()
    loads = np.ones(3)
    if plain > MANYFOLD * residual:
        alternatives = tuple(_words(tried[i][1], file, tried[i][2]) for _, _, i in sorted(as_good)[1:3])
        findings, lines = wiring_findings(wiring, file, plain / residual, alternatives)
        crossed = wiring.crossed
        rotated = [k for k in range(3) if sizes[k] < 0.0]
        loads[rotated] = -1.0
        findings += [
            Finding(
                'load_sign',
                LOADS[k][5:],
                -1.0,
                f'turn the sign of {LOADS[k]} in the recording',
                plain / residual,
                alternatives,
            )
            for k in rotated
        ]
    if unit_findings(sizes)[0]:
        # kg mm and N cm are 2 % apart, and a large movement is not in proportion to its load.
        sizes = np.abs(sizes) * _over_simulated(
            [_corrected(o, lines, crossed, np.nan_to_num(sizes, nan=1.0)) for o in observations], base
        )
    units, factors = unit_findings(sizes, plain / residual)
    findings += units
    loads = loads * factors
    if not findings:
        return list(observations), [], {}
    return [_corrected(o, lines, crossed, loads) for o in observations], findings, lines


def noise_energy(observations: Sequence[Observation]) -> float:
    """What noise adds to the sum over block means, by the rig file, m^2."""
    out = 0.0
    for o in observations:
        dots = o.rig.noises[:, :2] * o.rig.amplifier.sensitivity
        out += float((dots**2).sum()) * len(o.volts) / o.rig.estimator.block_size**2
    return out


def _changes(wiring: Wiring, file: Wiring, sizes: FloatArray) -> int:
    return len(differences(wiring, file)) + int(np.sum(sizes < 0.0))


def _words(wiring: Wiring, file: Wiring, sizes: FloatArray) -> str:
    """What is wrong if ``wiring`` is right, in names."""
    out = [f'{d.name} of {d.where}' for d in differences(wiring, file)]
    out += [f'load_sign of {LOADS[k][5:]}' for k in range(3) if sizes[k] < 0.0]
    return ' and '.join(out) or 'as the rig file says'


def _corrected(o: Observation, lines: dict[str, object], crossed: tuple[int, ...], loads: FloatArray) -> Observation:
    rig, volts = o.rig, o.volts
    if lines or crossed:
        rig = replace_values(o.rig, lines)
        right = dataclasses.replace(Wiring.from_rig(rig), crossed=crossed)
        volts = right.to_psds(Wiring.from_rig(o.rig).to_device(o.volts))
    return dataclasses.replace(o, rig=rig, volts=volts, loads=o.loads * loads, digest=o.digest or o.hashed())


def likely_delays(workspace: Workspace) -> list[float]:
    """By how much the loads may be noted late, s: where the readings fit the simulation best when it is shifted."""
    simulated = workspace.simulate(workspace.base)
    total: FloatArray | None = None
    step = workspace.observations[0].period * workspace.fine[0]
    reach = round(ONE_DELAY_S / step)
    for s, m, c, noise in zip(simulated, workspace.measured, workspace.count, workspace.noise, strict=True):
        for k in workspace.rows:
            there = c[k] > 0.0
            if there.sum() < 4 * reach:
                continue
            a = np.where(there, m[k] - m[k][there].mean(), 0.0) / noise.sigma[k]
            b = (s[k] - s[k].mean()) / noise.sigma[k]
            n = 2 * len(a)
            correlation = np.fft.irfft(np.fft.rfft(a, n) * np.conj(np.fft.rfft(b, n)), n)
            around = np.concatenate((correlation[-reach:], correlation[: reach + 1]))
            total = around if total is None else total + around
    if total is None:
        return []
    peak = int(np.argmax(total))
    best = peak - reach
    if best == 0:
        # Between two fine blocks: where a parabola has its top.
        a, b, c = total[peak - 1 : peak + 2].tolist()
        early = 0.5 * (a - c) / (a - 2.0 * b + c) * step
        return [-early] if abs(early) >= 0.125 * FINE_SECONDS else []
    # The readings follow later than simulated: the loads are noted early.
    return sorted({-best * step, -(best + 1) * step, -(best - 1) * step} - {0.0})


def likely_jumps(workspace: Workspace, residual: FloatArray) -> list[tuple[int, int, float]]:
    """(recording, PSD, time s) of the greatest step of the residual (D,), whitened, of each PSD in each recording."""
    out = []
    for r, part in enumerate(workspace.split(residual)):
        n = part.shape[1]
        if n < 50:
            continue
        k = np.arange(1, n)
        for psd in range(1, len(part) // 3 + 1):
            rows = part[3 * psd - 3 : 3 * psd - 1]
            sums = np.cumsum(rows - rows.mean(axis=1, keepdims=True), axis=1)[:, :-1]
            gain = (sums**2).sum(axis=0) * n / (k * (n - k))
            at = int(np.argmax(gain))
            if gain[at] > 50.0:
                out.append((r + 1, psd, (at + 1) * workspace.fine[r] * workspace.observations[r].period))
    return out


def finding_of_effect(
    workspace: Workspace, fit: Fit, index: int, evidence: float
) -> tuple[list[Finding], dict[str, object]]:
    """Effect ``index`` of ``fit``, a mistake of the set-up, in words, and the lines for the rig file."""
    active = fit.effects[index]
    v, rig = active.values, workspace.observations[0].rig
    name = active.effect.name
    if name == 'jump':
        o = workspace.observations[int(v['recording']) - 1]
        words = (
            f'PSD {int(v["psd"])} of {o.name} jumps by {1e6 * v["jump_x"]:.3g} µm along x and '
            f'{1e6 * v["jump_y"]:.3g} µm along y: see its mount and its laser; split the recording there'
        )
        return [Finding(name, f'psd_{int(v["psd"])}', 1e-6 * v['time_us'], words, evidence)], {}
    if name == 'load_delay':
        size = f'{abs(v["late_by"]):.4g} s'
        direction, way = ('late', f'subtract {size} from') if v['late_by'] > 0.0 else ('early', f'add {size} to')
        words = f'the recorded load times are {size} {direction}: {way} them'
        return [Finding(name, ' '.join(LOADS), v['late_by'], words, evidence)], {}
    if name == 'zero':
        o = workspace.observations[int(v['recording']) - 1]
        moved = zero_moved(v, o.psds)
        zeros = [[float(f'{x:.7g}') for x in row] for row in (o.rig.zeros + moved).tolist()]
        words = f'overrides of {o.name}: ' + ', '.join(line(f'psd_{i}.zero', z) for i, z in enumerate(zeros, start=1))
        return [Finding(name, o.name, float(np.abs(moved).max()), words, evidence)], {}
    factor = 1.0 + v['error']
    if name in RIG_NUMBERS:
        key = RIG_NUMBERS[name]
        return [], {key: float(f'{float(str(rig.values[key])) * factor:.6g}')}
    key, old = {
        'sensitivity': ('amplifier.sensitivity', rig.amplifier.sensitivity),
        'link_length': ('link.length', rig.link.length),
        'sample_rate': ('converter.sample_rate_hz', rig.converter.sample_rate_hz),
    }[name]
    value = float(f'{old * factor:.6g}')
    return [Finding(name, key, factor, line(key, value), evidence)], {key: value}


def noise_of(workspace: Workspace) -> FloatArray:
    """Noise (P, 2) of x and y of each PSD, V rms a sample, over all recordings."""
    squares = [n.sigma[workspace.rows] ** 2 for n in workspace.noise]
    return np.asarray(np.sqrt(np.mean(squares, axis=0)).reshape(-1, 2))
