# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Makes a recording of the format that its name says."""

from collections.abc import Collection, Mapping
from pathlib import Path

from psd_deflection.base.errors import RecordingError
from psd_deflection.recordings.formats.format import ReferenceFile, Sink, WriteOptions, format_of_name
from psd_deflection.records import Record


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
    Raises RecordingError if ``path`` exists or cannot be made, or if its format is only read; ConfigError if rerun
    is not installed.
    """
    form = format_of_name(path)
    if form.write is None:
        raise RecordingError(f'{path}: {form.help} is read and not written')
    options = WriteOptions(
        rig_values=rig_values,
        device_hello=device_hello,
        samples_with=samples_with,
        title=title,
        psds=psds,
    )
    return form.write(Path(path), options)


def open_reference_file(path: str | Path) -> ReferenceFile:
    """The file for the poses of a camera. Raises as :func:`open_sink` does."""
    form = format_of_name(path)
    if form.write_references is None:
        raise RecordingError(f'{path}: {form.help} does not take the poses of a camera')
    return form.write_references(Path(path))
