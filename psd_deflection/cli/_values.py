# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Values of options: a mistake ends with status 2. Light, for the commands that only speak to a daemon."""

import contextlib
import functools
import math
import re
from collections.abc import Callable, Iterator
from typing import TypeVar

from psd_deflection.base.errors import ConfigError, UsageError
from psd_deflection.base.text import plain_number

N = TypeVar('N', int, float)


def seed(text: str) -> int:
    """A value of --seed; raises UsageError."""
    return integer('--seed', 0)(text)


def integer(option: str, least: int, most: int | None = None) -> Callable[[str], int]:
    """Reads a whole number within bounds; what it gives raises UsageError."""
    bounds = f'at least {least}' + ('' if most is None else f' and at most {most}')
    return functools.partial(
        _within, option, int, f'a whole number of {bounds}', least, math.inf if most is None else most
    )


def plain(name: str) -> Callable[[str], float]:
    """Reads a number as it is written in files; what it gives raises UsageError."""

    def read(text: str) -> float:
        try:
            return plain_number(text)
        except ValueError:
            comma = '; its decimals have a point' if ',' in text else ''
            raise UsageError(f'{name} {text}: must be a number{comma}') from None

    return read


def number(option: str, least: float, most: float) -> Callable[[str], float]:
    """Reads a number within bounds; what it gives raises UsageError."""
    return functools.partial(
        _within, option, float, f'a number of at least {least:g} and at most {most:g}', least, most
    )


def _within(option: str, kind: Callable[[str], N], words: str, least: float, most: float, text: str) -> N:
    with contextlib.suppress(ValueError):
        value = kind(text)
        # NaN fails every comparison.
        if least <= value <= most:
            return value
    raise UsageError(f'{option} {text}: must be {words}')


@contextlib.contextmanager
def given_as_option(*parameters: str) -> Iterator[None]:
    """Turn a rejected value inside into a UsageError: it came as an option (status 2), not from a file (3).

    ``parameters``: those with their own option; in the message ``keep_out = ...`` becomes ``--keep-out = ...``.
    """
    try:
        yield
    except ConfigError as error:
        text = str(error)
        for name in parameters:
            text = re.sub(rf'\b{name}(?= = )', f'--{name.replace("_", "-")}', text)
        raise UsageError(text) from None


def need_finite(option: str, values: tuple[float, ...]) -> None:
    """Raise UsageError unless all are finite."""
    if not all(map(math.isfinite, values)):
        raise UsageError(f'{option} {" ".join(f"{v:g}" for v in values)}: must be finite')
