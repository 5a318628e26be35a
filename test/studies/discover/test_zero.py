# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The noise of a zero that was taken in the recording is no effect."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from psd_deflection.measure.pipeline import ZERO_BLOCKS, zero_variances
from psd_deflection.model.simulation.simulator import RigSimulator
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.engine import zero_variances_at_end
from psd_deflection.records import DOT_CHANNELS, ParameterChange
from psd_deflection.rig.config import load_rig, replace_values
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.discover.recorded import Recorded, with_free
from psd_deflection.studies.discover.result import Discovery
from psd_deflection.studies.discover.search.workspace import Workspace

RIG = load_rig()
BAG = Path(__file__).parents[3] / 'bags' / 'clean'
LOADS = np.repeat(
    np.array([(0, 0, 0), (0, -20, 0), (0, -50, -29), (30, 0, 0), (20, -40, 12), (0, 0, 0)], float), 6000, axis=0
)
ZERO = zero_variances(RIG)
OFF = np.sqrt(ZERO) * [0.3, -1.1, 1.6, -0.8]
"""An error that such a zero has."""


def recorded(*, taken: bool, rotated: float = 0.0) -> Observation:
    """A recording with a zero that is off, ``taken`` in it or not, of a rig with a detector ``rotated``, rad."""
    true = {'effects.e.name': 'sensor_rotation', 'effects.e.psd': 1, 'effects.e.angle': rotated} if rotated else {}
    volts = RigSimulator(replace_values(RIG, true), 3).step(LOADS).counts * RIG.converter.volts_per_count
    zeros = {f'psd_{i + 1}.zero': OFF[2 * i : 2 * i + 2].tolist() for i in range(2)}
    o = Observation('x', replace_values(RIG, zeros), np.asarray(volts, dtype=np.float64), LOADS)
    return replace(o, zero_variances=ZERO) if taken else o


@pytest.fixture(scope='module')
def faultless() -> Discovery:
    return discover([recorded(taken=True)])


@pytest.mark.slow
def test_residual_of_noisy_zero_is_nothing_unknown(faultless: Discovery) -> None:
    assert faultless.verdict == 'nothing_missing'
    assert not faultless.effects
    assert not faultless.unknown


@pytest.mark.slow
def test_the_same_constants_are_reported_if_no_zero_was_taken() -> None:
    found = discover([recorded(taken=False)])
    assert found.effects or found.unknown


@pytest.mark.slow
def test_an_effect_beside_such_a_zero_is_named_alone() -> None:
    found = discover([recorded(taken=True, rotated=0.004)])
    assert [e.active.effect.name for e in found.effects] == ['sensor_rotation']
    assert found.effects[0].active.values['angle'] == pytest.approx(0.004, abs=4.0 * found.effects[0].sd['angle'])
    assert found.verdict == 'effects_found'


def test_a_constant_is_whitened_by_what_the_zero_allows() -> None:
    """One standard deviation of a well seen constant leaves a residual of about one standard deviation of noise."""
    o = recorded(taken=True)
    ws = Workspace([o])
    own = with_free(Recorded((o,), RIG, ()), ws)
    constant = [np.zeros_like(t) for t in ws.measured]
    axis = 3
    constant[0][DOT_CHANNELS[axis]] = np.sqrt(ZERO[axis]) / RIG.sensitivities.ravel()[axis]
    observed = float(np.linalg.norm(ws.whiten(constant)))
    assert observed > 5.0
    assert np.linalg.norm(own.whiten(constant)) == pytest.approx(observed / np.hypot(1.0, observed), rel=1e-9)
    assert not own.free_loads
    assert own.refitted(ws.measured) is own


@pytest.mark.parametrize(
    ('changes', 'variances'),
    [
        ((), ()),
        (({'environment.temperature': 22.0},), ()),
        (({'psd_1.zero': (1e-6, 0.0)},), ZERO),
        (({'psd_2.zero': (1e-6, 0.0), 'state.zero_variances': (1.0, 2.0, 3.0, 4.0)},), (1.0, 2.0, 3.0, 4.0)),
        (({'state.zero_variances': (1.0, 2.0, 3.0, 4.0)}, {'psd_2.zero': (1e-6, 0.0)}), ZERO),
        (({'psd_2.zero': (1e-6, 0.0), 'state.zero_variances': (1.0, 2.0)},), ZERO),
        (({'psd_2.zero': (1e-6, 0.0), 'state.zero_variances': 'x'},), ZERO),
    ],
)
def test_a_recording_says_how_well_its_zero_is_known(
    changes: tuple[dict[str, float | str | tuple[float, ...]], ...],
    variances: tuple[float, ...],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recording = open_recording(BAG)
    reported = [ParameterChange(0, i, tuple(c.items())) for i, c in enumerate(changes)]
    monkeypatch.setattr(recording, 'changes', reported)
    assert zero_variances_at_end(recording, RIG) == variances


def test_a_zero_that_gives_nothing_is_the_mean_of_half_a_second() -> None:
    per_sample = [s**2 * (n**2 + RIG.converter.volts_per_count**2 / 12) for s, n in _channels()]
    samples = ZERO_BLOCKS * RIG.estimator.block_size
    assert samples == 500
    np.testing.assert_allclose(ZERO, np.array(per_sample) / samples, rtol=1e-12)


def _channels() -> list[tuple[float, float]]:
    return list(zip(RIG.sensitivities.ravel().tolist(), RIG.noises[:, :2].ravel().tolist(), strict=True))
