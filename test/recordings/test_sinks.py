# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Which sink a name means."""

from __future__ import annotations

from pathlib import Path

import pytest

from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.write.bag_writer import BagWriter, McapFile
from psd_deflection.recordings.write.csv_writer import CsvEstimateSink, CsvSampleSink
from psd_deflection.recordings.write.sinks import open_sink
from psd_deflection.records import AppliedLoad

from .making import run


@pytest.mark.parametrize(
    ('name', 'kind'), [('e.csv', CsvEstimateSink), ('a.MCAP', McapFile), ('a', BagWriter), ('a.b', BagWriter)]
)
def test_the_name_says_which_sink(tmp_path: Path, name: str, kind: type[object]) -> None:
    sink = open_sink(tmp_path / name, {})
    assert type(sink) is kind
    for record in run(3):
        sink.put(record)
    sink.close()
    sink.close()
    assert (tmp_path / name).exists()


def test_a_csv_of_samples_has_the_columns_that_are_asked_for(tmp_path: Path) -> None:
    sink = open_sink(tmp_path / 's.CSV', {}, samples_with=[AppliedLoad])
    assert type(sink) is CsvSampleSink
    for record in run(3):
        sink.put(record)
    sink.close()
    recording = open_recording(tmp_path / 's.CSV')
    assert [load[1:] for load in recording.loads()] == [(0.0, 0.0, 0.1)]
    assert recording.temperatures() == []
