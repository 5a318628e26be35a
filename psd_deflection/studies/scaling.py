# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Appendix B: a flexible link BC, clamped at B, carries a rigid CD at right angles under a force P at D. Each printed
cell is what the stated modulus gives, or an erratum with its reason."""

import math
from dataclasses import dataclass
from decimal import Decimal
from typing import NamedTuple

from psd_deflection.model.link.section import TubeSection
from psd_deflection.model.link.statics import LinkStatics

FORCE = 60.0
"""N, at D, all cases of Table B1."""

YOUNGS_MODULUS = 69e9
SHEAR_MODULUS = 24e9
"""Pa, aluminium 6061 as in Table B2. E/G = 2.875 would need a Poisson ratio of 0.44; data sheets say G = 26 GPa."""

BASE_LENGTH = 0.585
BASE_SECTION = TubeSection(0.0159, 0.0138)


@dataclass(frozen=True, slots=True)
class TwinLink:
    """BC flexible, CD rigid, both ``length`` (m) long, perpendicular; ``youngs_modulus``, ``shear_modulus`` in Pa."""

    length: float
    section: TubeSection
    youngs_modulus: float = YOUNGS_MODULUS
    shear_modulus: float = SHEAR_MODULUS

    @property
    def statics(self) -> LinkStatics:
        """BC alone."""
        return LinkStatics(
            self.length,
            self.youngs_modulus * self.section.second_moment,
            self.shear_modulus * self.section.polar_moment,
        )

    def bending(self, force: float) -> float:
        """Deflection of C, m (B-2)."""
        return self.statics.deflection(0.0, force, 0.0)[1]

    def twist(self, force: float) -> float:
        """Twist of C under the torque force x length, rad (B-4)."""
        return self.statics.deflection(0.0, 0.0, force * self.length)[2]

    def tip_by_twist(self, force: float, small_angle: bool = False) -> float:
        """Displacement of D by the twist of BC, m: L sin(theta), or L theta."""
        twist = self.twist(force)
        return self.length * (twist if small_angle else math.sin(twist))

    def tip_total(self, force: float, small_angle: bool = False) -> float:
        """Deflection of D by bending and twist of BC, m."""
        return self.bending(force) + self.tip_by_twist(force, small_angle)


def torsion_to_bending_ratio(youngs_modulus: float, shear_modulus: float, length_ratio: float = 1.0) -> float:
    """TBR for small twist: 1.5 (E/G) (L_CD/L_BC)^2.

    B-8 is the case ``length_ratio`` = 1; The appendix concludes that the ratio depends on the
    material alone. This holds only because its two links have equal length.
    """
    return 1.5 * youngs_modulus / shear_modulus * length_ratio**2


def torsion_to_bending_ratio_exact(link: TwinLink, force: float) -> float:
    """B-5 without the small angle: L sin(theta) over the bending deflection.

    The first printed form of B-5 has a further L inside the sine (2.52 instead of 4.31).
    """
    return link.tip_by_twist(force) / link.bending(force)


class Case(NamedTuple):
    """A row of Table B1."""

    number: int
    what: str
    link: TwinLink


def table_b1_cases(youngs_modulus: float = YOUNGS_MODULUS) -> tuple[Case, ...]:
    """Return the six theoretical cases; ``youngs_modulus`` Pa."""
    length, section = 2.0 * BASE_LENGTH, BASE_SECTION
    wall = section.wall
    double_outer = TubeSection(2.0 * section.outer_radius, 2.0 * section.outer_radius - wall)
    double_inner = TubeSection(2.0 * section.inner_radius + wall, 2.0 * section.inner_radius)
    # Twice the length needs 2^3 times the stiffness to bend as before.
    virtual = TubeSection.of_stiffness(8.0 * section.second_moment, wall)
    double_all = TubeSection(2.0 * section.outer_radius, 2.0 * section.outer_radius - 2.0 * wall)
    rows = (
        ('as built', BASE_LENGTH, section),
        ('length x 2', length, section),
        ('length, Ro x 2, wall kept', length, double_outer),
        ('length, Ri x 2, wall kept', length, double_inner),
        ('length x 2, I x 8, wall kept', length, virtual),
        ('length, Ro, wall x 2', length, double_all),
    )
    return tuple(Case(i, what, TwinLink(at, tube, youngs_modulus)) for i, (what, at, tube) in enumerate(rows, start=1))


COLUMNS = ('I', 'J', 'Ro', 'Ri', 'bend', 'twist', 'D by twist', 'D total')
"""Table B1's columns after the length; m^4, m^4, m, m, m, rad, mm, mm as the thesis prints them."""

PRINTED_B1: dict[int, tuple[str, ...]] = {
    1: ('2.17e-8', '4.34e-8', '0.0159', '0.0138', '2.68e-3', '0.020', '11.5', '14.2'),
    2: ('2.17e-8', '4.34e-8', '0.0159', '0.0138', '21.4e-3', '0.08', '92.1', '113.6'),
    3: ('1.92e-7', '3.84e-7', '0.0318', '0.0297', '2.42e-3', '0.009', '10.4', '12.8'),
    4: ('1.55e-7', '3.11e-7', '0.0297', '0.0276', '3e-3', '0.011', '12.9', '15.9'),
    5: ('1.73e-7', '3.46e-7', '0.0308', '0.0287', '2.68e-3', '0.01', '11.5', '14.2'),
    6: ('3.47e-7', '6.94e-7', '0.0318', '0.0276', '1.34e-3', '0.005', '5.8', '7.1'),
}
"""What the thesis prints for the theoretical rows."""

EXPERIMENTAL_ERRATUM = (
    'measured row: 3.38 + 13.0 mm are 16.38 mm, not 29.45; 13.07 mm are unaccounted for by the row itself '
    '(counting the twist twice gives 29.38)'
)

ERRATA_B1: dict[tuple[int, str], str] = {
    (1, 'bend'): 'computed with E = 68.9 GPa; the stated 69 GPa gives 2.67 mm',
    (2, 'D total'): 'adds the small-angle 92.2 mm to the bending, while its own column has the sine, 92.1',
    (5, 'I'): 'belongs to a mean radius of 29.70 mm; 8 times the I of case 1 needs 29.74 mm',
    (5, 'J'): 'belongs to a mean radius of 29.70 mm; 8 times the J of case 1 needs 29.74 mm',
    (5, 'bend'): 'computed with E = 68.9 GPa; the stated 69 GPa gives 2.67 mm',
    (6, 'J'): 'twice the rounded I; 2 x 3.474 rounds to 6.95',
}
"""Cells of Table B1 that the stated inputs do not give, with the reason."""


class TableCell(NamedTuple):
    """One cell of a table of the appendix: computed beside printed."""

    row: str
    column: str
    computed: float
    printed: str
    erratum: str

    @property
    def agrees(self) -> bool:
        """Whether the computed value rounds to the printed one."""
        return round_as(self.computed, self.printed) == Decimal(self.printed)


def round_as(value: float, printed: str) -> Decimal:
    """``value`` rounded to the last digit of ``printed``."""
    return Decimal(repr(value)).quantize(Decimal(printed))


def table_b1(youngs_modulus: float = YOUNGS_MODULUS) -> list[TableCell]:
    """Return every cell of Table B1's theoretical rows, in the thesis's own units."""
    cells = []
    for number, _, link in table_b1_cases(youngs_modulus):
        section = link.section
        computed = (
            section.second_moment,
            section.polar_moment,
            section.outer_radius,
            section.inner_radius,
            link.bending(FORCE),
            link.twist(FORCE),
            link.tip_by_twist(FORCE) * 1e3,
            link.tip_total(FORCE) * 1e3,
        )
        for column, value, printed in zip(COLUMNS, computed, PRINTED_B1[number], strict=True):
            cells.append(TableCell(str(number), column, value, printed, ERRATA_B1.get((number, column), '')))
    return cells


class Material(NamedTuple):
    """A row of Table B2: moduli in Pa, and the ratio as printed."""

    name: str
    youngs_modulus: float
    shear_modulus: float
    printed: str


MATERIALS = (
    Material('Aluminum', 69e9, 24e9, '4.31'),
    Material('Copper', 110e9, 48e9, '3.44'),
    Material('Iron', 211e9, 82e9, '3.86'),
    Material('Carbon fibre 0/90', 70e9, 5e9, '21.0'),
    Material('Carbon fibre +-45', 17e9, 33e9, '0.77'),
    Material('E-glass/epoxy 0/90', 25e9, 4e9, '9.38'),
    Material('E-glass/epoxy +-45', 12e9, 11e9, '1.68'),
)

ERRATA_B2 = {'E-glass/epoxy +-45': '1.5 x 12/11 is 1.636, so 1.64'}


def table_b2() -> list[TableCell]:
    """Return every ratio of Table B2."""
    return [
        TableCell(
            m.name,
            'TBR',
            torsion_to_bending_ratio(m.youngs_modulus, m.shear_modulus),
            m.printed,
            ERRATA_B2.get(m.name, ''),
        )
        for m in MATERIALS
    ]
