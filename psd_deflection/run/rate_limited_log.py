# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Lines that may come again and again, said at once and then ever more seldom, with a count."""

import re
from dataclasses import dataclass, field

from psd_deflection.base.bounds import BoundedMap
from psd_deflection.base.log import INFO, LogCallback

FIRST_WAIT_S = 10.0
LONGEST_WAIT_S = 3600.0
MOST_REASONS = 12
"""Reasons of one kind that are distinguished; further ones are counted together."""
_DETAIL = re.compile(r"""'[^']*'|"[^"]*"|(?<!\w)[-+]?\d[\d.e+-]*""")
"""What may differ between two lines of one reason: numbers, and words that are quoted."""


@dataclass(slots=True)
class _Reason:
    line: str = ''
    level: int = INFO
    since: int = 0
    reported_s: float = 0.0
    next_s: float = 0.0
    wait_s: float = FIRST_WAIT_S

    def quiet(self, now_s: float) -> bool:
        """Whether it did not come for so long that it is new when it comes again."""
        return not self.since and now_s >= self.next_s + self.wait_s


@dataclass(slots=True)
class _Kind:
    reported: int = 0
    reasons: dict[str, _Reason] = field(default_factory=dict)  # Bound: MOST_REASONS.


class RateLimitedLog:
    """``log``: told of the lines. The first line with a reason is said at once; the next one with that reason waits
    ``FIRST_WAIT_S``, the one after it twice as long, and so on up to ``LONGEST_WAIT_S``. A reason that was quiet for
    that long starts anew. Two lines of a kind have one reason if they differ in numbers and quoted words alone.

    Owns no clock: every time comes from the caller, s.
    """

    def __init__(self, log: LogCallback) -> None:
        self._log = log
        self._kinds: BoundedMap[str, _Kind] = BoundedMap()

    def log(self, kind: str, line: str, level: int, now_s: float, at_once: int = 1) -> None:
        """Say ``line`` now, or count it. ``kind``: one of the program's own few names. ``level``: its severity.
        ``at_once``: so many of the kind are said without waiting."""
        known = self._kinds.setdefault(kind, _Kind())
        if all(reason.quiet(now_s) for reason in known.reasons.values()):
            known.reported = 0
        reason = _reason_of(known, line, now_s)
        if reason.quiet(now_s):
            reason.wait_s = FIRST_WAIT_S
        reason.line, reason.level = line, level
        reason.since += 1
        news = known.reported < at_once
        if not news and now_s < reason.next_s:
            return
        known.reported += 1
        more = f' (and {reason.since - 1} more like it)' if reason.since > 1 else ''
        if news:
            # Those that are said at once make none wait longer.
            reason.wait_s = FIRST_WAIT_S
        self._write(reason, line + more, now_s)

    def settle(self, now_s: float) -> None:
        """Say what was counted and is due: it was so, and may not be so any more."""
        for known in self._kinds.values():
            for reason in known.reasons.values():
                if reason.since and now_s >= reason.next_s:
                    ago = f'in the last {now_s - reason.reported_s:.0f} s'
                    self._write(reason, f'{reason.since} more {ago}: {reason.line}', now_s)

    def _write(self, reason: _Reason, line: str, now_s: float) -> None:
        self._log(line, reason.level)
        reason.since, reason.reported_s = 0, now_s
        reason.next_s = now_s + reason.wait_s
        reason.wait_s = min(2.0 * reason.wait_s, LONGEST_WAIT_S)


def _reason_of(known: _Kind, line: str, now_s: float) -> _Reason:
    """The one of ``line``, or of all for which there is no room."""
    name = _DETAIL.sub('', line)
    if name not in known.reasons and len(known.reasons) >= MOST_REASONS:
        known.reasons = {other: reason for other, reason in known.reasons.items() if not reason.quiet(now_s)}
        if len(known.reasons) >= MOST_REASONS:
            name = ''
    return known.reasons.setdefault(name, _Reason())
