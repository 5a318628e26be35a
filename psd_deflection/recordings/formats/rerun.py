# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Rerun: what is computed of a recording, to look at."""

from pathlib import Path

from psd_deflection.recordings.formats.format import Format, Sink, WriteOptions
from psd_deflection.recordings.write.rerun_writer import RerunFile
from psd_deflection.rig.config import rig_from_values


def _write(path: Path, options: WriteOptions) -> Sink:
    return RerunFile(path, rig_from_values(options.rig_values, str(path)), options.title)


FORMAT = Format(name='rerun', suffixes=('.rrd',), help='an .rrd for the Rerun viewer', write=_write)
