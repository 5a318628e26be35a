# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What readers of whole recordings share: values held on the grid of the samples, and the hash of a recording."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from psd_deflection.base.errors import RecordingError
from psd_deflection.records import FloatArray, IntArray

MAX_SAMPLES = 20_000_000
"""Samples of a recording that is taken into memory whole."""


def held_at(
    times: IntArray, values: FloatArray, t_ns: FloatArray, grace: float, before: FloatArray | float
) -> FloatArray:
    """``values`` (k, ...) from ``times`` (k,) ns on, at ``t_ns`` or up to ``grace`` ns later; ``before`` the first."""
    order = np.argsort(times, kind='stable')
    index = np.searchsorted(times[order], t_ns + grace, side='right') - 1
    out = values[order][np.maximum(index, 0)].astype(np.float64)
    out[index < 0] = before
    return out


def digest_of(path: Path) -> str:
    """SHA-256 of a file, or of all files of a folder. Raises RecordingError if one cannot be read."""
    digest = hashlib.sha256()
    files = sorted(p for p in path.rglob('*') if p.is_file()) if path.is_dir() else [path]
    try:
        for file in files:
            with file.open('rb') as stream:
                while piece := stream.read(1 << 20):
                    digest.update(piece)
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read ({error.strerror or error})') from None
    return digest.hexdigest()
