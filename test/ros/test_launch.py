# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The launch files: their arguments reach the node."""

import runpy
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, List  # noqa: UP035, launch knows no list[str]

import pytest
import rclpy

from psd_deflection.arms.chains import chain_file
from psd_deflection.arms.compensation import settings
from psd_deflection.rig.config import load_rig
from psd_deflection.rig.declarations import BY_NAME
from psd_deflection.rig.parameters import Parameter
from psd_deflection.studies.study import described

LAUNCH = Path(__file__).parent.parent.parent / 'launch'
FILE = LAUNCH / 'estimator.launch.py'
KINDS = {'string': str, 'bool': bool, 'double': float, 'integer': int, 'string_array': List[str]}  # noqa: UP006
CHAIN = Parameter('chain', 'string', '', '', '')


class Configuration:
    """Stands for a LaunchConfiguration. (launch comes with a ROS installation, not with the wheels.)"""

    def __init__(self, name: str) -> None:
        self.name = name

    def perform(self, given: Mapping[str, str]) -> str:
        return given.get(self.name, '')


def keep(*words: object, **named: object) -> SimpleNamespace:
    return SimpleNamespace(words=words, **named)


STAND_INS: dict[str, dict[str, Any]] = {
    'launch': {'LaunchDescription': list, 'LaunchContext': dict},
    'launch.actions': {'DeclareLaunchArgument': keep, 'OpaqueFunction': keep},
    'launch.substitutions': {'LaunchConfiguration': Configuration},
    'launch_ros': {},
    'launch_ros.actions': {'Node': keep},
    'launch_ros.parameter_descriptions': {'ParameterValue': lambda value, value_type: (value.name, value_type)},
    'launch_ros.substitutions': {'FindPackageShare': keep},
}


class Launched:
    """What a launch file declares, and the node that it starts with the arguments that are given."""

    def __init__(self, names: dict[str, Any]) -> None:
        self.names = names
        *declared, self._begin = names['generate_launch_description']()
        assert all(part.description for part in declared)
        self.arguments = {part.words[0] for part in declared}

    def start(self, **given: str) -> Any:
        (node,) = self._begin.function(given)
        assert not hasattr(node, 'arguments')
        return node

    def check_types(self, declared: Mapping[str, Any]) -> None:
        """Every argument that is a parameter of the node reaches it with its type, and no other does."""
        for name, (kind, text) in self.names['PARAMETERS'].items():
            assert KINDS[declared[name].kind] == kind, name
            assert text, name
            # Under the node's own name: a line of a file for every node does not win over it.
            assert self.start(**{name: '1'}).parameters == [{name: (name, kind)}]


@pytest.fixture
def launched(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Launched:
    for module, names in STAND_INS.items():
        made = ModuleType(module)
        vars(made).update(names)
        monkeypatch.setitem(sys.modules, module, made)
    return Launched(runpy.run_path(str(LAUNCH / f'{request.param}.launch.py')))


def of(name: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize('launched', [name], indirect=True)


@of('estimator')
def test_arguments_reach_the_estimator_and_nothing_else_does(launched: Launched) -> None:
    assert {'params_file', 'namespace', 'log_level', *launched.names['PARAMETERS']} == launched.arguments
    assert {'port', 'solver', 'autostart', 'record', 'frame_prefix', 'publish_tf'} <= launched.arguments
    launched.check_types(BY_NAME)
    node = launched.start()
    assert (node.parameters, node.namespace.name) == ([], 'namespace')
    assert [w if isinstance(w, str) else w.name for w in node.ros_arguments] == [
        *('--params-file', 'params_file'),
        *('--log-level', 'log_level'),
    ]


@of('chain')
def test_the_chain_is_launched_with_its_file(launched: Launched) -> None:
    assert launched.arguments == {'namespace', *launched.names['PARAMETERS']}
    launched.check_types({**chain_file.SETTINGS.parameters, **BY_NAME, 'chain': CHAIN})
    node = launched.start(chain='two.yaml')
    assert (node.executable, node.namespace.name) == ('chain', 'namespace')
    # A name is text, also one that looks like a number.
    assert node.parameters == [{'chain': ('chain', str)}]


@of('shaper')
def test_arguments_reach_the_shaper(launched: Launched) -> None:
    assert launched.arguments == {'namespace', *launched.names['PARAMETERS'], *launched.names['TOPICS']}
    launched.check_types(settings.SHAPING.parameters)
    node = launched.start()
    assert [(a, b.name) for a, b in node.remappings] == [('~/trajectory', 'given'), ('~/shaped', 'shaped')]


@of('compensator')
def test_arguments_reach_the_compensator(launched: Launched) -> None:
    topics = {launched.names['TOPIC_OF'].get(name, name) for name in launched.names['TOPICS']}
    assert launched.arguments == {'namespace', 'params_file', *launched.names['PARAMETERS'], *topics}
    launched.check_types(settings.SETTINGS.parameters)
    node = launched.start(params_file='p.yaml')
    assert [w if isinstance(w, str) else w.name for w in node.ros_arguments] == ['--params-file', 'params_file']
    assert {(a, b.name) for a, b in node.remappings} == {
        (f'~/{name}', launched.names['TOPIC_OF'].get(name, name)) for name in launched.names['TOPICS']
    }
    assert (launched.start().ros_arguments, launched.start().parameters) == ([], [])


@pytest.mark.skipif(shutil.which('ros2') is None, reason='ros2 launch comes with a ROS installation')
def test_ros2_launch_shows_the_arguments() -> None:
    command = ['ros2', 'launch', str(FILE), '--show-args']
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    for name in ('namespace', 'autostart', 'solver', 'log_level', 'port'):
        assert f"'{name}':" in shown


def test_rcl_reads_the_rig_file_that_a_study_writes(tmp_path: Path) -> None:
    rig, context = tmp_path / 'rig.yaml', rclpy.Context()
    rig.write_text(described(load_rig(), []))
    rclpy.init(args=['--ros-args', '--params-file', str(rig)], context=context)
    rclpy.shutdown(context=context)
