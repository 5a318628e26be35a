# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Rounding is distinguished from other differences, and who made the recording decides whether it may be there."""

import platform
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

import psd_deflection
from psd_deflection import __version__
from psd_deflection.cli.main import main
from psd_deflection.model.solvers.interface import Solutions
from psd_deflection.recordings.provenance import NAMES, differences, provenance
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.replay.comparison import agree
from psd_deflection.recordings.replay.engine import open_for_replay
from psd_deflection.recordings.write import bag_writer

ROOT = Path(__file__).parents[2]
POSE = {'position': {'x': 1e-3, 'y': -2e-3, 'z': 0.0}, 'orientation': {'x': 0.0, 'y': 0.0, 'z': 1e-3, 'w': 1.0}}


def changed(step: float, name: str = 'x') -> dict[str, dict[str, float]]:
    """``POSE`` with one place changed by ``step`` m."""
    return {**POSE, 'position': {**POSE['position'], name: POSE['position'][name] + step}}


def test_numbers_agree_within_1e_9_of_largest() -> None:
    assert agree(POSE, changed(1.9e-12), 1e-13)
    assert agree(POSE, changed(1.9e-12, 'z'), 1e-13)
    assert not agree(POSE, changed(2.1e-12), 1e-13)


def test_the_least_counts_for_vectors_near_zero() -> None:
    assert agree({'x': 0.0, 'y': 0.0}, {'x': 9e-14, 'y': 0.0}, 1e-13)
    assert not agree({'x': 0.0, 'y': 0.0}, {'x': 1.1e-13, 'y': 0.0}, 1e-13)


def test_texts_and_whole_numbers_must_be_the_same() -> None:
    message = {'header': {'frame_id': 'a', 'sec': 3}, 'n': 5}
    assert agree(message, {'header': {'frame_id': 'a', 'sec': 3}, 'n': 5}, 1.0)
    assert not agree(message, {'header': {'frame_id': 'b', 'sec': 3}, 'n': 5}, 1.0)
    assert not agree(message, {'header': {'frame_id': 'a', 'sec': 4}, 'n': 5}, 1.0)
    assert not agree(message, {'header': {'frame_id': 'a', 'sec': 3}}, 1.0)


def test_a_covariance_agrees_by_the_deviations_of_row_and_column() -> None:
    full = np.diag([1e-14, 4e-14, 1e6]).ravel()
    for i, j, off in ((0, 0, 1e-23), (0, 1, 2e-23), (1, 2, 2e-13)):
        for share, same in ((0.9, True), (1.1, False)):
            other = full.copy()
            other[3 * i + j] += share * off
            assert agree({'covariance': full}, {'covariance': other}, 1.0) is same
    assert not agree({'covariance': full}, {'covariance': full[:4]}, 1.0)


def test_what_is_no_number_agrees_with_itself() -> None:
    nan = float('nan')
    assert agree({'x': nan}, {'x': nan}, 0.0)
    assert not agree({'x': nan}, {'x': 1.0}, 0.0)
    assert agree({'covariance': np.full(4, nan)}, {'covariance': np.full(4, nan)}, 0.0)


def recorded(folder: Path, monkeypatch: pytest.MonkeyPatch, made_with: Mapping[str, str] | None, *rig: str) -> str:
    """A simulated recording that says ``made_with``, or nothing, computed it."""
    if made_with is not None:
        monkeypatch.setattr(bag_writer, 'provenance', lambda: MappingProxyType(dict(made_with)))
    name = str(folder / 'made')
    assert main(['simulate', '--out', name, '--loads', 'steps:0,0,0;0,-10,0:1', *rig]) == 0
    return name


def disturbed(monkeypatch: pytest.MonkeyPatch, share: float) -> None:
    """From now on every answer's dX is off by that share."""
    from psd_deflection.model.solvers.exact import ExactSolver

    solve_many = ExactSolver.solve_many

    def disturbed_many(*given: Any) -> Solutions:
        solutions = solve_many(*given)
        solutions.pose[:, 0] *= 1.0 + share
        return solutions

    monkeypatch.setattr(ExactSolver, 'solve_many', disturbed_many)


OLD = {'psd_deflection': '0.0.9', 'numpy': '1.25.0'}
SINCE = 'rounding may differ: recorded with psd_deflection 0.0.9, now '


@pytest.mark.parametrize(
    ('made_with', 'share', 'status', 'words'),
    [
        pytest.param(OLD, 3e-16, 0, ('differ by rounding alone', SINCE, 'numpy 1.25.0, now '), marks=pytest.mark.slow),
        (None, 3e-16, 1, ('rounding differs although the same versions recorded it: please report this',)),
        (OLD, 1e-6, 1, ('by rounding alone, ',)),
    ],
    ids=['rounding of another version', 'rounding of the same version', 'more than rounding'],
)
def test_rounding_alone_of_another_version_is_no_failure(
    made_with: Mapping[str, str] | None,
    share: float,
    status: int,
    words: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    name = recorded(tmp_path, monkeypatch, made_with)
    assert main(['replay', name, '--compare']) == 0
    assert 'no bit differs' in capsys.readouterr().out
    disturbed(monkeypatch, share)
    assert main(['replay', name, '--compare']) == status
    output = capsys.readouterr().out
    assert all(word in output for word in words), output
    assert main(['replay', name, '--compare', '--strict']) == 1


def test_recording_names_its_provenance(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    name = recorded(tmp_path, monkeypatch, {'psd_deflection': '7', 'numpy': '8', 'processor': 'a\x1b[2Jb'})
    recording = open_recording(name)
    assert dict(recording.made_with) == {'psd_deflection': '7', 'numpy': '8', 'processor': 'a\x1b[2Jb'}
    capsys.readouterr()
    assert main(['info', name]) == 0
    assert 'computed by  numpy 8, processor a\\x1b[2Jb\n' in capsys.readouterr().out


def test_versions_and_processor_are_there() -> None:
    now = provenance()
    assert set(now) <= set(NAMES)
    assert (now['psd_deflection'], now['numpy'], now['machine']) == (__version__, np.__version__, platform.machine())
    assert now['python'] == platform.python_version()
    assert now['processor']


@pytest.mark.parametrize(
    ('changes', 'words'),
    [
        ({}, []),
        ({'numpy': '1.25.0'}, [f'numpy 1.25.0, now {np.__version__}']),
        # The processor does not count; what is no name of ours is passed over, what is no text is made one.
        ({'processor': 'another', 'C library': 'another'}, []),
        ({'numpy': '\x1b[2J', 'mine': 'x' * 10_000}, [f'numpy \\x1b[2J, now {np.__version__}']),
    ],
)
def test_what_differs_is_named_with_both_values(changes: dict[str, str], words: list[str]) -> None:
    assert differences({**provenance(), **changes}, provenance()) == words
    assert differences({}, provenance()) == ['a version that does not say what computed it']


def test_a_rig_file_without_a_zero_gets_the_recorded_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    thesis = (ROOT / 'config' / 'thesis_rig.yaml').read_text()
    zeroed, run = tmp_path / 'zeroed.yaml', str(tmp_path / 'run')
    zeroed.write_text(thesis.replace('zero: [0.0, 0.0]', 'zero: [3.0e-4, -1.0e-4]'))
    assert main(['simulate', '--out', run, '--loads', 'constant:0,-10,0:1', '--params-file', str(zeroed)]) == 0
    mirrored = tmp_path / 'mirrored.yaml'
    mirrored.write_text(thesis.replace('zero: [', 'axes: [x, -y]\n      zero: ['))
    for file, words in (
        (ROOT / 'config' / 'thesis_rig.yaml', 'its zero is used, since '),
        (mirrored, f'its zero is not used: {mirrored} has other psd_1.axes, psd_2.axes'),
        (zeroed, ''),
    ):
        capsys.readouterr()
        same = main(['replay', run, '--params-file', str(file), '--compare']) == 0
        assert same == (file != mirrored)
        assert capsys.readouterr().err.split(':')[0] == ('warning' if file == mirrored else 'note' if words else '')
        recording, _ = open_for_replay(run, str(file))
        assert words in ''.join(recording.warnings)
    again = psd_deflection.replay(run, psd_deflection.load_rig(ROOT / 'config' / 'thesis_rig.yaml'))
    assert np.array_equal(again.pose, psd_deflection.replay(run).pose)
