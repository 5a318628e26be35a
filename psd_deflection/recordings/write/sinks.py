"""Sinks of records: CSV, MCAP, bag and Rerun, chosen by the file name."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Protocol

from psd_deflection.recordings.write.bag_writer import BagWriter, McapFile
from psd_deflection.recordings.write.csv_writer import CsvEstimateSink, CsvSampleSink
from psd_deflection.recordings.write.rerun_writer import RerunFile
from psd_deflection.records import Record
from psd_deflection.rig.config import rig_from_values


class Sink(Protocol):
    """Takes records, one thread at a time. Both calls raise RecordingError if the disk refuses to write."""

    def put(self, record: Record) -> None:
        """Take one record; a sink ignores the kinds that it cannot store."""

    def close(self) -> None:
        """Write the buffered rest and close; a second call does nothing."""


def is_csv(path: str | Path) -> bool:
    """Whether :func:`open_sink` writes a CSV there."""
    return Path(path).suffix.lower() == '.csv'


def is_for_viewing(path: str | Path) -> bool:
    """Whether :func:`open_sink` writes a file there that holds what is computed and cannot be read back."""
    return Path(path).suffix.lower() == '.rrd'


def open_sink(
    path: str | Path,
    rig_values: Mapping[str, object],
    *,
    device_hello: Mapping[str, object] | None = None,
    samples_with: Collection[type[Record]] | None = None,
    title: str = '',
    psds: int = 2,
) -> Sink:
    """The sink for ``path``: a ``.csv``, an ``.rrd`` (for Rerun), an ``.mcap`` (a single file), else a bag folder.

    ``rig_values``: the flat parameter set. ``samples_with``: a CSV holds the samples, with columns for these
    kinds of records; None: it holds the estimates. ``title``: title of an ``.rrd``. ``psds``: of the samples of a CSV.
    Raises RecordingError if ``path`` exists or cannot be made, ConfigError if rerun is not installed.
    """
    path = Path(path)
    if is_csv(path):
        if samples_with is not None:
            return CsvSampleSink(path, samples_with, psds)
        return CsvEstimateSink(path, rig_from_values(rig_values, str(path)).estimator.solvers)
    if is_for_viewing(path):
        return RerunFile(path, rig_from_values(rig_values, str(path)), title)
    if path.suffix.lower() == '.mcap':
        return McapFile(path, rig_values=rig_values, device_hello=device_hello)
    return BagWriter(path, rig_values=rig_values, device_hello=device_hello)
