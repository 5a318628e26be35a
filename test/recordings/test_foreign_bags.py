# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Bags as reindexing, copying by hand and stepped clocks leave them: samples stay, and what is odd is named."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from msg_adapters import to_messages
from psd_deflection.base.errors import RecordingError
from psd_deflection.recordings import cdr
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.repair import recover
from psd_deflection.recordings.write.bag_writer import McapFile

from .making import assert_same, block, write_mcap

RECORDS = [block(i) for i in range(40)]


def bag(folder: Path, *, storage: str | None = 'mcap', listed: tuple[str, ...] = ('run_0.mcap',)) -> Path:
    folder.mkdir()
    write_mcap(folder / 'run_0.mcap', RECORDS)
    information = {'version': 5, 'storage_identifier': storage, 'relative_file_paths': list(listed)}
    (folder / 'metadata.yaml').write_text(yaml.safe_dump({'rosbag2_bagfile_information': information}))
    return folder


@pytest.mark.parametrize('storage', ['mcap', '', None])
def test_a_bag_after_a_reindex_is_read(tmp_path: Path, storage: str | None) -> None:
    recording = open_recording(bag(tmp_path / 'run', storage=storage))
    assert_same(list(recording.blocks()), RECORDS)
    assert recording.warnings == []


def test_another_storage_names_both_converters(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r'sqlite3 storage.*`mcap convert IN.db3 OUT.mcap` or `ros2 bag convert`'):
        open_recording(bag(tmp_path / 'run', storage='sqlite3'))


def test_a_file_that_metadata_do_not_list_is_named(tmp_path: Path) -> None:
    folder = bag(tmp_path / 'run')
    shutil.copy(folder / 'run_0.mcap', folder / 'copy.mcap')
    recording = open_recording(folder)
    assert_same(list(recording.blocks()), RECORDS)
    (warning,) = recording.warnings
    assert warning.startswith(f'{folder}/copy.mcap: is not listed in metadata.yaml and is not read')
    recover(folder)
    assert open_recording(folder).warnings == []


@pytest.mark.parametrize('leap_s', [-3600.0, 12.0, 1.7e9])
def test_a_leap_of_log_times_is_reported_once(tmp_path: Path, leap_s: float) -> None:
    with McapFile(tmp_path / 'a.mcap', rig_values={}) as out:
        for record in RECORDS:
            leapt = int(leap_s * 1e9) if record.index >= 20 else 0
            for message in to_messages(record):
                encoded = cdr.encode(message.type, message.fields)
                out.write_encoded(message.topic, message.type, encoded, int(record.t_ns[0]) + leapt)
    recording = open_recording(tmp_path / 'a.mcap')
    for _ in range(2):
        assert_same(list(recording.blocks()), RECORDS)
    (warning,) = recording.warnings
    assert f"the recorder's clock leapt by {leap_s:+.3f} s" in warning
    assert np.diff(recording.samples['t']).max() < 0.0011
