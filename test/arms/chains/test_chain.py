# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Composed deflections beside an independent finite-element frame (PyNite), and their covariance beside chance."""

import numpy as np
import pytest

from psd_deflection.arms.chains.chain import Chain, ChainLink, EndEffector, TipDeflection
from psd_deflection.arms.chains.transform import IDENTITY, Transform, of_position_and_angles, shift
from psd_deflection.base.errors import ConfigError
from psd_deflection.model.link.statics import LinkStatics
from psd_deflection.records import FloatArray
from psd_deflection.studies.scaling import FORCE, TwinLink, table_b1_cases

CERTAIN = np.zeros((3, 3))
RIGID = 1e7
"""How much stiffer than the link a piece is that does not bend."""


def random_chain(rng: np.random.Generator, links: int, slopes: str) -> Chain:
    """Links of other stiffnesses in other directions, with joints between them that have a size."""
    return Chain(
        [
            ChainLink(
                f'link_{n}',
                of_position_and_angles(rng.uniform(-0.1, 0.1, 3) * (n > 0), rng.uniform(-1.2, 1.2, 3)),
                LinkStatics(rng.uniform(0.3, 0.7), rng.uniform(800.0, 2000.0), rng.uniform(600.0, 1500.0)),
            )
            for n in range(links)
        ],
        of_position_and_angles(rng.uniform(-0.1, 0.1, 3), rng.uniform(-1.0, 1.0, 3)),
        slopes,
    )


class Frame:
    """A chain as a frame of beams. ``tips``: dX, dY, theta of each link; ``end`` (6,).

    ``force`` (3,) at its end, ``others`` (N, 3) at the tips, N in the base.
    """

    def __init__(self, chain: Chain, force: FloatArray, inner: FloatArray | None = None) -> None:
        pynite = pytest.importorskip('Pynite', reason='the finite elements: pip install PyNiteFEA')
        self.model = pynite.FEModel3D()
        self.model.add_material('unit', 1.0, 1.0, 0.0, 0.0)
        self._count = 0
        at = IDENTITY
        root = self._node(at.position)
        self.model.def_support(root, *([True] * 6))
        ends: list[tuple[str, str, Transform, float]] = []
        for link in chain.links:
            base = at @ link.base(0.0)
            foot = self._beam(root, at.position, base, RIGID, RIGID)
            tip = base @ shift(0.0, 0.0, link.length)
            root = self._beam(
                foot, base.position, tip, link.statics.bending_stiffness, link.statics.torsional_stiffness
            )
            ends.append((foot, root, base, link.length))
            at = tip
        end = self._beam(root, at.position, at @ chain.end, RIGID, RIGID)
        loads = [(end, force)] if inner is None else [(end, force), *zip((e[1] for e in ends), inner, strict=True)]
        for node, vector in loads:
            for axis, value in zip('XYZ', vector, strict=True):
                self.model.add_node_load(node, f'F{axis}', float(value))
        self.model.analyze_linear()
        self.end = self._moved(end)
        self.tips = []
        for foot, tip_name, base, length in ends:
            below, above = self._moved(foot), self._moved(tip_name)
            carried = below[:3] + np.cross(below[3:], base.rotation[:, 2] * length)
            bent, rotated = base.rotation.T @ (above[:3] - carried), base.rotation.T @ (above[3:] - below[3:])
            self.tips.append(np.array([bent[0], bent[1], rotated[2]]))

    def _node(self, at: FloatArray) -> str:
        self._count += 1
        self.model.add_node(f'N{self._count}', *map(float, at))
        return f'N{self._count}'

    def _beam(self, start: str, at: FloatArray, end: Transform, bending: float, torsion: float) -> str:
        if np.linalg.norm(end.position - at) < 1e-9:
            return start
        name = f'{bending} {torsion}'
        if name not in self.model.sections:
            self.model.add_section(name, RIGID, bending, bending, torsion)
        node = self._node(end.position)
        self.model.add_member(f'M{node}', start, node, 'unit', name)
        return node

    def _moved(self, node: str) -> FloatArray:
        n = self.model.nodes[node]
        return np.array([d['Combo 1'] for d in (n.DX, n.DY, n.DZ, n.RX, n.RY, n.RZ)])


def in_base(tip: EndEffector) -> FloatArray:
    """Translation and rotation vector of the end effector, in the base."""
    return np.concatenate([tip.rigid.rotation @ tip.vector[:3], tip.rigid.rotation @ tip.vector[3:]])


def assert_agrees(tip: EndEffector, truth: FloatArray, share: float) -> None:
    moved = in_base(tip)
    for part in (slice(0, 3), slice(3, 6)):
        assert np.linalg.norm(moved[part] - truth[part]) < share * np.linalg.norm(truth[part])


CASES = [pytest.param(case.link, id=case.what) for case in table_b1_cases()]


@pytest.mark.slow
@pytest.mark.parametrize('link', CASES)
def test_point_d_of_appendix_b(link: TwinLink) -> None:
    chain = Chain([ChainLink('BC', IDENTITY, link.statics)], shift(link.length, 0.0, 0.0))
    # The frame's model is of first order: a tenth of the force of the appendix.
    frame = Frame(chain, np.array([0.0, 0.1 * FORCE, 0.0]))
    assert_agrees(chain.compose([TipDeflection(frame.tips[0], CERTAIN)]), frame.end, 0.005)
    # The appendix lets the twist carry D along an arc, as the composed pose does.
    bent = chain.tips_under(np.array([0.0, FORCE, 0.0]))[0]
    tip = chain.compose([TipDeflection(bent, CERTAIN)])
    assert tip.vector[1] == pytest.approx(link.tip_total(FORCE), rel=1e-3)


@pytest.mark.parametrize('seed', range(6))
def test_three_links_in_any_direction_bend_as_a_frame_of_beams(seed: int) -> None:
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, 3, 'end_force')
    force = rng.uniform(-5.0, 5.0, 3)
    frame = Frame(chain, force)
    assert_agrees(chain.compose([TipDeflection(tip, CERTAIN) for tip in frame.tips]), frame.end, 0.005)
    assert chain.tips_under(force) == pytest.approx(np.array(frame.tips), rel=1e-4, abs=1e-9)


def test_slope_ratio_of_force_is_wrong_for_inner_link() -> None:
    """What docs/chains.md says of ``ratio``; the moment of the next link's load bends too."""
    rng = np.random.default_rng(0)
    chain = random_chain(rng, 3, 'ratio')
    frame = Frame(chain, np.array([3.0, -4.0, 5.0]))
    moved = in_base(chain.compose([TipDeflection(tip, CERTAIN) for tip in frame.tips]))
    error = np.linalg.norm(moved[:3] - frame.end[:3]) / np.linalg.norm(frame.end[:3])
    assert 0.03 < error < 0.3


def test_chain_without_load_entry_assumes_end_force() -> None:
    rng = np.random.default_rng(3)
    asked = random_chain(rng, 3, 'end_force')
    chain = Chain(asked.links, asked.end)
    frame = Frame(chain, np.array([3.0, -4.0, 5.0]))
    assert_agrees(chain.compose([TipDeflection(tip, CERTAIN) for tip in frame.tips]), frame.end, 0.007)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('slopes', 'share'), [('end_force', 0.0), ('end_force', 0.3), ('end_force', 1.0), ('ratio', 0.0)]
)
def test_covariance_covers_other_forces_than_assumed(slopes: str, share: float) -> None:
    """Readings without noise, and other forces at the tips, ``share`` of that at the end."""
    inside, error, stated = [], [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        chain = random_chain(rng, 3, slopes)
        force, inner = rng.uniform(-5.0, 5.0, 3), share * rng.uniform(-5.0, 5.0, (3, 3))
        frame = Frame(chain, force, inner)
        effector = chain.compose([TipDeflection(tip, CERTAIN) for tip in frame.tips])
        rotated = np.kron(np.eye(2), effector.rigid.rotation)
        deviations = np.sqrt(np.diag(rotated @ effector.covariance @ rotated.T))
        miss = np.abs(in_base(effector) - frame.end)
        inside.extend(miss < 1.96 * deviations)
        error.append(np.linalg.norm(miss[:3]))
        stated.append(np.linalg.norm(deviations[:3]))
    assert np.mean(inside) > 0.85
    # Nor does it hold anything: it is of the size of the errors.
    assert np.median(stated) < 6.0 * np.median(error)


@pytest.mark.parametrize('slopes', ['ratio', 'end_force'])
def test_covariance_is_carried_by_finite_differences(slopes: str) -> None:
    rng, h = np.random.default_rng(5), 1e-6
    chain, angles = random_chain(rng, 3, slopes), [0.3, -0.8, 1.1]
    tips = np.array(chain.tips_under(np.array([30.0, -40.0, 20.0])))
    mixed = rng.normal(size=(3, 3, 3)) * 1e-4
    covariances = mixed @ mixed.transpose(0, 2, 1)

    def deflected(change: FloatArray) -> Transform:
        poses = tips + change.reshape(3, 3)
        return chain.compose([TipDeflection(pose, CERTAIN) for pose in poses], angles).deflection

    slope = np.empty((6, 9))
    for column, change in zip(slope.T, h * np.eye(9), strict=True):
        above, below = deflected(change), deflected(-change)
        moved = Transform(above.rotation @ below.rotation.T, above.position - below.position)
        column[:] = np.concatenate([moved.position, moved.rotation_vector]) / (2.0 * h)
    effector = chain.compose([TipDeflection(p, c) for p, c in zip(tips, covariances, strict=True)], angles)
    want = sum(slope[:, n : n + 3] @ c @ slope[:, n : n + 3].T for n, c in zip((0, 3, 6), covariances, strict=True))
    np.testing.assert_allclose(effector.covariance - effector.of_model, want, rtol=2e-3, atol=1e-12)


def test_an_uncertain_slope_ratio_widens_by_its_lever() -> None:
    link = ChainLink('BC', IDENTITY, LinkStatics(0.5, 1500.0, 1000.0), slope_ratio_sd=0.1)
    chain = Chain([link], shift(0.0, 0.0, 0.4))
    effector = chain.compose([TipDeflection(np.array([1e-3, 0.0, 0.0]), CERTAIN)])
    deviations = np.sqrt(np.diag(effector.covariance - effector.of_model))
    # k dX/L turns the tip about Y, and the end effector is 0.4 m beyond it.
    assert deviations[4] == pytest.approx(0.1 * 1e-3 / 0.5, rel=1e-5)
    assert deviations[0] == pytest.approx(0.4 * deviations[4], rel=1e-4)
    assert deviations[[1, 3, 5]] == pytest.approx(0.0, abs=1e-9)
    # Bent aslant: what is beyond goes further the same way, so x and y err together.
    aslant = chain.compose([TipDeflection(np.array([1e-3, 2e-3, 0.0]), CERTAIN)])
    covariance = aslant.covariance - aslant.of_model
    sd = np.sqrt(np.diag(covariance))
    assert sd[1] == pytest.approx(2.0 * sd[0], rel=1e-3)
    assert covariance[0, 1] == pytest.approx(sd[0] * sd[1], rel=1e-3)


def test_joints_turn_what_follows_them() -> None:
    straight = LinkStatics(0.5, 1500.0, 1000.0)
    elbow = ChainLink('fore', IDENTITY, straight, axis=np.array([0.0, 1.0, 0.0]))
    chain = Chain([ChainLink('upper', IDENTITY, straight), elbow])
    assert chain.rigid().position == pytest.approx([0.0, 0.0, 1.0])
    assert chain.rigid([0.0, np.pi / 2]).position == pytest.approx([0.5, 0.0, 0.5])
    twisted = [TipDeflection(np.array([0.0, 0.0, 0.01]), CERTAIN), TipDeflection(np.zeros(3), CERTAIN)]
    effector = chain.compose(twisted, [0.0, np.pi / 2])
    assert in_base(effector)[:3] == pytest.approx([0.5 * (np.cos(0.01) - 1), 0.5 * np.sin(0.01), 0.0], abs=1e-12)
    assert in_base(effector)[3:] == pytest.approx([0.0, 0.0, 0.01], abs=1e-12)


def test_what_is_no_chain_is_rejected() -> None:
    link = ChainLink('BC', IDENTITY, LinkStatics(0.5, 1500.0, 1000.0))
    for links, words in (([], 'at least one link'), ([link, link], 'two links have the name BC')):
        with pytest.raises(ConfigError, match=words):
            Chain(links)
    with pytest.raises(ConfigError, match='slopes = none: must be one of end_force, ratio'):
        Chain([link], slopes='none')
    with pytest.raises(ValueError, match='2 deflections for 1 links'):
        Chain([link]).compose([TipDeflection(np.zeros(3), CERTAIN)] * 2)
    with pytest.raises(ValueError, match='2 angles for 1 joints'):
        Chain([link]).rigid([0.0, 0.0])
