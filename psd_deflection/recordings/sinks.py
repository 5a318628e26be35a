"""Where records go: a recorder is a sink like any other."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Protocol

from psd_deflection.config import rig_from_values
from psd_deflection.recordings.bag_writer import BagWriter, McapFile
from psd_deflection.recordings.csv_writer import CsvEstimateSink
from psd_deflection.recordings.rerun_writer import RerunFile
from psd_deflection.records import Record


class Sink(Protocol):
    """Takes records, one thread at a time. Both calls raise RecordingError where the disk refuses."""

    def put(self, record: Record) -> None:
        """Take one record; a sink passes over the kinds it has no place for."""

    def close(self) -> None:
        """Write what is held back and close; does nothing the second time."""


def open_sink(
    path: str | Path,
    *,
    rig_values: Mapping[str, object],
    solvers: Collection[str],
    device_hello: Mapping[str, object] | None = None,
) -> Sink:
    """The sink for ``path``: ``.csv`` (estimates), ``.rrd`` (for Rerun), ``.mcap`` (a lone file), else a bag folder."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == '.csv':
        return CsvEstimateSink(path, solvers)
    if suffix == '.rrd':
        return RerunFile(path, rig_from_values(rig_values, str(path)))
    if suffix == '.mcap':
        return McapFile(path, rig_values=rig_values, device_hello=device_hello)
    return BagWriter(path, rig_values=rig_values, device_hello=device_hello)
