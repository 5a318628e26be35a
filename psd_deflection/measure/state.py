# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""State of the pipeline's parts from block to block, as numbers by name: recorded, so that a replay goes on with the
same bits."""

from collections.abc import Iterable, Mapping
from typing import Protocol

Value = float | str | tuple[float, ...]
State = dict[str, Value]
"""Values by name. Names of parameters and of :data:`psd_deflection.records.ENVIRONMENT` apart, all begin with
:data:`STATE`."""

STATE = 'state.'
FULL = 'state.whole'
"""In a change that is the complete state of a pipeline: another one forgets its own first."""


class Part(Protocol):
    """A part with a state."""

    @property
    def part(self) -> str:
        """Its name, for messages."""

    @property
    def prefixes(self) -> tuple[str, ...]:
        """How the names of its values begin."""

    def state_dict(self) -> State:
        """Return what the next block depends on; {} if that is nothing."""

    def load_state_dict(self, values: Mapping[str, Value]) -> None:
        """Go on from the :meth:`state_dict` of another one. Raises ValueError for a value that does not fit."""


def numbers(values: Mapping[str, Value], name: str, wanted: str, *counts: int) -> tuple[float, ...] | None:
    """Return the row of numbers ``name``, None if ``values`` has none.

    Raises ValueError if it has none of these ``counts`` (any, if none is given); ``wanted``: what it should be.
    """
    value = values.get(name)
    if value is None:
        return None
    row = value if isinstance(value, tuple) else ()
    if not row or (counts and len(row) not in counts):
        raise mismatch(name, value, f'{wanted}, {" or ".join(map(str, counts))} numbers' if counts else wanted)
    return row


def mismatch(name: str, value: Value, wanted: str) -> ValueError:
    """Return the error for a value that does not fit."""
    text = f'{len(value)} numbers' if isinstance(value, tuple) else repr(value)
    return ValueError(f'{name}: {text}; expected {wanted}')


def load_states(parts: Iterable[Part], values: Mapping[str, Value]) -> list[str]:
    """Load each part's ``values``; return a line for each that does not fit and is ignored."""
    rest = dict(values)
    lines = []
    for part in parts:
        part_values = {name: rest.pop(name) for name in values if name in rest and name.startswith(part.prefixes)}
        try:
            if part_values:
                part.load_state_dict(part_values)
        except ValueError as error:
            lines.append(f'{part.part} does not go on from what was recorded: {error}')
    return [*lines, *(f'{name}: no part of this rig remembers such a value; it is left out' for name in rest)]
