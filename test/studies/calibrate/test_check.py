"""Parts of the check of an old calibration, against plain linear algebra."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.model.misalignment.model import PARAMETERS, ZERO
from psd_deflection.studies.calibrate.check import _moved


def test_a_group_has_moved_by_what_its_rows_and_its_prior_say() -> None:
    names = [p.group for p in PARAMETERS[:ZERO]]
    group = next(name for name in names if names.count(name) > 1)
    own = [i for i, name in enumerate(names) if name == group]
    at = np.arange(ZERO)
    rng = np.random.default_rng(5)
    root = rng.normal(size=(ZERO, ZERO))
    m, score, scale = root @ root.T, rng.normal(size=ZERO), rng.uniform(0.5, 2.0, ZERO)
    found = _moved(group, at, score, m, scale)
    # In units of the prior, whose information is 1.
    covariance = np.linalg.inv(m[np.ix_(own, own)] + np.eye(len(own)))
    shift = scale[own] * (covariance @ score[own])
    sd = scale[own] * np.sqrt(np.diag(covariance))
    assert [v for v, _ in found.shifts.values()] == pytest.approx(shift.tolist())
    assert [s for _, s in found.shifts.values()] == pytest.approx(sd.tolist())
