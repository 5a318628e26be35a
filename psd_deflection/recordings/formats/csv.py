# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""CSV: a row a sample; or the estimates, or the poses of a camera."""

from pathlib import Path

from psd_deflection.recordings.formats.format import Format, ReadOptions, Sink, WriteOptions
from psd_deflection.recordings.read.csv_reader import CsvRecording
from psd_deflection.recordings.write.csv_writer import CsvEstimateSink, CsvReferenceFile, CsvSampleSink
from psd_deflection.rig.config import rig_from_values


def _read(path: Path, options: ReadOptions) -> CsvRecording:
    return CsvRecording(path, options.block_size, options.sample_rate_hz)


def _write(path: Path, options: WriteOptions) -> Sink:
    if options.samples_with is not None:
        return CsvSampleSink(path, options.samples_with, options.psds)
    rig = rig_from_values(options.rig_values, str(path))
    return CsvEstimateSink(path, rig.estimator.solvers)


FORMAT = Format(
    name='csv',
    suffixes=('.csv',),
    help='a .csv',
    read=_read,
    write=_write,
    write_references=CsvReferenceFile,
    is_table=True,
)
