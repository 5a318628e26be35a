# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Other ways of choosing effects, on the cases of the blind suite: ``python -m blind.run --peer stlsq --out DIR``.

A peer gets all that discover's own search begins with: the recordings made ready, what the rig as it is described
leaves of them, whitened, and what each effect of the library changes, to first order. It differs only in how it
chooses. ``stlsq`` is PySINDy's (sequentially thresholded least squares); ``subsets`` tries every subset of at most
three effects, as a user of MuJoCo's sysid does by hand, among the forty that explain most alone. Both take what has the
smallest BIC.
"""

from __future__ import annotations

import importlib.util
import itertools
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from blind import score
from psd_deflection.records import FloatArray
from psd_deflection.rig.config import Rig
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.discover.recorded_rig import RecordedRig
from psd_deflection.studies.discover.search.fit import refit
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.setup.hidden import SETUP

THRESHOLDS = tuple(np.geomspace(3.0, 300.0, 9).tolist())
"""Of STLSQ, in standard deviations of a coefficient."""
ALONE, MOST = 40, 3
"""So many effects enter the subsets, of so many at most."""


class Pictures:
    """What each effect of the library would change, against what a recording leaves: all to first order."""

    def __init__(self, machine: RecordedRig) -> None:
        self.ws: Workspace = machine.workspace
        self.null = refit(self.ws, ())
        self.screen = machine.screen(self.ws, None)
        self.residual = self.null.residual
        self._pull = (self.screen.rows @ self.residual.astype(np.float32)).astype(np.float64)
        self._penalty = math.log(self.ws.effective_size())

    def columns(self, chosen: Sequence[int]) -> list[int]:
        """Return the rows of the screen of the candidates ``chosen``."""
        return [j for i in chosen for j in range(self.screen.slices[i].start, self.screen.slices[i].stop)]

    def sizes(self, chosen: Sequence[int]) -> FloatArray:
        """Coefficients (k,) of these by least squares."""
        at = self.columns(chosen)
        lengths = np.sqrt(self.screen.lengths[at])
        unit = self.screen.fisher[np.ix_(at, at)] / np.outer(lengths, lengths)
        return np.asarray(np.linalg.lstsq(unit, self._pull[at] / lengths, rcond=1e-9)[0] / lengths)

    def bic(self, chosen: Sequence[int]) -> float:
        """Of the model with these, less that of none."""
        at = self.columns(chosen)
        return self._penalty * len(at) - float(self.sizes(chosen) @ self._pull[at]) if at else 0.0

    def remaining(self, chosen: Sequence[int]) -> float:
        """Return the gap that these leave, m."""
        if not chosen:
            return self.ws.gap(self.null.difference)
        moved = self.sizes(chosen) @ self.screen.rows[self.columns(chosen)].astype(np.float64)
        change = self.ws.unwhitened(moved)
        return self.ws.gap([d - c for d, c in zip(self.null.difference, change, strict=True)])


def stlsq(pictures: Pictures) -> list[int]:
    """By PySINDy, at the threshold that gives the smallest BIC. Raises ImportError if it is not installed."""
    optimizer = importlib.import_module('pysindy').STLSQ
    screen = pictures.screen
    table = screen.rows.T.astype(np.float64) / np.sqrt(screen.lengths)
    tried: list[list[int]] = [[]]
    for threshold in THRESHOLDS:
        with warnings.catch_warnings():
            # That a threshold leaves nothing.
            warnings.simplefilter('ignore')
            fitted = optimizer(threshold=threshold).fit(table, pictures.residual[:, None])
        found = np.asarray(fitted.coef_).ravel() != 0.0
        tried.append([i for i, s in enumerate(screen.slices) if found[s].any()])
    return min(tried, key=pictures.bic)


def subsets(pictures: Pictures) -> list[int]:
    """Of every subset of a few effects the one with the smallest BIC."""
    alone = sorted(range(len(pictures.screen.slices)), key=lambda i: pictures.bic([i]))[:ALONE]
    return min(
        (list(s) for n in range(MOST + 1) for s in itertools.combinations(alone, n)),
        key=pictures.bic,
    )


def lacking(peer: str) -> str:
    """What has to be installed for ``peer``, in words; '' if it is."""
    missing = peer == 'stlsq' and importlib.util.find_spec('pysindy') is None
    return 'PySINDy is not installed: pip install pysindy' if missing else ''


PEERS: dict[str, Callable[[Pictures], list[int]]] = {'stlsq': stlsq, 'subsets': subsets}


def answer(peer: str, observed: Sequence[Observation], rig: Rig, without: Sequence[str]) -> dict[str, Any]:
    """What ``peer`` says of recordings, as docs/blind.md has it: something is unknown if 1.5 floors remain."""
    machine = RecordedRig.of(observed, rig, without, None, lambda _: None)
    pictures = Pictures(machine)
    chosen = PEERS[peer](pictures)
    named = [pictures.screen.candidates[i].effect.name for i in chosen]
    if machine.recorded.value_grid is not None:
        # The readings say so before any search.
        named.append(machine.recorded.value_grid.effect.name)
    floor, remaining = pictures.ws.floor(), pictures.remaining(chosen)
    return {
        'effects': [{'name': name} for name in dict.fromkeys(named) if name not in SETUP],
        'setup': [{'name': name, 'where': '', 'value': None} for name in dict.fromkeys(named) if name in SETUP],
        'unknown': [{}] if remaining > score.THRESHOLDS['unsaid_floors'] * floor else [],
        'remaining': {'floors': remaining / floor},
    }
