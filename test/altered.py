# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A named tuple with other values, as ``dataclasses.replace`` and Python 3.13's ``copy.replace`` have it."""

from typing import Any, TypeVar

Record = TypeVar('Record', bound=tuple[Any, ...])


def altered(record: Record, **values: object) -> Record:
    changed: Record = record._replace(**values)  # type: ignore[attr-defined]
    return changed
