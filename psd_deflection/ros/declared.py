# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The settings of a node as its ROS parameters: described, bounded, unknown ones rejected; live ones may be set.

A section of :mod:`psd_deflection.rig.parameters` declares them, once, for the command line, too. A value of
``-p NAME:=VALUE`` or ``--params-file`` has the last word.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from psd_deflection.base.errors import ConfigError
from psd_deflection.base.text import did_you_mean
from psd_deflection.rig.declarations import QOS_OVERRIDES_PREFIX, ROS_OWN
from psd_deflection.rig.parameters import Parameter, Section, Value, check_value

SOURCE = 'ROS parameters'
AT_START = 'read at the start of the process'
USE_SIM_TIME = ROS_OWN[0]
T = TypeVar('T')


def descriptor(parameter: Parameter, bounds: str, constraint: str) -> ParameterDescriptor:
    """What ``ros2 param describe`` shows; ``bounds`` in words, ``constraint``: what else holds."""
    out = ParameterDescriptor(
        name=parameter.name,
        description=parameter.description + (f' [{parameter.unit}]' if parameter.unit else ''),
        additional_constraints='; '.join(filter(None, (bounds, constraint))),
    )
    low = parameter.minimum if parameter.minimum is not None else parameter.above
    if low is not None and parameter.maximum is not None:
        if parameter.kind == 'double':
            out.floating_point_range = [FloatingPointRange(from_value=low, to_value=parameter.maximum)]
        elif parameter.kind == 'integer':
            out.integer_range = [IntegerRange(from_value=int(low), to_value=int(parameter.maximum), step=1)]
    return out


def plain(parameter: RosParameter) -> Any:
    """Its value; a list for an array."""
    value = parameter.value
    return value if value is None or isinstance(value, (str, bool, int, float)) else list(value)


def declare(node: Node, parameter: Parameter, value: Value, shown: ParameterDescriptor) -> None:
    """Declare ``parameter`` of ``node`` at ``value``, which may be an empty list."""
    if value != []:
        node.declare_parameter(parameter.name, value, shown, ignore_override=True)
        return
    # rclpy cannot tell the type of an empty list.
    kind, example = _EMPTY[parameter.kind]
    node.declare_parameter(parameter.name, [example], shown, ignore_override=True)
    node.set_parameters([RosParameter(parameter.name, kind, [])])


_EMPTY = {'double_array': (RosParameter.Type.DOUBLE_ARRAY, 0.0), 'string_array': (RosParameter.Type.STRING_ARRAY, '')}


class UnknownParameterError(ParameterNotDeclaredException):  # type: ignore[misc]
    """Its text is the answer of the service. rclpy's own lists no names, and it takes an empty name for a known one."""

    def __init__(self, name: str, known: Mapping[str, object]) -> None:
        Exception.__init__(self, f'{name!r}: no parameter of that name{did_you_mean(name, known)}')


def meant(node: Node, changed: list[RosParameter], known: Mapping[str, Parameter]) -> list[RosParameter]:
    """``changed`` without synonyms, whose type rclpy would reject: `ros2 param set … degraded off` sends false.

    Raises UnknownParameterError, whose text names the nearest of ``known``.
    """
    out = []
    for parameter in changed:
        if not parameter.name or not node.has_parameter(parameter.name):
            raise UnknownParameterError(parameter.name, known)
        value = known[parameter.name].meant(parameter.value) if parameter.name in known else parameter.value
        out.append(parameter if value is parameter.value else RosParameter(parameter.name, value=value))
    return out


class DeclaredParameters(Generic[T]):
    """The parameters of ``node`` that ``section`` declares, at ``values`` unless ROS was given others.

    ``node``: has what was given to it as parameters. ``changed``: gets the settings when a live one was set; it may
    raise ConfigError to reject them. ``more``: further parameters, at their defaults; ``values`` has all of them.
    Raises ConfigError for an unknown parameter, a wrong type or a value out of bounds, or if values contradict.
    """

    def __init__(
        self,
        node: Node,
        section: Section[T],
        values: Mapping[str, Value],
        changed: Callable[[T], None] = lambda _: None,
        more: Sequence[Parameter] = (),
    ) -> None:
        self._section, self._changed = section, changed
        self._declared = {p.name: p for p in (*section.parameters.values(), *more)}
        given = reject_unknown(node, self._declared)
        checked = {name: check_value(self._declared[name], value, SOURCE) for name, value in given.items()}
        self.values: dict[str, Value] = {**{p.name: p.default for p in more}, **values, **checked}
        self.settings = section.of(self.values)
        for name, parameter in self._declared.items():
            if name in given:
                node.undeclare_parameter(name)
            shown = descriptor(parameter, parameter.bound_text(), '' if parameter.live else AT_START)
            declare(node, parameter, self.values[name], shown)
        node.add_pre_set_parameters_callback(lambda changed: meant(node, changed, self._declared))
        node.add_on_set_parameters_callback(self._set)

    def _set(self, changed: list[RosParameter]) -> SetParametersResult:
        try:
            self._take({p.name: plain(p) for p in changed if not _is_ros_own(p.name)})
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _take(self, values: Mapping[str, object]) -> None:
        """Set all of ``values`` or none."""
        new = dict(self.values)
        for name, value in values.items():
            new[name] = check_value(self._declared[name], value, SOURCE)
            if new[name] != self.values[name] and not self._declared[name].live:
                raise ConfigError(f'{name}: is {AT_START}')
        settings = self._section.of(new)
        if new != self.values:
            self._changed(settings)
            self.values, self.settings = new, settings


def reject_unknown(node: Node, known: Mapping[str, Parameter]) -> dict[str, Any]:
    """What ``node`` was given, by name. Raises ConfigError if a parameter is not ``known``."""
    given = {name: plain(p) for name, p in node.get_parameters_by_prefix('').items() if not _is_ros_own(name)}
    for name, value in given.items():
        if name not in known:
            there = did_you_mean(name, known)
            raise ConfigError(f'{SOURCE}: {name} = {value!r}: no parameter of that name{there}')
    return given


def given_of(node: Node, section: Section[T], values: Mapping[str, Value]) -> T:
    """The settings of ``section`` before they are declared: ``values``, and what ROS was given.

    Raises ConfigError for a value that is not valid.
    """
    known = {p.name: p for p in section.parameters.values()}
    given = {name: plain(p) for name, p in node.get_parameters_by_prefix('').items() if name in known}
    return section.of({**values, **{name: check_value(known[name], value, SOURCE) for name, value in given.items()}})


def _is_ros_own(name: str) -> bool:
    return name in ROS_OWN or name.startswith(QOS_OVERRIDES_PREFIX)
