"""Lines that may come again and again, said at once and then ever more seldom, with a count."""

from __future__ import annotations

from dataclasses import dataclass

from psd_deflection.base.bounds import BoundedMap
from psd_deflection.base.log import INFO, Say

FIRST_WAIT_S = 10.0
LONGEST_WAIT_S = 3600.0


@dataclass(slots=True)
class _Kind:
    line: str = ''
    level: int = INFO
    since: int = 0
    next_s: float = 0.0
    wait_s: float = FIRST_WAIT_S
    told: int = 0


class Repeats:
    """``say``: told of the lines. After a line of a kind the next one of that kind waits ``FIRST_WAIT_S``, the one
    after it twice as long, and so on up to ``LONGEST_WAIT_S``. A kind that was quiet for that long starts anew.

    Owns no clock: every time comes from the caller, s.
    """

    def __init__(self, say: Say) -> None:
        self._say = say
        self._kinds: BoundedMap[str, _Kind] = BoundedMap()

    def tell(self, kind: str, line: str, level: int, now_s: float, at_once: int = 1) -> None:
        """Say ``line`` now, or count it. ``kind``: one of the program's own few names. ``level``: its severity.
        ``at_once``: so many are said without waiting."""
        known = self._kinds.setdefault(kind, _Kind())
        known.line, known.level = line, level
        known.since += 1
        if now_s >= known.next_s + known.wait_s:
            known.told, known.wait_s = 0, FIRST_WAIT_S
        if known.told < at_once:
            known.next_s = now_s
        self._settle(known, now_s)

    def settle(self, now_s: float) -> None:
        """Say what was counted and is due."""
        for known in self._kinds.values():
            if known.since:
                self._settle(known, now_s)

    def _settle(self, known: _Kind, now_s: float) -> None:
        if now_s < known.next_s:
            return
        more = f' (and {known.since - 1} more like it)' if known.since > 1 else ''
        self._say(known.line + more, known.level)
        known.since = 0
        known.told += 1
        known.next_s = now_s + known.wait_s
        known.wait_s = min(2.0 * known.wait_s, LONGEST_WAIT_S)
