# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a law may be made of: terms, and how much of a residual each explains to first order, without a simulation."""

import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from psd_deflection.model.simulation.catalogue import sort_effects
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.laws import DOTS, FORMS, TARGETS, LawTerm, known, variables_of
from psd_deflection.model.simulation.modes import mode_coefficients
from psd_deflection.model.simulation.physics import dots_on_plate
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.records import FloatArray, IntArray, channel_names, dot_names
from psd_deflection.studies.discover.hidden import only_in
from psd_deflection.studies.discover.search.fit import Fit
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.thresholds import BIC_GAIN, LEVELS, MANY_EFFECTS, MAX_FINE, TRIED
from psd_deflection.studies.loads.plate_motion import fine_means
from psd_deflection.studies.loads.thresholds import MANYFOLD

LOADS, POSE = ('load_fx', 'load_fy', 'load_tz'), ('dx', 'dy', 'theta')


def sought(psds: int) -> tuple[str, ...]:
    """Return the targets that are looked at of so many PSDs. A law on a load does what one on the static pose does."""
    sums = (f'sum{n}' for n in range(1, psds + 1))
    return (*(f'static_{n}' for n in POSE), *POSE, *dot_names(psds), *sums)


SOUGHT = sought(2)
"""Those of two PSDs."""


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """One recording beside the effects of a fit. ``known``: every variable (n,); ``targets``: what is looked at;
    ``weight`` (nf, targets (1 + p)):
    what a term on fine blocks is multiplied with for its product with the residual and p fitted columns;
    ``length`` (nf, targets): likewise for its squared length. ``error`` and ``power`` (targets, nf): the residual as
    an estimate of what the target lacks, and the inverse of its variance. ``modes``: of bending and torsion;
    ``rings``: the period of each in fine blocks.
    """

    known: Mapping[str, FloatArray]
    period: float
    fine: int
    weight: FloatArray
    length: FloatArray
    error: FloatArray
    power: FloatArray
    modes: tuple[tuple[FloatArray, FloatArray], ...]
    rings: tuple[int, int]
    targets: tuple[str, ...] = SOUGHT


def _jacobian(pose: FloatArray, beams: FloatArray, model: ForwardModel) -> FloatArray:
    """Change of the dots (3, 2P, nf) with dX, dY, theta."""
    out = np.empty((3, len(beams), pose.shape[1]))
    for k, h in enumerate((1e-6, 1e-6, 1e-6)):
        plus, minus = pose.copy(), pose.copy()
        plus[k] += h
        minus[k] -= h
        out[k] = (dots_on_plate(plus, beams, model.physics) - dots_on_plate(minus, beams, model.physics)) / (2.0 * h)
    return out


def _unwhiten(rows: FloatArray, ar: FloatArray) -> FloatArray:
    """Return the adjoint of whitening, without its scale, of one channel's rows (k, nf)."""
    out = rows.copy()
    for j in range(1, len(ar) + 1):
        out[:, :-j] -= ar[j - 1] * rows[:, j:]
    return out


def responses(ws: Workspace, fit: Fit) -> list[Response]:
    """How each recording answers to a term on each of its targets, beside the effects of ``fit``."""
    q, _ = np.linalg.qr(fit.jacobian / np.maximum(np.linalg.norm(fit.jacobian, axis=0), 1e-300))
    columns = [ws.split(c) for c in np.ascontiguousarray(q.T)]
    out = []
    targets, channels, variables = sought(ws.psds), 3 * ws.psds, variables_of(ws.psds)
    ws.tally.count += 1
    for i, size in enumerate(ws.fine):
        model, s = _variables(ws, fit.effects, i)
        p = model.physics
        nf = ws.measured[i].shape[1]
        values = {name: known(s, name) for name in variables}
        jacobian = _jacobian(fine_means(s.pose, size), fine_means(s.beams, size), model)
        jacobian = jacobian / p.sensitivity.reshape(1, -1, 1)
        noise = ws.noise[i]
        scale = np.sqrt(ws.count[i]) / noise.innovation[:, None]
        vectors = [ws.split(fit.residual)[i], *(c[i] for c in columns)]
        if noise.slow is not None:
            vectors = [noise.slow.whiten(v) for v in vectors]
        # Each vector, as it multiplies unwhitened fine blocks: (3P, 1 + p, nf).
        simulated = [np.stack([v[c] * scale[c] for v in vectors]) for c in range(channels)]
        back = np.stack([_unwhiten(rows, ar) for rows, ar in zip(simulated, noise.ar, strict=True)])
        gain = (scale * (1.0 - noise.ar.sum(axis=1))[:, None]) ** 2
        mixing = np.zeros((len(targets), channels, nf))
        for t, name in enumerate(targets):
            target = TARGETS[name]
            if target.point in ('static', 'pose'):
                mixing[t, ws.rows] = jacobian[target.row]
            elif target.of_sums:
                mixing[t, 3 * target.row + 2] = 1.0
            else:
                mixing[t, ws.rows[target.row]] = 1.0 / p.sensitivity.ravel()[target.row]
        weight = np.einsum('tcn,ckn->ntk', mixing, back).reshape(nf, -1)
        power = np.einsum('tcn,cn->tn', mixing**2, gain)
        direct = np.einsum('tcn,cn->tn', mixing, back[:, 0])
        bending = mode_coefficients(p.bending_frequency, p.bending_damping_ratio, p.period)
        torsion = mode_coefficients(p.torsion_frequency, p.torsion_damping_ratio, p.period)
        fine = p.period * size
        out.append(
            Response(
                values,
                p.period,
                size,
                weight,
                np.ascontiguousarray(power.T),
                direct / np.maximum(power, 1e-300),
                power,
                (bending, torsion),
                (round(1.0 / (p.bending_frequency * fine)), round(1.0 / (p.torsion_frequency * fine))),
                targets,
            )
        )
    return out


def _variables(ws: Workspace, effects: Sequence[ActiveEffect], i: int) -> tuple[ForwardModel, SimulatedSamples]:
    """Recording number ``i``, simulated with ``effects`` besides those of the rig file."""
    o = ws.observations[i]
    model = ForwardModel(o.rig, only_in(sort_effects([*ws.base, *ws.nuisance, *effects]), i))
    return model, model.run(o.acting, o.temperature)


def known_values(ws: Workspace, effects: Sequence[ActiveEffect], name: str) -> list[FloatArray]:
    """Block means of a variable of each recording, simulated with ``effects``."""
    out = []
    for i, o in enumerate(ws.observations):
        _, samples = _variables(ws, effects, i)
        out.append(fine_means(known(samples, name)[None, :], o.rig.estimator.block_size)[0])
    return out


def known_fine(ws: Workspace, effects: Sequence[ActiveEffect], name: str) -> list[FloatArray]:
    """Likewise as means over fine blocks."""
    return [fine_means(known(_variables(ws, effects, i)[1], name)[None, :], size)[0] for i, size in enumerate(ws.fine)]


def _deviation(parts: Sequence[FloatArray]) -> float:
    return float(np.max(np.abs(np.concatenate(parts))))


def _levels(parts: Sequence[FloatArray], count: int) -> list[float]:
    """Between the values that a variable takes, evenly by rank of the distinct ones."""
    values = np.concatenate(parts)
    low, high = float(values.min()), float(values.max())
    if high <= low:
        return []
    return [low + (high - low) * (k + 0.5) / count for k in range(count)]


def terms(responses_of_rig: Sequence[Response]) -> Iterator[LawTerm]:
    """Every term that is tried, with a grid for its shapes; variables that never change are left out."""
    parts = {name: [r.known[name] for r in responses_of_rig] for name in responses_of_rig[0].known}
    size = {name: _deviation(values) for name, values in parts.items()}
    moving = [n for n in parts if size[n] > 0.0]
    placed = [n for n in moving if n != 'time']
    for k in (1, 2, 3):
        for several in itertools.combinations_with_replacement(moving, k):
            if k < 3 or len(set(several)) == 1:
                yield LawTerm('product', several)
    for name in placed:
        yield from _where_it_is(name, parts[name], size[name])
    for name in placed:
        yield from _how_it_moves(name, size[name])
    for name in LOADS:
        if name in moving:
            for f in np.geomspace(2.0, 180.0, 48).tolist():
                yield LawTerm('resonance', (name,), shapes={'natural_frequency': f, 'zeta': 0.04})


def _where_it_is(name: str, parts: Sequence[FloatArray], size: float) -> Iterator[LawTerm]:
    """Terms of the value of one variable: its size and its thresholds."""
    yield LawTerm('absolute', (name,))
    yield LawTerm('signed_square', (name,))
    for level in _levels(parts, 8):
        yield LawTerm('above', (name,), shapes={'threshold': level})
        yield LawTerm('below', (name,), shapes={'threshold': level})
    for share in (0.05, 0.15, 0.3, 0.5, 0.7):
        yield LawTerm('excess', (name,), shapes={'threshold': share * size})
        yield LawTerm('within', (name,), shapes={'threshold': share * size})
    # Held loads take few values, and any threshold between two of them is the same.
    distinct = np.unique(np.concatenate(parts))
    few = [0.5 * (a + b) for a, b in itertools.pairwise(distinct.tolist())] if len(distinct) <= LEVELS else []
    for level in few or _levels(parts, LEVELS):
        yield LawTerm('over', (name,), shapes={'threshold': level})
        yield LawTerm('under', (name,), shapes={'threshold': level})


def _how_it_moves(name: str, size: float) -> Iterator[LawTerm]:
    """Terms of the rate and the history of one variable, and waves over it."""
    if name not in LOADS:
        yield LawTerm('rate', (name,))
        yield LawTerm('rate_absolute', (name,))
        yield LawTerm('drag', (name,))
    if name in LOADS or name in POSE:
        yield LawTerm('direction', (name,))
    for share in (0.02, 0.1, 0.3):
        yield LawTerm('play', (name,), shapes={'half_width': share * size})
    for tau in (0.02, 0.1, 0.3, 1.0, 3.0, 10.0):
        yield LawTerm('relaxed', (name,), shapes={'tau': tau})
        yield LawTerm('relaxed', (name, name), shapes={'tau': tau})
    if name in DOTS or name in POSE:
        for share in (0.2, 0.3, 0.45, 0.7, 1.0, 1.5):
            for phase in (0.0, 0.5 * math.pi):
                yield LawTerm('wave', (name,), shapes={'period': share * size, 'phase': phase})


@dataclass(frozen=True, slots=True)
class Scored:
    """A term with its coefficient to first order, and its gain in chi-square."""

    target: str
    term: LawTerm
    gain: float


def allowed(target: str, term: LawTerm) -> bool:
    """Return whether the term's variables are known where it acts."""
    return all(v in TARGETS[target].variables for v in term.depends_on)


def _blocks(r: Response, values: FloatArray) -> FloatArray:
    return np.asarray(fine_means(values[None, :], r.fine)[0])


def _way(target: str) -> int:
    """0: as it is; 1: through the mode of bending; 2: through that of torsion."""
    return 0 if TARGETS[target].point != 'static' else 2 if target == 'static_theta' else 1


def _through(r: Response, way: int, row: FloatArray) -> FloatArray:
    return row if way == 0 else np.asarray(lfilter(*r.modes[way - 1], row))


def score(responses_of_rig: Sequence[Response], listed: Sequence[LawTerm], targets: Sequence[str] = ()) -> list[Scored]:
    """Return each term on each of ``targets``, by default all, the best first."""
    out: list[Scored] = []
    every = responses_of_rig[0].targets
    targets, count, k = targets or every, len(every), responses_of_rig[0].weight.shape[1] // len(every)
    listed = [t for t in listed if any(allowed(name, t) for name in targets)]
    ways = sorted({_way(name) for name in targets})
    size = max(1, round(MANYFOLD * MAX_FINE) // len(responses_of_rig[0].error[0]))
    for start in range(0, len(listed), size):
        batch = listed[start : start + size]
        # In place, and through the modes of bending and torsion.
        totals = np.zeros((3, len(batch), count, k))
        lengths = np.zeros((3, len(batch), count))
        for r in responses_of_rig:
            rows = [t.evaluate(r.known.__getitem__, len(r.known['time']), r.period, {}) for t in batch]
            for way in ways:
                # Only loads and what is like them drive a mode.
                driving = [i for i, t in enumerate(batch) if way == 0 or allowed('static_dx', t)]
                if driving:
                    at = np.stack([_blocks(r, _through(r, way, rows[i])) for i in driving])
                    totals[way, driving] += (at @ r.weight).reshape(len(driving), count, k)
                    lengths[way, driving] += at**2 @ r.length
        for i, term in enumerate(batch):
            for t, name in enumerate(every):
                if name not in targets or not allowed(name, term):
                    continue
                way = _way(name)
                g, across = totals[way, i, t, 0], totals[way, i, t, 1:]
                f = lengths[way, i, t] - float(across @ across)
                if f > 1e-6 * lengths[way, i, t] > 0.0:
                    guess = LawTerm(term.form, term.of, float(g / f), term.shapes, term.times)
                    out.append(Scored(name, guess, float(g * g / f)))
    out.sort(key=lambda s: -s.gain)
    return out


def switchings(responses_of_rig: Sequence[Response], targets: Sequence[str] = ()) -> list[LawTerm]:
    """Terms that are on between times which the residual of the only recording shows, on ``targets``, by default all.

    The states are the likeliest of two levels, 0 and A (Viterbi's algorithm), with A fitted in turn. What the link
    rings after a switching is averaged over its period first, and the times are improved with the modes in the model.
    """
    scored: list[Scored] = []
    (r,) = responses_of_rig
    for t, name in enumerate(r.targets):
        if (targets and name not in targets) or TARGETS[name].point == 'static':
            continue
        dots_of_axis = [n for n in DOTS if name in DOTS and (n[1] == name[1])]
        on_link = TARGETS[name].point == 'pose'
        for of in ((), *((n,) for n in dots_of_axis)):
            v = _blocks(r, r.known[of[0]]) if of else np.ones(r.error.shape[1])
            error = _averaged(r.error[t], r.rings[int(name == 'theta')]) if on_link else r.error[t]
            times = two_levels(error, r.power[t] * v * v, v)
            if 0 < len(times) <= TRIED:
                term = LawTerm('switched', of, times=tuple(float(k * r.fine * r.period) for k in times))
                places = (name, f'static_{name}') if on_link else (name,)
                scored += score(responses_of_rig, [term], places)
    scored.sort(key=lambda s: -s.gain)
    better = [with_better_times(responses_of_rig, s.target, s.term) for s in scored[:MANY_EFFECTS]]
    return list({(t.of, t.times): t for t in better}.values())


def _averaged(values: FloatArray, blocks: int) -> FloatArray:
    """Means over ``blocks`` neighbours."""
    if blocks < 2:
        return values
    return np.asarray(np.convolve(values, np.ones(blocks) / blocks, mode='same'))


def with_better_times(responses_of_rig: Sequence[Response], target: str, term: LawTerm) -> LawTerm:
    """Return each time moved to where the term explains most on ``target``: by up to 0.08 s, then to a sample."""
    step = responses_of_rig[0].period
    for reach, pitch in ((0.08, 8.0 * step), (0.08, 8.0 * step), (8.0 * step, step)):
        for k in range(len(term.times)):
            tries = []
            for shift in np.arange(-reach, reach + 0.5 * pitch, pitch).tolist():
                times = [*term.times]
                times[k] = round(times[k] + shift, 9)
                if times == sorted(set(times)):
                    tries.append(LawTerm(term.form, term.of, times=tuple(times)))
            best = score(responses_of_rig, tries, (target,))
            if best:
                term = LawTerm(term.form, term.of, times=best[0].term.times)
    return term


def with_better_level(responses_of_rig: Sequence[Response], s: Scored) -> Scored:
    """Return the term with the threshold at which it explains most: no refit moves one at which the form jumps.

    It is the middle between the two values of the variable around it, which are as good; they are its uncertainty.
    """
    if 'threshold' not in FORMS[s.term.form].fixed:
        return s
    values = np.unique(np.concatenate([r.known[s.term.of[0]] for r in responses_of_rig]))
    best, reach = s, float(np.ptp(values)) / LEVELS
    for _ in range(3):
        middle = best.term.shapes['threshold']
        levels = (middle + reach * np.linspace(-1.0, 1.0, 17)).tolist()
        tries = [dataclasses.replace(best.term, shapes={'threshold': level}) for level in levels]
        best = max([best, *score(responses_of_rig, tries, (s.target,))], key=lambda t: t.gain)
        reach /= 8.0
    above = int(np.searchsorted(values, best.term.shapes['threshold']))
    if 0 < above < len(values):
        low, high = float(values[above - 1]), float(values[above])
        between = {'threshold': 0.5 * (low + high)}
        term = dataclasses.replace(best.term, shapes=between, sd={'threshold': (high - low) / math.sqrt(12.0)})
        best = dataclasses.replace(best, term=term)
    return best


def two_levels(error: FloatArray, weight: FloatArray, v: FloatArray) -> list[int]:
    """Where the state changes: ``error`` (nf,) is A v s with s 0 or 1, each with ``weight`` in units of A."""
    ratio = np.where(np.abs(v) > 1e-12, error / np.where(np.abs(v) > 1e-12, v, 1.0), 0.0)
    # The best box, on a coarse grid, gives the first A.
    step = max(1, len(ratio) // 240)
    p = np.concatenate(([0.0], np.cumsum(ratio * weight)))[::step]
    n = np.concatenate(([0.0], np.cumsum(weight)))[::step]
    top, below = p[None, :] - p[:, None], n[None, :] - n[:, None]
    gain = np.where(below > 1e-9 * n[-1], top**2 / np.maximum(below, 1e-9 * n[-1] + 1e-300), 0.0)
    a, b = np.unravel_index(int(np.argmax(np.triu(gain, 1))), gain.shape)
    if below[a, b] <= 0.0 or gain[a, b] < toggle_cost(len(ratio)):
        return []
    level = float(top[a, b] / below[a, b])
    for _ in range(4):
        state = likeliest_states(weight * level * (2.0 * ratio - level))
        on = state == 1
        if not on.any():
            return []
        level = float((ratio * weight)[on].sum() / max(float(weight[on].sum()), 1e-300))
    return [int(k) for k in np.flatnonzero(np.diff(state, prepend=0))]


def toggle_cost(blocks: int) -> float:
    """Return the chi-square that each switching must gain: any of the ``blocks`` might have been its time."""
    return 2.0 * math.log(blocks) + BIC_GAIN


def likeliest_states(gain: FloatArray) -> IntArray:
    """States (n,) 0 or 1 that gain most, each change for :func:`toggle_cost`; 0 before the first."""
    cost = toggle_cost(len(gain))
    off, on = 0.0, -cost
    came = np.empty((len(gain), 2), dtype=np.int64)
    for k, g in enumerate(gain.tolist()):
        from_on, from_off = on - cost, off - cost
        came[k, 0], came[k, 1] = int(from_on > off), int(on >= from_off)
        off, on = max(off, from_on), max(on, from_off) + g
    state = np.empty(len(gain), dtype=np.int64)
    now = int(on > off)
    for k in range(len(gain) - 1, -1, -1):
        state[k] = now
        now = int(came[k, now])
    return state


def most_jitter(
    ws: Workspace, fit: Fit, known: Mapping[str, Sequence[FloatArray]]
) -> tuple[tuple[float, str, str, float, float] | None, int]:
    """Gain, channel, variable, slope and its greatest square, where the noise follows a variable most; how many were
    tried.
    """
    best: tuple[float, str, str, float, float] | None = None
    tried = 0
    for c, channel in enumerate(channel_names(ws.psds)):
        squares = np.concatenate([part[c] for part in ws.split(fit.residual)]) ** 2
        there = squares > 0.0
        for name, values in known.items():
            v2 = np.concatenate(values) ** 2
            full = float(v2.max())
            if full <= 0.0:
                continue
            tried += 1
            a, b = variance(squares[there], v2[there] / full)
            gain = likelihood(squares[there], a + b * v2[there] / full) - likelihood(
                squares[there], squares[there].mean()
            )
            if best is None or gain > best[0]:
                best = gain, channel, name, b / full, full
    return best, tried


def likelihood(squares: FloatArray, variance: FloatArray | float) -> float:
    """Twice the log-likelihood of whitened values, up to a constant."""
    v = np.broadcast_to(np.asarray(variance), squares.shape)
    return float(-np.sum(np.log(v) + squares / v))


def variance(squares: FloatArray, v2: FloatArray) -> tuple[float, float]:
    """a and b of variance = a + b v2, the likeliest: weighted least squares on the squares, in turn."""
    a, b = float(squares.mean()), 0.0
    columns = np.stack([np.ones_like(v2), v2], axis=1)
    for _ in range(8):
        weight = 1.0 / (a + b * v2)
        solution = np.linalg.lstsq(columns * weight[:, None], squares * weight, rcond=None)[0]
        a, b = max(float(solution[0]), 0.05), max(float(solution[1]), 0.0)
    return a, b
