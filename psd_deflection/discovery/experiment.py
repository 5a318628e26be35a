"""Finds an experiment that distinguishes two explanations, by simulating both within the rig's limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from psd_deflection.config import Rig, replace_values
from psd_deflection.discovery.fit import STEP, Fit
from psd_deflection.discovery.workspace import Workspace, fine_means
from psd_deflection.records import FloatArray
from psd_deflection.simulation import loads
from psd_deflection.simulation.catalogue import sort_effects
from psd_deflection.simulation.declaration import ActiveEffect
from psd_deflection.simulation.loads import LoadHistory
from psd_deflection.simulation.simulator import ForwardModel

TELLS_APART = 21.6
"""lambda sin^2(theta) from which two effects are told apart: lambda sin^2(theta/2) >= 5.4, small angles."""


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """An experiment: what to do, in words, and as loads, temperatures (K above the start) and rig."""

    words: str
    loads: LoadHistory
    warmer: FloatArray | None
    changes: dict[str, object]


@dataclass(frozen=True, slots=True)
class Suggestion:
    """``separation``: smallest chi-square between the alternatives; below ``TELLS_APART`` the experiment is not
    enough.
    """

    words: str
    separation: float

    @property
    def text(self) -> str:
        """The suggestion as text, for people and result.json."""
        if self.separation < TELLS_APART:
            return (
                f'none of the experiments tried tells them apart; the best, {self.words}, separates by chi-square '
                f'{self.separation:.1f} (needed: {TELLS_APART})'
            )
        return f'{self.words}: in simulation this separates them by chi-square {self.separation:.0f}'


def proposals(rig: Rig) -> list[Proposal]:
    """Experiments that a rig like the thesis's can do, 10 to 40 s each, with the dots on the sensors."""
    rate = rig.converter.sample_rate_hz
    zero = (0.0, 0.0, 0.0)
    up = [zero, (0.0, -50.0, 0.0), zero, (0.0, 50.0, 0.0), zero, (50.0, 0.0, 0.0), zero, (-50.0, 0.0, 0.0), zero]
    twist = [zero, (0.0, 0.0, 29.0), zero, (0.0, 0.0, -29.0), zero]
    stairs = [zero, *((0.0, -f, -0.2 * f) for f in (20.0, 40.0, 60.0, 40.0, 20.0)), zero]
    hold = loads.constant(zero, 1.0, rate).then(loads.constant((0.0, -40.0, -10.0), 24.0, rate))
    hold = hold.then(loads.constant(zero, 15.0, rate))
    still = loads.constant(zero, 30.0, rate)
    warm = 10.0 * np.sin(np.linspace(0.0, 3.0 * np.pi, len(still)))
    steps = loads.steps(up, 1.5, rate)
    twisted = loads.steps(twist, 2.0, rate)
    climbed = loads.steps(stairs, 2.0, rate)
    swept = loads.chirp((3.0, 3.0, 2.0), 2.0, 40.0, 20.0, rate)
    shorter = 0.7 * rig.link.length
    # A shorter link has higher frequencies. They are kept here, so only the statics differ.
    both = loads.steps([zero, (0.0, -50.0, 0.0), (50.0, 0.0, 0.0), (0.0, 0.0, 25.0), zero], 3.0, rate)
    return [
        Proposal('weights of 50 N pulling along +-Y and +-X in turn, on the link itself', steps, None, {}),
        Proposal('pure torque of +-29 N m', twisted, None, {}),
        Proposal('20, 40, 60 N up and down again in steps, 0.2 m off the link', climbed, None, {}),
        Proposal('40 N held for 24 s at constant temperature, then 15 s unloaded', hold, None, {}),
        Proposal('30 s unloaded at constant temperature', still, None, {}),
        Proposal('30 s unloaded while the temperature swings by +-10 K', still, warm, {}),
        Proposal(
            'a sweep from 2 to 40 Hz on both axes and in torsion',
            swept,
            None,
            {},
        ),
        Proposal(f'the same weights on a link of {shorter:.2f} m', both, None, {'link.length': shorter}),
    ]


def _white(rig: Rig, effects: Sequence[ActiveEffect], p: Proposal, size: int, sigma: FloatArray) -> FloatArray:
    temperature = None if p.warmer is None else 20.0 + p.warmer
    chunk = ForwardModel(rig, sort_effects(effects)).expect(p.loads.loads, temperature)
    return (fine_means(chunk.volts, size) / sigma[:, None]).ravel()


def suggest(workspace: Workspace, named: Fit, others: Sequence[Fit]) -> Suggestion | None:
    """The experiment that best separates ``named`` from the worst of ``others``, added to the existing recordings.

    Each alternative may adapt its parameters to the old data and the new together.
    """
    if not others:
        return None
    rig = workspace.observations[0].rig
    size, noise = workspace.fine[0], workspace.noise[0]
    base = list(workspace.base)
    best: Suggestion | None = None
    for p in proposals(rig):
        changed = replace_values(rig, p.changes) if p.changes else rig
        truth = _white(changed, [*base, *named.effects], p, size, noise.innovation)
        worst = np.inf
        for other in others:
            there = _white(changed, [*base, *other.effects], p, size, noise.innovation)
            workspace.simulations += 2
            r = truth - there
            columns = np.empty((len(r), len(other.free)))
            for j, (i, name) in enumerate(other.free):
                parameter = other.effects[i].effect.parameter(name)
                h = STEP * parameter.scale
                if other.effects[i].values[name] + h > parameter.maximum:
                    h = -h
                moved = list(other.effects)
                moved[i] = ActiveEffect(moved[i].effect, {**moved[i].values, name: moved[i].values[name] + h})
                columns[:, j] = (_white(changed, [*base, *moved], p, size, noise.innovation) - there) / h
                workspace.simulations += 1
            lengths = np.sqrt(np.sum(columns**2, axis=0) + np.sum(other.jacobian**2, axis=0)) + 1e-150
            c, old = columns / lengths, other.jacobian / lengths
            g = c.T @ r
            step = np.linalg.lstsq(c.T @ c + old.T @ old, g, rcond=1e-10)[0]
            worst = min(worst, float(r @ r - g @ step))
        if best is None or worst > best.separation:
            best = Suggestion(p.words, float(worst))
    return best
