# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A calibration that the page starts: a real process, which speaks to the page's server."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from psd_deflection import simulate
from psd_deflection.recordings.conversion import Beside, convert

from .serving import Serving
from .test_server import ask, listen

Serve = Callable[..., Serving]


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A recording with a reference, as if it were being written."""
    folder = tmp_path / 'bag'
    made = simulate(None, [(0, 0, 0), (30, 0, 0), (0, -50, -29), (-40, 40, 20)], seconds=1, seed=4)
    convert(made, folder, made.parameters, Beside.of(made), made.blocks())
    return folder


def calibrations(url: str, until: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """What the page is told of the calibration, as soon as ``until`` accepts it."""

    def accepted(message: dict[str, Any]) -> bool:
        found = (message.get('health') or {}).get('calibration')
        return found is not None and until(found)

    last: dict[str, Any] = listen(url, accepted)[-1]['health']['calibration']
    return last


def asked(url: str, wanted: object) -> tuple[int, str]:
    status, text, _ = ask(url + 'api/calibrate', body={'calibrate': wanted})
    return status, json.loads(text)['message']


def test_it_shows_what_is_determined_and_ends_with_its_files(serve: Serve, bag: Path, tmp_path: Path) -> None:
    serving = serve(bag_dir=str(tmp_path / 'made'))
    serving.shown.folder = str(bag)
    assert asked(serving.url, True) == (200, 'calibrating: zero the unloaded link, then hang known loads and note each')
    assert asked(serving.url, True) == (409, 'a calibration runs already')
    found = calibrations(serving.url, lambda c: 'parameters' in c)
    assert found['running']
    assert found['kind'] == 'reference'
    assert 0 < found['determined'] < len(found['parameters'])
    assert 1 <= len(found['needs']) <= 4
    assert {'name', 'words', 'value', 'filled', 'determined'} <= set(found['parameters'][0])
    status, words = asked(serving.url, False)
    assert (status, words) == (200, f'the calibration ends; its files: {found["out"]}')
    ended = calibrations(serving.url, lambda c: not c['running'])
    assert ended['last'] == 'calibrated'
    assert {path.name for path in Path(ended['out']).iterdir()} == {'rig.yaml', 'report.html', 'calibration.json'}
    assert serving.shown.recordings == [str(bag), None]
    assert asked(serving.url, False) == (409, 'no calibration runs')


def test_why_it_could_not_is_reported(serve: Serve, tmp_path: Path) -> None:
    serving = serve(bag_dir=str(tmp_path))
    assert asked(serving.url, True)[0] == 200
    ended = calibrations(serving.url, lambda c: not c['running'])
    assert 'recordings/test: is not on this machine' in ended['last']


def test_a_played_recording_and_nonsense_are_rejected(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    serving = serve()
    assert asked(serving.url, 1) == (400, 'rejected: expected {"calibrate": true} or {"calibrate": false}')
    described = {'kind': 'replay', 'name': 'test', 'recording': None}
    monkeypatch.setattr(serving.shown, 'describe', lambda: described)
    assert asked(serving.url, True) == (409, 'a recording is played; psd-deflection calibrate takes it')
