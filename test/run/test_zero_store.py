# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The kept zero: what is taken back, and what is passed over with a line."""

import json
from pathlib import Path

import pytest

from psd_deflection.base.log import ERROR, INFO, WARNING
from psd_deflection.rig.config import Rig, load_rig, replace_values
from psd_deflection.run.zero_store import ZeroStore
from test.heard import WAIT_S

ZERO = {'psd_1.zero': [1e-4, -2e-4], 'psd_2.zero': [3e-5, 0.0]}


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rig:
    monkeypatch.setenv('XDG_STATE_HOME', str(tmp_path / 'state'))
    return load_rig()


def test_kept_zero_applies_only_to_the_same_device(rig: Rig) -> None:
    assert ZeroStore(rig, 'A-1').save(replace_values(rig, ZERO)) == ''
    back, message, _ = ZeroStore(rig, 'A-1').load(rig)
    assert 'zero of the last run' in message
    assert {name: back.values[name] for name in ZERO} == ZERO
    assert back.psds[0].zero == (1e-4, -2e-4)
    assert ZeroStore(rig, 'B-2').load(rig) == (rig, '', INFO)


@pytest.mark.parametrize(
    ('one', 'other'), [('Rig \u00c4', 'Rig \u00d6'), ('a' * 64 + 'x', 'a' * 64 + 'y'), ('', 'unknown'), ('A', 'A.')]
)
def test_two_serial_numbers_never_share_a_zero(rig: Rig, one: str, other: str) -> None:
    assert ZeroStore(rig, one).save(replace_values(rig, ZERO)) == ''
    assert ZeroStore(rig, other).load(rig) == (rig, '', INFO)
    assert ZeroStore(rig, one).load(rig)[0].values['psd_1.zero'] == ZERO['psd_1.zero']


def test_a_zero_file_of_another_device_is_passed_over(tmp_path: Path) -> None:
    named = load_rig(overrides={'zero_file': str(tmp_path / 'zero.json')})
    assert ZeroStore(named, 'A').save(replace_values(named, ZERO)) == ''
    back, message, level = ZeroStore(named, 'B').load(named)
    assert back is named
    assert 'that of another device' in message
    assert level == WARNING


def test_a_rig_file_that_says_otherwise_now_holds(rig: Rig) -> None:
    ZeroStore(rig, 'A').save(replace_values(rig, ZERO))
    edited = load_rig(overrides={'psd_1.zero': [5e-4, 0.0]})
    back, message, level = ZeroStore(edited, 'A').load(edited)
    assert back is edited
    assert 'the rig file holds' in message
    assert level == WARNING


@pytest.mark.parametrize('serial', ['../../evil', '/etc/passwd', '..', '', None, 'a' * 500, 'x\x00y', 7])
def test_no_serial_number_leads_out_of_the_folder(rig: Rig, tmp_path: Path, serial: object) -> None:
    store = ZeroStore(rig, serial)
    assert store.path.parent == tmp_path / 'state' / 'psd_deflection'
    assert len(store.path.name) < 100
    assert store.save(rig) == ''
    assert store.path.resolve().is_relative_to(tmp_path / 'state')


@pytest.mark.parametrize(
    ('content', 'why'),
    [
        (b'', 'Expecting value'),
        (b'[]', 'not what ~/zero writes'),
        (b'{"psd_1.zero": [0, 0], "psd_2.zero": [0, 0]}', 'not what ~/zero writes'),
        (b'\xff\xfe', 'Expecting value'),
        (b'[' * 5000, ''),
        (b' ' * 20_000, 'more than 10000 bytes'),
    ],
)
def test_a_bad_file_never_stops_a_run(rig: Rig, content: bytes, why: str) -> None:
    store = ZeroStore(rig, 'A')
    store.path.parent.mkdir(parents=True)
    store.path.write_bytes(content)
    back, message, _ = store.load(rig)
    assert back is rig
    assert f'{store.path}: the kept zero cannot be used (' in message
    assert why in message
    assert message.endswith('; the rig file holds')


@pytest.mark.parametrize('zero', [[9, 9], 'x', [float('nan'), 0], [0], None, {}, [0, 0, 0], [True, 0]])
def test_a_kept_zero_is_checked_like_any_parameter(rig: Rig, zero: object) -> None:
    store = ZeroStore(rig, 'A')
    assert store.save(replace_values(rig, ZERO)) == ''
    kept = json.loads(store.path.read_text())
    assert store.load(rig)[0] is not rig
    store.path.write_text(json.dumps({**kept, 'psd_1.zero': zero}))
    back, message, _ = store.load(rig)
    assert back is rig
    assert f'{store.path}: the kept zero cannot be used (' in message
    assert 'psd_1.zero' in message


def test_a_kept_zero_names_its_device_or_is_reported(tmp_path: Path) -> None:
    named = load_rig(overrides={'zero_file': str(tmp_path / 'zero.json')})
    assert ZeroStore(named, 'A').save(named) == ''
    assert json.loads((tmp_path / 'zero.json').read_text())['serial'] == 'A'
    rig = load_rig(overrides={'zero_file': str(tmp_path / 'zero.json' / 'zero.json')})
    store = ZeroStore(rig, 'A')
    logged: list[tuple[str, int]] = []

    def log(text: str, level: int = INFO, /) -> None:
        logged.append((text, level))

    store.keep(rig, log)
    assert store.join(WAIT_S)
    assert logged == [(store.save(rig), ERROR)]
    assert 'cannot be kept' in logged[0][0]
