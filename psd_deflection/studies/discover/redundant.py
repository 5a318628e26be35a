# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Of 2P readings of P PSDs a plate moves three; the other 2P - 3, orthonormal in units of noise, ask before any model
of the link whether a detector, beam or amplifier is at fault."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from psd_deflection.model.simulation.declaration import ActiveEffect, Effect, EffectParameter, State, Values
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.search.screen import Columns
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.thresholds import CERTAIN_SD
from psd_deflection.studies.loads.plate_motion import across_of, dot_rows, moved_plate
from psd_deflection.studies.loads.thresholds import SAME

STAGES = frozenset(('optics', 'psd', 'electronics'))
"""Of the effects that the fourth reading can acquit."""


@dataclass(frozen=True, slots=True)
class FourthReading:
    """``chi_square`` of what no movement of the plate makes, over ``values`` numbers: as large if it is noise."""

    chi_square: float
    values: int

    @property
    def allowed(self) -> float:
        """How much more than ``values`` chi-square may be of noise alone."""
        return CERTAIN_SD * float(np.sqrt(2.0 * self.values)) + SAME * self.values

    @property
    def acquits(self) -> bool:
        """Whether no detector, beam or amplifier is at fault."""
        return self.chi_square - self.values < self.allowed


def fourth(ws: Workspace, vectors: FloatArray) -> FloatArray:
    """What no movement of the plate makes of whitened ``vectors`` (k, D): (k, m), of unit variance if it is noise.

    The 2P - 3 numbers of a recording follow one after the other.
    """
    out = []
    for i, (o, noise) in enumerate(zip(ws.observations, ws.noise, strict=True)):
        scale = o.rig.sensitivities.ravel()
        rows = np.array([ws.split(v)[i][ws.rows] for v in vectors])
        there = (ws.count[i][ws.rows] > 0.0).all(axis=0)
        for across in _orthonormal(across_of(o.rig) * scale * noise.innovation[ws.rows]):
            out.append(np.einsum('c,kct->kt', across, rows[:, :, there]))
    return np.concatenate(out, axis=1)


def _orthonormal(rows: FloatArray) -> list[FloatArray]:
    """The span of ``rows`` (k, n), which are independent, by rows of length 1 at right angles (Gram and Schmidt)."""
    out: list[FloatArray] = []
    for row in rows:
        # Twice: the first time leaves what rounding makes of it.
        for basis_vector in (*out, *out):
            row = row - (basis_vector @ row) * basis_vector
        out.append(row / np.linalg.norm(row))
    return out


def fourth_reading(ws: Workspace, residual: FloatArray) -> FourthReading:
    """Of a whitened ``residual`` (D,), measured minus simulated, of poses that are nearly right."""
    rest = np.clip(fourth(ws, residual[None, :])[0], -CERTAIN_SD, CERTAIN_SD)
    return FourthReading(float(rest @ rest), len(rest))


def excess(ws: Workspace, residual: FloatArray) -> tuple[float, float]:
    """Chi-square beyond noise of the dots of a whitened ``residual`` (D,), and that of each value, clipped.

    The second is what the fourth reading could see: a dot that is far off for some moments has much of the first alone.
    """
    rows = dot_rows(len(ws.count[0]) // 3)
    there = [count[rows] > 0.0 for count in ws.count]
    dots = np.concatenate([part[rows][here] for part, here in zip(ws.split(residual), there, strict=True)])
    clipped = np.clip(dots, -CERTAIN_SD, CERTAIN_SD)
    return float(dots @ dots) - len(dots), float(clipped @ clipped) / len(dots) - 1.0


def solved(ws: Workspace, difference: Sequence[FloatArray]) -> FloatArray:
    """Return the whitened residual (D,) of the poses that the readings say; ``difference``: of the simulated ones."""
    moves = [np.zeros((3, d.shape[1])) for d in difference]
    for _ in range(2):
        for i, (o, part) in enumerate(zip(ws.observations, difference, strict=True)):
            more = moved_plate(o.rig, part, ws.count[i])
            moves[i] += np.where(np.isfinite(more), more, 0.0)
        asked = [_moved(i, len(moves), np.repeat(m, ws.fine[i], axis=1)) for i, m in enumerate(moves)]
        residual, difference = ws.residual([*ws.base, *asked])
    return residual


def _moved(recording: int, count: int, shift: FloatArray) -> ActiveEffect:
    """Return the pose of one recording moved ``shift`` (3, n)."""

    def move(chunk: SimulatedSamples, values: Values, state: State) -> None:
        n = min(chunk.pose.shape[1], shift.shape[1])
        chunk.pose[:, :n] += shift[:, :n]

    choices = tuple(range(1, count + 1))
    which = EffectParameter('recording', '', 1, count, 1, '', nominal=1, kind='choice', choices=choices, each=True)
    share = EffectParameter('share', '', 0.0, 1.0, 1.0, '')
    effect = Effect('moved', 'link', '', '', '', '', (which, share), 'pose', apply=move, order=99, full=True)
    return ActiveEffect(effect, {'recording': recording + 1, 'share': 1.0})


def visible(ws: Workspace, columns: Columns) -> float:
    """Return the least share of its energy that an effect with signatures ``columns`` shows in the fourth reading."""
    white = np.array([ws.whiten([table.astype(np.float64) for table in c]) for c in columns])
    patterns = fourth(ws, white)
    gram = white @ white.T
    lengths = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    gram = gram / np.outer(lengths, lengths) + 1e-9 * np.eye(len(white))
    cosines = (patterns @ patterns.T) / np.outer(lengths, lengths)
    return float(eigh(cosines, gram, eigvals_only=True)[0])
