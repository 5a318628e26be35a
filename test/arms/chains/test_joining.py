# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The file of a chain, and estimates of its links, whose blocks do not coincide, at common times."""

from pathlib import Path

import numpy as np
import pytest

from psd_deflection.arms.chains.chain import Joined, Joiner
from psd_deflection.arms.chains.chain_file import ChainSettings, read_chain
from psd_deflection.base.errors import ConfigError
from psd_deflection.records import DeflectionEstimate

BLOCK_NS = 20_000_000
NOISE = (4e-12, 0.0, 0.0, 0.0, 9e-12, 0.0, 0.0, 0.0, 1e-10)


def estimate(t_ns: int, x: float) -> DeflectionEstimate:
    return DeflectionEstimate(t_ns, 0, 'exact', x, 2 * x, 3 * x, 0.0, 0.0, NOISE, 0.0, True)


def run(joiner: Joiner, stamps: dict[int, list[int]], x: float = 1e-3) -> list[Joined]:
    """Estimates of each link at its times, in order; each is ``x`` times its time in blocks."""
    events = sorted((t, link) for link, times in stamps.items() for t in times)
    return [j for t, link in events for j in joiner.put(link, estimate(t, x * t / BLOCK_NS))]


def every(start: int, count: int) -> list[int]:
    return [start + n * BLOCK_NS for n in range(count)]


def test_a_line_is_interpolated_at_the_stamps_of_the_first_link() -> None:
    joiner = Joiner([BLOCK_NS] * 3)
    got = run(joiner, {0: every(0, 10), 1: every(7_000_000, 10), 2: every(-5_000_000, 10)})
    # Before 7 ms link 1 had not begun, after 175 ms link 2 has ended.
    assert [j.t_ns for j in got] == every(BLOCK_NS, 8)
    for j in got:
        for tip in j.tips:
            assert tip.pose == pytest.approx(np.array([1, 2, 3]) * 1e-3 * j.t_ns / BLOCK_NS, rel=1e-12)
    assert (joiner.joined, joiner.missing) == (8, [0, 0, 0])
    u = 13 / 20
    assert np.diag(got[-1].tips[1].covariance) == pytest.approx(
        (u**2 + (1 - u) ** 2) * np.array([4e-12, 9e-12, 1e-10]), rel=1e-9
    )
    assert np.diag(got[-1].tips[0].covariance) == pytest.approx([4e-12, 9e-12, 1e-10])


def test_blocks_that_coincide_are_taken_as_they_are() -> None:
    got = run(Joiner([BLOCK_NS] * 2), {0: every(0, 5), 1: every(0, 5)})
    assert [j.t_ns for j in got] == every(0, 5)
    assert np.array_equal(got[3].tips[1].covariance, np.reshape(NOISE, (3, 3)))


def test_interpolated_motion_widens_covariance() -> None:
    joiner = Joiner([BLOCK_NS] * 2)
    out: list[Joined] = []
    for n in range(200):
        out += joiner.put(0, estimate(n * BLOCK_NS, 0.0))
        t_ns = n * BLOCK_NS + BLOCK_NS // 2
        out += joiner.put(1, estimate(t_ns, 1e-3 * np.sin(2 * np.pi * 5.0 * t_ns / 1e9)))
    errors = np.array([j.tips[1].pose[0] - 1e-3 * np.sin(2 * np.pi * 5.0 * j.t_ns / 1e9) for j in out[3:]])
    stated = np.array([j.tips[1].covariance[0, 0] for j in out[3:]])
    # Much more than the noise, and as large as the error is.
    assert np.sqrt(np.mean(errors**2)) > 10 * 2e-6
    assert np.mean(errors**2) / np.mean(stated) == pytest.approx(1.0, abs=0.5)


def test_lost_block_of_other_link_leaves_gap_beside_it() -> None:
    joiner = Joiner([BLOCK_NS] * 2)
    times = [t for t in every(7_000_000, 10) if t != 7_000_000 + 4 * BLOCK_NS]
    got = run(joiner, {0: every(0, 10), 1: times})
    assert [j.t_ns // BLOCK_NS for j in got if j.missing] == [4, 5]
    assert all(j.missing == (1,) and j.tips == () for j in got if j.missing)
    assert (joiner.missing, joiner.joined) == ([0, 2], 7)
    # Three blocks that are not neighbours tell nothing of a curve.
    (after,) = (j.tips[1] for j in got if j.t_ns == 6 * BLOCK_NS)
    u = 13 / 20
    assert after.covariance == pytest.approx((u**2 + (1 - u) ** 2) * np.reshape(NOISE, (3, 3)))


def test_ended_link_is_dropped_and_joins_on_return() -> None:
    joiner = Joiner([BLOCK_NS] * 2)
    got = run(joiner, {0: every(0, 40), 1: every(7_000_000, 5)})
    assert [j.t_ns // BLOCK_NS for j in got if j.missing] == list(range(5, 39 - 25))
    got = run(joiner, {0: every(40 * BLOCK_NS, 10), 1: every(40 * BLOCK_NS + 7_000_000, 10)})
    assert [j.t_ns // BLOCK_NS for j in got if j.tips] == list(range(41, 50))
    assert joiner.missing[1] == 36


def test_lost_blocks_of_first_link_are_counted_later() -> None:
    joiner = Joiner([BLOCK_NS] * 2)
    run(joiner, {0: every(0, 5) + every(8 * BLOCK_NS, 5), 1: every(7_000_000, 13)})
    assert (joiner.missing, joiner.joined) == ([3, 0], 9)


def test_a_clock_that_goes_back_begins_anew() -> None:
    joiner = Joiner([BLOCK_NS] * 2)
    run(joiner, {0: every(10**12, 5), 1: every(10**12 + 7_000_000, 5)})
    got = run(joiner, {0: every(0, 5), 1: every(7_000_000, 5)})
    assert [j.t_ns // BLOCK_NS for j in got if j.tips] == [1, 2, 3, 4]
    assert (joiner.missing, joiner.joined) == ([0, 0], 8)


def test_two_estimates_closer_than_a_block_miss_none() -> None:
    joiner = Joiner([BLOCK_NS] * 2)
    run(joiner, {0: [*every(0, 5), 4 * BLOCK_NS + 6_000_000], 1: every(7_000_000, 6)})
    assert joiner.missing == [0, 0]


EXAMPLE = Path(__file__).parents[3] / 'config' / 'two_links.yaml'


def test_the_example() -> None:
    file = read_chain(EXAMPLE)
    assert file.names == ('upper', 'fore')
    assert [joint.name for joint in file.joints] == ['shoulder', 'elbow']
    assert file.angles == (1.2, 0.6)
    assert [rig.monitor.frame_prefix for rig in file.rigs] == ['upper_', 'fore_']
    assert file.chain.slopes == 'end_force'
    assert file.chain.rigid().position == pytest.approx([0.0, 0.0, 0.1 + 0.585 + 0.05 + 0.585 + 0.1])


def test_a_prefix_is_before_each_frame(tmp_path: Path) -> None:
    (tmp_path / 'chain.yaml').write_text('frame_prefix: left_\nbase_frame: arm\nlinks: [{name: a}, {name: b}]\n')
    file = read_chain(tmp_path / 'chain.yaml')
    assert file.base_frame == 'left_arm'
    assert [rig.monitor.frame_prefix for rig in file.rigs] == ['left_a_', 'left_b_']
    other = file.with_settings(ChainSettings('end_force', 'stand', 'right_'))
    assert (other.base_frame, other.chain.slopes) == ('right_stand', 'end_force')
    assert [rig.monitor.frame_prefix for rig in other.rigs] == ['right_a_', 'right_b_']


def test_each_link_has_its_own_rig(tmp_path: Path) -> None:
    (tmp_path / 'a.yaml').write_text('/**:\n  ros__parameters:\n    link: {length: 0.4, slope_ratio: 1.7}\n')
    (tmp_path / 'chain.yaml').write_text(
        'links:\n'
        '  - {name: a, rig: a.yaml, port: /dev/a, parameters: {solver: wls}, slope_ratio_sd: 0.2}\n'
        '  - {name: b, mount: {xyz: [1, 2, 3], rpy: [0, 1.5707963267948966, 0]}, joint: {axis: [0, 2, 0], angle: 1}}\n'
    )
    file = read_chain(tmp_path / 'chain.yaml', {'record': True, 'bag_dir': 'bags'}, 'end_force')
    a, b = file.chain.links
    assert (a.length, a.slope_ratio, a.slope_ratio_sd) == (0.4, 1.7, 0.2)
    assert (file.rigs[0].acquisition.port, file.rigs[0].estimator.solver) == ('/dev/a', 'wls')
    assert [rig.acquisition.bag_dir for rig in file.rigs] == ['bags/a', 'bags/b']
    assert all(rig.acquisition.record for rig in file.rigs)
    assert np.allclose(b.axis, [0, 1, 0])
    assert np.allclose(b.mount.rotation @ [0, 0, 1], [1, 0, 0])
    assert file.chain.slopes == 'end_force'


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('', 'must be a map with keys of slopes, base_frame, frame_prefix, links'),
        ('links: []', 'links: must be a list of 1 to 32 links'),
        ('link: []', "unknown key 'link'; did you mean links?"),
        ('links: [3]', 'link 1: must be a map with keys of name'),
        ('links: [{rig: x.yaml}]', "link 1: name = '': must be a lower-case letter"),
        ('links: [{name: "a/b"}]', "link 1: name = 'a/b': must be"),
        ('links: [{name: a}, {name: a}]', 'two links have the name a'),
        ('links: [{name: a, rig: gone.yaml}]', 'gone.yaml: no such parameter file'),
        ('links: [{name: a, rig: 3}]', 'link 1: rig = 3: must be text'),
        ('links: [{name: a, mount: {xyz: [0, 0]}}]', 'a: mount: xyz = [0, 0] m: must have 3 elements, has 2'),
        ('links: [{name: a, mount: {xyz: [0, 0, .nan]}}]', 'a: mount: xyz = [0, 0, nan] m: must be finite'),
        ('links: [{name: a, mount: {rpy: [0, 0, true]}}]', 'a: mount: rpy = [0, 0, True] rad: must be a number'),
        ('links: [{name: a, joint: {axis: [0, 0, 0]}}]', 'a: joint: axis: must not be zero'),
        ('links: [{name: a, joint: {name: 4}}]', 'a: joint: name = 4: must be text'),
        ('links: [{name: a, slope_ratio_sd: -1}]', 'link 1: slope_ratio_sd = -1: must be at least 0 and'),
        ('links: [{name: a, parameters: {lenght: 1}}]', 'a: lenght = 1: no parameter of that name'),
        ('links: [{name: a}]\nslopes: none', "slopes = 'none': must be one of end_force, ratio"),
        ('links: [{name: a}]\nbase_frame: ""', "base_frame = '': must be the name of a frame"),
        ('links: [{name: a}]\nframe_prefix: "a b"', "frame_prefix = 'a b': must be"),
        ('links: [{name: a}]\nend_effector: {xyz: 1}', 'end_effector: xyz = 1 m: must be a list'),
    ],
)
def test_rejected(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / 'chain.yaml'
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        read_chain(path)
    assert str(caught.value).startswith(str(tmp_path))
    assert message in str(caught.value)


def test_no_file() -> None:
    with pytest.raises(ConfigError, match=r'gone\.yaml: no such chain file'):
        read_chain('gone.yaml')
