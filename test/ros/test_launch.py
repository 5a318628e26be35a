# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The launch files: their arguments reach the node."""

from __future__ import annotations

import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from psd_deflection.cli.main import make_parser
from psd_deflection.rig.declarations import BY_NAME

LAUNCH = Path(__file__).parent.parent.parent / 'launch'
FILE = LAUNCH / 'estimator.launch.py'
KINDS = {'string': str, 'bool': bool, 'double': float, 'integer': int}


class Configuration:
    """Stands for a LaunchConfiguration. (launch comes with a ROS installation, not with the wheels.)"""

    def __init__(self, name: str) -> None:
        self.name = name

    def perform(self, context: dict[str, str]) -> str:
        return context[self.name]


@pytest.fixture
def launch_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stand-ins for launch and launch_ros that keep their arguments."""

    def keep(*words: object, **named: object) -> SimpleNamespace:
        return SimpleNamespace(words=words, **named)

    modules: dict[str, dict[str, Any]] = {
        'launch': {'LaunchContext': object, 'LaunchDescription': list},
        'launch.actions': {'DeclareLaunchArgument': keep, 'OpaqueFunction': keep},
        'launch.substitutions': {'LaunchConfiguration': Configuration},
        'launch_ros': {},
        'launch_ros.actions': {'Node': keep},
        'launch_ros.parameter_descriptions': {'ParameterValue': lambda value, value_type: (value.name, value_type)},
        'launch_ros.substitutions': {'FindPackageShare': keep},
    }
    for module, names in modules.items():
        made = ModuleType(module)
        vars(made).update(names)
        monkeypatch.setitem(sys.modules, module, made)


@pytest.fixture
def launch_file(launch_modules: None) -> dict[str, Any]:
    """The names of the estimator's launch file."""
    return runpy.run_path(str(FILE))


def test_every_argument_is_a_parameter_of_its_type(launch_file: dict[str, Any]) -> None:
    arguments = launch_file['PARAMETERS']
    assert {'port', 'solver', 'autostart', 'record', 'frame_prefix', 'publish_tf'} <= arguments.keys()
    for name, (kind, text) in arguments.items():
        assert KINDS[BY_NAME[name].kind] is kind, name
        assert text, name


def test_what_is_given_reaches_the_node_and_nothing_else_does(launch_file: dict[str, Any]) -> None:
    declared = {a.words[0]: a for a in launch_file['generate_launch_description']() if hasattr(a, 'description')}
    assert {'params_file', 'namespace', 'log_level', *launch_file['PARAMETERS']} == declared.keys()
    assert all(a.description for a in declared.values())
    context = dict.fromkeys(declared, '')
    (plain,) = launch_file['estimator'](context)
    assert plain.parameters == []
    given = {'solver': 'wls', 'autostart': 'false'}
    (node,) = launch_file['estimator']({**context, **given})
    assert node.parameters == [{'solver': ('solver', str), 'autostart': ('autostart', bool)}]
    assert node.namespace.name == 'namespace'
    assert [w if isinstance(w, str) else w.name for w in node.ros_arguments] == [
        *('--params-file', 'params_file'),
        *('--log-level', 'log_level'),
    ]


def test_the_chain_is_launched_with_its_file(launch_modules: None) -> None:
    names = runpy.run_path(str(LAUNCH / 'chain.launch.py'))
    declared = {a.words[0]: a for a in names['generate_launch_description']() if hasattr(a, 'description')}
    assert declared.keys() == {'chain', *names['ARGUMENTS']}
    assert all(a.description for a in declared.values())
    (plain,) = names['chain'](dict.fromkeys(declared, ''))
    assert [a.name for a in plain.arguments] == ['chain']
    (node,) = names['chain'](dict.fromkeys(declared, '') | {'slopes': 'end_force', 'record': 'bags'})
    assert node.arguments[1:] == ['--slopes', 'end_force', '--record', 'bags']
    assert (node.executable, node.namespace.name) == ('chain', 'namespace')


def test_the_shaper_is_launched_with_its_options(launch_modules: None) -> None:
    names = runpy.run_path(str(LAUNCH / 'shaper.launch.py'))
    declared = {a.words[0]: a for a in names['generate_launch_description']() if hasattr(a, 'description')}
    assert declared.keys() == {'namespace', *names['ARGUMENTS'], *names['TOPICS']}
    assert all(a.description for a in declared.values())
    options = make_parser(['shaper']).parse_args(['shaper'])
    assert set(names['ARGUMENTS']) <= vars(options).keys()
    (node,) = names['shaper'](dict.fromkeys(declared, '') | {'frequency': '14', 'damping_ratio': '0.02'})
    assert node.arguments == ['--frequency', '14', '--damping-ratio', '0.02']
    assert [(a, b.name) for a, b in node.remappings] == [('~/trajectory', 'given'), ('~/shaped', 'shaped')]


def test_the_compensator_is_launched_with_its_options(launch_modules: None) -> None:
    names = runpy.run_path(str(LAUNCH / 'compensator.launch.py'))
    declared = {a.words[0]: a for a in names['generate_launch_description']() if hasattr(a, 'description')}
    topics = [names['TOPIC_OF'].get(name, name) for name in names['TOPICS']]
    assert declared.keys() == {'namespace', 'drive', 'params_file', *names['ARGUMENTS'], *topics}
    assert all(a.description for a in declared.values())
    options = make_parser(['compensator']).parse_args(['compensator', 'arm.urdf', '--tip', 'tool'])
    assert set(names['ARGUMENTS']) <= vars(options).keys()
    given = {'urdf': 'arm.urdf', 'tip': 'tool', 'drive': 'true', 'max_rate': '0.05', 'params_file': 'p.yaml'}
    (node,) = names['compensator'](dict.fromkeys(declared, '') | given)
    assert node.arguments == ['arm.urdf', '--tip', 'tool', '--max-rate', '0.05', '--drive']
    assert node.parameters == ['p.yaml']
    assert [(a, b.name) for a, b in node.remappings] == [
        (f'~/{name}', topic) for name, topic in zip(names['TOPICS'], topics, strict=True)
    ]
    (dry,) = names['compensator'](dict.fromkeys(declared, '') | {'urdf': 'arm.urdf', 'tip': 'tool'})
    assert dry.arguments == ['arm.urdf', '--tip', 'tool']


@pytest.mark.skipif(shutil.which('ros2') is None, reason='ros2 launch comes with a ROS installation')
def test_ros2_launch_shows_the_arguments() -> None:
    command = ['ros2', 'launch', str(FILE), '--show-args']
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    for name in ('namespace', 'autostart', 'solver', 'log_level', 'port'):
        assert f"'{name}':" in shown
