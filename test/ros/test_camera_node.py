# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The node ``camera``: images in, references and diagnostics out."""

import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from sensor_msgs.msg import Image

from blind.render import Pose, Scene, photograph
from tools.program import PSD_DEFLECTION, Program

pytestmark = pytest.mark.ros


def message(image: Any, seconds: int) -> Image:
    out = Image(height=image.shape[0], width=image.shape[1], encoding='mono8', step=image.shape[1])
    out.data = image.tobytes()
    out.header.stamp.sec = seconds
    return out


def test_images_become_references_and_a_rejected_one_its_reason(domain: int, peer: Any, tmp_path: Path) -> None:
    scene, rng = Scene(), np.random.default_rng(0)
    parameters = tmp_path / 'camera.yaml'
    parameters.write_text(f'camera.matrix: {scene.matrix}\ncamera.exposure: 0.01\nrest.frames: 1\n')
    node = Program([*PSD_DEFLECTION, 'camera', '--params-file', str(parameters)])
    try:
        publisher = peer.node.create_publisher(Image, '/image', 10)
        poses = peer.collect(PoseStamped, '/reference/deflection')
        certain = peer.collect(PoseWithCovarianceStamped, '/reference/deflection_with_covariance')
        reports = peer.collect(DiagnosticArray, '/diagnostics')
        still = message(photograph(scene, [Pose()], rng), 1)
        moved = message(photograph(scene, [Pose(1e-3, -2e-3, 0.05)], rng), 2)
        dark = message(np.full((480, 640), 20, np.uint8), 3)

        def reported(image: Image, condition: Any) -> Any:
            def asked() -> bool:
                publisher.publish(image)
                return bool(condition())

            return asked

        peer.until(reported(still, lambda: poses and certain), 'the rest')
        peer.until(
            reported(moved, lambda: poses[-1].header.stamp.sec == 2 and certain[-1].header.stamp.sec == 2), 'a pose'
        )
        at = poses[-1].pose.position
        assert (poses[-1].header.frame_id, poses[-1].header.stamp.nanosec) == ('link_tip_rest', 5_000_000)
        assert [at.x, at.y] == pytest.approx([1e-3, -2e-3], abs=10e-6)
        assert 0.0 < certain[-1].pose.covariance[0] < 1e-10

        def rejected() -> bool:
            return any('no target' in s.message for r in reports for s in r.status)

        peer.until(reported(dark, rejected), 'the reason')
    finally:
        node.end(signal.SIGINT)
