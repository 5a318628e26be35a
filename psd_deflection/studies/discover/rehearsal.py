# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A measured confidence: the found model is simulated with the loads, gaps and noise of the recording, and the search
runs again on each simulation. Every rehearsal has a noise of its own."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from psd_deflection.base.errors import ConfigError
from psd_deflection.model.simulation.catalogue import sort_effects
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.recordings.observation import Observation
from psd_deflection.records import FloatArray
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.discover.hidden import RIG_NUMBERS, SETUP, only_in
from psd_deflection.studies.discover.noise import NoiseModel
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.loads.thresholds import MINOR

if TYPE_CHECKING:
    from psd_deflection.studies.discover.conclusion import Conclusion, RigConclusion

COMPETING = SETUP | {'load_value', 'load_unit'}
"""Mistakes that imitate effects."""


class Named(NamedTuple):
    """An effect or mistake; ``equivalent``: names of what explains the data as well; ``sd``: of the fitted values."""

    name: str
    label: str
    equivalent: tuple[str, ...] = ()
    values: Mapping[str, float] = {}
    sd: Mapping[str, float] = {}


UNKNOWN = Named('unknown effect', 'unknown effect')


def named_by(answer: Conclusion) -> tuple[Named, ...]:
    """Return what a search named: effects, mistakes that compete with them, and an unknown effect."""
    effects = [Named(e.name, e.active.label, e.equivalent, e.values, e.sd) for e in answer.effects]
    competing = [f for f in getattr(answer, 'setup', ()) if f.name in COMPETING]
    mistakes = {f.name: Named(f.name, f.name, f.equivalent) for f in competing}
    return (*effects, *mistakes.values(), *([UNKNOWN] if answer.unknown else []))


class RehearsalOutcome(NamedTuple):
    """``named``: by one rehearsal. ``error``: why it ended early, '' if it did not."""

    named: tuple[Named, ...] = ()
    error: str = ''


@dataclasses.dataclass(frozen=True, slots=True)
class Rehearsal:
    """``expected``: what the search of the recording named. ``outcomes``: of the rehearsals."""

    expected: tuple[Named, ...]
    outcomes: tuple[RehearsalOutcome, ...]

    def _pairs(self, outcome: RehearsalOutcome) -> list[tuple[Named, Named]] | None:
        """Return each expected effect with the rehearsed one; None if they are neither the same nor equivalent."""
        # An unknown effect is not simulated; effects that were tied, and thus unknown, are tied again.
        wanted = [n for n in self.expected if n != UNKNOWN]
        again = [n for n in outcome.named if n != UNKNOWN or UNKNOWN not in self.expected]
        if outcome.error or len(wanted) != len(again):
            return None
        cost = [[0.0 if a.label == b.label else 1.0 if b.name in a.equivalent else 9e9 for b in again] for a in wanted]
        order = linear_sum_assignment(np.reshape(cost, (len(wanted), len(again))))
        pairs = [(wanted[i], again[j]) for i, j in zip(*order, strict=True)]
        return pairs if all(a.label == b.label or b.name in a.equivalent for a, b in pairs) else None

    def tree(self) -> dict[str, Any]:
        """Return the counts of result.json."""
        matches = [p for o in self.outcomes if (p := self._pairs(o)) is not None]
        pairs = [*itertools.chain(*matches)]
        inside = [
            abs(b.values[name] - a.values[name]) <= 1.96 * sd
            for a, b in pairs
            for name, sd in b.sd.items()
            if a.label == b.label and math.isfinite(a.values[name] + b.values[name])
        ]
        differing = (o.named for o in self.outcomes if not o.error and self._pairs(o) is None)
        otherwise = Counter(tuple(sorted(n.label for n in named)) for named in differing)
        return {
            'times': len(self.outcomes),
            'again': len(matches),
            'by_equivalent': dict(Counter(b.label for a, b in pairs if a.label != b.label)),
            'sizes': len(inside),
            'sizes_in_interval': sum(inside),
            'otherwise': [{'effects': [*labels], 'times': n} for labels, n in otherwise.most_common()],
            'failed': sum(bool(o.error) for o in self.outcomes),
        }

    def sentences(self) -> list[str]:
        """Return how often the search found its own answer again, and what it named instead."""
        tree = self.tree()
        again = f'without a missing effect: nothing missing in {tree["again"]} of {tree["times"]}'
        if any(n != UNKNOWN for n in self.expected):
            again = f'with the found effects: found again in {tree["again"]}'
        if equivalents := [f'in {n} its equivalent {label}' for label, n in tree['by_equivalent'].items()]:
            again += f' ({", ".join(equivalents)})'
        words = [f'{_times(o["times"])} {" and ".join(o["effects"]) or "nothing"} instead' for o in tree['otherwise']]
        if tree['failed']:
            words.append(f'{_times(tree["failed"])} failed ({next(o.error for o in self.outcomes if o.error)})')
        out = [f'Rehearsed {_times(tree["times"])} on simulated recordings {"; ".join([again, *words])}.']
        if tree['sizes']:
            out.append(f'{tree["sizes_in_interval"]} of {tree["sizes"]} sizes were within their 95 % intervals.')
        return [*out, 'The simulated recordings lack what is unknown.'] if UNKNOWN in self.expected else out


def _times(count: int) -> str:
    return 'once' if count == 1 else f'{count} times'


def attempted(search: Callable[[], Conclusion]) -> RehearsalOutcome:
    """Return the outcome of ``search``; an error that it raises is an outcome, too."""
    try:
        return RehearsalOutcome(named_by(search()))
    except Exception as error:
        return RehearsalOutcome(error=f'{type(error).__name__}: {error}')


def rehearsals(answer: Conclusion, times: int) -> Iterator[Callable[[], RehearsalOutcome]]:
    """Yield the rehearsals of the seeds 1 to ``times``, which run when called. Raises ConfigError below 1."""
    if times < 1:
        raise ConfigError(f'times = {times}: must be at least 1')
    for seed in range(1, times + 1):
        try:
            yield partial(attempted, answer.search_in_simulation(seed))
        except Exception as error:
            yield partial(RehearsalOutcome, (), f'{type(error).__name__}: {error}')


def simulated_recordings(answer: RigConclusion, seed: int) -> list[Observation]:
    """Return the recordings as the found model would have made them, with their wiring, annotations and gaps."""
    mistakes = [a for a in answer.fit.effects if a.effect.name in SETUP and a.effect.name not in RIG_NUMBERS]
    effects = [*answer.known, *answer.fit.nuisance, *(e.active for e in answer.effects), *mistakes]
    ws = answer.workspace
    volts = _simulated(ws, ws.noise, effects, seed)
    right = [dataclasses.replace(o, volts=v) for o, v in zip(ws.observations, volts, strict=True)]
    if any(n.slow for n in ws.noise) and not any(n.slow for n in Workspace(right, effects).noise):
        # Slow noise that its own estimate does not find is that of a memory which the estimate cannot describe.
        volts = _simulated(ws, [dataclasses.replace(n, slow=None) for n in ws.noise], effects, seed)
    out = []
    for given, o, simulated in zip(answer.recordings, ws.observations, volts, strict=True):
        wiring, corrected = Wiring.from_rig(given.rig), Wiring.from_rig(o.rig)
        # Gaps of PSDs on another clock are elsewhere in the readings that are on one clock.
        lost = np.isnan(given.volts if answer.late else wiring.to_psds(corrected.to_device(o.volts)))
        rewired = wiring.to_psds(corrected.to_device(simulated))
        out.append(dataclasses.replace(given, volts=np.where(lost, np.nan, rewired), digest=''))
    return out


def _simulated(ws: Workspace, noises: Sequence[NoiseModel], effects: list[ActiveEffect], seed: int) -> list[FloatArray]:
    rng, out = np.random.default_rng(seed), []
    for i, (o, noise) in enumerate(zip(ws.observations, noises, strict=True)):
        steps = np.full(3 * o.psds, o.rig.converter.volts_per_count)
        for a in (a for a in effects if a.effect.value_grid):
            steps[[True, True, a.effect.steps_sums(a.values)] * o.psds] = a.values[a.effect.value_grid]
        # The estimated noise contains that of the steps, which the simulation adds.
        variance = np.maximum(noise.sigma**2 - steps**2 / 12.0, (MINOR * noise.sigma) ** 2)
        drawn = dataclasses.replace(noise, sigma=np.sqrt(variance)).draw(len(o.loads), o.period, rng)
        simulator = RigSimulator(o.rig, effects=sort_effects(only_in(effects, i)))
        counts = simulator.step(o.acting, o.temperature, drawn).counts.astype(np.float64)
        out.append(Wiring.from_rig(o.rig).to_psds(counts * o.rig.converter.volts_per_count))
    return out
