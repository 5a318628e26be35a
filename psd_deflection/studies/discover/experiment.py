# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a rig can be asked to do, and how well it would tell two explanations apart: the chi-square that remains when
one is fitted to what the other predicts (T-optimality, Atkinson and Fedorov, Biometrika 62 (1975) 57)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from psd_deflection.model.simulation.catalogue import sort_effects
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.loads import SIDEBAR_ARM, load_history, temperature_table
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig, replace_values
from psd_deflection.studies.discover.hidden import only_in
from psd_deflection.studies.discover.search.fit import Fit
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.thresholds import MOST, STEP
from psd_deflection.studies.loads.plate_motion import fine_means
from psd_deflection.studies.loads.thresholds import FINE_SECONDS

START_CELSIUS = 20.0
SWINGS = (0.0, 0.5, 1.0, 0.5, 0.0, -0.5, -1.0, -0.5, 0.0)
"""Course of the temperature in a recording in which it swings, over the swing."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What the rig may be asked to do.

    ``force`` N; ``torque`` N m; ``sidebar``: farthest place of a weight from the link, m; ``sideways``: whether forces
    may pull along X and up as well as down; ``sweep``: highest frequency of an exciter, Hz, 0 for none; ``swing``: by
    how much the temperature can be raised and lowered, K; ``lengths``: of links that can be mounted, m, None for 0.7 of
    the rig's; ``rates``: further sample rates, Hz; ``seconds``: longest recording.
    """

    force: float = 50.0
    torque: float = 29.25
    sidebar: float = SIDEBAR_ARM
    sideways: bool = True
    sweep: float = 150.0
    swing: float = 10.0
    lengths: tuple[float, ...] | None = None
    rates: tuple[float, ...] = ()
    seconds: float = 60.0


@dataclass(frozen=True, slots=True)
class Setting:
    """How a whole recording is made: ``changes`` of the rig file, and ``swing`` of the temperature, K."""

    words: str = ''
    changes: Mapping[str, object] = field(default_factory=dict)
    swing: float = 0.0
    effort: float = 0.0

    def temperature(self, n: int) -> FloatArray | None:
        """(n,) degrees Celsius, or None if it is constant."""
        return temperature_table(self.knots, n) if self.swing else None

    @property
    def knots(self) -> list[float]:
        """Degrees Celsius, evenly over the recording, straight lines between them."""
        return [START_CELSIUS + self.swing * s for s in SWINGS] if self.swing else [START_CELSIUS]


@dataclass(frozen=True, slots=True)
class Piece:
    """Part of a recording. ``script``: its loads in the notation of ``simulate --loads``; ``words``: for people."""

    words: str
    script: tuple[str, ...]

    def loads(self, rate: float) -> FloatArray:
        """(n, 3) N, N, N m."""
        return np.concatenate([load_history(s, rate).loads for s in self.script])


@dataclass(frozen=True, slots=True)
class Proposal:
    """A piece in a setting."""

    setting: Setting
    piece: Piece


def _load(fx: float, fy: float, tz: float) -> str:
    return ','.join(f'{round(v, 3) + 0.0:g}' for v in (fx, fy, tz))


def _steps(levels: Sequence[tuple[float, float, float]], dwell: float) -> str:
    return f'steps:{";".join(_load(*level) for level in levels)}:{dwell:g}'


def settings(rig: Rig, limits: Limits) -> list[Setting]:
    """Ways to make a recording, the rig as it is first."""
    out = [Setting()]
    if limits.swing > 0.0:
        out.append(Setting(f'while the temperature swings by +-{limits.swing:g} K', swing=limits.swing, effort=0.03))
    arm_length = rig.link.length
    lengths = (round(0.7 * arm_length, 3),) if limits.lengths is None else limits.lengths
    for length in lengths:
        if not math.isclose(length, arm_length):
            out.append(Setting(f'on a link of {length:.2f} m', {'link.length': length}, effort=0.05))
    for rate in limits.rates:
        if not math.isclose(rate, rig.converter.sample_rate_hz):
            out.append(Setting(f'at {rate:g} samples/s', {'converter.sample_rate_hz': rate}, effort=0.02))
    return out


def pieces(rig: Rig, limits: Limits) -> list[Piece]:
    """What can be done to a link, 8 to 40 s each, with the dots on the sensors."""
    physics = Physics.of(rig)
    edge = np.minimum(physics.half_area, physics.full_scale * physics.sensitivity) - np.abs(rig.zeros)
    room = MOST * float(edge.min())
    reach = float(np.hypot(*rig.centers.T).max())
    f = min(limits.force, room / physics.force_compliance)
    t = min(limits.torque, room / max(physics.torque_compliance * reach, 1e-12))
    arm = limits.sidebar
    # Its pull and its twist move the dots the same way.
    both = physics.force_compliance + arm * physics.torque_compliance * reach
    on_bar = min(limits.force, room / both) if arm > 0.0 else 0.0
    zero = (0.0, 0.0, 0.0)
    out: list[Piece] = []
    down: list[tuple[float, float, float]] = [zero, (0.0, -f, 0.0), zero, (0.0, -0.5 * f, 0.0), zero]
    around = [zero, (0.0, -f, 0.0), zero, (0.0, f, 0.0), zero, (f, 0.0, 0.0), zero, (-f, 0.0, 0.0), zero]
    if f > 0.0 and limits.sideways:
        out.append(Piece(f'{f:.3g} N along -Y, +Y, +X and -X in turn, on the link itself', (_steps(around, 1.5),)))
    elif f > 0.0:
        out.append(Piece(f'weights of {f:.3g} N and half of it on the link itself', (_steps(down, 2.0),)))
    if t > 0.0 and limits.sideways:
        out.append(
            Piece(f'pure torque of +-{t:.3g} N m', (_steps([zero, (0.0, 0.0, t), zero, (0.0, 0.0, -t), zero], 2.0),))
        )
        g, u = 0.5 * f, 0.6 * t
        corners = [zero, (g, g, u), (-g, g, -u), (-g, -g, u), (g, -g, -u), (g, g, -u), (-g, -g, -u), zero]
        out.append(Piece(f'{g:.3g} N along both axes with {u:.3g} N m, in all corners', (_steps(corners, 1.5),)))
    if on_bar > 0.0:
        bar = [zero, (0.0, -on_bar, -on_bar * arm), zero, (0.0, -on_bar, on_bar * arm), zero]
        out.append(
            Piece(f'{on_bar:.3g} N on the sidebar, {arm:.3g} m to the right and to the left', (_steps(bar, 2.0),))
        )
    shares = (0.0, 0.25, 0.5, 0.75, 1.0, 0.75, 0.5, 0.25, 0.0)
    if f > 0.0:
        climbed = [(0.0, -s * f, 0.0) for s in shares]
        out.append(Piece(f'up to {f:.3g} N along -Y in four steps and down again', (_steps(climbed, 1.5),)))
    if limits.sideways and f > 0.0:
        climbed = [(s * f, 0.0, 0.0) for s in shares]
        out.append(Piece(f'up to {f:.3g} N along +X in four steps and down again', (_steps(climbed, 1.5),)))
    if limits.sideways and t > 0.0:
        climbed = [(0.0, 0.0, s * t) for s in shares]
        out.append(Piece(f'up to {t:.3g} N m in four steps and down again', (_steps(climbed, 1.5),)))
    if f > 0.0:
        long = min(24.0, 0.6 * limits.seconds)
        held = (
            f'constant:{_load(*zero)}:1',
            f'constant:{_load(0.0, -0.8 * f, -0.3 * t if limits.sideways else 0.0)}:{long:g}',
            f'constant:{_load(*zero)}:{0.6 * long:g}',
        )
        out.append(Piece(f'{0.8 * f:.3g} N held for {long:g} s, then {0.6 * long:g} s unloaded', held))
    still = min(30.0, limits.seconds)
    out.append(Piece(f'{still:g} s unloaded', (f'constant:{_load(*zero)}:{still:g}',)))
    low, high = min(40.0, limits.sweep), min(limits.sweep, 0.4 * rig.converter.sample_rate_hz)
    if low > 2.0:
        sizes = _load(0.06 * f, 0.06 * f, 0.07 * t)
        out.append(Piece(f'a sweep from 2 to {low:g} Hz on both axes and in torsion', (f'chirp:{sizes}:2,{low:g}:15',)))
    if high > 45.0:
        sizes = _load(0.3 * f, 0.3 * f, 0.3 * t)
        words = f'a sweep from 40 to {high:g} Hz on both axes and in torsion'
        out.append(Piece(words, (f'chirp:{sizes}:40,{high:g}:12',)))
    return out


def proposals(rig: Rig, limits: Limits) -> list[Proposal]:
    """Return every piece in every setting, those that fit into the longest recording."""
    out = []
    for setting in settings(rig, limits):
        changed = replace_values(rig, setting.changes) if setting.changes else rig
        rate = changed.converter.sample_rate_hz
        out += [
            Proposal(setting, piece)
            for piece in pieces(changed, limits)
            if len(piece.loads(rate)) <= limits.seconds * rate + 1.0
        ]
    return out


@dataclass(frozen=True, slots=True, eq=False)
class ModelSums:
    """What a recording shows of some models, all sums over its readings, in units of the noise.

    ``apart`` (m, m): squared distance of the predictions of two models. ``pull`` [a][b] (p_b,): the distance from b to
    a along the derivatives of b. ``fisher`` [b] (p_b, p_b): these derivatives' products. ``seconds``: duration.
    """

    apart: FloatArray
    pull: list[list[FloatArray]]
    fisher: list[FloatArray]
    seconds: float

    def __add__(self, other: ModelSums) -> ModelSums:
        return ModelSums(
            self.apart + other.apart,
            [[x + y for x, y in zip(a, b, strict=True)] for a, b in zip(self.pull, other.pull, strict=True)],
            [x + y for x, y in zip(self.fisher, other.fisher, strict=True)],
            self.seconds + other.seconds,
        )

    def __mul__(self, times: float) -> ModelSums:
        return ModelSums(
            times * self.apart,
            [[times * x for x in a] for a in self.pull],
            [times * x for x in self.fisher],
            times * self.seconds,
        )

    def separation(self, true: int, assumed: int, known: FloatArray) -> float:
        """Return chi-square of models ``true`` and ``assumed``, whose parameters adapt; ``known`` (p, p): the curvature
        of the old data about it.
        """
        pull = self.pull[true][assumed]
        if not len(pull):
            return float(self.apart[true, assumed])
        f = self.fisher[assumed] + known
        lengths = np.sqrt(np.maximum(np.diag(f), 1e-300))
        g = pull / lengths
        step = np.linalg.lstsq(f / np.outer(lengths, lengths), g, rcond=1e-10)[0]
        return max(float(self.apart[true, assumed] - g @ step), 0.0)


def nothing_of(models: Sequence[Fit]) -> ModelSums:
    """What a recording of no samples shows."""
    sizes = [len(m.free) for m in models]
    return ModelSums(
        np.zeros((len(models), len(models))),
        [[np.zeros(k) for k in sizes] for _ in models],
        [np.zeros((k, k)) for k in sizes],
        0.0,
    )


def expected_sums(
    workspace: Workspace, models: Sequence[Fit], setting: Setting, loads: FloatArray, rig: Rig | None = None
) -> ModelSums:
    """What a recording with ``loads`` (n, 3) in ``setting`` would show of ``models``.

    Noise is that of the first recording so far. ``rig``: that of the recording, if it is at hand.
    """
    first = workspace.observations[0].rig
    if rig is None:
        rig = replace_values(first, setting.changes) if setting.changes else first
    rate = rig.converter.sample_rate_hz
    size = max(1, round(FINE_SECONDS * rate))
    sigma = workspace.noise[0].innovation * math.sqrt(workspace.fine[0] / size)
    temperature = setting.temperature(len(loads))
    number = len(workspace.observations)

    def white(effects: Sequence[ActiveEffect]) -> FloatArray:
        workspace.tally.count += 1
        active = only_in(sort_effects([*workspace.base, *effects]), number)
        chunk = ForwardModel(rig, active).expect(loads, temperature)
        return (fine_means(chunk.volts, size) / sigma[:, None]).ravel()

    rows, slopes = [], []
    for model in models:
        there = white(model.effects)
        columns = np.zeros((len(there), len(model.free)))
        for j, (i, name) in enumerate(model.free):
            if i < 0:
                # How another recording began does not show in this one.
                continue
            parameter = model.effects[i].effect.parameter(name)
            h = STEP * parameter.scale
            if model.effects[i].values[name] + h > parameter.maximum:
                h = -h
            moved = list(model.effects)
            moved[i] = ActiveEffect(moved[i].effect, {**moved[i].values, name: moved[i].values[name] + h})
            columns[:, j] = (white(moved) - there) / h
        rows.append(there)
        slopes.append(columns)
    apart = np.array([[float(np.sum((a - b) ** 2)) for b in rows] for a in rows])
    pull = [[c.T @ (a - b) for b, c in zip(rows, slopes, strict=True)] for a in rows]
    return ModelSums(apart, pull, [c.T @ c for c in slopes], len(loads) / rate)


def limits_to_tree(limits: Limits) -> dict[str, Any]:
    """Return the limits as result.json has them."""
    return {
        'force_n': limits.force,
        'torque_nm': limits.torque,
        'sidebar_m': limits.sidebar,
        'sideways': limits.sideways,
        'sweep_hz': limits.sweep,
        'swing_k': limits.swing,
        'lengths_m': None if limits.lengths is None else list(limits.lengths),
        'rates_hz': list(limits.rates),
        'seconds': limits.seconds,
    }
