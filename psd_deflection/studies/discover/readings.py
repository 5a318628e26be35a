# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The inputs of discover that are tables of readings: a link at rest, as a plant."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from psd_deflection.base.errors import RecordingError
from psd_deflection.base.log import Note
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.read.references import IN_MILLIMETRES, KNOWN, TIMES, ReadingsTable, is_table, kinds_of
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.replay.engine import rig_at_end, warnings_about_rig
from psd_deflection.recordings.sample_table import TEMPERATURE_COLUMN, digest_of
from psd_deflection.recordings.summary import THESIS_RIG
from psd_deflection.records import dot_channels
from psd_deflection.rig.config import Rig, load_rig, replace_values
from psd_deflection.rig.wiring import Wiring
from psd_deflection.studies.discover.from_recordings import entries
from psd_deflection.studies.discover.plant_search import PlantDiscovery, discover_in
from psd_deflection.studies.discover.plants import Readings, ReadingsPlant, Resting, resting_in, resting_rows
from psd_deflection.studies.loads.thresholds import PART, SEVERAL
from psd_deflection.studies.study import Notify


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
    kinds = [is_table(source) or recording is not None for (source, _, _), recording in zip(listed, alone, strict=True)]
    if not any(kinds):
        return []
    if not all(kinds):
        source_of_kind = next(s for (s, _, _), table in zip(listed, kinds, strict=True) if not table)
        name = source_of_kind.path if isinstance(source_of_kind, Recording) else source_of_kind
        raise RecordingError(f'{name}: is no table of readings, but others are: search them one by one')
    if rig is None and None in alone:
        warn(Note(f'a table of readings holds no parameters: {THESIS_RIG}'))
    return [
        read_readings(Path(str(source)), rig, overrides, where, warn)
        if recording is None
        else _references_of(recording, rig, overrides, where, warn)
        for (source, overrides, where), recording in zip(listed, alone, strict=True)
    ]


def stuck_readings(plant: ReadingsPlant) -> Iterator[str]:
    """Readings that are the same to the last digit under several loads which differ by a fifth of what moves them."""
    for table, measured, simulated in zip(plant.tables, plant.measured(), plant.simulate({}), strict=True):
        for channel, every, moves in zip(plant.channels, measured, simulated, strict=True):
            rows = np.flatnonzero(np.isfinite(every))
            for run in np.split(rows, np.flatnonzero(np.diff(every[rows])) + 1):
                if SEVERAL <= len(run) < len(rows) and np.ptp(moves[run]) > PART * np.ptp(moves):
                    first, last = run[[0, -1]] + 1
                    yield (
                        f'{table.name}: {channel} is the same in rows {first} to {last} under different loads: '
                        'something stopped the link, or the reading is stuck; empty cells are left out'
                    )


def discovered(
    tables: Sequence[Readings], without: tuple[str, ...], params_file: str | Path | None, warn: Notify, seed: int
) -> PlantDiscovery:
    """Return what the simulation lacks to explain ``tables``; ``warn`` is told if the rig file cannot be edited, and of
    readings that are stuck.
    """
    plant = ReadingsPlant(tables, without, params_file, warn)
    for words in stuck_readings(plant):
        warn(words)
    return discover_in(plant, seed=seed)
