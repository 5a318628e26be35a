# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``calibrate --live``: records and calibrates at the bench, and shows what is determined and what is open."""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from psd_deflection.base.errors import DaemonError, RecordingError
from psd_deflection.base.text import sanitize
from psd_deflection.cli._daemon import daemon_of
from psd_deflection.cli._report import LONGEST_LINE, print_json, show, warn
from psd_deflection.run.bench_calibration import BenchStep, follow
from psd_deflection.run.monitor.served import need_server
from psd_deflection.run.realtime import Signals
from psd_deflection.studies.calibrate.from_recordings import CalibrationOptions
from psd_deflection.studies.calibrate.progress import CalibrationProgress, Need, ParameterProgress
from psd_deflection.studies.calibrate.result import Calibrated

if TYPE_CHECKING:
    from psd_deflection.run.monitor.client import Daemon

BAR = 20
MOST_NEEDS, MOST_NAMES = 4, 4
"""What is shown of what is open."""
BY = {'reference': 'the reference', 'loads': 'known loads', 'self': 'the redundant reading'}
NICE = 10
"""The daemon's threads go before this computation."""
FIRST = 'next: zero the unloaded link, then hang known loads and note each, or move the tip before a reference'


def calibrate_live(args: argparse.Namespace, asked: CalibrationOptions) -> Calibrated:
    """Record, calibrate until nothing is open, the recording is stopped or Ctrl-C; return the last answer.

    Raises DaemonError if no daemon answers, RecordingError if the recording is not on this machine or was too short.
    """
    need_server()
    # Imported here: only these commands and the page need aiohttp.
    from psd_deflection.run.monitor.client import ask, recording_of

    daemon = daemon_of(args)
    starts_recording = recording_of(daemon) is None
    if starts_recording:
        ask(daemon, 'api/record', {'record': True})
    try:
        return _followed(args, asked, daemon)
    finally:
        if starts_recording:
            # It may have ended, or the daemon with it.
            with contextlib.suppress(DaemonError):
                ask(daemon, 'api/record', {'record': False})


def _followed(args: argparse.Namespace, asked: CalibrationOptions, daemon: Daemon) -> Calibrated:
    from psd_deflection.run.monitor.client import recording_of

    folder = Path(recording_of(daemon) or '')
    if not folder.is_absolute() or not folder.is_dir():
        raise RecordingError(f'{folder}: is not on this machine; run `calibrate --live` on the machine of the daemon')
    show(f'recording to {folder}; Ctrl-C or `psd-deflection record stop` ends it', FIRST, aside=args.json)
    with contextlib.suppress(OSError, AttributeError):
        # Windows has no niceness.
        os.nice(NICE)

    # An exception out of a signal may be lost in a library, and then nothing would end: the flag is looked at.
    signals = Signals()

    def still() -> bool:
        if signals.stop:
            # A second one ends at once, with the last answer.
            signals.restore_handlers()
            return False
        try:
            return recording_of(daemon) == str(folder)
        except DaemonError as error:
            warn(f'{error}; what is recorded counts')
            return False

    display = LiveDisplay(as_json=args.json)
    last: BenchStep | None = None
    try:
        for step in follow(folder, asked, still):
            display.update(step)
            last = step if step.answer is not None or last is None else last
    except KeyboardInterrupt:
        pass
    finally:
        signals.restore_handlers()
    display.end()
    if last is None or last.answer is None:
        why = f': {last.words}' if last is not None else ''
        raise RecordingError(f'{folder}: ended before anything could be calibrated{why}')
    return last.answer


class LiveDisplay:
    """The bars, drawn over themselves on a terminal; elsewhere a line when something was determined."""

    def __init__(self, *, as_json: bool) -> None:
        self._json = as_json
        self._live = not as_json and sys.stdout.isatty()
        self._drawn = 0
        self._logged: set[str] = set()

    def update(self, step: BenchStep) -> None:
        """Show one look at the recording."""
        for warning in step.warnings:
            self._once(warning, warn)
        if self._json:
            print_json({'waiting': step.words} if step.progress is None else step.progress.tree())
            sys.stdout.flush()
        elif self._live:
            self._draw([step.words] if step.progress is None else picture(step.progress))
        elif step.progress is None:
            self._once(step.words, show)
        else:
            self._notify(step.progress)

    def _once(self, words: str, log: Callable[[str], None]) -> None:
        if words not in self._logged:
            self._logged.add(words)
            self.end()
            log(words)

    def _notify(self, progress: CalibrationProgress) -> None:
        for parameter in progress.parameters:
            if parameter.determined and parameter.name not in self._logged:
                self._logged.add(parameter.name)
                show(f'{progress.seconds:6.1f} s  {line(parameter)}')
        for need in progress.needs[:1]:
            self._once(next_words(need), show)

    def _draw(self, lines: list[str]) -> None:
        up = f'\x1b[{self._drawn}A' if self._drawn else ''
        wide = shutil.get_terminal_size().columns - 1
        # A line that the terminal itself wraps would count as one when it is drawn over.
        lines = [part for line in lines for part in textwrap.wrap(sanitize(line, LONGEST_LINE), wide) or ['']]
        text = '\n'.join(lines)
        sys.stdout.write(f'\r{up}\x1b[J{text}\n')
        sys.stdout.flush()
        self._drawn = len(lines)

    def end(self) -> None:
        """Leave what is drawn where it is."""
        self._drawn = 0


def line(parameter: ParameterProgress) -> str:
    """One parameter: its bar, its value, what is left of its tolerance."""
    full = round(parameter.filled * BAR)
    value = parameter.value if parameter.determined else 'open'
    return f'{parameter.name:<27} [{"#" * full}{"." * (BAR - full)}]  {value}'


def picture(progress: CalibrationProgress) -> list[str]:
    """The bars and what to do next."""
    known = f'{progress.determined} of {len(progress.parameters)} parameters determined'
    head = f'{progress.seconds:.1f} s, by {BY[progress.kind]}: {known}'
    lines = [head, '', *(line(parameter) for parameter in progress.parameters), '']
    if progress.rejected:
        lines.append(f'rejected: {progress.rejected}')
    lines += [next_words(need) for need in progress.needs[:MOST_NEEDS]]
    return lines if progress.needs else [*lines, 'nothing is open']


def next_words(need: Need) -> str:
    """What to do, and for which parameters."""
    names = ', '.join(need.names[:MOST_NAMES])
    more = ', …' if len(need.names) > MOST_NAMES else ''
    return f'next: {need.motion} ({names}{more})'
