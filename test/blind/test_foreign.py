# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""discover_in on machines that others measured; skipped where their data are not."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from blind import emps, foreign
from blind.arm import Arm
from blind.auxtel import AuxTel
from blind.boom import Boom
from blind.measured import DATA
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.plant_search import PlantComparison, PlantDiscovery, discover_in
from psd_deflection.studies.discover.plants import Model
from psd_deflection.studies.discover.search.fit import refit

pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason='the data that others measured are not here')


def names(found: PlantDiscovery) -> set[str]:
    return {e.active.effect.name for e in found.effects}


@pytest.mark.slow
def test_the_boom_lacks_gravity_and_its_root_gives_way() -> None:
    """Its stiffness is not known and no finding. Clamp and length cannot be distinguished, and are named so."""
    found = discover_in(Boom(without=('tip_force',)))
    weight, root = found.effects
    assert weight.active.effect.name == 'self_weight'
    assert {root.active.effect.name, *root.equivalent} == {'clamp_compliance', 'root_length'}
    assert {r.active.effect.name for r in root.fitted_alternatives} == set(root.equivalent)
    assert found.gap_before == pytest.approx(17.65e-3, rel=0.01)
    assert found.gap_after < 2e-3
    assert found.gap_heldout_after < 3e-3
    # A ruler reads to half a millimetre: what remains is said.
    assert found.verdict == 'unknown_effect'
    assert 'bending_compliance' not in names(found)
    ((stiffness, sd),) = found.nuisance
    assert stiffness.values['scale'] < -0.3
    assert 0.0 < sd['scale'] < 0.1


@pytest.mark.slow
def test_the_weighed_boom_lacks_no_weight() -> None:
    found = discover_in(Boom(weighed=True))
    assert names(found) <= {'tip_force', 'root_length', 'clamp_compliance'}
    assert found.gap_after == pytest.approx(1.58e-3, rel=0.02)


@pytest.mark.slow
def test_the_telescope_has_five_effects_and_their_sizes_are_those_of_tpoint() -> None:
    """More than four effects by evidence. TPOINT, with 22 free terms: AN 44.26, AW 69.89, NPAE -50.97 arcsec."""
    found = discover_in(AuxTel())
    sizes = {e.active.effect.name: e.active.values['size'] for e in found.effects}
    assert len(sizes) >= 5
    assert sizes['AN'] == pytest.approx(44.26, abs=4.0)
    assert sizes['AW'] == pytest.approx(69.89, abs=8.0)
    (between,) = (e for e in found.effects if {'NPAE', 'CA'} & {e.active.effect.name, *e.equivalent})
    assert {'NPAE', 'CA'} <= {between.active.effect.name, *between.equivalent}
    # On unseen stars: 24.3 arcsec on the sky with four effects at most.
    assert math.sqrt(2.0) * found.gap_heldout_after < 15.0
    # With one smooth function beside them, found without the star; it has no name.
    assert found.remainder is not None
    assert set(found.remainder.depends_on) == {'elevation', 'place on the sky'}
    assert math.sqrt(2.0) * found.remainder.heldout < 9.0
    assert found.verdict == 'unknown_effect'


@pytest.mark.slow
@pytest.mark.parametrize('name', ['AN', 'AW'])
def test_a_term_that_the_model_of_the_telescope_lacks_is_named(name: str) -> None:
    known = [n for n in ('AN', 'AW', 'NPAE', 'CA') if n != name]
    assert name in names(discover_in(AuxTel(known=known)))


@pytest.mark.slow
def test_of_collimation_and_axes_the_stars_show_one_and_it_is_named() -> None:
    found = discover_in(AuxTel(known=('AN', 'AW')))
    (between,) = (e for e in found.effects if {'NPAE', 'CA'} & {e.active.effect.name, *e.equivalent})
    assert {'NPAE', 'CA'} <= {between.active.effect.name, *between.equivalent}
    # Beside either the other one is no evidence: BIC is worse with both.
    telescope = AuxTel()
    observed = telescope.measured()[0].ravel()

    def bic(*names: str) -> float:
        terms = np.column_stack([telescope.simulate({n: {'size': 1.0}})[0].ravel() for n in names])
        residual = observed - terms @ np.linalg.lstsq(terms, observed, rcond=None)[0]
        return len(observed) * math.log(float(residual @ residual)) + math.log(len(observed)) * len(names)

    beside = ('IA', 'IE', 'AN', 'AW', 'HECE4', 'HECE7')
    assert min(bic(*beside, 'NPAE'), bic(*beside, 'CA')) + 1.0 < bic(*beside, 'NPAE', 'CA')


@pytest.mark.slow
def test_the_sd_of_the_weight_is_its_scatter_over_lengths() -> None:
    """Lengths drawn by chance, with replacement, against the sd of one search."""
    found = discover_in(Boom(without=('tip_force',)))
    weight = found.effects[0]
    rng = np.random.default_rng(0)
    drawn = []
    for _ in range(60):
        ws = PlantComparison(Resampled(rng))
        fit = refit(ws, [e.active for e in found.effects], nuisance=[a for a, _ in found.nuisance])
        drawn.append(fit.effects[0].values['weight'])
    assert weight.sd['weight'] / float(np.std(drawn)) == pytest.approx(1.0, rel=0.5)


class Resampled(Boom):
    def __init__(self, rng: np.random.Generator) -> None:
        super().__init__()
        picked = rng.integers(0, len(self.cases), len(self.cases))
        self._rows = [self._rows[i] for i in picked]
        self.cases = tuple(f'{self.cases[i]} ({k})' for k, i in enumerate(picked))


@pytest.mark.slow
def test_what_the_drive_lacks_is_found_together() -> None:
    """Neither may be found alone first: more viscous friction seems to explain the lack of both."""
    plant = emps.Emps(('coulomb_friction', 'force_offset'), step=10)
    plant.library = tuple(e for e in plant.library if e.name not in ('input_delay', 'position_gain', 'mass'))
    found = discover_in(plant)
    friction, offset = sorted(found.effects, key=lambda e: e.active.effect.name)
    assert (friction.active.effect.name, offset.active.effect.name) == ('coulomb_friction', 'force_offset')
    assert found.verdict == 'effects_found'
    for effect, published in ((friction, emps.COULOMB), (offset, emps.OFFSET)):
        assert abs(effect.active.values['force'] - published) < 2.0 * effect.sd['force']
        assert effect.active.values['force'] == pytest.approx(published, rel=0.06)
    assert found.gap_after < 3e-3 < 0.05 < found.gap_before


@pytest.mark.slow
def test_the_published_drive_lacks_nothing() -> None:
    plant = emps.Emps(step=10)
    plant.library = tuple(e for e in plant.library if e.name not in ('input_delay', 'position_gain', 'mass'))
    assert discover_in(plant).verdict == 'nothing_missing'


@pytest.mark.slow
def test_what_was_found_missing_of_the_arm_closes_its_gap() -> None:
    # The search itself takes longer: python -m blind.foreign arm.
    arm = Arm()

    def rms(model: Model) -> FloatArray:
        apart = [m - s for m, s in zip(arm.measured(), arm.simulate(model), strict=True)]
        return np.asarray(np.sqrt(np.mean(np.concatenate(apart, axis=1) ** 2, axis=1)))

    nominal = rms({})
    damped = rms({'tip_damping': {'damping': 9.196}})
    both = rms({'tip_damping': {'damping': 9.196}, 'coulomb_friction': {'torque': 1.472}})
    np.testing.assert_allclose(nominal, [0.350, 0.01263], rtol=0.01)
    assert damped[1] < 0.45 * nominal[1]
    assert both[0] < 0.5 * nominal[0]
    assert both[1] < 0.4 * nominal[1]


@pytest.mark.slow
def test_the_command_writes_result_and_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr('sys.argv', ['foreign', 'boom', '--out', str(tmp_path)])
    assert foreign.main() == 0
    tree = json.loads((tmp_path / 'boom' / 'result.json').read_text())
    assert [n['name'] for n in tree['nuisance']] == ['bending_compliance']
    assert tree['gap']['unit'] == 'm'
    assert {e['name'] for e in tree['effects']} <= {'self_weight', 'tip_force', 'root_length', 'clamp_compliance'}
    assert 'self_weight' in capsys.readouterr().out
    assert '<figure class="chart"' in (tmp_path / 'boom' / 'report.html').read_text()
