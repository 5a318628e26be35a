# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""From the tip's pose to the load that causes it, at rest, through the effects that the rig file lists, the last one
first; it knows no effect by name."""

from collections.abc import Mapping, Sequence

from psd_deflection.base.arithmetic import FIXED
from psd_deflection.base.errors import ConfigError
from psd_deflection.model.simulation.declaration import POINTS, ActiveEffect, Traced
from psd_deflection.model.simulation.physics import Physics
from psd_deflection.rig.config import Rig

TIP_LOADS = 'state.tip_loads'
"""Name under which :meth:`TipLoads.memory` is recorded."""


class TipLoads:
    """The load at the tip, block after block.

    ``zeroed``: the unloaded dots were measured, so they contain what displaces the tip without a load (its weight, a
    tilted base); otherwise the pose does. Raises ConfigError if an effect fails on a pose.
    """

    part = 'the load at the tip'
    prefixes = (TIP_LOADS,)

    def __init__(self, rig: Rig, effects: Sequence[ActiveEffect]) -> None:
        """``effects``: those of the rig file, in the order in which they act; none: the nominal link."""
        self.zeroed = False
        self._seconds = rig.estimator.block_size / rig.converter.sample_rate_hz
        self._physics = Physics.of(rig)
        self._physics.xp = FIXED
        for active in effects:
            if active.effect.configure is not None:
                active.effect.configure(self._physics, active.values)
        self._statics = self._physics.statics
        self._offset: list[float] = [*self._physics.at_rest]
        traced = [active for active in effects if active.effect.trace_back is not None]
        self._effects = sorted(traced, key=lambda a: (POINTS.index(a.effect.point), a.effect.rank), reverse=True)
        self._last: int | None = None
        self._forget()
        for active in self._effects:
            try:
                self._trace(active, Traced([1e-3, 1e-3, 1e-3], [1.0, 1.0, 1.0], self._seconds, self._physics), [])
            except Exception as error:
                # The effect may be a user's own file. Fail here, not at the first block of a run.
                raise ConfigError(
                    f'effects: {active.label}: trace_back fails on a pose ({type(error).__name__}: {error})'
                ) from error

    def _forget(self) -> None:
        self._remembered: list[list[float]] = [[] for _ in self._effects]

    @staticmethod
    def _trace(active: ActiveEffect, block: Traced, remembered: list[float]) -> None:
        if active.effect.trace_back is not None:
            active.effect.trace_back(block, active.values, remembered)

    def tip_load(self, block: int, dx: float, dy: float, theta: float) -> tuple[float, float, float]:
        """(fx N, fy N, tz N m), as the load record counts them, for the pose (m, m, rad) of block number ``block``."""
        passed = 1 if self._last is None else max(block - self._last, 0)
        self._last = block
        x, y = (0.0, 0.0) if self.zeroed else self._offset
        traced = Traced([dx - x, dy - y, theta], [], passed * self._seconds, self._physics)
        for active, remembered in zip(self._effects, self._remembered, strict=True):
            if active.effect.point == 'load':
                break
            self._trace(active, traced, remembered)
        traced.loads = [*self._statics.tip_load(*traced.pose)]
        for active, remembered in zip(self._effects, self._remembered, strict=True):
            if active.effect.point == 'load':
                self._trace(active, traced, remembered)
        fx, fy, tz = traced.loads
        return fx, fy, tz

    @property
    def compliance(self) -> tuple[float, float, float]:
        """Deflection for a load of 1 N, 1 N, 1 N m at the tip: m/N, m/N, rad/(N m)."""
        return self._statics.deflection(1.0, 1.0, 1.0)

    def state_dict(self) -> dict[str, float | str | tuple[float, ...]]:
        """What :meth:`restore` needs to go on from here; {} if the next load depends on the pose alone."""
        moved = self.zeroed and any(self._offset)
        if not moved and not any(self._remembered):
            return {}
        out = [float(self.zeroed), -1.0 if self._last is None else float(self._last)]
        for remembered in self._remembered:
            out += [float(len(remembered)), *remembered]
        return {TIP_LOADS: tuple(out)}

    def load_state_dict(self, values: Mapping[str, float | str | tuple[float, ...]]) -> None:
        """Go on from another one's :meth:`state_dict`. Raises ValueError if it had other effects."""
        reported = values.get(TIP_LOADS, ())
        numbers = reported if isinstance(reported, tuple) else ()
        taken: list[list[float]] = []
        at = 2
        while 2 <= at < len(numbers):
            end = at + 1 + int(numbers[at])
            taken.append(list(numbers[at + 1 : end]))
            at = end if end > at else 0
        if at != len(numbers) or len(taken) != len(self._remembered):
            raise ValueError(
                f'{TIP_LOADS}: {len(numbers)} numbers; expected the memories of {len(self._remembered)} effects'
            )
        zeroed, last = numbers[:2]
        self.zeroed, self._last = bool(zeroed), None if last < 0.0 else int(last)
        self._remembered = taken
