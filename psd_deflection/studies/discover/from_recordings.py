# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads recordings for discover into arrays on a sample grid without gaps, loads and temperatures held; and tables of
readings.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.base.foreign_yaml import tree_of_file
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.read.references import (
    IN_MILLIMETRES,
    KNOWN,
    TIMES,
    ReadingsTable,
    is_table,
    kinds_of,
)
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.replay.engine import check_psds, rig_at_end, warnings_about_rig, zero_variances_at_end
from psd_deflection.recordings.sample_table import MAX_SAMPLES, TEMPERATURE_COLUMN, digest_of, held_at
from psd_deflection.recordings.spans import FULL, Span
from psd_deflection.records import FloatArray, channel_names, dot_channels
from psd_deflection.rig.config import Rig, load_rig, replace_values
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.discover.plant_search import PlantDiscovery, discover_in
from psd_deflection.studies.discover.plants import Readings, ReadingsPlant, Resting, resting_in, resting_rows
from psd_deflection.studies.discover.report import Discovery
from psd_deflection.studies.study import GIVEN_RIG, Notify, warn_caller


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


def read_observations(
    sources: Sequence[Recording | str | Path],
    rig: Rig | None = None,
    *,
    namespace: str | None = None,
    span: Span = FULL,
    warn: Callable[[str], None] | None = None,
    any_rate: bool = False,
) -> list[Observation]:
    """All of ``sources``: recordings (open or by path), or ``.yaml`` lists with the parameters that differ in each::

        - recording: short.csv
          overrides: {link.length: 0.4}

    Raises ConfigError and RecordingError naming file and key.
    """
    return [
        read_observation(source, rig, overrides, where, namespace=namespace, span=span, warn=warn, any_rate=any_rate)
        for source, overrides, where in entries(sources)
    ]


def entries(
    sources: Sequence[Recording | str | Path],
) -> Iterator[tuple[Recording | Path, Mapping[str, object] | None, str]]:
    """Each recording, or its path, that ``sources`` name, also in ``.yaml`` lists; with its overrides and where those
    are from.
    """
    for source in sources:
        if isinstance(source, Recording):
            yield source, None, ''
            continue
        path = Path(source)
        if path.suffix.lower() not in ('.yaml', '.yml') or path.name == 'metadata.yaml':
            yield path, None, ''
            continue
        for i, (name, overrides) in enumerate(_listed(path)):
            yield path.parent / name, overrides, f'{path}: entry {i + 1}'


def _listed(path: Path) -> list[tuple[str, dict[str, object]]]:
    tree = tree_of_file(path, 'list of recordings')
    if not isinstance(tree, list) or not tree:
        raise ConfigError(f'{path}: must be a list of "- recording: FILE" with optional "overrides:"')
    out: list[tuple[str, dict[str, object]]] = []
    for i, entry in enumerate(tree):
        if isinstance(entry, str):
            entry = {'recording': entry}
        if not isinstance(entry, dict) or not isinstance(entry.get('recording'), str):
            raise ConfigError(f'{path}: entry {i + 1}: must have "recording: FILE"')
        unknown = set(entry) - {'recording', 'overrides'}
        if unknown:
            raise ConfigError(f'{path}: entry {i + 1}: {sorted(map(str, unknown))[0]}: only recording and overrides')
        overrides = entry.get('overrides') or {}
        if not isinstance(overrides, dict):
            raise ConfigError(f'{path}: entry {i + 1}: overrides = {overrides!r}: must be a map of parameters')
        flat: dict[str, object] = {}
        for key, value in overrides.items():
            if isinstance(value, dict):
                flat.update({f'{key}.{k}': v for k, v in value.items()})
            else:
                flat[str(key)] = value
        out.append((entry['recording'], flat))
    return out


def read_readings(
    path: Path,
    rig: Rig | None = None,
    overrides: Mapping[str, object] | None = None,
    where: str = 'overrides',
    warn: Callable[[str], None] | None = None,
) -> Readings:
    """Return one table with its rig (by default the nominal one), changed by ``overrides``, which are from ``where``.

    ``warn`` is told what is not read. Raises RecordingError naming file, line, column and value, ConfigError for a bad
    override.
    """
    table = ReadingsTable(path)
    loads, names = table.loads(), table.values()
    if rig is None:
        rig = load_rig()
    if overrides:
        rig = replace_values(rig, overrides, where)
    values = table.columns(names, empty=True)
    warm = table.column(TEMPERATURE_COLUMN) if TEMPERATURE_COLUMN in table.names else None
    kind = kinds_of(names)[names]
    if kind == 'dots':
        psds = len(rig.psds)
        if len(names) != 2 * psds:
            raise RecordingError(
                f'{path}: has readings of {len(names) // 2} PSDs, the rig file has {psds} (psd_N.center)'
            )
        channels = np.zeros((len(values), 3 * psds))
        channels[:, dot_channels(psds)] = values
        scale = 1e-3 if names[0].endswith(IN_MILLIMETRES) else rig.sensitivities.ravel()
        values = Wiring.from_rig(rig).to_psds(channels)[:, dot_channels(psds)] * scale
    if np.isfinite(values).sum(axis=0).max() < 2:
        raise RecordingError(f'{path}: columns {", ".join(names)} have less than 2 readings each')
    unknown = [n for n in table.names if n not in KNOWN]
    if unknown and warn is not None:
        warn(f'{path}:{table.head}: columns that are not read: {", ".join(unknown)}')
    if TIMES in table.names:
        return _readings_of(path, rig, resting_rows(table, rig, loads, values, warm))
    return Readings(str(path), rig, kind, loads, values, warm, digest_of(path))


def _readings_of(path: Path, rig: Rig, rest: Resting) -> Readings:
    return Readings(str(path), rig, 'poses', rest.loads, rest.poses, rest.temperature, digest_of(path))


def _references_of(
    recording: Recording, rig: Rig | None, overrides: Mapping[str, object] | None, where: str, warn: Notify
) -> Readings:
    """The references of a recording without samples, with its rig (by default its own), changed by ``overrides``."""
    if rig is None:
        rig = rig_at_end(recording)
        for warning in warnings_about_rig(recording):
            warn(warning)
    if overrides:
        rig = replace_values(rig, overrides, where)
    return _readings_of(recording.path, rig, resting_in(recording, rig))


def _without_samples(source: Recording | str | Path, namespace: str | None) -> Recording | None:
    """``source`` opened if it is a recording that has references and no samples, as a CSV of samples never is."""
    if not isinstance(source, Recording) and Path(source).suffix.lower() == '.csv':
        return None
    recording = source if isinstance(source, Recording) else open_recording(source, namespace=namespace)
    return None if recording.has_samples or not recording.references() else recording


def read_tables(
    sources: Sequence[Recording | str | Path],
    rig: Rig | None = None,
    warn: Notify = lambda _: None,
    namespace: str | None = None,
) -> list[Readings]:
    """Return the tables among ``sources``, which may be ``.yaml`` lists; none if all are recordings of samples.

    A recording that has references and no samples counts as a table. ``namespace``: as in :func:`open_recording`.
    Raises RecordingError if some are tables and some are not.
    """
    listed = list(entries(sources))
    alone = [None if is_table(source) else _without_samples(source, namespace) for source, _, _ in listed]
    kinds = [is_table(source) or found is not None for (source, _, _), found in zip(listed, alone, strict=True)]
    if not any(kinds):
        return []
    if not all(kinds):
        source_of_kind = next(s for (s, _, _), table in zip(listed, kinds, strict=True) if not table)
        name = source_of_kind.path if isinstance(source_of_kind, Recording) else source_of_kind
        raise RecordingError(f'{name}: is no table of readings, but others are: search them one by one')
    if rig is None and None in alone:
        warn('a table of readings says nothing of its rig: the nominal rig is taken; give --params-file')
    return [
        read_readings(Path(str(source)), rig, overrides, where, warn)
        if recording is None
        else _references_of(recording, rig, overrides, where, warn)
        for (source, overrides, where), recording in zip(listed, alone, strict=True)
    ]


@dataclass(frozen=True, slots=True)
class DiscoverOptions:
    """What is asked of a search; it goes to a worker process.

    ``known``: the rig as it is known, or its parameter file; None: the rig in the first recording. ``without``:
    effects that are not looked for. ``span``: the part of each recording.
    """

    known: Rig | str | Path | None = None
    namespace: str | None = None
    seed: int = 0
    without: tuple[str, ...] = ()
    span: Span = FULL

    @property
    def params_file(self) -> str | Path | None:
        """The rig's, if there is one."""
        return None if isinstance(self.known, Rig) else self.known

    def rig(self) -> Rig | None:
        """Return the rig as it is known, if it is. Raises ConfigError."""
        return self.known if self.known is None or isinstance(self.known, Rig) else load_rig(self.known)

    def read(self, sources: Sequence[Recording | str | Path], notify: Notify = warn_caller) -> list[Observation]:
        """Return the recordings; ``notify`` gets what is odd."""
        return read_observations(
            sources, self.rig(), namespace=self.namespace, span=self.span, warn=notify, any_rate=True
        )

    def tables(self, sources: Sequence[Recording | str | Path], notify: Notify = warn_caller) -> list[Readings]:
        """Return the tables of readings; none if ``sources`` are recordings."""
        return read_tables(sources, self.rig(), notify, self.namespace)

    def discovered(
        self,
        observations: Sequence[Observation],
        progress: Callable[[str], None] = lambda _: None,
        notify: Notify = warn_caller,
    ) -> Discovery:
        """Return the answer; ``notify`` gets a warning if the rig file cannot be edited."""
        discovery = discover(observations, self.rig(), seed=self.seed, without=self.without, progress=progress)
        source = GIVEN_RIG if self.known else 'the parameters in each recording, the nominal rig if it has none'
        return replace(discovery, params_file=self.params_file, notify=notify, rig_source=source)

    def discovered_in_tables(self, tables: Sequence[Readings], notify: Notify = warn_caller) -> PlantDiscovery:
        """Return the answer of tables of readings; ``notify`` gets a warning if the rig file cannot be edited.

        Raises RecordingError if a part of a table is asked for.
        """
        if self.span != FULL:
            raise RecordingError(f'{tables[0].name}: holds readings of a link at rest: take all of it')
        return discover_in(ReadingsPlant(tables, self.without, self.params_file, notify), seed=self.seed)
