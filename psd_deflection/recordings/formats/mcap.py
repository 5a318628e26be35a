# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""MCAP: one file with the messages of a run."""

from pathlib import Path

from psd_deflection.recordings.formats.format import Format, ReadOptions, Sink, WriteOptions
from psd_deflection.recordings.mcap_format import MAGIC
from psd_deflection.recordings.read.bag_reader import BagRecording
from psd_deflection.recordings.write.bag_writer import McapFile, ReferenceSink


def _read(path: Path, options: ReadOptions) -> BagRecording:
    return BagRecording(path, options.block_size, options.namespace)


def _write(path: Path, options: WriteOptions) -> Sink:
    return McapFile(path, rig_values=options.rig_values, device_hello=options.device_hello)


FORMAT = Format(
    name='mcap',
    suffixes=('.mcap',),
    help='an .mcap',
    read=_read,
    write=_write,
    write_references=lambda path: ReferenceSink(McapFile(path, rig_values={})),
    holds=lambda path, head: head.startswith(MAGIC),
)
