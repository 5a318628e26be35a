# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The campaigns of ``bench/campaign``, a few rounds of each: they must be able to run, and to fail."""

import random
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from bench import cpu, page, rigs
from bench.campaign import soak
from bench.campaign.crash import evaluate, left_by_a_kill
from bench.campaign.fuzz import GRAMMARS, TARGETS, corrupted, evaluated
from bench.campaign.line import Line
from bench.rows import read
from psd_deflection.rig.config import Rig, load_rig

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
FOUND = sorted((ROOT / 'test' / 'data' / 'fuzz').glob('*'))


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Line]:
    link = Line(tmp_path)
    yield link
    link.close()


@pytest.fixture
def recording_rig(line: Line, tmp_path: Path) -> Rig:
    places = {'port': str(tmp_path / 'port'), 'bag_dir': str(tmp_path / 'bags')}
    return load_rig(None, {**places, 'record': True, 'keep_zero': False, 'realtime': False})


@pytest.mark.filterwarnings('ignore:This process .* is multi-threaded:DeprecationWarning')
@pytest.mark.parametrize('after_s', [0.05, 0.4])
def test_what_a_kill_leaves_is_whole(recording_rig: Rig, tmp_path: Path, after_s: float) -> None:
    """What it costs is bounded in log time (test_recover); here a busy machine may add to it."""
    folder, killed_ns = left_by_a_kill(recording_rig, tmp_path / 'bags', after_s)
    assert evaluate(folder, killed_ns) > 0.0


def test_simulated_minutes_lose_nothing_and_keep_time(capsys: pytest.CaptureFixture[str]) -> None:
    assert soak.simulated_time(100 / 3600)
    assert 'wrapped past 2^32' in capsys.readouterr().out


@pytest.mark.parametrize('name', GRAMMARS)
def test_any_choice_within_a_grammar_is_answered(name: str) -> None:
    target, seeds = TARGETS[name]()
    chance = random.Random(7)
    assert any([evaluated(target, c) for c in [*seeds, b'', *(chance.randbytes(200) for _ in range(10))]])


@pytest.mark.parametrize('name', [n for n in TARGETS if n not in GRAMMARS])
def test_fuzz_targets_accept_good_and_reject_bad_input(name: str) -> None:
    target, seeds = TARGETS[name]()
    assert evaluated(target, seeds[0]) == []
    assert evaluated(target, b'\x00\x03nonsense\x00') != []
    chance = random.Random(5)
    for seed in [*seeds, b'', *(p.read_bytes() for p in FOUND if p.name.startswith(name))]:
        evaluated(target, seed)
        for _ in range(5):
            spoiled = bytearray(seed or b'\x00')
            spoiled[chance.randrange(len(spoiled))] ^= 1 << chance.randrange(8)
            evaluated(target, bytes(spoiled))


def test_damaged_frames_are_rejected(capsys: pytest.CaptureFixture[str]) -> None:
    assert corrupted(20_000) == 0
    assert ' 0 accepted with a wrong content' in capsys.readouterr().out


def test_a_bench_by_hand_changes_no_tracked_file(monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[Path] = []
    monkeypatch.setattr(sys, 'argv', ['rigs', '--most', '1'])
    monkeypatch.setattr(rigs, 'measure', lambda *_: {'samples': 1000.0, 'lost': 0.0, 'share': 0.1})
    monkeypatch.setattr(rigs, 'keep', lambda _, path: written.append(path))
    assert (rigs.main(), written) == (0, [ROOT / 'build' / 'bench' / 'results.json'])


def test_the_page_is_made_of_the_results() -> None:
    assert page.PAGE.read_text(encoding='utf-8') == page.page(*read(), *read(cpu.RESULTS))
    assert '<!--' not in page.PAGE.read_text(encoding='utf-8')
    assert page.PAGE == ROOT / 'docs' / 'performance.md'
    text = page.README.read_text(encoding='utf-8')
    assert (page.readme(text, read()[0]), text.count(f'{page.PRINTED_BY}\n')) == (text, 3)
