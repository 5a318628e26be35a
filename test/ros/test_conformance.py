"""What every node does alike. A new node is in the table, or the first test fails."""

from __future__ import annotations

import ast
import importlib
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from rcl_interfaces.msg import Log  # noqa: E402
from rcl_interfaces.srv import DescribeParameters, ListParameters  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

from test.ros.conftest import WARNINGS  # noqa: E402
from tools.program import PSD_DEFLECTION, ROOT, WAIT_S, Program  # noqa: E402

ROS = ROOT / 'psd_deflection' / 'ros'
NODES: Mapping[str, tuple[str, ...]] = {
    'estimator': (),
    'camera': (),
    'chain': (str(ROOT / 'config' / 'two_links.yaml'),),
    'compensator': (str(ROOT / 'config' / 'two_links.urdf'), '--tip', 'tool', '--axes', 'x,z'),
    'shaper': ('--shaper', 'none'),
}
"""Every node, with the words that it needs."""
WITH_PARAMETERS = ('estimator', 'compensator', 'shaper')
LISTENS_TO_JOINTS = ('chain', 'compensator', 'shaper')
OF_THEIR_OWN = {
    'gate.py': 'the gate',
    'wires.py': 'inputs of a session, which judges each message',
    'camera.py': 'images, each of which is judged as a frame',
}
"""Files that may subscribe."""


def modules() -> dict[str, ast.Module]:
    return {path.name: ast.parse(path.read_text()) for path in sorted(ROS.glob('*.py'))}


def test_every_node_is_in_the_table() -> None:
    names = {
        importlib.import_module(f'psd_deflection.ros.{Path(name).stem}').NODE_NAME
        for name, tree in modules().items()
        for node in tree.body
        if isinstance(node, ast.Assign) and [ast.unparse(t) for t in node.targets] == ['NODE_NAME']
    }
    assert names == set(NODES)
    setup = (ROOT / 'setup.py').read_text()
    assert all(f'{name} = ' in setup or f"'{name}'" in setup for name in NODES)


def test_messages_come_in_through_the_gate() -> None:
    own = {
        name
        for name, tree in modules().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and node.attr == 'create_subscription'
    }
    assert own <= set(OF_THEIR_OWN)


@pytest.mark.parametrize('name', NODES)
def test_an_unknown_parameter_is_refused_by_name(name: str, domain: int, tmp_path: Path) -> None:
    command = [*PSD_DEFLECTION, name, *NODES[name], '--ros-args', '-p', 'max_ofset:=0.5']
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert ended.returncode == 3, ended.stderr
    assert 'max_ofset' in ended.stderr


@pytest.mark.parametrize('name', NODES)
def test_a_node_logs_reports_and_survives_strangers(name: str, peer: Any, tmp_path: Path) -> None:
    logged: list[Log] = []
    latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    subscription = peer.node.create_subscription(Log, '/rosout', logged.append, latched)
    reports = peer.collect(DiagnosticArray, '/diagnostics')
    joints = peer.node.create_publisher(JointState, '/joint_states', 5)
    node = Program([*PSD_DEFLECTION, name, *NODES[name]], env={'PYTHONWARNINGS': WARNINGS}, cwd=tmp_path)
    try:
        peer.until(lambda: any(line.name == name for line in logged), f'a line of {name} on /rosout')
        peer.until(lambda: bool(reports), 'diagnostics')
        names = peer.call(ListParameters, f'/{name}/list_parameters', ListParameters.Request()).result.names
        own = [n for n in names if n != 'use_sim_time' and not n.startswith(('qos_overrides', 'start_type'))]
        if name in WITH_PARAMETERS:
            request = DescribeParameters.Request(names=own)
            described = peer.call(DescribeParameters, f'/{name}/describe_parameters', request).descriptors
            assert [d.name for d in described if not d.description] == []
        if name in LISTENS_TO_JOINTS:
            strange = ('shoulder', 'elbow'), [1e300, 1e300]

            def refused() -> bool:
                joints.publish(JointState(name=strange[0], position=strange[1]))
                values = {v.key: v.value for report in reports[-3:] for s in report.status for v in s.values}
                return name == 'shaper' or int(values.get('messages refused: joint_states', '0')) > 0

            peer.until(refused, 'the refusal of joints at 1e300')
        count = len(reports)
        peer.until(lambda: len(reports) > count, 'diagnostics after it')
        assert node.process.poll() is None
    finally:
        node.end()
        peer.node.destroy_subscription(subscription)
