# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Several rigs in one process: a session for each link, and the end effector composed of their estimates.

Each session has its own reader and pipeline thread. The pipeline threads hand their estimates to one joiner, in
turn; the one that completes a time composes the end effector.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

from psd_deflection.arms.chains.chain import EndEffector, Joined, Joiner
from psd_deflection.arms.chains.chain_file import ChainFile
from psd_deflection.base.log import INFO, LogCallback
from psd_deflection.records import (
    BlockStatus,
    DeflectionEstimate,
    EndEffectorDeflection,
    ParameterChange,
    Record,
    SpotMeans,
)
from psd_deflection.rig.config import Rig, replace_values
from psd_deflection.run.processing import OutageLog
from psd_deflection.run.session import Session
from psd_deflection.run.simulated_rig import simulates, started_early

SILENT_S = 0.5
"""A link whose last estimate is older than this is reported as missing, although its blocks come no more."""


class Composed(NamedTuple):
    """The end effector at one time; ``end`` is None if a link is missing, and ``why`` says which."""

    t_ns: int
    end: EndEffector | None
    why: str = ''

    def as_record(self) -> EndEffectorDeflection | None:
        """What is published, None without a composed deflection."""
        if self.end is None:
            return None
        moved = self.end.deflection
        return EndEffectorDeflection(
            self.t_ns,
            tuple(moved.position.tolist()),
            tuple(moved.quaternion.tolist()),
            tuple(self.end.covariance.ravel().tolist()),
        )


class _LinkSink:
    """Hands a link's records to the chain."""

    def __init__(self, chain: ChainSession, link: int) -> None:
        self._chain, self._link = chain, link

    def put(self, record: Record) -> None:
        """One record."""
        if isinstance(record, DeflectionEstimate):
            if record.primary:
                self._chain.take(self._link, record)
        elif isinstance(record, SpotMeans):
            self._chain.reasons[self._link] = '' if record.status is BlockStatus.OK else record.reason


class ChainSession:
    """Opens every rig on construction. ``log`` gets one line for each change of state, from any thread.

    ``sessions``: in the order of the links. ``listeners`` get each :class:`Composed`, from any pipeline thread.
    ``reasons``: for each link, why its last block had no estimate, or ''. ``last``: the newest composed one, or None.

    Raises DeviceError, ConfigError, SolverError or RecordingError if the run cannot start.
    """

    def __init__(
        self,
        file: ChainFile,
        log: LogCallback,
        open_session: Callable[[str, Rig, LogCallback], Session] = lambda _, rig, log: Session(rig, log),
    ) -> None:
        self.file = file
        self.sessions: list[Session] = []  # Bound: the links of the chain.
        self.listeners: list[Callable[[Composed], None]] = []
        self.reasons = [''] * len(file.rigs)
        self.last: Composed | None = None
        self._angles = file.angles
        self._closed = False
        self._lock = threading.Lock()
        self._log = log
        self._outage_log = OutageLog(lambda line, level=INFO: log(f'end effector: {line}', level))
        self._joiner = Joiner([round(1e9 * r.estimator.block_size / r.converter.sample_rate_hz) for r in file.rigs])
        try:
            with contextlib.ExitStack() as early:
                for rig in file.rigs:
                    early.enter_context(started_early(simulates(rig.values)))
                for name, rig in zip(file.names, file.rigs, strict=True):
                    # Nobody notes loads to a chain.
                    moving = replace_values(rig, {'demo': True}) if simulates(rig.values) else rig
                    self.sessions.append(open_session(name, moving, partial(self._log_of, name)))
        except BaseException:
            self.close()
            raise
        for link, session in enumerate(self.sessions):
            # One offset for all, so that a system clock that was set between two starts does not part the links.
            session.acquisition.to_ros_ns = self.sessions[0].acquisition.to_ros_ns
            session.processing.sinks.append(_LinkSink(self, link))

    def _log_of(self, name: str, line: str, level: int = INFO, /) -> None:
        self._log(f'{name}: {line}', level)

    @property
    def alive(self) -> bool:
        """Whether every link's blocks are still processed."""
        return all(session.alive for session in self.sessions)

    @property
    def failed(self) -> BaseException | None:
        """The error that ended a link's pipeline or reader, or None."""
        return next((session.failed for session in self.sessions if session.failed is not None), None)

    @property
    def composed(self) -> int:
        """Times at which the end effector was composed."""
        return self._joiner.joined

    @property
    def missing(self) -> dict[str, int]:
        """At how many times each link was missing."""
        return dict(zip(self.file.names, self._joiner.missing, strict=True))

    @property
    def angles(self) -> tuple[float, ...]:
        """Of the joints, rad."""
        return self._angles

    def responsive(self) -> bool:
        """Whether the threads of all links completed a round lately."""
        return all(session.responsive() for session in self.sessions)

    def silent(self) -> str:
        """The links that give no estimates now, with the reasons, or ''."""
        now = self.sessions[0].acquisition.now_ns()
        names = []
        for link, session in enumerate(self.sessions):
            newest = self._joiner.newest_ns[link]
            if newest is None or now - newest > SILENT_S * 1e9:
                away = 'the device is away' if session.acquisition.away else 'no samples'
                heard = session.processing.silent_s() < SILENT_S
                names.append(f'{self.file.names[link]}: {(self.reasons[link] or "no estimate") if heard else away}')
        return '; '.join(names)

    def set_angles(self, angles: Mapping[str, float]) -> None:
        """Take the angles (rad) of joints by their names; names that the chain does not have are passed over."""
        self._angles = tuple(
            angles.get(joint.name, now) if joint.name else now
            for joint, now in zip(self.file.joints, self._angles, strict=True)
        )

    def start(self) -> None:
        """Let samples flow. Raises RecordingError as :meth:`Session.start` does."""
        for session in self.sessions:
            session.start()

    def take(self, link: int, estimate: DeflectionEstimate) -> None:
        """An estimate of a link, from its pipeline thread; compose what is complete."""
        with self._lock:
            if self._closed:
                return
            for joined in self._joiner.put(link, estimate):
                composed = self._compose(joined)
                self.last = composed
                for listener in self.listeners:
                    listener(composed)
                self._outage_log.block(composed.why and 'missing', f'not composed: {composed.why}', time.monotonic())

    def _compose(self, joined: Joined) -> Composed:
        if joined.missing:
            why = '; '.join(f'{self.file.names[n]}: {self.reasons[n] or "no estimate"}' for n in joined.missing)
            return Composed(joined.t_ns, None, why)
        try:
            return Composed(joined.t_ns, self.file.chain.compose(joined.tips, self._angles))
        except (ArithmeticError, ValueError) as error:
            # Each link measures and records on, whatever the angles of the joints are.
            return Composed(joined.t_ns, None, f'cannot be composed ({error})')

    def zero(self) -> list[ParameterChange | None]:
        """Take the present dots of every link as the unloaded ones; None for a link whose last block is not good.

        Raises TimeoutError if no data flows.
        """
        return [session.zero() for session in self.sessions]

    def record(self, wanted: bool) -> list[Future[Path | None]]:
        """Start or stop a recording of every link, each in its own folder. Raises TimeoutError if no data flows."""
        return [session.record(wanted) for session in self.sessions]

    def close(self) -> None:
        """End every session."""
        with self._lock:
            # The links do not end at the same time: none of them is missing.
            self._closed = True
        if self.sessions:
            with ThreadPoolExecutor(len(self.sessions)) as pool:
                list(pool.map(Session.close, self.sessions))
