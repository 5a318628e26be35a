# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the pages on devices print is what the code takes; the second emulator against the daemon."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from psd_deflection.base.log import texts
from psd_deflection.devices.protocol import frames
from psd_deflection.devices.protocol.text_lines import Description, Line, parse
from psd_deflection.devices.registry import DEVICES
from psd_deflection.records import DeflectionEstimate, SampleBlock
from psd_deflection.rig.config import load_rig
from psd_deflection.run.session import Session
from test.heard import WAIT_S
from test.run.conftest import Estimates

PAGES = Path(__file__).parent.parent.parent / 'docs' / 'devices'


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf'```{language}\n(.*?)```', (PAGES / page).read_text(), re.DOTALL)


def test_every_source_has_its_row() -> None:
    table, _, _ = (PAGES / 'README.md').read_text().partition('\n## ')
    rows = re.findall(r'^\| `(\w+)` \|', table, re.MULTILINE)
    assert rows == list(DEVICES)


@pytest.mark.parametrize('page', [f'{name}.md' for name in DEVICES if name not in ('serial', 'replay')])
def test_the_parameters_of_a_page_are_parameters(page: str, tmp_path: Path) -> None:
    (text,) = blocks(page, 'yaml')
    path = tmp_path / 'rig.yaml'
    path.write_text(text)
    assert load_rig(path).acquisition.source == page.removesuffix('.md')


def test_the_example_lines_are_lines() -> None:
    (example,) = blocks('lines.md', '')[:1]
    items = [parse(line.encode()) for line in example.splitlines()]
    assert [type(i) for i in items] == [Description, Line, Line]


def test_the_sketch_is_of_twenty_lines_and_describes_itself() -> None:
    (sketch,) = blocks('lines.md', 'cpp')
    assert len(sketch.splitlines()) <= 21
    described = re.search(r'F\("(.*)"\)', sketch)
    assert described is not None
    item = parse(described[1].replace('\\"', '"').encode())
    assert item == Description({'serial': 'UNO-1', 'sample_rate_hz': 100})


EMULATOR = Path(__file__).parent / 'second_device.py'
PAGE = Path(__file__).parent.parent.parent / 'docs' / 'protocol.md'
COOKIE = 0x0102030405060708
EXAMPLES: list[frames.GoodFrame] = [
    frames.HelloRequestFrame(),
    frames.StartFrame(),
    frames.StopFrame(),
    frames.PingFrame(COOKIE),
    frames.PongFrame(COOKIE, 1_000_000),
    frames.StatusFrame(3, 2150),
    frames.StatusFrame(0, None),
    frames.SampleFrame(0, 1, 1000, (0, -1, 16384, 256, -32768, 16384)),
    frames.SampleFrame(3, 0, 0, (32767, 0, 16384, 0, 0, 16384)),
    frames.HelloFrame(1, {'serial': 'A1'}),
]
WIDE = frames.SampleFrame(0, 1, 1000, (8388607, -1, 4194304, 256, -8388608, 4194304))


def test_the_page_and_the_code_say_the_same_bytes() -> None:
    on_the_page = [bytes.fromhex(h) for h in re.findall(r'\| `((?:[0-9a-f]{2})+00)` \|', PAGE.read_text())]
    sent = [frames.encode(frame) for frame in EXAMPLES]
    sent.insert(-1, frames.encode(WIDE, wide=True))
    assert on_the_page == sent


def test_the_emulator_imports_nothing_of_ours() -> None:
    tree = ast.parse(EMULATOR.read_text())
    names = [n.name for node in ast.walk(tree) if isinstance(node, ast.Import) for n in node.names]
    names += [str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    assert {n.split('.')[0] for n in names} <= set(sys.stdlib_module_names)


@pytest.fixture
def port() -> Iterator[str]:
    process = subprocess.Popen(
        [sys.executable, str(EMULATOR), str(2**32 - 500)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdin is not None
    assert process.stdout is not None
    yield process.stdout.readline().strip()
    process.stdin.close()
    process.wait(WAIT_S)
    process.stdout.close()


def test_it_works_unchanged_with_the_daemon(port: str) -> None:
    logged: list[str] = []
    session = Session(load_rig(overrides={'port': port}), texts(logged.append))
    estimates = Estimates(40)
    session.processing.sinks.append(estimates)
    hello = session.acquisition.hello
    assert hello is not None
    assert hello.info['serial'] == 'SECOND-7'
    try:
        session.start()
        assert estimates.enough.wait(WAIT_S)
    finally:
        session.close()
    assert session.failed is None
    counters = session.acquisition.counters
    assert (counters.bad, counters.repeated, counters.restarts) == (0, 0, 0)
    # On a busy machine the emulator may have to drop; it then says so.
    assert counters.lost == 0 or counters.device_dropped > 0
    blocks = [r for r in estimates.records if isinstance(r, SampleBlock)]
    numbers = [int(s) for b in blocks for s in b.seq]
    assert numbers == sorted(set(numbers))
    ramp = [round(v * 32768 / 10) for b in blocks for v in b.volts[:, 0].tolist()]
    assert ramp == [(s - (2**32 - 500)) % 2**32 % 2000 for s in numbers]
    assert any(isinstance(r, DeflectionEstimate) for r in estimates.records)
