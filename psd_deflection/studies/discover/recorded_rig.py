# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The rig with its recordings, as the search sees it: what is compared, its signatures, and where it looks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from psd_deflection.model.simulation.catalogue import effects_for, effects_of_rig
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.recordings.observation import Observation, check_same_psds
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.studies.discover import recorded as recordings_ready
from psd_deflection.studies.discover.hidden import FIRST, SETUP, mistakes
from psd_deflection.studies.discover.planning import Suggestion, suggest
from psd_deflection.studies.discover.problem import Machine, Problem, Progress
from psd_deflection.studies.discover.recorded import Recorded
from psd_deflection.studies.discover.redundant import STAGES, excess, fourth_reading, visible
from psd_deflection.studies.discover.search import proposals as propose
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit
from psd_deflection.studies.discover.search.localise import Localisation, localise, regressors
from psd_deflection.studies.discover.search.screen import (
    Candidate,
    Columns,
    Screen,
    SignatureBank,
    candidates,
    signatures_beside,
)
from psd_deflection.studies.discover.search.smooth import Table
from psd_deflection.studies.discover.search.trials import is_far_off
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.setup import likely_jumps
from psd_deflection.studies.loads.thresholds import MANYFOLD, PART


@dataclass(frozen=True, slots=True, eq=False)
class RecordedRig(Machine):
    """The rig with its recordings. ``workspace``: these against its simulation. ``proposals``: starting values that the
    residual shows, by name. ``bank``: signatures beside nothing.
    """

    recorded: Recorded
    workspace: Workspace
    proposals: Mapping[str, Sequence[float]]
    bank: SignatureBank

    @classmethod
    def of(
        cls,
        recordings: Sequence[Observation],
        rig: Rig,
        without: Sequence[str],
        bank: SignatureBank | None,
        progress: Progress,
    ) -> RecordedRig:
        """Return the recordings made ready. ``bank``: see :func:`discover`."""
        check_same_psds(recordings, rig)
        progress('checking the recording')
        recorded = Recorded(tuple(recordings), rig, tuple(effects_of_rig(rig)), tuple(without))
        for step in recordings_ready.STEPS:
            recorded = step(recorded)
        progress('simulating the rig as it is described')
        recorded, workspace = recordings_ready.compared(recorded)
        # Signatures that are kept are those of recordings as they were, from rest, without a gap.
        gaps = not all(np.isfinite(o.volts).all() for o in workspace.observations)
        changed = recorded.mistaken or gaps or bool(workspace.nuisance) or any(d > 0.0 for d in recorded.delays)
        bank_of_rig = SignatureBank() if bank is None or changed else bank
        bank_of_rig.nominal(workspace)
        proposals = proposals_of(workspace)
        if recorded.value_grid is not None:
            workspace = workspace.replaced(base=(*workspace.base, recorded.value_grid))
        return cls(recorded=recorded, workspace=workspace, proposals=proposals, bank=bank_of_rig)

    def compared(self) -> Workspace:
        """Return the recordings against the simulation."""
        return self.workspace

    def bare(self, comparison: Comparison) -> Comparison:
        """Without the coarse steps."""
        if self.recorded.value_grid is None:
            return comparison
        return comparison.replaced(base=tuple(a for a in comparison.base if a is not self.recorded.value_grid))

    def chi_square_explained(self, comparison: Comparison) -> float:
        """Chi-square that the coarse steps explain."""
        value_grid = self.recorded.value_grid
        return 0.0 if value_grid is None else 2.0 * value_grid_gain(workspace_of(comparison), value_grid)

    def screen(self, comparison: Comparison, fit: Fit | None) -> Screen:
        """Return the catalogue's effects and the mistakes of the set-up, beside ``fit`` if that leaves much."""
        ws = workspace_of(comparison)
        residual = ws.residual([*ws.base, *ws.nuisance])[0] if fit is None else fit.residual
        more = mistakes(len(ws.observations), self.recorded.delays, likely_jumps(ws, residual), ws.psds)
        more = [e for e in more if e.name not in FIRST or e.name in ws.first]
        library = [e for e in effects_for(ws.psds) if e.name not in self.recorded.without and not e.value_grid]
        values = self.proposals
        if fit is not None and fit.effects:
            # A large effect hides the spectral lines of a small one.
            beside = proposals_of(ws, fit.effects)
            values = {
                name: [*observed, *(v for v in beside[name] if v not in observed)] for name, observed in values.items()
            }
        listed = list(candidates([*library, *more], self.recorded.physics, values))
        # A large effect changes the signatures of the others.
        anew = signatures_beside(ws, listed, fit) if fit is not None and is_far_off(fit) else None
        signatures = anew if anew is not None else ((c, self.bank.get(c, ws)) for c in listed)
        most = sum(len(c.free) for c in listed)
        return Screen(ws, self._not_acquitted(ws, signatures, residual, fit), most)

    def _not_acquitted(
        self, ws: Workspace, signatures: Iterator[tuple[Candidate, Columns]], residual: FloatArray, fit: Fit | None
    ) -> Iterator[tuple[Candidate, Columns]]:
        """Without detectors and beams that would show in the fourth reading if they made much of ``residual`` (D,)."""
        reading = self.recorded.fourth if fit is None else fourth_reading(ws, residual)
        excess_chi_square, throughout = excess(ws, residual)
        if reading is None or not reading.acquits or throughout < MANYFOLD - 1.0:
            return signatures
        least = 2.0 * reading.allowed / (PART * excess_chi_square)
        # Mistakes of the set-up touch every channel; those of a detector are steps that the readings themselves show.
        return (
            (c, columns)
            for c, columns in signatures
            if c.effect.stage not in STAGES or c.effect.name in SETUP or visible(ws, columns) < least
        )

    def look(self, comparison: Comparison, fit: Fit, null: Fit | None, rng: np.random.Generator) -> Localisation:
        """By load case, channel and frequency band, and what it follows."""
        ws = workspace_of(comparison)
        if null is None or not fit.free:
            return localise(ws, fit.residual, None, rng)
        return localise(ws, fit.residual, fit.jacobian, rng, explained=null.residual - fit.residual)

    def regressors(self, comparison: Comparison, fit: Fit) -> Table:
        """Time, loads and temperature, and the dots of the channel's own PSD."""
        return regressors(workspace_of(comparison))

    def suggest(self, comparison: Comparison, fit: Fit, equal: Sequence[Fit]) -> Suggestion | None:
        """Return the recording that tells them apart."""
        return suggest(workspace_of(comparison), fit, equal[: 3 if comparison.simulations < comparison.budget else 1])


def workspace_of(comparison: Comparison) -> Workspace:
    """``comparison``, which is that of the rig."""
    if not isinstance(comparison, Workspace):
        raise TypeError(f'{type(comparison).__name__}: not the rig with its recordings')
    return comparison


def rig_of(problem: Problem) -> RecordedRig:
    """Return the machine of ``problem``, which is the rig."""
    if not isinstance(problem.machine, RecordedRig):
        raise TypeError(f'{type(problem.machine).__name__}: not the rig with its recordings')
    return problem.machine


def proposals_of(workspace: Workspace, effects: Sequence[ActiveEffect] = ()) -> dict[str, list[float]]:
    """Starting values by the name of a parameter's ``propose``, Hz or V, from what is left beside ``effects``."""
    raw = workspace.raw_residual([*workspace.base, *effects])
    observations = workspace.observations
    noise = float(observations[0].rig.noises.max())
    sigmas, periods = [n.sigma for n in workspace.noise], [o.period for o in observations]
    peaks = propose.spectral_peaks(raw, sigmas, periods)
    return {
        'spectral': peaks,
        'line': propose.persistent(peaks, raw, sigmas, periods),
        'highest': propose.highest_voltages(observations, True, noise),
        'highest_dots': propose.highest_voltages(observations, False, noise),
    }


def value_grid_gain(workspace: Workspace, value_grid: ActiveEffect) -> float:
    """Log-likelihood of all readings lying on the grid: by chance each does so with probability LSB/step."""
    lsb = workspace.observations[0].rig.converter.volts_per_count
    return (
        workspace.size
        * workspace.fine[0]
        * float(np.log(max(value_grid.values[value_grid.effect.value_grid] / lsb, 1.0)))
    )
