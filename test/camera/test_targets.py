# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What every kind of target must do: its print, photographed, is found again; it says its own sizes and no other's."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest

from blind.render import Pose, Scene, board, developed
from psd_deflection.camera.answer import NoPoseError, Status, TargetPose
from psd_deflection.camera.kinds import TARGETS, target_class
from psd_deflection.camera.lens import Lens
from psd_deflection.camera.print_target import printed
from psd_deflection.camera.reference import CameraReference
from psd_deflection.camera.settings import SETTINGS, CameraSettings
from psd_deflection.camera.target import Drawing, Target
from psd_deflection.camera.targets import target_of

SCENE = Scene(width=640, height=480, focal=2000.0, centre=(325.0, 236.0), distance=0.42)
MOVED = Pose(2e-3, -1e-3, math.radians(2.0), 0.02, -0.01)
DOTS_PER_METRE = 600 / 0.0254
CAPTION = round(0.012 * DOTS_PER_METRE)
"""Rows of the paper below the target that have no counterpart above it."""


def settings_of(kind: str) -> CameraSettings:
    return CameraSettings(target=kind, matrix=tuple(SCENE.matrix), rest_frames=1)


def found_again(settings: CameraSettings, make: type[Target]) -> None:
    """Fail unless the printed target is found where it is, and no target on an empty plate."""
    target, rng = make(settings), np.random.default_rng(3)
    paper = cv2.imdecode(np.frombuffer(printed(target, 'png'), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert paper is not None
    white = paper[:-CAPTION] / 255.0
    size = (white.shape[1] / DOTS_PER_METRE, white.shape[0] / DOTS_PER_METRE)

    def photographed(pose: Pose, texture: Any) -> Any:
        return developed(SCENE, board(SCENE, pose, texture, size), rng)

    reference = CameraReference(settings, make)
    answers = reference.take(0, photographed(Pose(), white))
    answers += reference.take(1, photographed(MOVED, white))
    answers += reference.take(2, photographed(MOVED, np.ones((2, 2))))
    assert [a.status is Status.OK for a in answers] == [True, True, False]
    answer = answers[1]
    off = np.array([answer.dx - MOVED.dx, answer.dy - MOVED.dy, answer.theta - MOVED.theta])
    assert np.all(np.abs(off) < [20e-6, 20e-6, math.radians(0.05)]), off
    assert answer.covariance is not None
    assert np.all(np.abs(off) < 5.0 * np.sqrt(np.diag(answer.covariance))), off


@pytest.mark.slow
@pytest.mark.parametrize('kind', TARGETS)
def test_a_printed_target_is_found_again(kind: str) -> None:
    found_again(settings_of(kind), target_class(kind))


@pytest.mark.parametrize('kind', TARGETS)
def test_a_target_describes_itself_by_its_own_settings(kind: str) -> None:
    target = target_of(settings_of(kind))
    assert target.kind == kind
    names = [line.split(':')[0] for line in target.describe()]
    assert names == ['target.kind', *(SETTINGS.parameters[own].name for own in target.own)]
    assert all(name.startswith('target.') for name in names)
    # They make the same target again, and each of them is a setting that somebody has.
    values = dict(line.split(': ') for line in target.describe())
    same = SETTINGS.read({**values, 'camera.matrix': SCENE.matrix} | _numbers(values), 'as printed')
    assert target_of(same).describe() == target.describe()


def _numbers(values: dict[str, str]) -> dict[str, object]:
    kinds = {p.name: p.kind for p in SETTINGS.parameters.values()}
    read = {'double': float, 'integer': int}
    return {name: read[kinds[name]](text) for name, text in values.items() if kinds[name] in read}


def test_every_size_in_the_settings_is_of_some_kind() -> None:
    own = {f'{SETTINGS.parameters[name].name}' for kind in TARGETS for name in target_class(kind).own}
    sizes = {p.name for p in SETTINGS.parameters.values() if p.name.startswith('target.')}
    assert sizes - own == {'target.kind'}


class Cross(Target):
    """A kind that finds nothing, or something everywhere."""

    kind = 'cross'
    own = ()
    everywhere = False

    def locate(self, image: Any, grey: Any, lens: Lens, full_scale: float) -> TargetPose:
        if self.everywhere:
            return TargetPose(np.eye(3), np.array([0.0, 0.0, 1.0]), np.eye(6), 0.0, 1, np.zeros((1, 2)))
        raise NoPoseError(Status.MISSING)

    def drawing(self) -> Drawing:
        return Drawing((0.05, 0.05), discs=((0.0, 0.0, 0.01),))
