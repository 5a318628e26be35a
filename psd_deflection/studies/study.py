# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The shape of every study: recordings give a frozen problem of arrays (``read_NAME``), a function of the
study's name takes it and gives a :class:`StudyResult`, which says, shows and writes itself: answer, sections, what it
is of."""

from __future__ import annotations

import abc
import html
import re
import warnings
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import yaml

from psd_deflection.base.drawings import Drawing, in_page, plotted
from psd_deflection.base.errors import ConfigError, RecordingError
from psd_deflection.base.files import replace_file
from psd_deflection.base.pages import page, table
from psd_deflection.base.tables import Table
from psd_deflection.base.text import json_text, sanitize
from psd_deflection.model.simulation.catalogue import effects_to_values
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.replay.engine import rig_at_end, warnings_about_rig
from psd_deflection.recordings.spans import FULL, Span
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.rig.declarations import DESCRIPTION
from psd_deflection.rig.parameter_files import nested, parameter_text

if TYPE_CHECKING:
    import pandas

    from psd_deflection.base.figures import ShownFigure

Notify = Callable[[str], None]
"""Takes a warning."""

GIVEN_RIG = 'the rig that was given'
OF_THE_THESIS = 'the rig of the thesis: there is none in'
LONGEST_REPR = 2000


def warn_caller(warning: str) -> None:
    """A warning as Python has it, for a caller who names no other way."""
    warnings.warn(warning, stacklevel=3)


class PageSection(NamedTuple):
    """A part of the page: ``title`` ('' if it belongs to what is above), HTML and drawings."""

    title: str
    parts: tuple[str | Drawing, ...]


class StudyResult(abc.ABC):
    """The answer of a study. ``study``: its name; ``title``: of its page; ``json_name``: of the file of the tree."""

    study: ClassVar[str]
    title: ClassVar[str]
    json_name: ClassVar[str]

    @abc.abstractmethod
    def tree(self) -> dict[str, Any]:
        """Return the answer for programs: names, numbers in SI units, lists."""

    @abc.abstractmethod
    def sentences(self) -> list[str]:
        """Return the answer for a person, the most important first."""

    @abc.abstractmethod
    def sections(self) -> Iterable[PageSection]:
        """Return the page below the sentences."""

    @abc.abstractmethod
    def table(self) -> Table:
        """Return the answer as columns with units, a row for each thing that was found."""

    def __repr__(self) -> str:
        return f'<{type(self).__name__}: {sanitize(" ".join(self.sentences()), LONGEST_REPR)}>'

    def page_sentences(self) -> list[str]:
        """Those of :meth:`sentences` that stand above the sections of the page; a section may have the others."""
        return self.sentences()

    @property
    def sources(self) -> Mapping[str, str]:
        """What the answer was made from, by what it is."""
        return {}

    def lines(self) -> list[str]:
        """What the command prints."""
        return self.sentences()

    def report(self) -> str:
        """Return the page as HTML, with its pictures inside."""
        first, *remaining = self.page_sentences()
        body = [f'<h1>{html.escape(self.title)}</h1><p class=verdict>{html.escape(first)}</p>']
        body += [f'<p>{html.escape(text)}</p>' for text in remaining]
        for section in self.sections():
            body += [f'<h2>{html.escape(section.title)}</h2>'] if section.title else []
            body += map(in_page, section.parts)
        if self.sources:
            body += ['<h2>Made from</h2>', table(('what', 'from'), list(self.sources.items()))]
        return page(f'psd-deflection {self.study}', body)

    def drawings(self) -> list[Drawing]:
        """What is drawn on the page, in its order. ``words`` of each say what it shows."""
        return [part for section in self.sections() for part in section.parts if not isinstance(part, str)]

    def plot(self, number: int = 0) -> ShownFigure:
        """Return the drawing ``number`` of :meth:`drawings` as a matplotlib figure, which a notebook shows.

        ``figure.savefig('a.png')`` writes it. Raises ConfigError if there is no such drawing, or no matplotlib.
        """
        shown = self.drawings()
        if not 0 <= number < len(shown):
            there = '; '.join(f'{i}: {drawn.words}' for i, drawn in enumerate(shown)) or 'none, for nothing was found'
            raise ConfigError(f'number: {number}: no such drawing; there are {there}')
        return plotted(shown[number])

    def to_pandas(self) -> pandas.DataFrame:
        """:meth:`table` as a DataFrame; ``.attrs['units']`` has the units.

        Raises ConfigError if pandas is not installed.
        """
        return self.table().to_pandas()

    def json(self) -> str:
        """Return the tree as text; null for numbers that JSON does not have."""
        return json_text(self.tree(), indent=1) + '\n'

    def files(self) -> dict[str, str]:
        """What :meth:`save` writes, by name."""
        return {'report.html': self.report(), self.json_name: self.json()}

    def save(self, folder: str | Path) -> list[Path]:
        """Write the page, the JSON and whatever else there is into ``folder``; it is made if it is not there.

        Returns the paths. Raises RecordingError if the disk rejects.
        """
        into = Path(folder)
        files = self.files()
        try:
            into.mkdir(parents=True, exist_ok=True)
            for name, text in files.items():
                replace_file(into / name, text.encode(errors='replace'))
        except OSError as error:
            raise RecordingError(f'{into}: cannot be written ({error.strerror or error})') from None
        return [into / name for name in files]


class Opened(NamedTuple):
    """A recording, cut into the rig's blocks, and its rig.

    ``params_file``: of the rig, if it has one. ``notify``: takes warnings. ``given``: whether the caller gave the rig.
    """

    recording: Recording
    rig: Rig
    params_file: Path | None
    notify: Notify = warn_caller
    given: bool = False

    @property
    def sources(self) -> dict[str, str]:
        """See :attr:`StudyResult.sources`."""
        if self.params_file is not None:
            rig = str(self.params_file)
        elif self.given:
            rig = GIVEN_RIG
        else:
            rig = 'the parameters in the recording' if self.recording.parameters else f'{OF_THE_THESIS} the recording'
        return {'recording': str(self.recording.path), 'rig': rig}


def opened(
    recording: Recording | str | Path,
    rig: Rig | str | Path | None = None,
    *,
    namespace: str | None = None,
    span: Span = FULL,
    notify: Notify = warn_caller,
) -> Opened:
    """Return the recording and the rig that describes it: ``rig``, its parameter file, or that of the recording's end.

    ``span``: the part of the recording that is meant. ``notify`` gets a warning if nobody names a rig.
    Raises RecordingError and ConfigError.
    """
    if not isinstance(recording, Recording):
        recording = open_recording(recording, namespace=namespace, span=span)
    params_file = None if rig is None or isinstance(rig, Rig) else Path(rig)
    if rig is None:
        for warning in warnings_about_rig(recording):
            notify(warning)
        known = rig_at_end(recording)
    else:
        known = rig if isinstance(rig, Rig) else load_rig(rig)
    return Opened(
        recording.with_block_size(known.estimator.block_size), known, params_file, notify, isinstance(rig, Rig)
    )


def named(recording: str, digest: str, digits: int = 16) -> str:
    """Return a recording by its name and the start of its SHA-256, if it has files."""
    return f'{recording} (sha256 {digest[:digits]})' if digest else recording


def described(rig: Rig, effects: Iterable[ActiveEffect]) -> str:
    """What describes the rig, as a ROS 2 parameter file with ``effects`` instead of its own.

    For a rig without a file of its own; :func:`psd_deflection.rig.parameter_files.with_effects_section` adds them to a
    file. Port, folders and page are left out: they belong to a machine.
    """
    tree = nested({name: rig.values[name] for name in DESCRIPTION})
    if given := list(effects):
        tree['effects'] = effects_to_values(given)
    return yaml.dump({'/**': {'ros__parameters': tree}}, Dumper=_Quoting, sort_keys=False, allow_unicode=True)


class _Quoting(yaml.SafeDumper):
    """Quotes the names of axes, as PyYAML alone does not: to rcl y is true."""


_Quoting.add_implicit_resolver('tag:yaml.org,2002:bool', re.compile('[yYnN]$'), list('yYnN'))


def edited_rig_file(
    params_file: str | Path | None,
    name: str,
    rig_text: Callable[[], str],
    edit: Callable[[str, Path], str],
    notify: Notify = warn_caller,
) -> str:
    """Return the text of the file ``name``: ``edit`` of the user's file and its path, comments kept.

    Without a file of the user, or if it cannot be edited, which ``notify`` gets, ``edit`` of what ``rig_text`` gives.
    """
    if params_file is not None:
        path = Path(params_file)
        text = parameter_text(path)
        try:
            return edit(text, path)
        except ConfigError as error:
            notify(f'{error}: {name} has its values without its comments')
    return edit(rig_text(), Path(name))
