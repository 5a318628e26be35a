# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reads recordings for discover, also those of ``.yaml`` lists, and what is asked of a search."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.base.foreign_yaml import tree_of_file
from psd_deflection.base.plugins import optional
from psd_deflection.recordings.observation import Observation, read_observation
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.spans import FULL, Span
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.discover.report import Discovery
from psd_deflection.studies.study import GIVEN_RIG, Notify, StudyResult, warn_caller


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

    def tables(self, sources: Sequence[Recording | str | Path], notify: Notify = warn_caller) -> list[Any]:
        """Return the tables of readings; none if ``sources`` are recordings, or without the room of plants."""
        readings = optional('psd_deflection.studies.discover.readings')
        return list(readings.read_tables(sources, self.rig(), notify, self.namespace)) if readings else []

    def discovered(
        self,
        observations: Sequence[Observation],
        progress: Callable[[str], None] = lambda _: None,
        notify: Notify = warn_caller,
    ) -> Discovery:
        """Return the answer; ``notify`` gets a warning if the rig file cannot be edited."""
        discovery = discover(observations, self.rig(), seed=self.seed, without=self.without, progress=progress)
        source = GIVEN_RIG if self.known else 'the parameters in each recording, the rig of the thesis if it has none'
        return replace(discovery, params_file=self.params_file, notify=notify, rig_source=source)

    def discovered_in_tables(self, tables: Sequence[Any], notify: Notify = warn_caller) -> StudyResult:
        """Return the answer of tables of readings; ``notify`` gets a warning if the rig file cannot be edited.

        Raises RecordingError if a part of a table is asked for.
        """
        if self.span != FULL:
            raise RecordingError(f'{tables[0].name}: holds readings of a link at rest: take all of it')
        readings = optional('psd_deflection.studies.discover.readings')
        result: StudyResult = readings.discovered(tables, self.without, self.params_file, notify, self.seed)
        return result
