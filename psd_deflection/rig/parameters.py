# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a parameter is (name, type, default, unit, bounds, a sentence), how it is declared, how a value is checked.

A field of a section declares one, once::

    @dataclass(frozen=True, slots=True)
    class LinkConfig:
        length: float = parameter(0.585, 'm', 'length L of the link', above=0.0, maximum=1000.0)

    LINK = Section(LinkConfig, 'link.')

The parameter files, the command line, the node and the documentation read what the sections of
:mod:`psd_deflection.rig.declarations` declare. :func:`check_value` is the one place that validates a value.
"""

import math
import reprlib
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any, Generic, Literal, TypedDict, TypeVar, Unpack, cast

import numpy as np

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.text import did_you_mean, plain_number

Kind = Literal['double', 'integer', 'bool', 'string', 'double_array', 'string_array']
Value = float | int | bool | str | list[float] | list[str]
T = TypeVar('T')

_SHORT = reprlib.Repr()
_SHORT.maxlevel = 1
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = 20
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = 200

_KINDS: Mapping[object, Kind] = {float: 'double', int: 'integer', bool: 'bool', str: 'string'}


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter. ``minimum`` and ``maximum`` apply to each element of an array.

    ``above``: an exclusive lower bound. ``synonyms``: other words, each with the one of ``choices`` that it means.
    ``live``: the parameter may be changed while the node runs.
    """

    name: str
    kind: Kind
    default: Any
    unit: str
    description: str
    minimum: float | None = None
    maximum: float | None = None
    above: float | None = None
    length: int | None = None
    choices: tuple[str, ...] | None = None
    synonyms: tuple[tuple[str | bool, str], ...] = ()
    live: bool = False

    def bound_text(self) -> str:
        """The bounds or the choices in words, for an error message or ``--help``; '' if there are none."""
        if self.choices is not None:
            return f'one of {", ".join(self.choices)}'
        words = (('above', self.above), ('at least', self.minimum), ('at most', self.maximum))
        # Whole numbers in full: 1000000 bytes, not 1e+06.
        form = '.0f' if self.kind == 'integer' else 'g'
        return ' and '.join(f'{word} {bound:{form}}' for word, bound in words if bound is not None)

    def meant(self, value: object) -> object:
        """The one of ``choices`` of which ``value`` is a synonym, else ``value``."""
        # By type as well: 0 equals False.
        return next((word for other, word in self.synonyms if type(other) is type(value) and other == value), value)

    def with_value(self, value: object) -> str:
        """``NAME = VALUE UNIT``, for a message."""
        return f'{self.name} = {shown(value)}' + (f' {self.unit}' if self.unit else '')


class Allowed(TypedDict, total=False):
    """The values that a parameter may have; :class:`Parameter` explains them."""

    minimum: float | None
    maximum: float | None
    above: float | None
    choices: tuple[str, ...] | None
    synonyms: tuple[tuple[str | bool, str], ...]


def parameter(
    default: T, unit: str, description: str, *, name: str = '', live: bool = False, **allowed: Unpack[Allowed]
) -> T:
    """Declare a parameter as a field of a dataclass; the field's type is its type.

    ``name``: its name in a parameter file, below the section's prefix, if it differs from the
    field's name. :class:`Parameter` explains the rest.
    """
    declared = {'unit': unit, 'description': description, 'name': name, 'live': live}
    anything = Allowed(minimum=None, maximum=None, above=None, choices=None, synonyms=())
    declaration: T = field(default=default, metadata={**declared, **anything, **allowed})
    return declaration


class Section(Generic[T]):
    """The parameters that the fields of the dataclass ``kind`` declare, below ``prefix`` (``link.``).

    ``parameters``: by field. ``defaults``: by field, if they are not those of ``kind``.
    """

    def __init__(self, kind: type[T], prefix: str = '', **defaults: object) -> None:
        self._kind = kind
        self.prefix = prefix
        types = typing.get_type_hints(kind)
        self.parameters: Mapping[str, Parameter] = MappingProxyType(
            {
                f.name: _declared(prefix, f.name, types[f.name], defaults.get(f.name, f.default), f.metadata)
                for f in fields(cast(Any, kind))
            }
        )

    def of(self, values: Mapping[str, Value]) -> T:
        """The section with these flat, checked values (``link.length``); lists become tuples."""
        by_field = {name: values[p.name] for name, p in self.parameters.items()}
        return self._kind(**{name: tuple(v) if isinstance(v, list) else v for name, v in by_field.items()})

    def read(self, given: Mapping[str, object], source: str) -> T:
        """The section with what is ``given``, flat and unchecked, and its defaults.

        Raises ConfigError naming ``source``: an unknown name, a value that is not valid, or values that contradict.
        """
        known = {p.name: p for p in self.parameters.values()}
        values: dict[str, Value] = {name: p.default for name, p in known.items()}
        for name, value in given.items():
            if name not in known:
                raise ConfigError(
                    f'{source}: {name} = {shown(value)}: no parameter of that name{did_you_mean(name, known)}'
                )
            values[name] = check_value(known[name], value, source)
        try:
            return self.of(values)
        except ConfigError as error:
            raise ConfigError(f'{source}: {error}') from None

    def values(self, settings: T) -> dict[str, Value]:
        """The flat values that :meth:`of` makes ``settings`` of."""
        flat = {p.name: getattr(settings, name) for name, p in self.parameters.items()}
        return {name: list(v) if isinstance(v, tuple) else v for name, v in flat.items()}


def _declared(prefix: str, field_name: str, kind: object, default: object, metadata: Mapping[str, Any]) -> Parameter:
    more = dict(metadata)
    name = prefix + (more.pop('name') or field_name)
    if typing.get_origin(kind) is not tuple:
        return Parameter(name, _KINDS[kind], default, **more)
    element, *rest = typing.get_args(kind)
    array: Kind = 'double_array' if element is float else 'string_array'
    length = None if rest == [...] else 1 + len(rest)
    return Parameter(name, array, list(cast(Sequence[object], default)), length=length, **more)


def shown(value: object) -> str:
    """``value`` for a message: as the user types it, cut short if it is very long."""
    try:
        return _SHORT.repr(value)
    except ValueError:
        # Python does not print integers of thousands of digits.
        return 'a number of too many digits'


def check_value(parameter: Parameter, value: object, source: str) -> Value:
    """Return ``value`` converted to the parameter's type.

    Raises ConfigError naming ``source``, key, value and bound if the value is not valid.
    """
    try:
        return _CHECKS[parameter.kind](parameter, value)
    except _RejectedError as why:
        raise ConfigError(f'{source}: {parameter.with_value(value)}: {why}') from None


class _RejectedError(Exception):
    """A value is not valid; the text says what it must be."""


def _number(parameter: Parameter, value: object) -> float:
    if isinstance(value, str):
        # YAML 1.1 reads 69e9 as a string. ROS reads it as a number, so this does too.
        try:
            value = plain_number(value)
        except ValueError:
            raise _RejectedError('must be a number') from None
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise _RejectedError('must be a number')
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise _RejectedError('must be finite')
    p = parameter
    above_ok = p.above is None or number > p.above
    if not (above_ok and (p.minimum is None or number >= p.minimum) and (p.maximum is None or number <= p.maximum)):
        raise _RejectedError(f'must be {p.bound_text()}')
    return number


def _integer(parameter: Parameter, value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise _RejectedError('must be a whole number')
    return int(_number(parameter, value))


def _bool(parameter: Parameter, value: object) -> bool:
    if not isinstance(value, bool):
        raise _RejectedError('must be true or false')
    return value


def _string(parameter: Parameter, value: object) -> str:
    value = parameter.meant(value)
    if not isinstance(value, str):
        raise _RejectedError('must be text')
    if not value.isprintable():
        raise _RejectedError('must be text that can be printed')
    if parameter.choices is not None and value not in parameter.choices:
        raise _RejectedError(f'must be {parameter.bound_text()}')
    return value


def _items(parameter: Parameter, value: object) -> list[object]:
    if isinstance(value, str) or not isinstance(value, Sequence | np.ndarray):
        raise _RejectedError('must be a list')
    items = list(value)
    if parameter.length is not None and len(items) != parameter.length:
        raise _RejectedError(f'must have {parameter.length} elements, has {len(items)}')
    return items


def _numbers(parameter: Parameter, value: object) -> list[float]:
    return [_number(parameter, item) for item in _items(parameter, value)]


def _strings(parameter: Parameter, value: object) -> list[str]:
    items = _items(parameter, value)
    names = [item for item in map(parameter.meant, items) if isinstance(item, str)]
    if not names or len(names) != len(items):
        raise _RejectedError('must be a list of names')
    if parameter.choices is not None and not set(names) <= set(parameter.choices):
        raise _RejectedError(f'each must be {parameter.bound_text()}')
    return names


_CHECKS: Mapping[Kind, Callable[[Parameter, object], Value]] = {
    'double': _number,
    'integer': _integer,
    'bool': _bool,
    'string': _string,
    'double_array': _numbers,
    'string_array': _strings,
}
