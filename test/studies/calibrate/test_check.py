"""Parts of the check of an old calibration, against plain linear algebra."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from psd_deflection.model.misalignment.model import INDEX, PARAMETERS, ZERO
from psd_deflection.rig.config import rig_from_values
from psd_deflection.studies.calibrate.calibrate import undetermined
from psd_deflection.studies.calibrate.check import _moved
from psd_deflection.studies.calibrate.fit import posterior, prior_of_rig


@pytest.mark.parametrize('seed', range(3))
def test_a_group_has_moved_by_what_its_rows_and_its_prior_say(seed: int) -> None:
    names = [p.group for p in PARAMETERS[:ZERO]]
    group = max(names, key=names.count)
    own = [i for i, name in enumerate(names) if name == group]
    at = np.arange(ZERO)
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(ZERO, ZERO))
    m, score, scale = root @ root.T, rng.normal(size=ZERO), rng.uniform(0.5, 2.0, ZERO)
    found = _moved(group, at, score, m, scale)
    # In units of the prior, whose information is 1.
    covariance = np.linalg.inv(m[np.ix_(own, own)] + np.eye(len(own)))
    shift = scale[own] * (covariance @ score[own])
    sd = scale[own] * np.sqrt(np.diag(covariance))
    assert [v for v, _ in found.shifts.values()] == pytest.approx(shift.tolist())
    assert [s for _, s in found.shifts.values()] == pytest.approx(sd.tolist())


def test_what_no_row_tells_is_undetermined_alone_or_as_a_combination() -> None:
    prior = prior_of_rig(rig_from_values({}))
    size = len(prior.mean)
    free = np.ones(size, dtype=bool)
    each = 1e4 / prior.sd**2
    information = np.diag(each)
    open_one, (a, b) = INDEX['psd_2.height'], (INDEX['psd_1.gain_x'], INDEX['psd_2.gain_x'])
    information[open_one, open_one] = 0.0
    # Of two gains only the sum is told.
    pair = np.zeros(size)
    pair[[a, b]] = 1.0 / prior.sd[[a, b]]
    information[[a, b], [a, b]] = 0.0
    information += 1e4 * np.outer(pair, pair)
    whole = cast(
        Any,
        SimpleNamespace(covariance=posterior(information, prior, free), information=information, free=free),
    )
    found = {tuple(sorted(d.parts)): d.parts for d in undetermined(whole, prior)}
    assert set(found) == {('psd_2.height',), ('psd_1.gain_x', 'psd_2.gain_x')}
    one, other = found['psd_1.gain_x', 'psd_2.gain_x'].values()
    assert (abs(one), one + other) == pytest.approx((0.5**0.5, 0.0), abs=2e-4)
