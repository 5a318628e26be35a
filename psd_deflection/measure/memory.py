# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the parts of the pipeline remember from block to block, as numbers by name.

A part says what the next block depends on besides its samples (:meth:`Part.memory`, which changes nothing), and goes
on from another one's (:meth:`Part.restore`). The values are recorded; from there a replay gives the same bits.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Protocol

Value = float | str | tuple[float, ...]
Memory = dict[str, Value]
"""Values by name. Names of parameters and of :data:`psd_deflection.records.ENVIRONMENT` apart, all begin with
:data:`STATE`."""

STATE = 'state.'
WHOLE = 'state.whole'
"""In a change that is everything that a pipeline remembers: what another one remembers is forgotten first."""


class Part(Protocol):
    """A part with a state."""

    @property
    def part(self) -> str:
        """What it is, for messages."""

    @property
    def remembers(self) -> tuple[str, ...]:
        """How the names of its values begin."""

    def memory(self) -> Memory:
        """What the next block depends on; {} if that is nothing. It changes nothing."""

    def restore(self, values: Mapping[str, Value]) -> None:
        """Go on from :meth:`memory` of another one. Raises ValueError for a value that does not fit."""


def numbers(values: Mapping[str, Value], name: str, wanted: str, *counts: int) -> tuple[float, ...] | None:
    """The row of numbers ``name``, None if it is not in ``values``.

    Raises ValueError if it has none of these ``counts`` (any, if there are none given); ``wanted``: what it should be.
    """
    value = values.get(name)
    if value is None:
        return None
    row = value if isinstance(value, tuple) else ()
    if not row or (counts and len(row) not in counts):
        raise misfit(name, value, f'{wanted}, {" or ".join(map(str, counts))} numbers' if counts else wanted)
    return row


def misfit(name: str, value: Value, wanted: str) -> ValueError:
    """The error for a value that does not fit."""
    found = f'{len(value)} numbers' if isinstance(value, tuple) else repr(value)
    return ValueError(f'{name}: {found}; expected {wanted}')


def restore(parts: Iterable[Part], values: Mapping[str, Value]) -> list[str]:
    """Give each part its ``values``; return a line for each that does not fit and is left out."""
    rest = dict(values)
    lines = []
    for part in parts:
        own = {name: rest.pop(name) for name in values if name in rest and name.startswith(part.remembers)}
        try:
            if own:
                part.restore(own)
        except ValueError as error:
            lines.append(f'{part.part} does not go on from what was recorded: {error}')
    return [*lines, *(f'{name}: no part of this rig remembers such a value; it is left out' for name in rest)]
