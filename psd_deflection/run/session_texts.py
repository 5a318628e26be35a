# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a session says of its zero, its loads and its marks, a line each: the same from page, command and node."""

from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.records import AppliedLoad, Mark
from psd_deflection.rig.config import Rig

RETAKE_ZERO = 'take the zero again without load; until then estimates count from the loaded state'


def zero_text(rig: Rig) -> str:
    """The unloaded dots of ``rig``, as one line of text."""
    zeros = enumerate((psd.zero for psd in rig.psds), start=1)
    return 'unloaded dots (mm): ' + ', '.join(f'psd_{n} ({x * 1e3:z.4f}, {y * 1e3:z.4f})' for n, (x, y) in zeros)


def load_text(load: AppliedLoad, ago_s: float = 0.0) -> str:
    """A known load, as one line of text."""
    since = f', since {ago_s:.2f} s ago' if ago_s > 0.0 else ''
    return f'load noted: Fx {load.fx:.6g} N, Fy {load.fy:.6g} N, Tz {load.tz:.6g} N·m{since}'


def mark_text(mark: Mark) -> str:
    """A mark, as one line of text."""
    return f'mark: {mark.text}'


def why_no_zero(pipeline: Pipeline) -> str:
    """Why :meth:`Pipeline.zero` took no zero, as text."""
    if pipeline.zero_rejected:
        return pipeline.zero_rejected
    last = pipeline.last_spots
    return f'no good block now: {last.reason}' if last is not None and last.reason else 'no good block yet'
