# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Link statics both ways, and the cross-section they rest on."""

import numpy as np
import pytest

from psd_deflection.model.link import LinkStatics
from psd_deflection.model.link.section import TubeSection
from psd_deflection.rig.config import load_rig

LINK = LinkStatics.from_rig(load_rig())
SECTION = TubeSection(0.0159, 0.0138)


def test_the_beam_constants_of_the_thesis_rig() -> None:
    # A 50 N sidebar load at a lever of one link length.
    dx, dy, theta = LINK.deflection(0.0, -50.0, 50.0 * 0.585)
    assert dx == 0.0
    assert dy == pytest.approx(-2.2271675e-3, abs=1e-10)
    assert theta == pytest.approx(0.016418222, abs=1e-9)


def test_load_to_deflection_and_back() -> None:
    load = (11.0, -23.0, 4.5)
    assert LINK.tip_load(*LINK.deflection(*load)) == pytest.approx(load, rel=1e-15)


def test_the_weight_of_the_link_bends_it_and_turns_its_clamp() -> None:
    # Tip deflection by a unit force at x, summed over the weight: x^2 (3 L - x)/(6 EI), and c x L by the clamp.
    length, stiffness, compliance, weight = 0.585, 1529.0, 3e-5, 12.0
    x = (np.arange(20_000) + 0.5) * length / 20_000
    by_unit = x**2 * (3.0 * length - x) / (6.0 * stiffness) + compliance * x * length
    want = weight * float(by_unit.mean()) * length
    assert LinkStatics(length, stiffness, 1e3, clamp_bending=compliance).sag(weight) == pytest.approx(want, rel=1e-8)


def test_soft_clamp_rotates_by_moment_and_torque() -> None:
    soft = LinkStatics(0.585, 1529.0, 1042.0, clamp_bending=3e-5, clamp_torsion=2e-4)
    dx, dy, theta = soft.deflection(7.0, -11.0, 5.0)
    by_force = 0.585**3 / (3.0 * 1529.0) + 3e-5 * 0.585**2
    assert (dx, dy) == pytest.approx((7.0 * by_force, -11.0 * by_force), rel=1e-14)
    assert theta == pytest.approx(5.0 * (0.585 / 1042.0 + 2e-4), rel=1e-14)


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


def test_a_tube_is_found_for_a_stiffness() -> None:
    tube = TubeSection.of_stiffness(8.0 * SECTION.second_moment, SECTION.wall)
    assert tube.second_moment == pytest.approx(8.0 * SECTION.second_moment, rel=1e-14)
    assert tube.wall == pytest.approx(SECTION.wall, rel=1e-12)
    # The thesis's "equivalent virtual diameter", which it gives as 29.76 mm.
    assert tube.mean_radius == pytest.approx(29.737e-3, abs=5e-7)
    rod = TubeSection.of_stiffness(np.pi / 4.0 * 0.01**4, 0.01)
    assert (rod.outer_radius, rod.inner_radius) == pytest.approx((0.01, 0.0), abs=1e-16)
