# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The solver names of ``solver:`` and ``solvers:``. To add a method, write a
:class:`~psd_deflection.model.solvers.interface.Solver` and add a line here; it is imported when it is used."""

import importlib
from types import MappingProxyType
from typing import Any, NamedTuple

from psd_deflection.base.errors import ConfigError, SolverError
from psd_deflection.base.text import did_you_mean
from psd_deflection.model.plate.layout import Geometry
from psd_deflection.model.solvers.interface import Solver
from psd_deflection.rig.config import BASE_SOLVER, Rig
from psd_deflection.rig.declarations import BY_NAME


class Entry(NamedTuple):
    """``path``: ``module:class``. ``instead``: for a comparison-only method, the method to use in a live run."""

    path: str
    instead: str = ''


SOLVERS: MappingProxyType[str, Entry] = MappingProxyType(
    {
        'exact': Entry('psd_deflection.model.solvers.exact:ExactSolver'),
        'wls': Entry('psd_deflection.model.solvers.wls:WlsSolver'),
        'iterative': Entry('psd_deflection.model.solvers.iterative:IterativeSolver'),
        'beam': Entry('psd_deflection.model.solvers.beam:BeamSolver'),
        'wls_exact': Entry('psd_deflection.model.solvers.wls_exact:WlsExactSolver'),
        'ols': Entry('psd_deflection.model.solvers.ols:OlsSolver'),
        'minimum_tilt': Entry('psd_deflection.model.solvers.minimum_tilt:MinimumTiltSolver'),
        'pose': Entry('psd_deflection.model.solvers.pose:PoseSolver'),
        'base_pair': Entry('psd_deflection.model.solvers.base_pair:BasePairSolver'),
        'iterative_printed': Entry('psd_deflection.studies.thesis.appendix_d:IterativePrintedSolver', 'iterative'),
        'appendix_d': Entry('psd_deflection.studies.thesis.appendix_d:AppendixDSolver', 'iterative'),
        'appendix_d_ols': Entry('psd_deflection.studies.thesis.appendix_d:AppendixDOlsSolver', 'ols'),
        'appendix_d_wls': Entry('psd_deflection.studies.thesis.appendix_d:AppendixDWlsSolver', 'wls'),
    }
)
"""The default first."""


def solver_class(name: str) -> type[Solver]:
    """The class of the method ``name``. Raises ConfigError for an unknown name."""
    entry = SOLVERS.get(name)
    if entry is None:
        raise ConfigError(f'solver = {name!r}: must be one of {", ".join(SOLVERS)}{did_you_mean(name, SOLVERS)}')
    module, _, attribute = entry.path.partition(':')
    solver_type: type[Solver] = getattr(importlib.import_module(module), attribute)
    return solver_type


def make_solver(name: str, geometry: Geometry, **options: Any) -> Solver:
    """The method ``name`` bound to ``geometry``; ``options`` as its class documents them.

    Raises ConfigError for an unknown name, SolverError if the method cannot solve the geometry.
    """
    return solver_class(name)(geometry, **options)


def solver_from_rig(name: str, rig: Rig) -> Solver:
    """The method ``name`` for this rig, with the options that the rig file has for it.

    Raises ConfigError for an unknown name, SolverError if the method cannot solve the rig.
    """
    at, takes = rig.estimator.arrangement, solver_class(name).psds_at
    if at not in ('auto', takes):
        raise SolverError(f'{name} takes PSDs at the {takes}; the rig file has arrangement: {at}')
    return make_solver(name, Geometry.from_rig(rig), **solver_class(name).options_from_rig(rig))


def check_arrangement(rig: Rig) -> None:
    """Raise ConfigError if solvers or heights of the rig contradict where its PSDs are."""
    config = rig.estimator
    at = 'base' if rig.psds_at_base else 'tip'
    misplaced = [name for name in (config.solver, *config.solvers) if solver_class(name).psds_at != at]
    if config.solver in misplaced:
        name = BASE_SOLVER if rig.psds_at_base else BY_NAME['solver'].default
        raise ConfigError(
            f'arrangement = {config.arrangement!r}: solver = {config.solver!r} takes PSDs at the '
            f'{solver_class(config.solver).psds_at}: set solver: {name} and solvers: [{name}]'
        )
    if misplaced:
        raise ConfigError(
            f'solver = {config.solver!r} has the PSDs at the {at}; {", ".join(misplaced)} of solvers have not: '
            f'set solvers: [{config.solver}]'
        )
    if at == 'base' and config.degraded != 'none':
        raise ConfigError(f'degraded = {config.degraded!r}: one PSD at the base gives no pose; set degraded: none')
    for i, psd in enumerate(rig.psds, start=1):
        if at == 'tip' and psd.height < -0.5 * rig.link.length:
            raise ConfigError(
                f'psd_{i}.height = {psd.height:g} m: that is nearer to the base than to the tip; PSDs at the base, '
                'with the lasers on the tip plate, need arrangement: base, solver: base_pair and solvers: [base_pair]'
            )


def check_live(name: str) -> None:
    """Raise ConfigError if ``name`` is for comparison only: its answer must not be ``/link_tip/deflection``.

    Replay and ``thesis compare-methods`` take it, and so does a live run's list ``solvers``, on a topic of its own.
    """
    entry = SOLVERS.get(name)
    if entry is not None and entry.instead:
        raise ConfigError(
            f'solver = {name!r}: a method as printed, for comparison only: for a live run take {entry.instead!r}, '
            f'its corrected form (`solvers` may list {name!r} beside it, and replay takes it)'
        )
