# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where simulation and data differ: energy per channel, load case and frequency band against a bootstrap of the largest
cell, and how much of each channel follows a regressor (loads, rate, history, dot position, temperature, time)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2 as chi2_law

from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.records import FloatArray, IntArray, channel_names
from psd_deflection.studies.discover.hidden import only_in
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.thresholds import BANDS, CERTAIN_SD, DRAWS, P_CHANCE
from psd_deflection.studies.loads.plate_motion import fine_means
from psd_deflection.studies.loads.thresholds import SIMULATION_ERROR


@dataclass(frozen=True, slots=True)
class Cell:
    """One entry of the ``where`` list; ``statistic``: standard deviations above noise."""

    channel: str
    recording: int
    when: tuple[float, float]
    band: tuple[float, float]
    depends_on: tuple[str, ...]
    statistic: float
    p: float
    energy: float


@dataclass(frozen=True, slots=True)
class Dependence:
    """How much of ``channel`` follows ``regressor``: ``gain`` in chi-square, library-wide ``p``."""

    channel: str
    regressor: str
    gain: float
    p: float


@dataclass(frozen=True, slots=True, eq=False)
class Localisation:
    """Cells, most conspicuous first; dependences likewise. ``excess``:
    chi-square beyond noise in all significant places; ``p``: probability that noise alone gives
    this. ``map`` (spans, channels, bands): all cells; ``spans``: recording, start and end of each load
    case, s."""

    cells: tuple[Cell, ...]
    dependences: tuple[Dependence, ...]
    excess: float
    p: float
    map: FloatArray
    spans: tuple[tuple[int, float, float], ...]


NOWHERE = Localisation((), (), 0.0, 1.0, np.zeros((0, 0, 0)), ())
"""Nobody has looked."""


@dataclass(frozen=True, slots=True, eq=False)
class _Layout:
    recording: int
    start: int
    stop: int
    period: float
    bins: tuple[IntArray, ...]


def _layouts(workspace: Workspace) -> list[_Layout]:
    out = []
    for r, (case, o, size) in enumerate(zip(workspace.case, workspace.observations, workspace.fine, strict=True)):
        period = o.period * size
        edges = np.concatenate(([0], np.flatnonzero(np.diff(case)) + 1, [len(case)]))
        for a, b in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            if b - a < 8:
                continue
            f = np.fft.rfftfreq(b - a, period)
            bins = tuple(
                np.flatnonzero((f >= lo) & (f < hi)) for lo, hi in zip(BANDS[:-1], (*BANDS[1:-1], np.inf), strict=True)
            )
            out.append(_Layout(r, a, b, period, bins))
    return out


def _power(x: FloatArray) -> FloatArray:
    """Energy (k, frequencies) of rows (k, n), with the sum of their squares."""
    n = x.shape[1]
    power = np.abs(np.fft.rfft(x, axis=1)) ** 2 * (2.0 / n)
    power[:, 0] *= 0.5
    if n % 2 == 0:
        power[:, -1] *= 0.5
    return np.asarray(power)


def _energies(
    parts: list[FloatArray], layouts: list[_Layout], explained: list[FloatArray] | None = None
) -> tuple[FloatArray, FloatArray]:
    """z and excess energy (layout, channel, band), beyond what the simulation of ``explained`` may be wrong by."""
    z = np.full((len(layouts), len(parts[0]), len(BANDS) - 1), -9.0)
    excess = np.zeros_like(z)
    for i, layout in enumerate(layouts):
        span = slice(layout.start, layout.stop)
        power = _power(parts[layout.recording][:, span])
        wrong = None if explained is None else SIMULATION_ERROR**2 * _power(explained[layout.recording][:, span])
        n = layout.stop - layout.start
        for band, index in enumerate(layout.bins):
            if len(index) == 0:
                continue
            dof = 2.0 * len(index) - float(0 in index) - float(n % 2 == 0 and n // 2 in index)
            energy = power[:, index].sum(axis=1)
            if wrong is not None:
                energy = energy / (1.0 + wrong[:, index].sum(axis=1) / dof)
            # Wilson-Hilferty: chi-square to a normal deviate, good into the tail.
            z[i, :, band] = (np.cbrt(energy / dof) - (1.0 - 2.0 / (9.0 * dof))) / np.sqrt(2.0 / (9.0 * dof))
            excess[i, :, band] = energy - dof
    return z, excess


def regressors(workspace: Workspace) -> list[tuple[str, dict[str, list[FloatArray]]]]:
    """Per channel, per name, per recording: regressors of a residual, on fine blocks (nf,)."""
    out: list[dict[str, list[FloatArray]]] = [{} for _ in range(workspace.psds)]
    for i, (o, size) in enumerate(zip(workspace.observations, workspace.fine, strict=True)):
        chunk = ForwardModel(o.rig, only_in([*workspace.base, *workspace.nuisance], i)).run(o.acting, o.temperature)
        dots, loads = fine_means(chunk.dots, size) * 1e3, fine_means(chunk.loads, size)
        n = dots.shape[1]
        changes = np.sign(np.diff(chunk.loads, axis=1, prepend=chunk.loads[:, :1]))
        history = np.empty_like(changes)
        for row in range(3):
            last = np.maximum.accumulate(np.where(changes[row] != 0.0, np.arange(changes.shape[1]), 0))
            history[row] = changes[row][last]
        history = fine_means(history, size)
        time = np.arange(n) / n
        warmer = np.zeros(n) if o.temperature is None else fine_means(chunk.warmer[None, :], size)[0]
        axes = ('fx', 'fy', 'tz')
        for psd, columns_of_psd in enumerate(out):
            x, y = dots[2 * psd], dots[2 * psd + 1]
            named = {
                'constant': np.ones(n),
                'time': time,
                'time^2': time**2,
                **{f'load_{axis}': load for axis, load in zip(axes, loads, strict=True)},
                **{f'load_{axis}^2': load**2 for axis, load in zip(axes, loads, strict=True)},
                'dot_x': x,
                'dot_y': y,
                'dot_x^2': x * x,
                'dot_x dot_y': x * y,
                'dot_y^2': y * y,
                'dot_x r^2': x * (x * x + y * y),
                'dot_y r^2': y * (x * x + y * y),
                '|dot_x|': np.abs(x),
                '|dot_y|': np.abs(y),
                'rate of dot_x': np.gradient(x),
                'rate of dot_y': np.gradient(y),
                '|rate of dot_x|': np.abs(np.gradient(x)),
                '|rate of dot_y|': np.abs(np.gradient(y)),
                **{f'history of load_{axis}': last for axis, last in zip(axes, history, strict=True)},
                'temperature': warmer,
                'temperature^2': warmer**2,
            }
            for name, values in named.items():
                columns_of_psd.setdefault(name, []).append(values)
    return [(channel, out[c // 3]) for c, channel in enumerate(channel_names(workspace.psds))]


def dependences(
    workspace: Comparison,
    table: Sequence[tuple[str, Mapping[str, Sequence[FloatArray]]]],
    residual: FloatArray,
    known: FloatArray | None,
    explained: FloatArray | None = None,
) -> list[Dependence]:
    """Return every channel against every regressor, after projecting out ``known`` (D, p).

    ``table``: the name of each channel, and its regressors. What the simulation of ``explained`` (D,) may be wrong by
    does not count.
    """
    q = None
    if known is not None and known.shape[1]:
        q, _ = np.linalg.qr(known / np.maximum(np.linalg.norm(known, axis=0), 1e-300))
    relations: list[tuple[str, str, float]] = []
    for c, (channel, named) in enumerate(table):
        names = list(named)
        matrix = np.stack([workspace.row(c, values) for values in named.values()], axis=1)
        e = np.concatenate([part[c] for part in workspace.split(residual)])
        lengths = np.einsum('ij,ij->j', matrix, matrix)
        g = matrix.T @ e
        wrong = 0.0
        if explained is not None:
            channel_values = np.concatenate([part[c] for part in workspace.split(explained)])
            wrong = SIMULATION_ERROR * np.sqrt(lengths) * np.linalg.norm(channel_values)
        f = lengths.copy()
        if q is not None:
            fitted = np.stack([np.concatenate([part[c] for part in workspace.split(col)]) for col in q.T])
            across = matrix.T @ fitted.T
            f = f - np.einsum('ij,ij->i', across, across)
            g = g - across @ (q.T @ residual)
        g = np.maximum(np.abs(g) - wrong, 0.0)
        for k, name in enumerate(names):
            if lengths[k] > 0.0 and f[k] > 1e-6 * lengths[k]:
                relations.append((channel, name, float(g[k] ** 2 / f[k])))
    count = len(relations)
    out = [
        Dependence(ch, name, gain, float(-np.expm1(count * np.log1p(-min(float(chi2_law.sf(gain, 1)), 1 - 1e-16)))))
        for ch, name, gain in relations
    ]
    out.sort(key=lambda d: -d.gain)
    return out


def localise(
    workspace: Workspace,
    residual: FloatArray,
    known: FloatArray | None,
    rng: np.random.Generator,
    limit: int = 12,
    explained: FloatArray | None = None,
) -> Localisation:
    """Where ``residual`` (D,), whitened, has structure; ``known`` (D, p): columns already fitted.

    ``explained`` (D,): what the effects of the model explain; a small share of it may be the simulation's own error.
    """
    layouts = _layouts(workspace)
    apart = None if explained is None else workspace.split(explained)
    z, _ = _energies(workspace.split(np.clip(residual, -CERTAIN_SD, CERTAIN_SD)), layouts, apart)
    raw_z, raw_excess = _energies(workspace.split(residual), layouts, apart)
    maxima = np.empty(DRAWS)
    q = None
    if known is not None:
        q, _ = np.linalg.qr(known / np.maximum(np.linalg.norm(known, axis=0), 1e-300))
    present = (workspace.replaced(free=None).whiten([np.ones_like(m) for m in workspace.measured]) != 0.0).astype(
        np.float64
    )
    for draw in range(DRAWS):
        e = rng.standard_normal(len(residual), dtype=np.float32) * present
        if q is not None:
            e -= q @ (q.T @ e)
        maxima[draw] = _energies(workspace.split(e), layouts)[0].max()
    # Gumbel law of the maximum, by moments: a p below 1/DRAWS without thousands of draws.
    beta = float(np.std(maxima)) * np.sqrt(6.0) / np.pi
    mu = float(np.mean(maxima)) - 0.5772 * beta

    def p_of(value: float) -> float:
        return float(-np.expm1(-np.exp(-max((value - mu) / beta, -5.0))))

    depends = dependences(workspace, regressors(workspace), residual, known, explained)
    main: dict[str, list[str]] = {}
    for d in depends:
        if d.p < P_CHANCE and len(main.setdefault(d.channel, [])) < 2:
            name = plain_word(d.regressor)
            if name not in main[d.channel]:
                main[d.channel].append(name)
    order, channels = np.argsort(-z, axis=None), channel_names(workspace.psds)
    cells = []
    for flat in order[:limit].tolist():
        i, c, b = np.unravel_index(flat, z.shape)
        layout = layouts[int(i)]
        value = float(z[i, c, b])
        # The clipped statistic decides significance; the unclipped one ranks clear cases better.
        shown = float(raw_z[i, c, b]) if p_of(value) < P_CHANCE else value
        when = (layout.start * layout.period, layout.stop * layout.period)
        band = (BANDS[int(b)], min(BANDS[int(b) + 1], 0.5 / layout.period))
        channel = channels[int(c)]
        names = tuple(main.get(channel, [])) if BANDS[int(b)] < BANDS[4] else ()
        cells.append(Cell(channel, layout.recording, when, band, names, shown, p_of(value), float(raw_excess[i, c, b])))
    cells.sort(key=lambda cell: -cell.statistic)
    significant = np.array([p_of(v) < P_CHANCE for v in z.ravel()])
    total = float(raw_excess.ravel()[significant].sum())
    total = max(total, depends[0].gain if depends and depends[0].p < P_CHANCE else 0.0)
    p = min(1.0, 2.0 * min(p_of(float(z.max())), depends[0].p if depends else 1.0))
    spans = tuple((x.recording, x.start * x.period, x.stop * x.period) for x in layouts)
    return Localisation(tuple(cells), tuple(depends), total, p, raw_z, spans)


def plain_word(regressor: str) -> str:
    """Return the word of result.json for a regressor: a load, its rate, the dot's position, temperature, time."""
    for word in ('load_fx', 'load_fy', 'load_tz'):
        if word in regressor:
            return word
    if 'rate' in regressor:
        return 'rate'
    if 'dot' in regressor:
        return 'dot_position'
    return regressor.split('^')[0]
