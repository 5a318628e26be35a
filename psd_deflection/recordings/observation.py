# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""One recording as arrays on a complete sample grid, lost samples NaN, with its own rig and the loads
that are known."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from psd_deflection.base.errors import RecordingError
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.replay.engine import check_psds, rig_at_end, warnings_about_rig, zero_variances_at_end
from psd_deflection.recordings.sample_table import MAX_SAMPLES, held_at
from psd_deflection.recordings.spans import FULL, Span
from psd_deflection.records import FloatArray, IntArray, Moment, channel_names
from psd_deflection.rig.config import Rig, replace_values
from psd_deflection.rig.wiring import Wiring

QUIET = 0.25
"""A load that has not changed for this long, s, ends a load case at its next change."""


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """``volts`` (n, 3P) V of the PSDs, x y sum of each, NaN if a sample is lost; ``loads`` (n, 3) N, N, N m, held.

    ``temperature`` (n,) degrees Celsius or None. ``rig``: the rig with this recording's own
    overrides. ``digest``: of its source. ``unknown_load``: numbers of samples before the first known load and
    after the last; what ``loads`` holds there is only a placeholder. ``stated_rate_hz``: the rig
    file's sample rate if the recording's times say another, which ``rig`` then has; else 0. ``marks``: from the
    first sample. ``zero_variances`` (2P,) m^2: of the rig's zero, if it was taken in the recording. ``swing`` (n, 3):
    N, N, N m, what a weight that swayed added to the loads, or None.
    """

    name: str
    rig: Rig
    volts: FloatArray
    loads: FloatArray
    temperature: FloatArray | None = None
    digest: str = ''
    unknown_load: tuple[int, int] = (0, 0)
    stated_rate_hz: float = 0.0
    marks: tuple[Moment, ...] = ()
    zero_variances: tuple[float, ...] = ()
    swing: FloatArray | None = None

    def __post_init__(self) -> None:
        n = len(self.volts)
        if n < 4 * self.rig.estimator.block_size:
            raise RecordingError(f'{self.name}: {n} samples: discover needs at least 4 blocks')
        if self.volts.shape != (n, 3 * self.psds) or self.loads.shape != (n, 3):
            raise RecordingError(f'{self.name}: volts {self.volts.shape} and loads {self.loads.shape} do not match')
        if not np.all(np.isfinite(self.loads)):
            raise RecordingError(f'{self.name}: a load is not a finite number')
        if self.temperature is not None and not np.all(np.isfinite(self.temperature)):
            raise RecordingError(f'{self.name}: a temperature is not a finite number')

    @property
    def acting(self) -> FloatArray:
        """(n, 3): the loads with what swayed."""
        return self.loads if self.swing is None else self.loads + self.swing

    @property
    def psds(self) -> int:
        """How many PSDs the rig has."""
        return len(self.rig.psds)

    @property
    def period(self) -> float:
        """s between samples."""
        return 1.0 / self.rig.converter.sample_rate_hz

    @property
    def duration(self) -> float:
        """s."""
        return len(self.volts) * self.period

    def hashed(self) -> str:
        """SHA-256 of the numbers themselves, for provenance."""
        h = hashlib.sha256()
        for a in (self.volts, self.loads, self.temperature):
            if a is not None:
                h.update(np.ascontiguousarray(a, dtype=np.float32).tobytes())
        return h.hexdigest()


def check_same_psds(observations: Sequence[Observation], rig: Rig) -> None:
    """Raise RecordingError if a recording is of another number of PSDs than the ``rig`` of the search."""
    for o in observations:
        if o.psds != len(rig.psds):
            raise RecordingError(
                f'{o.name}: is of {o.psds} PSDs, the rig of the search has {len(rig.psds)}: search them one by one'
            )


def load_cases(loads: FloatArray, period: float) -> IntArray:
    """Return the load case of each sample, int (n,), counted from 0.

    A case begins if the load changes after at least ``QUIET`` seconds of rest. Each step with its
    ringing is one case; a sweep or ramp is one case. If there is only one case, it is cut into four
    pieces.
    """
    n = len(loads)
    changed = np.flatnonzero(np.any(np.diff(loads, axis=0) != 0.0, axis=1)) + 1
    quiet = max(1, round(QUIET / period))
    case = np.zeros(n, dtype=np.int64)
    starts = [int(c) for i, c in enumerate(changed) if i == 0 or c - changed[i - 1] >= quiet]
    for start in starts:
        case[start:] += 1
    if len(starts) < 2:
        case = np.arange(n, dtype=np.int64) * 4 // n
    return case


def read_observation(
    source: Recording | str | Path,
    rig: Rig | None = None,
    overrides: Mapping[str, object] | None = None,
    where: str = 'overrides',
    *,
    namespace: str | None = None,
    span: Span = FULL,
    warn: Callable[[str], None] | None = None,
    any_rate: bool = False,
) -> Observation:
    """Return one recording with its rig (by default from its own parameters), changed by ``overrides``.

    ``source``: the recording or its path. ``where``: where the overrides are from, for a message.
    ``namespace``, ``span``: as in :func:`open_recording`. ``warn``: told if the recording names no rig.
    ``any_rate``: if its times say another sample rate than the rig file, they are believed, and the observation
    says so.

    Raises RecordingError if it has no loads or cannot be read, ConfigError for a bad override.

    The sample at t sees the loads applied before t: a load counts from the first sample at or
    after its own time.
    """
    recording = source if isinstance(source, Recording) else open_recording(source, namespace=namespace, span=span)
    path = recording.path
    if rig is None:
        rig = rig_at_end(recording)
        if warn is not None:
            for warning in warnings_about_rig(recording):
                warn(warning)
    if overrides:
        rig = replace_values(rig, overrides, where)
    check_psds(recording, rig)
    recording = recording.with_block_size(rig.estimator.block_size)
    samples = recording.samples
    rig, stated = _at_its_rate(recording, rig, where, any_rate)
    first = int(samples['seq'][0])
    n = int(samples['seq'][-1]) - first + 1
    if n > MAX_SAMPLES:
        raise RecordingError(f'{path}: {n} samples; discover takes at most {MAX_SAMPLES}')
    place = (samples['seq'] - first).astype(np.int64)
    volts = np.full((n, 3 * len(rig.psds)), np.nan)
    for i, channel in enumerate(channel_names(len(rig.psds))):
        volts[place, i] = samples[channel]
    period = 1e9 / rig.converter.sample_rate_hz
    # Times of the whole grid, lost samples included: straight lines between the samples present.
    t_ns = np.rint(np.interp(np.arange(n), place, (samples['t_ns'] - samples['t_ns'][0]).astype(np.float64)))
    held, unknown = _held_loads(recording, t_ns, 0.25 * period)
    return Observation(
        recording.name,
        rig,
        Wiring.from_rig(rig).to_psds(volts),
        held,
        _held_temperature(recording, t_ns, 0.25 * period),
        digest=recording.digest,
        unknown_load=unknown,
        stated_rate_hz=stated,
        marks=recording.moments(),
        zero_variances=zero_variances_at_end(recording, rig),
    )


def _at_its_rate(recording: Recording, rig: Rig, where: str, any_rate: bool) -> tuple[Rig, float]:
    """Return the rig with the sample rate that the recording's times say, and the one that the rig file states, else 0.

    Raises RecordingError if they differ and not ``any_rate`` will do.
    """
    rate, stated = recording.sample_rate_hz, rig.converter.sample_rate_hz
    if rate <= 0.0 or abs(rate / stated - 1.0) <= 0.01:
        return rig, 0.0
    if not any_rate:
        raise RecordingError(
            f'{recording.path}: {rate:.1f} samples/s, but the rig file says converter.sample_rate_hz = '
            f'{stated:g}; set it to what was recorded'
        )
    return replace_values(rig, {'converter.sample_rate_hz': float(f'{rate:.5g}')}, where), stated


def _held_loads(recording: Recording, t_ns: FloatArray, grace: float) -> tuple[FloatArray, tuple[int, int]]:
    """Loads (n, 3) at ``t_ns`` (n,) from the first sample; numbers of samples before the first known and after.

    Raises RecordingError if there are none.
    """
    applied = recording.loads()
    if not applied:
        raise RecordingError(
            f'{recording.path}: holds no loads; they are needed to compare it with a simulation '
            f'(CSV columns load_fx, load_fy, load_tz, or the topic /link_tip/load)'
        )
    start = int(recording.samples['t_ns'][0])
    times = np.array([a.t_ns - start for a in applied], dtype=np.int64)
    held = held_at(times, np.array([a[1:] for a in applied]), t_ns, grace, np.zeros(3))
    count, last = recording.rows_with_load()
    later = t_ns > last - start + grace
    # Rows of a CSV say their load, one after the other, and then no more: it may have changed unseen.
    after = int(np.count_nonzero(later)) if count > 0.9 * np.count_nonzero(~later) else 0
    return held, (int(np.count_nonzero(t_ns + grace < times.min())), after)


def _held_temperature(recording: Recording, t_ns: FloatArray, grace: float) -> FloatArray | None:
    """Degrees Celsius (n,) at ``t_ns`` (n,) from the first sample, None if the recording has none."""
    temperatures = recording.temperatures()
    if not temperatures:
        return None
    start = int(recording.samples['t_ns'][0])
    at = np.array([r.t_ns - start for r in temperatures], dtype=np.int64)
    celsius = np.array([r.celsius for r in temperatures])
    if recording.temperatures_held:
        # A row's value holds until the next differs; a thermometer's messages are points on a curve.
        return held_at(at, celsius, t_ns, grace, celsius[0])
    return np.asarray(np.interp(t_ns, at.astype(np.float64), celsius))
