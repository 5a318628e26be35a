# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The kinematics of a URDF file: beside those of the chain, and by finite differences."""

from pathlib import Path

import numpy as np
import pytest

from psd_deflection.arms.chains.chain_file import read_chain
from psd_deflection.arms.compensation.arm import read_arm, read_limits
from psd_deflection.base.errors import ConfigError

URDF = Path(__file__).parents[3] / 'config' / 'two_links.urdf'
EXAMPLE = Path(__file__).parents[3] / 'config' / 'two_links.yaml'
WRIST = """<robot name="r"><link name="a"/><link name="b"/><link name="c"/><link name="d"/>
<joint name="slide" type="prismatic"><parent link="a"/><child link="b"/><origin xyz="1 2 3" rpy="0.1 -0.4 0.9"/>
<axis xyz="0 3 4"/><limit lower="-0.1" upper="0.2"/></joint>
<joint name="turn" type="revolute"><parent link="b"/><child link="c"/><axis xyz="1 1 0"/>
<limit lower="-1" upper="1"/></joint>
<joint name="end" type="fixed"><parent link="c"/><child link="d"/>
<origin xyz="0 0.3 0" rpy="0.5 0 0"/></joint></robot>"""


def test_it_is_the_rigid_chain() -> None:
    arm, file = read_arm(URDF, 'tool'), read_chain(EXAMPLE)
    assert arm.names == ('shoulder', 'elbow')
    assert (arm.lower[0], arm.upper[1]) == (-2.0, np.inf)
    for q in ([0.0, 0.0], [1.2, 0.6], [-0.3, 2.0]):
        rigid = file.chain.rigid(q)
        pose = arm.pose(np.array(q))
        assert pose.position == pytest.approx(rigid.position, abs=1e-12)
        assert pose.rotation == pytest.approx(rigid.rotation, abs=1e-12)


@pytest.mark.parametrize('base', ['', 'b'])
def test_the_jacobian_is_the_derivative(tmp_path: Path, base: str) -> None:
    (tmp_path / 'arm.urdf').write_text(WRIST)
    arm = read_arm(tmp_path / 'arm.urdf', 'd', base)
    assert arm.names == (('slide', 'turn') if not base else ('turn',))
    q = np.array([0.05, 0.7])[-len(arm.names) :]
    jacobian, at, h = arm.jacobian(q), arm.pose(q), 1e-6
    for n in range(len(q)):
        moved = arm.pose(q + h * np.eye(len(q))[n])
        rotated = moved._replace(rotation=moved.rotation @ at.rotation.T).rotation_vector
        assert jacobian[:, n] == pytest.approx(np.concatenate([moved.position - at.position, rotated]) / h, abs=1e-5)


@pytest.mark.parametrize(
    ('old', 'new', 'message'),
    [
        ('<robot', '<!DOCTYPE robot [<!ENTITY a "b">]><robot', 'has a document type or entities'),
        ('</robot>', '', 'not XML'),
        ('robot', 'model', 'its root is <model>, not <robot>'),
        ('<link name="d"/>', '', 'tip: no link d'),
        ('type="prismatic"', 'type="floating"', 'joint slide: type floating: must be one of revolute'),
        ('<axis xyz="1 1 0"/>', '<axis xyz="1 1 0"/><mimic joint="slide"/>', 'joint turn: mimics another joint'),
        ('<axis xyz="1 1 0"/>', '<axis xyz="0 0 0"/>', 'joint turn: its axis is zero'),
        ('xyz="1 2 3"', 'xyz="1 2 nan"', "joint slide: xyz = '1 2 nan': must be 3 finite numbers"),
        ('lower="-1"', 'lower="2"', 'joint turn: lower = 2 is above upper = 1'),
        ('lower="-1"', 'lower="low"', "joint turn: lower = 'low': must be 1 finite number"),
        ('lower="-1"', 'lower="-1_0"', "joint turn: lower = '-1_0': must be 1 finite number"),
        ('upper="0.2"', 'upper="٣"', 'joint slide: upper'),
        ('lower="-1"', 'lower="-1 0"', 'must be 1 finite number'),
        ('name="end"', 'name="turn"', 'joint turn: there are two of that name'),
        ('<child link="b"/>', '', 'no joints lead from a to d'),
    ],
)
def test_rejected(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / 'arm.urdf'
    path.write_text(WRIST.replace(old, new))
    with pytest.raises(ConfigError) as caught:
        read_arm(path, 'd', 'a')
    assert str(caught.value).startswith(str(path))
    assert message in str(caught.value)


def test_a_negative_speed_is_no_limit(tmp_path: Path) -> None:
    path = tmp_path / 'arm.urdf'
    path.write_text(WRIST.replace('lower="-1"', 'velocity="-1" lower="-1"'))
    with pytest.raises(ConfigError, match='joint turn: velocity = -1: must be at least 0'):
        read_limits(path)
    with pytest.raises(ConfigError, match='joint turn: velocity = -1: must be at least 0'):
        read_arm(path, 'd')
    path.write_text(WRIST.replace('lower="-1"', 'velocity="1.5e0" lower="-1"'))
    assert read_limits(path)['turn'].speed == 1.5


def test_a_tip_that_does_not_move(tmp_path: Path) -> None:
    (tmp_path / 'arm.urdf').write_text(WRIST)
    with pytest.raises(ConfigError, match='no joint between base and tip moves'):
        read_arm(tmp_path / 'arm.urdf', 'd', 'c')


@pytest.mark.parametrize('text', ['-1_0', '٣'])
def test_a_limit_that_is_no_number_is_rejected(text: str, tmp_path: Path) -> None:
    urdf = tmp_path / 'arm.urdf'
    urdf.write_text(
        '<robot name="a"><link name="base"/><link name="tool"/><joint name="j" type="revolute"><parent link="base"/>'
        f'<child link="tool"/><axis xyz="0 0 1"/><limit lower="{text}" upper="1" velocity="1" effort="1"/>'
        '</joint></robot>'
    )
    with pytest.raises(ConfigError, match='must be 1 finite number'):
        read_arm(urdf, 'tool')
