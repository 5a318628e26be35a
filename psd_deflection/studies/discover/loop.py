"""Search, plan, record, search again, until one explanation is left or no recording would help."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from psd_deflection.rig.config import Rig
from psd_deflection.studies.discover.discover import Discovery, discover
from psd_deflection.studies.discover.experiment import Limits
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.discover.planning import Plan, plan_next

Outcome = Literal['unique', 'limits', 'recordings']


@dataclass(frozen=True, slots=True, eq=False)
class Settled:
    """``found``: the last answer. ``plans``: those that were carried out. ``open``: the one that was not, if rivals
    are left. ``outcome``: one explanation is left; no recording within the limits tells the rest apart; or no more
    recordings were allowed.
    """

    found: Discovery
    plans: tuple[Plan, ...]
    open: Plan | None
    outcome: Outcome

    @property
    def sentence(self) -> str:
        """The outcome in one sentence."""
        count = len(self.plans)
        after = f'after {count} more recording{"" if count == 1 else "s"}' if count else 'without a further recording'
        if self.outcome == 'unique':
            return f'The answer is unique {after}.'
        if self.outcome == 'limits' and self.open is not None:
            return f'The answer is as far as it can be {after}. {self.open.sentence}'
        return f'The answer is not unique {after}, and no more were allowed.'


def next_of(found: Discovery, limits: Limits | None = None) -> Plan | None:
    """The next recording after a search; None if it left no rivals."""
    return plan_next(found.workspace, found.fit, found.rivals, limits)


def settle(
    recordings: Sequence[Observation],
    rig: Rig | None,
    record: Callable[[Plan, int], Observation],
    *,
    limits: Limits | None = None,
    most: int = 3,
    seed: int = 0,
    without: Sequence[str] = (),
    progress: Callable[[str], None] = lambda _: None,
) -> Settled:
    """Search ``recordings``, and ``record`` what is planned (its number counts from 1) until the answer is unique.

    ``most``: how many further recordings are made. Other arguments as for :func:`discover`.
    """
    known, plans = list(recordings), list[Plan]()
    while True:
        found = discover(known, rig, seed=seed, without=without, progress=progress)
        progress('planning')
        plan = next_of(found, limits)
        # A rival with more parameters that came out as the named effect would be has nothing left that could be tested:
        # nothing within the limits needs its further ones.
        needed = any(rival.parameters <= found.fit.parameters for rival in found.rivals)
        if plan is None or not (plan.useful or (found.unsettled and needed)):
            return Settled(found, tuple(plans), None, 'unique')
        if not plan.useful:
            return Settled(found, tuple(plans), plan, 'limits')
        if len(plans) == most:
            return Settled(found, tuple(plans), plan, 'recordings')
        plans.append(plan)
        progress(f'recording {len(plans)}')
        known.append(record(plan, len(plans)))
