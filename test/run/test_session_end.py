"""How a run ends when a part of it hangs: it is waited for, and not for long."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import pytest

from psd_deflection.base.log import texts
from psd_deflection.rig.config import Rig, replace_values
from psd_deflection.run.session import Session
from test.heard import WAIT_S

ALLOWED_S = 2.0


class Hanging:
    """A thread that never ends, and the time for which it was waited for."""

    ident = 1

    def __init__(self) -> None:
        self.waited_s = 0.0

    def is_alive(self) -> bool:
        return True

    def join(self, timeout: float | None = None) -> None:
        assert timeout is not None
        self.waited_s += timeout


@pytest.mark.parametrize(
    ('part', 'told'),
    [
        ('acquisition', 'the source hangs; it is not waited for'),
        ('processing', 'a subscriber holds up the last blocks; they are not waited for'),
        ('recorder', 'the disk is slow; it is not waited for'),
    ],
)
def test_a_part_that_hangs_holds_up_the_end_for_two_seconds_at_most(
    device: Any, rig: Rig, tmp_path: Path, part: str, told: str
) -> None:
    said: list[str] = []
    rig = replace_values(rig, {'bag_dir': str(tmp_path), 'record': True, 'realtime': False, 'keep_zero': False})
    session = Session(rig, texts(said.append))
    session.start()
    owner = cast(Any, getattr(session, part))
    hanging = Hanging()
    if part == 'recorder':
        [(take, thread)] = owner._writing.items()
        owner._writing[take] = hanging
    else:
        thread = owner._thread
        owner._thread = hanging
    session.close()
    assert 0.0 < hanging.waited_s <= ALLOWED_S
    assert any(told in text for text in said)
    # What was said to hang did not: it ends as it would have.
    thread.join(WAIT_S)
    assert not thread.is_alive()
    session.acquisition.source.close()
