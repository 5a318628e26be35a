# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the steps of discover know of a :class:`Machine` (the rig with recordings, or a plant) and of what its
simulation lacks. A :class:`Problem` is frozen; each step gives the next."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from psd_deflection.studies.check.result import Finding
from psd_deflection.studies.discover.laws import FoundLaw
from psd_deflection.studies.discover.planning import Suggestion
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit, HeldOut, refit
from psd_deflection.studies.discover.search.localise import NOWHERE, Localisation
from psd_deflection.studies.discover.search.predictive import Predictive
from psd_deflection.studies.discover.search.screen import Screen
from psd_deflection.studies.discover.search.search import Search, SearchResult
from psd_deflection.studies.discover.search.smooth import Remainder, Smooth, Table
from psd_deflection.studies.discover.search.weighing import NamedEffect, Unknown

Progress = Callable[[str], None]
"""Takes in words what is being done."""


class Machine(ABC):
    """What the steps ask of a machine."""

    @abstractmethod
    def compared(self) -> Comparison:
        """What was measured against the simulation as it is described."""

    @abstractmethod
    def screen(self, comparison: Comparison, fit: Fit | None) -> Screen:
        """Return the signatures of all that may be missing, beside ``fit``."""

    @abstractmethod
    def look(self, comparison: Comparison, fit: Fit, null: Fit | None, rng: np.random.Generator) -> Localisation:
        """Where what ``fit`` leaves has structure; ``null``: the fit without any effect, None if ``fit`` is that."""

    @abstractmethod
    def regressors(self, comparison: Comparison, fit: Fit) -> Table:
        """What the remainder of each channel may follow."""

    def smooth(self, comparison: Comparison, fit: Fit) -> Smooth | None:
        """What ``fit`` leaves as one smooth function of what the machine names."""
        return None

    def bare(self, comparison: Comparison) -> Comparison:
        """``comparison`` without what the readings show by themselves, before any search."""
        return comparison

    def chi_square_explained(self, comparison: Comparison) -> float:
        """Chi-square that this explains."""
        return 0.0

    def suggest(self, comparison: Comparison, fit: Fit, equal: Sequence[Fit]) -> Suggestion | None:
        """Return the experiment that tells ``fit`` from others that are as good."""
        return None


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """``search``: what is compared, and the signatures. ``result``: the model that the search chose. ``fit``: the model
    so far; ``heldout``: the gain of each of its effects on unseen load cases. ``null``: the model as described, against
    which gaps count. ``before``, ``residual``: where ``null`` and ``fit`` leave structure. ``named``: the effects of
    ``fit`` that are reported. ``remainder``: what is unknown as a function of named variables.
    ``predictive``: the model that predicts best, None if none was looked for.
    ``setup``: what is wrong with the set-up, with ``values`` that put the rig file right.
    ``alternative_fits``: complete models in place of ``fit``; ``unsettled``: names of what fits as well. ``law``: of
    what is unknown. ``stated_gap``: before the wiring was put right, 0 if that was right. ``rng``: draws of the steps.
    """

    machine: Machine
    search: Search
    result: SearchResult
    fit: Fit
    null: Fit
    rng: np.random.Generator
    seed: int
    progress: Progress
    heldout: tuple[HeldOut, ...] = ()
    before: Localisation = NOWHERE
    residual: Localisation = NOWHERE
    named: tuple[NamedEffect, ...] = ()
    unknown: tuple[Unknown, ...] = ()
    remainder: Remainder | None = None
    predictive: Predictive | None = None
    setup: tuple[Finding, ...] = ()
    values: Mapping[str, object] = field(default_factory=dict)
    alternative_fits: tuple[Fit, ...] = ()
    unsettled: tuple[str, ...] = ()
    law: FoundLaw | None = None
    stated_gap: float = 0.0

    @classmethod
    def of(cls, machine: Machine, seed: int, progress: Progress, rng: np.random.Generator) -> Problem:
        """Nothing is searched yet: the model is the described one."""
        progress('signatures of every effect')
        search = Search(machine.compared(), machine.screen, progress)
        null = refit(search.workspace, ())
        result = SearchResult(null, null)
        return cls(
            machine=machine, search=search, result=result, fit=null, null=null, rng=rng, seed=seed, progress=progress
        )

    @property
    def comparison(self) -> Comparison:
        """Measured against simulated, with the noise that the search estimated last."""
        return self.search.workspace

    @property
    def gap_before(self) -> float:
        """What the model as described leaves, rms."""
        return self.stated_gap or self.bare.gap(self.null.difference)

    @property
    def bare(self) -> Comparison:
        """The same without what the readings show by themselves."""
        return self.machine.bare(self.comparison)


Step = Callable[[Problem], Problem]
