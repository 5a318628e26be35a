"""What the pages on devices print is what the code takes."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest
import yaml

from psd_deflection.config import load_rig
from psd_deflection.devices.registry import SOURCES
from psd_deflection.devices.source import Sample, Source
from psd_deflection.protocol.text_lines import Description, Line, parse

PAGES = Path(__file__).parent.parent.parent / 'docs' / 'devices'


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf'```{language}\n(.*?)```', (PAGES / page).read_text(), re.DOTALL)


def test_every_source_has_its_row() -> None:
    rows = re.findall(r'^\| `(\w+)` \|', (PAGES / 'README.md').read_text(), re.MULTILINE)
    assert rows == list(SOURCES)


@pytest.mark.parametrize('page', ['dataq.md', 'thorlabs.md', 'lines.md'])
def test_the_parameters_of_a_page_are_parameters(page: str, tmp_path: Path) -> None:
    (text,) = blocks(page, 'yaml')
    path = tmp_path / 'rig.yaml'
    path.write_text(yaml.safe_dump({'/**': {'ros__parameters': yaml.safe_load(text)}}))
    assert load_rig(path).acquisition.source == page.removesuffix('.md')


@pytest.mark.parametrize('page', ['dataq.md', 'thorlabs.md', 'lines.md'])
def test_a_page_says_that_it_was_not_tried_on_hardware(page: str) -> None:
    assert 'Not tried on hardware' in (PAGES / page).read_text()


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


def test_the_example_of_a_plug_in_is_a_source(tmp_path: Path) -> None:
    (code,) = blocks('README.md', 'python')
    path = tmp_path / 'example_plug_in.py'
    path.write_text(code)
    spec = importlib.util.spec_from_file_location('example_plug_in', path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    source: Source = module.MyConverter(load_rig(overrides={'port': 'x'}))
    assert source.open(1.0).info['volts_per_count'] is None
    source.start()
    (first,) = source.read(0.1).events
    (second,) = source.read(0.1).events
    assert isinstance(first, Sample)
    assert isinstance(second, Sample)
    assert (first.seq, second.seq) == (0, 1)
    assert source.describe()
    source.close()
