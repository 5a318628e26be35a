# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The campaign of strange messages: what it sends, and that it can fail."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip('rclpy')


from bench.campaign.attacked import NODES  # noqa: E402
from test.ros.test_conformance import nodes_of_setup  # noqa: E402
from tools.program import ROOT, WAIT_S  # noqa: E402

ENDED = """
import sys
from bench.campaign.messages import main
from psd_deflection.arms.inputs import KnownJoints
def broken(*_):
    raise RuntimeError('a defect')
KnownJoints.notify = broken
sys.exit(main())
"""


def test_every_node_is_attacked() -> None:
    assert set(NODES) == set(nodes_of_setup())


@pytest.mark.slow
@pytest.mark.parametrize(('script', 'wanted'), [('', 0), (ENDED, 1)])
def test_a_node_that_holds_and_one_that_ends(domain: int, script: str, wanted: int) -> None:
    command = ['-c', script] if script else ['-m', 'bench.campaign.messages']
    words = [sys.executable, *command, '300', '--node', 'shaper', '--dds', '0']
    ended = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert ended.returncode == wanted, ended.stderr[-3000:]
    assert ('EndedError' in ended.stderr) == bool(script)
