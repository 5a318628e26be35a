# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The file of a chain: what it says, and how it is rejected."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from psd_deflection.arms.chains.chain_file import ChainSettings, read_chain
from psd_deflection.base.errors import ConfigError

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
    assert file.rigs[0].acquisition.port == '/dev/a'
    assert file.rigs[0].estimator.solver == 'wls'
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
