# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What every format must do, ours and the one that ``docs/recording.md`` says to add."""

import re
from pathlib import Path

import numpy as np
import pytest

import psd_deflection as pd
from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.cli.main import main
from psd_deflection.recordings.formats import format
from psd_deflection.recordings.formats.format import open_reference_file, open_sink
from psd_deflection.recordings.read.references import read_references
from psd_deflection.records import ReferenceWithCovariance, SampleBlock
from psd_deflection.rig.config import load_rig
from test.plug_in import install_plug_in
from test.recordings.making import run

SAMPLES = sum(len(record.seq) for record in run(3) if isinstance(record, SampleBlock))
PAGE = Path(__file__).parents[3] / 'docs' / 'recording.md'


def test_names_and_endings_are_different() -> None:
    assert [format.find_format(name).name for name in format.FORMATS] == list(format.FORMATS)
    endings = [ending for f in format.formats() for ending in f.suffixes]
    assert len(set(endings)) == len(endings)
    assert all(ending == ending.lower() and ending.startswith('.') for ending in endings)


@pytest.mark.parametrize('name', format.FORMATS)
def test_what_is_written_is_read_or_is_only_to_be_looked_at(tmp_path: Path, name: str) -> None:
    form = format.find_format(name)
    path = tmp_path / f'a{form.suffixes[0] if form.suffixes else ""}'
    assert format.format_of_name(path) is form
    if form.name == 'rerun':
        pytest.importorskip('rerun')
    assert form.write is not None
    sink = open_sink(path, load_rig().flat(), samples_with=())
    for record in run(3):
        sink.put(record)
    sink.close()
    if form.read is None:
        with pytest.raises(RecordingError, match=r'is no recording: a bag folder, an \.mcap or a \.csv'):
            pd.open(path)
    else:
        assert len(pd.open(path).samples) == SAMPLES


@pytest.mark.parametrize('name', [n for n in format.FORMATS if format.find_format(n).write_references])
def test_poses_of_a_camera_are_references_when_they_are_read(tmp_path: Path, name: str) -> None:
    form = format.find_format(name)
    path = tmp_path / f'a{form.suffixes[0] if form.suffixes else ""}'
    file = open_reference_file(path)
    pose = ReferenceWithCovariance(10**9, 1e-6, 2e-6, 3e-6, 0.0, 0.0, tuple(np.eye(3).ravel()))
    file.put(10**9, pose, 'ok')
    file.put(2 * 10**9, None, 'no target')
    file.close()
    references = read_references(path)
    assert (references.t_ns.tolist(), references.poses.tolist()) == ([10**9], [[1e-6, 2e-6, 3e-6]])


def test_a_file_of_another_name_is_known_by_its_content(tmp_path: Path) -> None:
    sink = open_sink(tmp_path / 'a.mcap', {})
    for record in run(3):
        sink.put(record)
    sink.close()
    other = (tmp_path / 'a.mcap').rename(tmp_path / 'a.backup')
    assert len(pd.open(other).samples) == SAMPLES


@pytest.mark.skipif('rerun' not in format.FORMATS, reason='an optional room')
def test_a_format_without_references_takes_none(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match='does not take the poses of a camera'):
        open_reference_file(tmp_path / 'a.rrd')


@pytest.fixture
def page() -> tuple[str, str]:
    """Code and entry point of the page's own format."""
    text = PAGE.read_text()
    (section,) = re.findall(r'### A format of your own\n(.*?)(?=\n##|\Z)', text, re.DOTALL)
    (code,) = re.findall(r'```python\n(.*?)```', section, re.DOTALL)
    (entry,) = re.findall(r'```ini\n.*?\n(psd_deflection.*?)```', section, re.DOTALL)
    return code, '[psd_deflection.formats]\n' + re.sub(r'^psd_deflection.*\n *', '', entry)


def test_a_format_made_as_the_page_says_is_read_like_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, page: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    install_plug_in(tmp_path, monkeypatch, 'logger', *page)
    path = tmp_path / 'run.npz'
    t = np.arange(100) / 1000.0
    np.savez(path, t=t, volts=np.ones((100, 6)))
    recording = pd.open(path)
    assert recording.samples['t_ns'].tolist() == (np.arange(100) * 10**6).tolist()
    assert '.npz' in format.endings_of_recordings()
    assert main(['convert', str(path), '--out', str(tmp_path / 'run.csv')]) == 0
    assert capsys.readouterr().out == f'{tmp_path / "run.csv"}: 100 samples\n'
    # It is read and not written, and .npz is no bag's ending.
    with pytest.raises(RecordingError, match='is read and not written'):
        open_sink(tmp_path / 'b.npz', {})
    assert main(['convert', str(path), '--out', str(tmp_path / 'b.npz')]) == 2


@pytest.mark.parametrize(
    ('code', 'message'),
    [('raise ValueError(3)', r'cannot be loaded \(ValueError: 3\)'), ('FORMAT = 3', '3 is no psd_defl')],
)
def test_format_that_is_none_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, message: str) -> None:
    install_plug_in(tmp_path, monkeypatch, 'logger', code, f'[{format.GROUP}]\nmine = my_package.logger:FORMAT\n')
    (tmp_path / 'run.npz').touch()
    with pytest.raises(ConfigError, match=f"format 'mine': my_package.logger:FORMAT.* ?{message}"):
        pd.open(tmp_path / 'run.npz')
    # Ours are found without it.
    (tmp_path / 'run.csv').touch()
    with pytest.raises(RecordingError, match='is empty'):
        pd.open(tmp_path / 'run.csv')
