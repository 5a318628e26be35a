# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The rig's parameters as ROS parameters, with types, ranges and units.

Values from the command line, a launch file or a parameter file reach the node as overrides.
:func:`rig_from_values` validates them as everywhere else: ``0`` for a length is rejected by name,
and a whole number is accepted for a ``double``. The descriptors come from the declarations; with
them rclpy rejects wrong types and values out of range.

While the node is unconfigured every parameter may be set; configuring reads them. While it is
configured only the live ones may; the pipeline validates these, because it knows which values
depend on each other. What was set stays when the node is cleaned up.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from psd_deflection.base.errors import ConfigError
from psd_deflection.devices.registry import source_names
from psd_deflection.model.solvers.registry import SOLVERS, check_live, solver_class
from psd_deflection.rig.config import Rig, replace_values, rig_from_values
from psd_deflection.rig.declarations import BY_NAME, QOS_OVERRIDES_PREFIX, ROS_OWN, SIMULATED
from psd_deflection.rig.parameters import Parameter, Value
from psd_deflection.ros.declared import AT_START, SOURCE, descriptor, meant, plain
from psd_deflection.run.session import Session

_READ = 'read when the node is configured'
# Who may set parameters over ROS shall not run programs as the daemon's user, nor send what it sees elsewhere.
_AT_START = {'autostart': AT_START, 'watch_command': AT_START, 'watch_webhook': AT_START}

_SIMULATED = ParameterDescriptor(
    name=SIMULATED,
    description='whether the samples are those of the simulated rig that the node started, because no port is given',
    additional_constraints='set by the node',
)


def rig_of_node(node: Node) -> tuple[Rig, set[str]]:
    """The rig that the node's overrides describe, and their names; its parameters are declared.

    The node was made with ``automatically_declare_parameters_from_overrides``. Raises ConfigError
    for an unknown parameter, a wrong type or a value out of bounds.
    """
    given = {name: plain(parameter) for name, parameter in node.get_parameters_by_prefix('').items()}
    rig = rig_from_values(given, SOURCE)
    shown = _ros_values(rig)
    values = {p.name: (shown[p.name], _descriptor(p)) for p in rig.parameters}
    for name, (value, shown_as) in {**values, SIMULATED: (False, _SIMULATED)}.items():
        # rclpy tells of overrides that nobody declares (a mistyped name) only by declaring them,
        # and then without descriptor and with the type as it was typed.
        if name in given:
            node.undeclare_parameter(name)
        node.declare_parameter(name, value, shown_as, ignore_override=True)
    return rig, set(given)


def _ros_values(rig: Rig) -> dict[str, Any]:
    """The values by name. Signs are written out, because rcl does not read the bare y that `ros2 param dump` writes."""
    signed = {
        f'psd_{n}.axes': [a if a.startswith('-') else f'+{a}' for a in psd.axes]
        for n, psd in enumerate(rig.psds, start=1)
    }
    return {**rig.values, **signed}


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    return descriptor(parameter, _bound_text(parameter), '' if parameter.live else _AT_START.get(parameter.name, _READ))


def _bound_text(parameter: Parameter) -> str:
    """Bounds or choices in words; also those that other rooms' registries add to the declaration."""
    if parameter.name == 'source':
        return f'one of {", ".join(source_names())}'
    if parameter.name == 'solver':
        return f'one of {", ".join(name for name, entry in SOLVERS.items() if not entry.instead)}'
    if parameter.name == 'solvers':
        return f'each one of {", ".join(SOLVERS)}'
    return parameter.bound_text()


def _check_solvers(rig: Rig) -> None:
    check_live(rig.estimator.solver)
    for name in rig.estimator.solvers:
        solver_class(name)


class LiveParameters:
    """Carries out changes of the node's parameters, or rejects them.

    ``settings``: the rig, as the parameters describe it. ``given``: names of those that the user
    has set. ``session``: the one that runs while the node is configured, or None.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._showing = False
        self.settings, self.given = rig_of_node(node)
        self._zeros = self.settings.zeros_by_name
        self.session: Session | None = None
        node.add_pre_set_parameters_callback(lambda changed: meant(node, changed, BY_NAME))
        node.add_on_set_parameters_callback(self._change)

    @property
    def values(self) -> Mapping[str, Value]:
        """By name."""
        return self.settings.values

    @property
    def unzeroed(self) -> Rig:
        """The rig with the zero that it was given, without one that was taken while the node ran."""
        return replace_values(self.settings, self._zeros, SOURCE)

    def show(self) -> None:
        """Set the node's parameters to the present values of the rig, so that a new zero can be read there."""
        session = self.session
        if session is not None:
            live = {p.name: session.rig.values[p.name] for p in session.rig.parameters if p.live}
            self.settings = replace_values(self.settings, live, SOURCE)
        simulated = session is not None and session.simulated
        changed = [
            RosParameter(name, value=value)
            for name, value in {**_ros_values(self.settings), SIMULATED: simulated}.items()
            if plain(self._node.get_parameter(name)) != value
        ]
        self._showing = True
        try:
            self._node.set_parameters(changed)
        finally:
            self._showing = False

    def _change(self, changed: list[RosParameter]) -> SetParametersResult:
        if self._showing:
            return SetParametersResult(successful=True)
        values = {p.name: plain(p) for p in changed if p.name not in ROS_OWN}
        values = {n: v for n, v in values.items() if not n.startswith(QOS_OVERRIDES_PREFIX)}
        try:
            self._take(values)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        except TimeoutError as error:
            return SetParametersResult(successful=False, reason=f'not changed: {error}')
        return SetParametersResult(successful=True)

    def _take(self, values: dict[str, Any]) -> None:
        """Set all of ``values`` or none. Raises ConfigError or, if no data flows, TimeoutError."""
        # A file that `ros2 param dump` wrote names every parameter; only those that differ are
        # changes.
        new = {n: v for n, v in values.items() if v != plain(self._node.get_parameter(n))}
        for name in new:
            if name == SIMULATED:
                raise ConfigError(f'{name}: is set by the node')
            if name in _AT_START:
                raise ConfigError(f'{name}: is {_AT_START[name]}')
        if not new:
            return
        if self.session is None:
            rig = replace_values(self.settings, new, SOURCE)
            _check_solvers(rig)
            self.settings = rig
            self.given |= set(new)
            self._zeros |= {name: rig.values[name] for name in rig.zeros_by_name if name in new}
            return
        fixed = [name for name in new if name not in BY_NAME or not BY_NAME[name].live]
        if fixed:
            node = self._node.get_fully_qualified_name()
            raise ConfigError(
                f'{", ".join(fixed)}: is {_READ}; first ros2 lifecycle set {node} deactivate, then cleanup'
            )
        # All of them or none, between two blocks.
        self.session.change({n: tuple(v) if isinstance(v, list) else v for n, v in new.items()})
