"""Link statics: the contract's equations, both ways, scalar and vectorised alike."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.config import load_rig
from psd_deflection.mechanics import LinkStatics

LINK = LinkStatics.from_rig(load_rig())


def test_the_beam_constants_of_the_thesis_rig() -> None:
    # Errata G-10: a 50 N sidebar load at a lever of one link length.
    dx, dy, theta = LINK.deflection(0.0, -50.0, 50.0 * 0.585)
    assert dx == 0.0
    assert dy == pytest.approx(-2.2271675e-3, abs=1e-10)
    assert theta == pytest.approx(0.016418222, abs=1e-9)
    phi, omega = LINK.slopes(0.0, -50.0)
    assert np.degrees(phi) == pytest.approx(0.3272, abs=5e-5)
    assert omega == 0.0


@pytest.mark.parametrize(('load', 'ratio'), [((0, 1), 1.5), ((2, 3), 2.0)])
def test_the_tip_slopes_have_the_contracts_sign_and_ratio(load: tuple[int, int], ratio: float) -> None:
    # phi = -k dY/L and omega = +k dX/L, k = 3/2 for a tip force and 2 for a tip moment.
    wrench = [0.0, 0.0, 0.0, 0.0]  # fx, fy, mx, my
    wrench[load[0]], wrench[load[1]] = 3.0, -7.0
    fx, fy, mx, my = wrench
    dx, dy, _ = LINK.deflection(fx, fy, 0.0, mx, my)
    phi, omega = LINK.slopes(fx, fy, mx, my)
    assert phi == pytest.approx(-ratio * dy / LINK.length, rel=1e-12)
    assert omega == pytest.approx(ratio * dx / LINK.length, rel=1e-12)
    assert dx != 0.0
    assert dy != 0.0


def test_load_to_deflection_and_back() -> None:
    load = (11.0, -23.0, 4.5)
    assert LINK.tip_load(*LINK.deflection(*load)) == pytest.approx(load, rel=1e-15)


def test_the_vectorised_twins_agree_bit_for_bit() -> None:
    loads = np.random.default_rng(1).normal(scale=30.0, size=(50, 5))
    poses = LINK.deflections(loads)
    assert poses.tolist() == [list(LINK.deflection(*row)) for row in loads.tolist()]
    assert LINK.deflections(loads[:, :3]).tolist() == [list(LINK.deflection(*row)) for row in loads[:, :3].tolist()]
    assert LINK.tip_loads(poses).tolist() == [list(LINK.tip_load(*row)) for row in poses.tolist()]


def test_the_full_compliance_is_reciprocal_and_holds_the_small_one() -> None:
    full = LINK.full_compliance
    assert np.array_equal(full, full.T)
    assert np.array_equal(full[:3, :3], LINK.compliance)
    assert np.all(np.linalg.eigvalsh(full) > 0.0)
    fx, fy, tz, mx, my = 1.0, 2.0, 3.0, 4.0, 5.0
    expected = (*LINK.deflection(fx, fy, tz, mx, my), *LINK.slopes(fx, fy, mx, my))
    assert full @ [fx, fy, tz, mx, my] == pytest.approx(expected, rel=1e-14)
