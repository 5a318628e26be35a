# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The rooms that ``make mutants`` breaks, and the tests that should notice.

``make test`` runs the tests that are not marked ``slow``, ``make test-all`` all. What ``make mutants`` says of a room's
quick tests holds for ``make test``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple


class Room(NamedTuple):
    """``code``: files and folders that are broken. ``tests``: what should notice, in seconds.

    ``leave``: files that only draw or word what others computed. ``slow``: what tries those that the ``tests`` do not
    notice.
    """

    code: tuple[str, ...]
    tests: tuple[str, ...]
    leave: tuple[str, ...] = ()
    slow: tuple[str, ...] = ()


_PIPELINE = 'test/measure/test_pipeline.py'
_GOLDEN = 'test/test_golden.py'
_SOLVERS = ('sensitivity', 'truth', 'golden', 'interface', 'properties', 'registry')
_UNCERTAINTY = ('consistency', 'block_estimator', 'block_fit', 'noise')
_RUNS = ('test/measure/test_pipeline.py', 'test/test_layouts.py')

ROOMS: Mapping[str, Room] = {
    'solvers': Room(
        ('psd_deflection/model/solvers',),
        (*(f'test/model/solvers/test_{n}.py' for n in _SOLVERS), _GOLDEN),
        slow=('test/model/solvers/test_statistics.py', 'test/studies/budget', *_RUNS),
    ),
    'plate': Room(
        ('psd_deflection/model/plate',),
        ('test/model/plate',),
        slow=(
            *(f'test/model/solvers/test_{n}.py' for n in ('sensitivity', 'truth', 'golden')),
            'test/model/simulation/test_simulator.py',
        ),
    ),
    'averaging': Room(
        ('psd_deflection/measure/averaging.py', 'psd_deflection/measure/measures.py'),
        ('test/measure/test_averaging.py', _GOLDEN),
    ),
    'timing': Room(
        ('psd_deflection/measure/timing.py',),
        ('test/measure/test_timing.py', 'test/run/test_clock_watch.py'),
        slow=('test/run/test_acquisition.py', 'test/run/test_pinger.py'),
    ),
    'pipeline': Room(
        (
            'psd_deflection/measure/pipeline.py',
            'psd_deflection/measure/estimation.py',
            'psd_deflection/measure/correction.py',
        ),
        (
            _PIPELINE,
            'test/measure/test_estimation.py',
            'test/model/misalignment/test_parameter_covariance.py',
            'test/measure/uncertainty/test_pipeline_state.py',
            'test/measure/test_health.py',
            'test/measure/test_state.py',
            'test/model/simulation/test_added_effect.py',
            'test/test_more_psds.py',
            'test/measure/motion/test_motion.py',
            _GOLDEN,
        ),
        slow=(
            'test/measure/test_pipeline.py',
            'test/test_more_psds.py',
            'test/measure/motion/test_motion.py',
            'test/measure/motion/test_inertia.py',
            'test/model/simulation/test_base_pair.py',
            'test/model/simulation/test_effects.py',
        ),
    ),
    'detector': Room(
        ('psd_deflection/model/detector', 'psd_deflection/measure/health.py', 'psd_deflection/rig/wiring.py'),
        (
            *('test/model/detector', 'test/measure/test_health.py', 'test/rig/test_wiring.py', _GOLDEN),
            'test/measure/test_state.py',
            'test/model/simulation/test_effect_terms.py',
        ),
        slow=_RUNS,
    ),
    'uncertainty': Room(
        ('psd_deflection/measure/uncertainty',),
        (
            *(f'test/measure/uncertainty/test_{n}.py' for n in _UNCERTAINTY),
            'test/measure/uncertainty/test_vibration.py',
            'test/measure/test_pipeline.py',
            'test/measure/test_state.py',
            'test/test_more_psds.py',
            'test/measure/uncertainty/test_pipeline_state.py',
        ),
        slow=_RUNS,
    ),
    'adapters': Room(
        ('msg_adapters',),
        (
            'test/recordings/test_adapters.py',
            'test/recordings/test_contract.py',
            'test/test_more_psds.py',
        ),
        slow=(
            *(f'test/recordings/test_{n}.py' for n in ('bag_writer', 'bag_reader', 'cdr', 'references')),
            'test/arms/chains/test_chain.py',
        ),
    ),
    'protocol': Room(
        ('psd_deflection/devices/protocol', 'psd_deflection/base/sequence.py'),
        (
            'test/devices/protocol',
            'test/base/test_sequence.py',
            *(f'test/devices/test_{n}.py' for n in ('dataq', 'text_lines', 'thorlabs')),
            'test/recordings/test_bag_reader.py',
        ),
        slow=(
            *(f'test/devices/test_{n}.py' for n in ('source', 'survey')),
            *(f'test/run/test_{n}.py' for n in ('acquisition', 'hello')),
        ),
    ),
    'effects': Room(
        ('psd_deflection/model/simulation/effects',),
        (
            'test/model/simulation/test_effect_terms.py',
            'test/model/simulation/test_effect_formulas.py',
            'test/model/simulation/test_effects.py',
        ),
        slow=('test/model/simulation/test_effects.py', 'test/model/simulation/test_simulator.py'),
    ),
    'discover': Room(
        ('psd_deflection/studies/discover',),
        (
            *(
                f'test/studies/discover/test_{n}.py'
                for n in (
                    *('formulas', 'law_formulas', 'plant_formulas', 'answers', 'rules', 'steps', 'parts'),
                    *('limits', 'smooth', 'no_effect', 'isolable', 'readings'),
                )
            ),
            # Their pieces: a whole discovery of the catalogue takes seconds.
            'test/studies/discover/test_discover.py',
            'test/studies/discover/test_planning.py',
            'test/studies/discover/test_setup.py',
            'test/studies/discover/test_applied.py',
        ),
        leave=('psd_deflection/studies/discover/report.py',),
        slow=tuple(
            f'test/studies/discover/test_{n}.py'
            for n in ('discover', 'planning', 'setup', 'laws', 'readings', 'applied')
        ),
    ),
    'link': Room(
        ('psd_deflection/model/link',),
        ('test/model/link',),
        slow=('test/model/simulation/test_simulator.py', 'test/studies/thesis'),
    ),
    'misalignment': Room(
        ('psd_deflection/model/misalignment',),
        ('test/model/misalignment',),
        slow=('test/studies/calibrate', 'test/measure/test_estimation.py'),
    ),
    'motion': Room(
        ('psd_deflection/measure/motion',),
        (
            'test/measure/motion/test_inertia.py',
            'test/measure/motion/test_filter.py',
        ),
        slow=('test/measure/motion/test_motion.py',),
    ),
    'watch': Room(
        ('psd_deflection/measure/watch.py',),
        ('test/measure/test_watch.py',),
        slow=('test/run/test_watcher.py',),
    ),
    'chains': Room(
        ('psd_deflection/arms/chains',),
        ('test/arms/chains',),
        slow=('test/run/test_chain.py', 'test/cli/test_arms.py'),
    ),
    'compensation': Room(
        ('psd_deflection/arms/compensation', 'psd_deflection/arms/shapers.py', 'psd_deflection/arms/inputs.py'),
        ('test/arms/compensation', 'test/arms/test_inputs.py'),
        slow=('test/cli/test_arms.py',),
    ),
    'camera': Room(
        ('psd_deflection/camera',),
        ('test/camera',),
        leave=('psd_deflection/camera/preview.py', 'psd_deflection/camera/print_target.py'),
        slow=('test/cli/test_camera.py',),
    ),
    'calibrate': Room(
        ('psd_deflection/studies/calibrate',),
        tuple(f'test/studies/calibrate/test_{n}.py' for n in ('dark', 'fit', 'check')),
        leave=('psd_deflection/studies/calibrate/pictures.py',),
        slow=('test/studies/calibrate/test_calibrate.py', 'test/cli/test_studies.py'),
    ),
    'check': Room(
        ('psd_deflection/studies/check', 'psd_deflection/studies/loads'),
        (
            'test/studies/check',
            'test/studies/loads',
        ),
        slow=(
            *('test/run/test_guided.py', 'test/run/test_last_load_change.py'),
            *(f'test/studies/discover/test_{n}.py' for n in ('setup', 'applied')),
        ),
    ),
    'identify': Room(
        ('psd_deflection/studies/identify',),
        ('test/studies/identify',),
        leave=('psd_deflection/studies/identify/pictures.py',),
        slow=('test/cli/test_studies.py',),
    ),
    'validate': Room(
        ('psd_deflection/studies/validate',),
        ('test/studies/validate',),
        leave=('psd_deflection/studies/validate/pictures.py',),
        slow=('test/cli/test_studies.py',),
    ),
    'budget': Room(
        ('psd_deflection/studies/budget',),
        ('test/studies/budget',),
        leave=('psd_deflection/studies/budget/pictures.py',),
        slow=('test/cli/test_budget.py',),
    ),
    'thesis': Room(
        ('psd_deflection/studies/thesis', 'psd_deflection/studies/splitter.py'),
        ('test/studies/thesis', 'test/studies/test_splitter.py'),
        leave=('psd_deflection/studies/thesis/figures.py',),
        slow=('test/cli/test_thesis.py',),
    ),
    'simulation': Room(
        ('psd_deflection/model/simulation/simulator.py',),
        ('test/model/simulation/test_simulator.py',),
        slow=('test/model/simulation/test_effects.py',),
    ),
    'tables': Room(
        (
            *(f'psd_deflection/recordings/{n}.py' for n in ('charts', 'estimates', 'sample_table', 'spans')),
            'psd_deflection/base/axes.py',
        ),
        (
            'test/base/test_charts.py',
            *(f'test/recordings/test_{n}.py' for n in ('recording_window', 'tables')),
            'test/test_api.py',
        ),
        slow=('test/cli/test_studies.py',),
    ),
    'history': Room(
        (
            'psd_deflection/run/last_load_change.py',
            'psd_deflection/run/monitor/history.py',
            'psd_deflection/run/monitor/kept_history.py',
        ),
        (
            'test/run/test_last_load_change.py',
            'test/run/monitor/test_history.py',
            'test/run/monitor/test_kept_history.py',
        ),
    ),
}

TIERS = ('quick', 'slow')


def paths_of(name: str) -> tuple[str, ...]:
    """Return what ``make test ROOM=name`` runs: a folder of test/, and the tests of a room of mutants."""
    return (f'test/{name}', *(ROOMS[name].tests if name in ROOMS else ()))


def holds(paths: tuple[str, ...], file: str) -> bool:
    """Return whether ``file`` is one of these files or in one of these folders."""
    return any(file == path or file.startswith(f'{path}/') for path in paths)
