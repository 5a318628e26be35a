# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Writes a camera's poses as messages: ``/reference/deflection`` and the same with covariance."""

from __future__ import annotations

from psd_deflection.recordings.write.bag_writer import BagWriter, McapFile
from psd_deflection.records import ReferencePose, ReferenceWithCovariance


class ReferenceSink:
    """Poses into ``file``, which it closes. Raises RecordingError if the disk cannot be written."""

    def __init__(self, file: McapFile | BagWriter) -> None:
        self._file = file

    def put(self, t_ns: int, reference: ReferenceWithCovariance | None, status: str) -> None:
        """Write the pose of one frame; a frame without one has no message."""
        if reference is not None:
            self._file.put(ReferencePose(t_ns, reference.dx, reference.dy, reference.theta))
            self._file.put(reference)

    def close(self) -> None:
        """Write index and summary and close."""
        self._file.close()
