"""The rig's parameters as ROS parameters, with types, ranges and units.

Values from the command line, a launch file or a parameter file reach the node as overrides.
:func:`rig_from_values` validates them as everywhere else: ``0`` for a length is refused by name, and a
whole number is accepted for a ``double``. The pipeline validates a change while the node runs, because it
knows which values depend on each other. The descriptors come from the declarations; with them rclpy
refuses read-only parameters, wrong types and values out of range.
"""

from __future__ import annotations

from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from psd_deflection.config import BY_NAME, PARAMETERS, Rig, rig_from_values
from psd_deflection.errors import ConfigError
from psd_deflection.parameters import Parameter
from psd_deflection.runner.session import Session

SOURCE = 'ROS parameters'


def rig_of_node(node: Node) -> Rig:
    """The rig that the node's overrides describe; its parameters are declared.

    The node was made with ``automatically_declare_parameters_from_overrides``. Raises ConfigError
    for an unknown parameter, a wrong type or a value out of bounds.
    """
    given = {name: _plain(parameter) for name, parameter in node.get_parameters_by_prefix('').items()}
    rig = rig_from_values(given, SOURCE)
    for parameter in PARAMETERS:
        # rclpy tells of overrides that nobody declares (a mistyped name) only by declaring them, and then without
        # descriptor and with the type as it was typed.
        if parameter.name in given:
            node.undeclare_parameter(parameter.name)
        node.declare_parameter(parameter.name, rig.values[parameter.name], _descriptor(parameter), ignore_override=True)
    return rig


def _plain(parameter: RosParameter) -> Any:
    value = parameter.value
    return value if value is None or isinstance(value, (str, bool, int, float)) else list(value)


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        name=parameter.name,
        description=parameter.description + (f' [{parameter.unit}]' if parameter.unit else ''),
        additional_constraints=parameter.bound_text(),
        read_only=not parameter.live,
    )
    low = parameter.minimum if parameter.minimum is not None else parameter.above
    if low is not None and parameter.maximum is not None:
        if parameter.kind == 'double':
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=parameter.maximum)]
        elif parameter.kind == 'integer':
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(parameter.maximum), step=1)]
    return descriptor


def _without_synonyms(changed: list[RosParameter]) -> list[RosParameter]:
    out = []
    for parameter in changed:
        meant = BY_NAME[parameter.name].meant(parameter.value) if parameter.name in BY_NAME else parameter.value
        out.append(parameter if meant is parameter.value else RosParameter(parameter.name, value=meant))
    return out


class LiveParameters:
    """Carries out changes of the parameters that may change while the node runs; refuses the others."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._showing = False
        self.session: Session | None = None
        # Before rclpy refuses the type of a synonym: `ros2 param set … degraded off` sends false.
        node.add_pre_set_parameters_callback(_without_synonyms)
        node.add_on_set_parameters_callback(self._change)

    def show(self, rig: Rig) -> None:
        """Set the node's parameters to the present values of the rig, so that a new zero can be read there."""
        changed = [
            RosParameter(p.name, value=rig.values[p.name])
            for p in PARAMETERS
            if p.live and _plain(self._node.get_parameter(p.name)) != rig.values[p.name]
        ]
        self._showing = True
        try:
            self._node.set_parameters(changed)
        finally:
            self._showing = False

    def _change(self, changed: list[RosParameter]) -> SetParametersResult:
        if self._showing:
            return SetParametersResult(successful=True)
        values: dict[str, Any] = {}
        for parameter in changed:
            if parameter.name in BY_NAME:
                value = _plain(parameter)
                values[parameter.name] = tuple(value) if isinstance(value, list) else value
        if not values:
            return SetParametersResult(successful=True)
        if self.session is None:
            return SetParametersResult(successful=False, reason='not changed: the node is not configured')
        try:
            # All of them or none, between two blocks.
            self.session.change(values)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        except TimeoutError as error:
            return SetParametersResult(successful=False, reason=f'not changed: {error}')
        return SetParametersResult(successful=True)
