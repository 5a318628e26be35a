"""Link statics both ways, and the cross-section they rest on."""

from __future__ import annotations

import numpy as np
import pytest

from psd_deflection.config import load_rig
from psd_deflection.mechanics import LinkStatics
from psd_deflection.mechanics.section import TubeSection

LINK = LinkStatics.from_rig(load_rig())
SECTION = TubeSection(0.0159, 0.0138)


def test_the_beam_constants_of_the_thesis_rig() -> None:
    # A 50 N sidebar load at a lever of one link length.
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


# ---- Cross-section ----


def test_the_section_of_the_thesis_link() -> None:
    assert SECTION.second_moment == pytest.approx(2.171272689e-8, rel=1e-9)
    assert SECTION.polar_moment == pytest.approx(4.342545378e-8, rel=1e-9)
    assert load_rig().link.second_moment == pytest.approx(SECTION.second_moment, rel=1e-15)


def test_the_section_agrees_with_integrals_over_the_ring() -> None:
    # An independent route: thesis by quadrature in r, closed form in the angle.
    radii = np.linspace(0.0138, 0.0159, 2001)
    middle, width = (radii[1:] + radii[:-1]) / 2.0, np.diff(radii)
    assert SECTION.area == pytest.approx(float(np.sum(2.0 * np.pi * middle * width)), rel=1e-6)
    assert SECTION.second_moment == pytest.approx(float(np.sum(np.pi * middle**3 * width)), rel=1e-6)
    assert SECTION.bore_area + SECTION.area == pytest.approx(np.pi * 0.0159**2, rel=1e-15)


def test_a_tube_is_found_for_a_stiffness() -> None:
    tube = TubeSection.of_stiffness(8.0 * SECTION.second_moment, SECTION.wall)
    assert tube.second_moment == pytest.approx(8.0 * SECTION.second_moment, rel=1e-14)
    assert tube.wall == pytest.approx(SECTION.wall, rel=1e-12)
    # The thesis's "equivalent virtual diameter", which it gives as 29.76 mm.
    assert tube.mean_radius == pytest.approx(29.737e-3, abs=5e-7)


def test_shear_strain_is_stress_over_modulus() -> None:
    # A-17 corrected: at 60 N gamma = 5.35e-4, and gamma L/r is the twist; the printed form gives 1867.
    torque = 60.0 * 0.585
    strain = SECTION.shear_strain(torque, SECTION.outer_radius, 24e9)
    assert strain == pytest.approx(5.35e-4, abs=5e-7)
    assert strain * 0.585 / SECTION.outer_radius == pytest.approx(0.01970186665973022, rel=1e-12)
