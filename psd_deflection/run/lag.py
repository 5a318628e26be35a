# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Why a thread does not keep up: this machine is too slow for it, or something holds it up; nothing is guessed."""

from __future__ import annotations

import sys
import threading
from pathlib import Path

HELD_S = 1.0
"""A thread that has made no step for so long is held up, unless it waits for a processor."""

SLOW = 'this machine is too slow'
_PACKAGE = 'psd_deflection.'
_STATES = {'D': 'waits for the disk', 'T': 'is stopped'}


def lag_reason(thread: threading.Thread, still_s: float) -> str:
    """Why ``thread`` is behind, in words. ``still_s``: how long it has made no step, s."""
    state = _state_of(thread)
    if still_s < HELD_S or state == 'R':
        return SLOW
    place = _place_of(thread)
    return f'{thread.name} {_STATES.get(state, "is held up")}' + (f' in {place}' if place else '')


def _state_of(thread: threading.Thread) -> str:
    """What the kernel says of it: R runs, or waits for a processor; '' if it does not say."""
    try:
        text = Path(f'/proc/self/task/{thread.native_id}/stat').read_text()
    except OSError:
        return ''
    return text.rpartition(')')[2].split()[0]


def _place_of(thread: threading.Thread) -> str:
    """The innermost function of ours that it is in."""
    frame = sys._current_frames().get(thread.ident or 0)  # noqa: SLF001
    while frame is not None:
        module = str(frame.f_globals.get('__name__', ''))
        if module.startswith(_PACKAGE):
            return f'{module.removeprefix(_PACKAGE)}.{frame.f_code.co_name}'
        frame = frame.f_back
    return ''
