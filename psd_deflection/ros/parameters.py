"""The parameters of ``parameters.PARAMETERS`` as ROS parameters, with types, ranges and units.

What is given on the command line, in a launch file or in a parameter file reaches the node as
overrides. They are checked by the same code as everywhere else, so that ``0`` for a length is
refused by name, and a whole number will do for a ``double``.
"""

from __future__ import annotations

from collections.abc import Mapping

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from psd_deflection.config import Rig, rig_from_values
from psd_deflection.errors import ConfigError
from psd_deflection.parameters import BY_NAME, PARAMETERS, Parameter, check_value
from psd_deflection.runner.session import Session

SOURCE = 'ROS parameters'


def rig_of_node(node: Node, extra: Mapping[str, object]) -> Rig:
    """The rig that the node's overrides describe, with ``extra`` on top, and declare it.

    The node was made with ``automatically_declare_parameters_from_overrides``. Raises ConfigError
    for an unknown parameter, a wrong type or a value out of bounds.
    """
    given: dict[str, object] = {}
    for name, parameter in node.get_parameters_by_prefix('').items():
        value = parameter.value
        given[name] = list(value) if not isinstance(value, (str, bool, int, float)) and value is not None else value
    rig = rig_from_values({**given, **extra}, SOURCE)
    for parameter in PARAMETERS:
        if node.has_parameter(parameter.name):
            node.undeclare_parameter(parameter.name)
        node.declare_parameter(parameter.name, rig.values[parameter.name], _descriptor(parameter), ignore_override=True)
    return rig


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    unit = f' [{parameter.unit}]' if parameter.unit else ''
    descriptor = ParameterDescriptor(
        name=parameter.name,
        description=parameter.description + unit,
        additional_constraints=parameter.bound_text()
        or (f'one of {", ".join(parameter.choices)}' if parameter.choices else ''),
        read_only=not parameter.live,
    )
    low = parameter.minimum if parameter.minimum is not None else parameter.above
    if low is not None and parameter.maximum is not None:
        if parameter.kind == 'double':
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=parameter.maximum)]
        elif parameter.kind == 'integer':
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(parameter.maximum), step=1)]
    return descriptor


class LiveParameters:
    """Carries out changes of the parameters that may change while the node runs; refuses the others."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._showing = False
        self.session: Session | None = None
        node.add_on_set_parameters_callback(self._change)

    def show(self, rig: Rig) -> None:
        """Let the node's parameters say what the rig has now: a zero that was taken can be read there."""
        changed = [
            RosParameter(p.name, value=rig.values[p.name])
            for p in PARAMETERS
            if p.live and self._node.get_parameter(p.name).value != rig.values[p.name]
        ]
        self._showing = True
        try:
            self._node.set_parameters(changed)
        finally:
            self._showing = False

    def _change(self, changed: list[RosParameter]) -> SetParametersResult:
        if self._showing:
            return SetParametersResult(successful=True)
        values: dict[str, float | str | tuple[float, ...]] = {}
        for parameter in changed:
            declared = BY_NAME.get(parameter.name)
            if declared is None:
                continue
            value = parameter.value
            if not isinstance(value, (str, bool, int, float)) and value is not None:
                value = list(value)
            try:
                checked = check_value(declared, value, SOURCE)
            except ConfigError as error:
                return SetParametersResult(successful=False, reason=str(error))
            if not declared.live:
                return SetParametersResult(successful=False, reason=f'{parameter.name}: cannot change while it runs')
            if isinstance(checked, list):
                values[parameter.name] = tuple(float(v) for v in checked)
            else:
                values[parameter.name] = checked
        if not values:
            return SetParametersResult(successful=True)
        if self.session is None:
            return SetParametersResult(successful=False, reason='not changed: the node is not configured')
        try:
            # All of them or none, between two blocks.
            self.session.change(values)
        except (TimeoutError, ConfigError) as error:
            return SetParametersResult(successful=False, reason=f'not changed: {error}')
        return SetParametersResult(successful=True)
