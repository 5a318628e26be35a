# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A bag of ROS 2: a folder of MCAP files with ``metadata.yaml``."""

from pathlib import Path

from psd_deflection.recordings.formats.format import Format, ReadOptions, Sink, WriteOptions
from psd_deflection.recordings.read.bag_reader import BagRecording
from psd_deflection.recordings.write.bag_writer import BagWriter, ReferenceSink


def _read(path: Path, options: ReadOptions) -> BagRecording:
    folder = path if path.is_dir() else path.parent
    return BagRecording(folder, options.block_size, options.namespace)


def _write(path: Path, options: WriteOptions) -> Sink:
    return BagWriter(path, rig_values=options.rig_values, device_hello=options.device_hello)


FORMAT = Format(
    name='bag',
    suffixes=(),
    help='a bag folder',
    read=_read,
    write=_write,
    write_references=lambda path: ReferenceSink(BagWriter(path, rig_values={})),
    holds=lambda path, head: path.is_dir() or path.name == 'metadata.yaml',
)
