# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tip deflection and twist of a flexible link from two position sensing detectors.

    import psd_deflection as pd

    rig = pd.load_rig('my_rig.yaml')                     # what is known of the rig; no file: the thesis rig
    recording = pd.open('recordings/run')                # a bag folder, an .mcap or a .csv
    recording.samples                                    # numpy, one row a sample, V
    recording.to_pandas()                                # the same as a DataFrame; .to_xarray() as a Dataset
    recording.crop(2.0, 5.0).plot()                      # a part of it as a matplotlib figure
    estimates = pd.replay(recording)                     # the deflections, as the daemon computes them
    estimates.t, estimates.dx, estimates.dy              # s, m, m; .theta rad; .sd; .wrench N, N, N m
    pd.solve([0.0, -1e-3, 0.0, -2e-3], rig).pose         # dots in m (x1, y1, x2, y2) to dX m, dY m, theta rad
    pd.simulate(rig, (0, -10, -5.85), seconds=2)         # a recording of this rig under a load, N, N, N m
    pd.check(recording)                                  # is the rig wired and set up as its file says?
    pd.watch(recording)                                  # since when is the rig not its model?
    pd.identify(recording)                               # the modes of the link
    pd.validate(recording, 'tracker.csv')                # against an independent reference
    pd.calibrate([recording]).save('calibrated')         # how the rig differs from its file; writes rig.yaml
    pd.budget(rig).tree()                                # what each source of error does
    pd.discover([recording], rig).save('found')          # the effects that the simulation lacks; writes model.yaml
    pd.discover_in(plant)                                # the same for a machine of yours that simulates itself

The answers of these studies are :class:`psd_deflection.studies.study.StudyResult`:
``sentences()`` for a person, ``tree()`` for a program, ``to_pandas()`` as a table, ``plot()`` as a matplotlib figure,
``report()`` is the page, ``save(folder)`` writes what the command writes.

SI units everywhere. What is rejected raises a subclass of ``psd_deflection.errors.PsdDeflectionError``: one line
with the file or argument, the value and its bound. The command ``psd-deflection`` does the same from a shell, and more.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import types
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    import numpy.typing as npt

    from psd_deflection.model.solvers.interface import Solutions
    from psd_deflection.recordings.estimates import EstimateSeries
    from psd_deflection.recordings.recording import Recording
    from psd_deflection.recordings.replay.simulated_recording import SimulatedRecording
    from psd_deflection.rig.config import Rig
    from psd_deflection.studies.budget.result import Budgeted
    from psd_deflection.studies.calibrate.result import Calibrated
    from psd_deflection.studies.check.result import Checkup
    from psd_deflection.studies.discover.plant_search import PlantDiscovery
    from psd_deflection.studies.discover.plants import Plant
    from psd_deflection.studies.discover.report import Discovery
    from psd_deflection.studies.identify.identify import Identified
    from psd_deflection.studies.validate.validate import Validated
    from psd_deflection.studies.watch.result import WatchedRun

__version__ = '0.1.0'

__all__ = [
    'budget',
    'calibrate',
    'check',
    'discover',
    'discover_in',
    'identify',
    'load_rig',
    'open',
    'replay',
    'simulate',
    'solve',
    'validate',
    'watch',
]


def __getattr__(name: str) -> types.ModuleType:
    """``psd_deflection.errors``: what is raised."""
    if name == 'errors':
        from psd_deflection.base import errors

        return errors
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')


# Every function imports what it needs when it is called, to keep `import psd_deflection` fast.


def load_rig(path: str | Path | None = None, /, **overrides: object) -> Rig:
    """The rig of a ROS 2 parameter file; the thesis rig if ``path`` is None.

    ``overrides``: parameters that differ, with dots or as maps: ``load_rig(block_size=10, link={'length': 0.4})``,
    ``load_rig('my_rig.yaml', **{'psd_1.center': [0.0, 0.08]})``. ``psd-deflection params`` lists them.
    Raises :class:`psd_deflection.base.errors.ConfigError`, which names file, parameter, value and bound.
    """
    from psd_deflection.rig.config import load_rig as of_file
    from psd_deflection.rig.parameter_files import flattened

    return of_file(path, flattened(overrides, 'load_rig'))


def open(path: str | Path) -> Recording:
    """Open a recording: a bag folder, an ``.mcap`` or a ``.csv``. ``.samples`` is a numpy array of its samples.

    Raises :class:`psd_deflection.base.errors.RecordingError` if it cannot be read.
    """
    from psd_deflection.recordings.read.readers import open_recording

    return open_recording(path)


def solve(dots: npt.ArrayLike, rig: Rig | str | Path | None = None, solver: str | None = None) -> Solutions:
    """The pose of the tip from the dots, without any correction of effects.

    ``dots``: (2P,) or (n, 2P) of P PSDs: x1, y1, x2, y2 ... from each PSD's centre, m. ``rig``: the rig or its
    parameter file; by default the thesis rig. ``solver``: by default that of the rig;
    :mod:`psd_deflection.model.solvers` has their names. A dot farther from the centre than the width of its detector
    is rejected.

    The result has ``pose`` (dX m, dY m, theta rad), ``tilt`` (phi, omega, rad), ``covariance`` of the pose (for means
    of one block, with the rig's noise), ``residual`` (m) and ``status`` (0: solved), each for one block or for n.
    Raises :class:`psd_deflection.base.errors.ConfigError` for a bad argument, and
    :class:`~psd_deflection.base.errors.SolverError` if the method cannot solve the rig.
    """
    import dataclasses

    import numpy as np

    from psd_deflection.base.errors import ConfigError
    from psd_deflection.model.detector import dot_noise_variances
    from psd_deflection.model.solvers import solver_from_rig
    from psd_deflection.records import dot_names

    known = _rig(rig)
    count = 2 * len(known.psds)
    try:
        rows = np.asarray(dots, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigError(f'dots: must be numbers, ({count},) or (n, {count})') from None
    if rows.ndim not in (1, 2) or rows.shape[-1] != count:
        names = ', '.join(dot_names(len(known.psds)))
        raise ConfigError(f'dots: has the shape {rows.shape}: must be ({count},) or (n, {count}): {names} in m')
    bad = np.argwhere(~np.isfinite(rows))
    if len(bad):
        raise ConfigError(f'dots{bad[0].tolist()} = {rows[tuple(bad[0])]} m: must be finite')
    # A dot off the detector cannot be read: most likely it is in other units.
    widths = np.array([side for psd in known.psds for side in psd.active_area])
    bad = np.argwhere(np.abs(rows) > widths)
    if len(bad):
        at = tuple(bad[0])
        raise ConfigError(
            f'dots{bad[0].tolist()} = {rows[at]:g} m: must be at most {widths[at[-1]]:g} m, the width of its detector'
        )
    method = solver_from_rig(known.estimator.solver if solver is None else solver, known)
    solutions = method.solve_many(np.atleast_2d(rows), dot_noise_variances(known) / known.estimator.block_size)
    if rows.ndim == 2:
        return solutions
    return dataclasses.replace(
        solutions, **{f.name: getattr(solutions, f.name)[0] for f in dataclasses.fields(solutions)}
    )


def simulate(
    rig: Rig | str | Path | None = None,
    loads: str | npt.ArrayLike = 'thesis',
    effects: str | Sequence[str] | Mapping[str, object] = (),
    *,
    seconds: float | None = None,
    temperature: npt.ArrayLike | None = None,
    seed: int = 0,
) -> SimulatedRecording:
    """A recording of the simulated rig, in memory, with the true pose (``.pose``) and the loads.

    ``rig``: the rig or its parameter file; by default the thesis rig. Its own effects are simulated and known.
    ``loads``: (3,) or (n, 3), Fx N, Fy N, Tz N m at the tip; each row is held for ``seconds``, or for one sample. Or
    words of ``psd-deflection simulate --loads``: ``'thesis'``, ``'identification'``, ``'ramp:0,0,0;0,-10,0:2'``.
    ``effects``: hidden effects that the recording does not name: ``['creep,amplitude=0.03']``, or a map as below
    ``effects:`` of a rig file, ``{'sensor_rotation': {'psd': 2, 'angle': 0.01}}``; ``psd-deflection effects`` lists
    them. ``temperature``: degrees Celsius, straight lines through these, evenly over the recording. The same
    ``seed`` gives the same noise.
    Raises :class:`psd_deflection.base.errors.ConfigError` naming argument, value and bound.
    """
    from psd_deflection.base.errors import ConfigError
    from psd_deflection.model.simulation.catalogue import with_effects_of
    from psd_deflection.model.simulation.loads import load_history, load_table, temperature_table
    from psd_deflection.recordings.replay.simulated_recording import SimulatedRecording

    known = with_effects_of(_rig(rig), (), 'effects')
    rate = known.converter.sample_rate_hz
    if not isinstance(loads, str):
        history = load_table(loads, rate, seconds)
    elif seconds is None:
        history = load_history(loads, rate)
    else:
        raise ConfigError(f'seconds = {seconds!r} s: loads = {loads!r} says how long they last; leave seconds out')
    if len(history) < 2:
        raise ConfigError(f'loads: {len(history)} samples at {rate:g} Hz: must be at least 2; give seconds')
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise ConfigError(f'seed = {seed!r}: must be a whole number of at least 0')
    warmth = None if temperature is None else temperature_table(temperature, len(history))
    return SimulatedRecording(with_effects_of(known, effects, 'effects'), known, history.loads, warmth, seed)


def replay(
    recording: Recording | str | Path, rig: Rig | str | Path | None = None, *, solver: str | None = None
) -> EstimateSeries:
    """The estimates of a recording, computed as the live node computes them.

    ``recording``: from :func:`open` or :func:`simulate`, or its path. ``rig``: the rig or its parameter file; by
    default the parameters in the recording, which give the messages that were published, bit for bit. A rig without a
    zero gets the recorded one.
    ``solver``: by default that of the rig.

    The result has numpy arrays (``t``, ``dx``, ``dy``, ``theta``, ``sd``, ``covariance``, ``wrench``), ``to_pandas()``
    and ``to_xarray()``. Blocks without an estimate (a laser lost) have no row. Warns (``UserWarning``) if the
    recording names no rig and none is given.
    Raises :class:`psd_deflection.base.errors.RecordingError`, :class:`~psd_deflection.base.errors.ConfigError`,
    :class:`~psd_deflection.base.errors.SolverError`.
    """
    import warnings

    from psd_deflection.recordings.recording import Recording
    from psd_deflection.recordings.replay.engine import (
        replayed_estimates,
        rig_at_start,
        warnings_about_rig,
        with_recorded_zero,
    )
    from psd_deflection.rig.config import replace_values

    opened = recording if isinstance(recording, Recording) else open(recording)
    known = rig_at_start(opened) if rig is None else with_recorded_zero(opened, _rig(rig), 'the rig')
    if solver is not None:
        known = replace_values(known, {'solver': solver, 'solvers': [solver]}, 'replay')
    if rig is None:
        for warning in warnings_about_rig(opened):
            warnings.warn(warning, stacklevel=2)
    return replayed_estimates(opened, known)


def check(recording: Recording | str | Path, rig: Rig | str | Path | None = None) -> Checkup:
    """Is the rig wired, quiet and lit as its file says? From pushes with known loads.

    ``recording``: from :func:`open` or :func:`simulate`, or its path. ``rig``: the rig or its parameter file; by
    default the parameters in the recording.
    Raises :class:`psd_deflection.base.errors.RecordingError` if it has no loads, and
    :class:`~psd_deflection.base.errors.ConfigError`.
    """
    from psd_deflection.recordings.observation import read_observation
    from psd_deflection.rig.wiring import Wiring
    from psd_deflection.studies.check.checkup import check as of_problem
    from psd_deflection.studies.check.checkup import of_recording
    from psd_deflection.studies.study import opened

    given = opened(recording, rig)
    observed = read_observation(given.recording, given.rig)
    volts = Wiring.from_rig(given.rig).to_device(observed.volts)
    return of_problem(of_recording(given.rig, volts, observed.loads, str(given.recording.path)))


def identify(recording: Recording | str | Path, rig: Rig | str | Path | None = None) -> Identified:
    """The modes of the link (frequency, damping ratio, each with its ±) and the input shaper for them.

    ``recording`` with knocks or releases, and ``rig``: as for :func:`check`. ``save`` writes ``rig.yaml`` too.
    Raises :class:`psd_deflection.base.errors.RecordingError` and :class:`~psd_deflection.base.errors.ConfigError`.
    """
    from psd_deflection.studies.identify.identify import identify as of_problem
    from psd_deflection.studies.identify.identify import read_identify
    from psd_deflection.studies.study import opened

    return of_problem(read_identify(opened(recording, rig)))


def watch(recording: Recording | str | Path, rig: Rig | str | Path | None = None) -> WatchedRun:
    """Since when the rig is not its model: the alarms of the watch over a recording, as ``replay --watch`` has them.

    ``recording``: from :func:`open` or :func:`simulate`, or its path. ``rig``: the rig or its parameter file; by
    default the parameters that the recording began with. The result has ``alarms`` and ``to_pandas()``.
    Raises :class:`psd_deflection.base.errors.RecordingError`, :class:`~psd_deflection.base.errors.ConfigError` and
    :class:`~psd_deflection.base.errors.SolverError`.
    """
    import warnings
    from pathlib import Path

    from psd_deflection.recordings.recording import Recording
    from psd_deflection.recordings.replay.engine import rig_at_start, warnings_about_rig
    from psd_deflection.rig.config import Rig
    from psd_deflection.studies.study import Opened
    from psd_deflection.studies.watch.result import watch as of_recording

    given = recording if isinstance(recording, Recording) else open(recording)
    known = rig_at_start(given) if rig is None else _rig(rig)
    if rig is None:
        for warning in warnings_about_rig(given):
            warnings.warn(warning, stacklevel=2)
    file = None if rig is None or isinstance(rig, Rig) else Path(rig)
    sources = Opened(given, known, file, given=rig is not None).sources
    return of_recording(given.with_block_size(known.estimator.block_size), known, sources)


def validate(
    recording: Recording | str | Path,
    reference: str | Path | None = None,
    rig: Rig | str | Path | None = None,
    *,
    align: bool = False,
    max_offset: float = 1.0,
    exposure: float = 0.0,
    solvers: Sequence[str] = (),
) -> Validated:
    """How the estimates of a recording agree with an independent reference.

    ``recording`` and ``rig``: as for :func:`check`. ``reference``: a table ``t,dx,dy,theta`` or another recording; by
    default the reference in the recording. ``align``: remove the offset between the clocks, which is looked for up
    to ``max_offset``, s. ``exposure``: time over which each reference is a mean, s. ``solvers``: names of those that
    are compared beside the rig's; ``'all'``: every one that can solve the rig.
    Raises :class:`psd_deflection.base.errors.RecordingError` and :class:`~psd_deflection.base.errors.ConfigError`.
    """
    from psd_deflection.studies.study import opened
    from psd_deflection.studies.validate.validate import read_validate
    from psd_deflection.studies.validate.validate import validate as of_problem

    known = opened(recording, rig)
    problem = read_validate(known, reference, align=align, largest=max_offset, exposure=exposure, solvers=solvers)
    return of_problem(problem)


def calibrate(
    recordings: Recording | str | Path | Sequence[Recording | str | Path],
    rig: Rig | str | Path | None = None,
    *,
    references: Sequence[str | Path] = (),
    dark: Sequence[Recording | str | Path] = (),
    exposure: float = 0.0,
    alone: bool = False,
) -> Calibrated:
    """How a real rig differs from its rig file, by a reference or by known loads.

    ``recordings``: one or several, from :func:`open` or :func:`simulate`, or paths. ``rig``: the rig as it is
    known, or its parameter file, which ``save`` writes anew with its comments; by default the parameters in the first
    recording.
    ``references``: one for each recording, by default those in them. ``dark``: recordings with the lasers off.
    ``exposure``: time over which each reference is a mean, s. ``alone``: by the redundant reading alone.
    Raises :class:`psd_deflection.base.errors.RecordingError` and :class:`~psd_deflection.base.errors.ConfigError`.
    """
    from pathlib import Path

    from psd_deflection.base.errors import ConfigError
    from psd_deflection.studies.calibrate.from_recordings import CalibrationOptions
    from psd_deflection.studies.study import warn_caller

    recordings = _several(recordings)
    if references and len(references) != len(recordings):
        raise ConfigError(f'references: {len(references)} for {len(recordings)} recordings; give one for each')
    file = str(rig) if isinstance(rig, (str, Path)) else None
    asked = CalibrationOptions(file, None, exposure, alone, tuple(references), tuple(dark))
    known = asked.rig(recordings, warn_caller) if rig is None or isinstance(rig, (str, Path)) else rig
    runs = asked.runs(recordings, known)
    return asked.calibrated(runs, known, asked.levels(known, runs), lambda words: None, warn_caller)


def budget(
    rig: Rig | str | Path | None = None,
    load: Sequence[float] | None = None,
    *,
    inputs: str | Path | Mapping[str, object] | None = None,
    method: str | None = None,
    draws: int = 0,
    seed: int = 1,
) -> Budgeted:
    """What each source of error does to dX, dY and theta of a rig.

    ``rig``: the rig or its parameter file; by default the thesis rig. ``load``: at the tip, Fx N, Fy N, Tz N m; by
    default one that suits the rig. ``inputs``: sizes of the errors by name, or a YAML file of them;
    ``psd-deflection budget --explain`` lists them. ``method``: whose errors are computed, by default that of the rig.
    ``draws``: random draws of all causes at once that check the totals, with ``seed``.
    Raises :class:`psd_deflection.base.errors.ConfigError` naming argument, value and bound.
    """
    import math
    from pathlib import Path

    from psd_deflection.base.errors import ConfigError
    from psd_deflection.studies.budget.budget import BudgetProblem
    from psd_deflection.studies.budget.budget import budget as of_problem
    from psd_deflection.studies.budget.inputs import read_inputs

    file = str(rig) if isinstance(rig, (str, Path)) else ''
    sizes = read_inputs(inputs, {}) if isinstance(inputs, (str, Path)) else read_inputs(None, inputs or {}, 'inputs')
    held: tuple[float, float, float] | None = None
    if load is not None:
        if len(load) != 3 or not all(math.isfinite(v) for v in load):
            raise ConfigError(f'load = {list(load)}: must be three finite numbers: Fx N, Fy N, Tz N m')
        held = float(load[0]), float(load[1]), float(load[2])
    return of_problem(BudgetProblem(_rig(rig), sizes, held, method, draws, seed, file))


def discover(
    recordings: Recording | str | Path | Sequence[Recording | str | Path],
    rig: Rig | str | Path | None = None,
    *,
    seed: int = 0,
) -> Discovery:
    """Name the effects that the simulation lacks to explain ``recordings``.

    ``recordings``: one or several with loads; from :func:`open` or :func:`simulate`, or paths, or ``.yaml`` lists of
    them.
    ``rig``: the known rig, or its parameter file; by default the parameters in the recordings. The same
    ``seed`` gives the same answer. Its ``save(folder)`` writes ``model.yaml``, ``result.json`` and ``report.html``.
    Raises :class:`psd_deflection.base.errors.RecordingError` if a
    recording cannot be read or holds no loads, :class:`~psd_deflection.base.errors.ConfigError` for a bad
    parameter.
    """
    from psd_deflection.studies.discover.from_recordings import DiscoverOptions

    asked = DiscoverOptions(rig, seed=seed)
    return asked.discovered(asked.read(_several(recordings)))


def discover_in(
    plant: Plant | str | Path,
    *,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
    parts: str = '',
    kinds: Mapping[str, str] | None = None,
    noise: Sequence[float] = (),
    seed: int = 0,
) -> PlantDiscovery:
    """Name the effects that the simulation of ``plant``, a machine of yours, lacks to explain what was measured.

    ``plant``: a :class:`psd_deflection.studies.discover.plants.Plant`, which has measured tables, a simulation and a
    library of effects that may be missing; or a CSV table, whose ``outputs`` are sums of terms of its ``inputs``, both
    names of columns (``parts``, ``kinds``, ``noise``: see
    :class:`psd_deflection.studies.discover.plant_csv.CsvPlant`). Search, rules and answer are those of
    :func:`discover`; ``save(folder)`` writes ``result.json`` and a page, ``predict`` takes another plant or table. The
    same ``seed`` gives the same answer. Raises :class:`psd_deflection.base.errors.ConfigError` if the plant contradicts
    itself.
    """
    from psd_deflection.studies.discover.plant_csv import CsvPlant
    from psd_deflection.studies.discover.plant_search import discover_in as of_plant
    from psd_deflection.studies.discover.plants import Plant

    if not isinstance(plant, Plant):
        plant = CsvPlant(plant, inputs, outputs, parts, kinds, noise)
    return of_plant(plant, seed=seed)


def _several(recordings: Recording | str | Path | Sequence[Recording | str | Path]) -> Sequence[Recording | str | Path]:
    """At least one recording, in a row. Raises ConfigError if there is none."""
    from pathlib import Path

    from psd_deflection.base.errors import ConfigError
    from psd_deflection.recordings.recording import Recording

    if isinstance(recordings, Recording | str | Path):
        return [recordings]
    if not recordings:
        raise ConfigError('recordings: must be at least one')
    return recordings


def _rig(rig: Rig | str | Path | None) -> Rig:
    """``rig``, or that of the parameter file, or the thesis rig."""
    from psd_deflection.rig.config import Rig
    from psd_deflection.rig.config import load_rig as of_file

    return rig if isinstance(rig, Rig) else of_file(rig)
