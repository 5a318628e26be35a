# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The two tiers of the tests, and the rooms that ``make mutants`` breaks: one table for both.

``make test`` runs the quick tier, ``make test-all`` both. A test is slow if it is marked ``statistics``, or if an entry
of ``SLOW`` or of a room's ``slow`` chooses it and no room counts on it (``tests``). So what ``make mutants`` says of a
room's quick tests holds for ``make test``. An entry is a path, perhaps with "-k WORDS" as of pytest.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterable, Mapping
from functools import cache
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


_PIPELINE = (
    'test/measure/test_pipeline.py -k not(drift or rms_errors or rotation or crosstalk or nonlinearity or iterative)'
)
_GOLDEN = 'test/test_golden.py'
_SOLVERS = (
    *('sensitivity', 'truth', 'golden', 'interface', 'properties', 'degenerate', 'registry', 'gauss_newton', 'one_psd'),
)
_UNCERTAINTY = (
    *('consistency', 'combinations', 'block_estimator', 'outliers', 'rest', 'block_fit', 'noise', 'converter'),
)
_RUNS = ('test/measure/test_pipeline.py', 'test/test_layouts.py')

ROOMS: Mapping[str, Room] = {
    'solvers': Room(
        ('psd_deflection/model/solvers',),
        (*(f'test/model/solvers/test_{n}.py' for n in _SOLVERS), _GOLDEN),
        slow=('test/model/solvers/test_audit.py', 'test/studies/budget', *_RUNS),
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
        ('test/measure/test_averaging.py', 'test/measure/test_measures.py', _GOLDEN),
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
            'test/measure/test_correction.py',
            'test/model/misalignment/test_spread.py',
            'test/measure/uncertainty/test_pipeline_state.py',
            'test/measure/test_health.py',
            'test/measure/test_state.py',
            'test/model/simulation/test_added_effect.py -k rejected',
            'test/test_more_psds.py -k psd_left or without_one or contradicts or on_itself or all_psds or the_last',
            'test/measure/motion/test_motion.py -k anew or begun_at or noted or is_rejected',
            _GOLDEN,
        ),
        slow=(
            'test/measure/test_pipeline.py -k drift or an_effect_in or iterative',
            'test/test_more_psds.py',
            'test/measure/motion/test_motion.py -k recorded or coast or ahead or foretold or stated',
            'test/measure/motion/test_inertia.py',
            'test/model/simulation/test_base_pair.py',
            'test/model/simulation/test_effects.py -k correction or together or the_wrench',
        ),
    ),
    'detector': Room(
        ('psd_deflection/model/detector', 'psd_deflection/measure/health.py', 'psd_deflection/rig/wiring.py'),
        (
            *('test/model/detector', 'test/measure/test_health.py', 'test/rig/test_wiring.py', _GOLDEN),
            'test/measure/test_state.py -k still or noisy or fit_is_named',
            'test/model/simulation/test_effect_terms.py -k spot',
        ),
        slow=_RUNS,
    ),
    'uncertainty': Room(
        ('psd_deflection/measure/uncertainty',),
        (
            *(f'test/measure/uncertainty/test_{n}.py' for n in _UNCERTAINTY),
            'test/measure/uncertainty/test_vibration.py -k tone or hum or regular or fit_states or counted',
            'test/measure/test_pipeline.py -k zero',
            'test/measure/test_state.py',
            'test/test_more_psds.py -k contradicts or degree or tells_on_itself or one_after',
            'test/measure/uncertainty/test_pipeline_state.py',
        ),
        slow=_RUNS,
    ),
    'adapters': Room(
        ('msg_adapters',),
        (
            'test/recordings/test_adapters.py',
            'test/recordings/test_contract.py',
            'test/test_more_psds.py -k cloud_of_two',
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
            'test/recordings/test_bag_reader.py -k restart or wrap or again',
        ),
        slow=(
            *(f'test/devices/test_{n}.py' for n in ('source', 'survey')),
            *(f'test/run/test_{n}.py' for n in ('acquisition', 'hello', 'restarts')),
        ),
    ),
    'effects': Room(
        ('psd_deflection/model/simulation/effects',),
        (
            'test/model/simulation/test_catalogue.py',
            'test/model/simulation/test_effect_terms.py',
            'test/model/simulation/test_effect_formulas.py',
            'test/model/simulation/test_effects.py -k back or play or pieces or (wrench and (creep or '
            'friction or load))',
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
                    *('problem', 'limits', 'ties'),
                )
            ),
            # Their pieces: a whole discovery of the catalogue takes seconds.
            'test/studies/discover/test_discover.py -k nothing_missing or '
            'the_hidden_effect or where_is or the_model_closes or keeps_to_the_contract or from_simulate_to_model',
            'test/studies/discover/test_planning.py -k loop or words or every_proposal or pieces',
            'test/studies/discover/test_setup.py -k put_right or other_unit or at_its or outliers',
            'test/studies/discover/test_hung.py -k what_rings_on or nobody_noted_changes or is_unseen or settled_again',
        ),
        leave=('psd_deflection/studies/discover/report.py',),
        slow=tuple(
            f'test/studies/discover/test_{n}.py'
            for n in ('discover', 'plants', 'planning', 'setup', 'laws', 'readings', 'hung')
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
            'test/measure/motion/test_modal.py',
            'test/measure/motion/test_unseen.py',
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
        slow=('test/run/test_chain.py', 'test/cli/test_chain.py'),
    ),
    'compensation': Room(
        ('psd_deflection/arms/compensation', 'psd_deflection/arms/shapers.py', 'psd_deflection/arms/inputs.py'),
        ('test/arms/compensation', 'test/arms/test_shapers.py', 'test/arms/test_inputs.py'),
        slow=('test/cli/test_shaper.py',),
    ),
    'camera': Room(
        ('psd_deflection/camera',),
        ('test/camera',),
        leave=('psd_deflection/camera/preview.py', 'psd_deflection/camera/print_target.py'),
        slow=('test/cli/test_camera.py',),
    ),
    'calibrate': Room(
        ('psd_deflection/studies/calibrate',),
        tuple(f'test/studies/calibrate/test_{n}.py' for n in ('dark', 'fit', 'check', 'observation', 'progress')),
        leave=('psd_deflection/studies/calibrate/pictures.py',),
        slow=('test/studies/calibrate/test_calibrate.py', 'test/cli/test_calibrate.py'),
    ),
    'check': Room(
        ('psd_deflection/studies/check', 'psd_deflection/studies/loads'),
        (
            'test/studies/check',
            'test/studies/loads -k not (lacks_nothing or mends_the_times or read_after_one_another)',
        ),
        slow=(
            *('test/run/test_guided.py', 'test/run/test_last_step.py'),
            *(f'test/studies/discover/test_{n}.py' for n in ('setup', 'hung')),
        ),
    ),
    'identify': Room(
        ('psd_deflection/studies/identify',),
        ('test/studies/identify',),
        leave=('psd_deflection/studies/identify/pictures.py',),
        slow=('test/cli/test_identify.py',),
    ),
    'validate': Room(
        ('psd_deflection/studies/validate',),
        ('test/studies/validate',),
        leave=('psd_deflection/studies/validate/pictures.py',),
        slow=('test/cli/test_validate.py',),
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
            'test/base/test_axes.py',
            *(f'test/recordings/test_{n}.py' for n in ('charts', 'recording_window', 'tables')),
            'test/test_api.py',
        ),
        slow=('test/cli/test_validate.py', 'test/cli/test_identify.py'),
    ),
    'history': Room(
        (
            'psd_deflection/run/last_step.py',
            'psd_deflection/run/monitor/history.py',
            'psd_deflection/run/monitor/kept_history.py',
        ),
        (
            'test/run/test_last_step.py',
            'test/run/monitor/test_history.py',
            'test/run/monitor/test_kept_history.py',
        ),
    ),
}

SLOW: Mapping[str, tuple[str, ...]] = {
    'campaigns, and their tests': ('test/blind', 'test/bench -k not every_part_is_there'),
    'packaging and release': ('test/test_deb.py', 'test/test_release.py'),
    'pages that are made': (
        'test/docs/test_try_page.py',
        'test/docs/test_gallery.py',
        'test/docs/test_design_docs.py',
        'test/docs/test_docs.py -k notebook',
    ),
    'whole searches that ask what another one asks, of another rig': (
        'test/studies/discover/test_isolable.py',
        'test/studies/loads/test_noted_times.py -k lacks_nothing or mends_the_times or read_after_one_another',
        'test/studies/discover/test_reference_readings.py -k nothing_is_named or a_table_with_times',
        'test/studies/discover/test_three_psds.py -k nothing_is_missing or of_six_psds or a_law_may_act or '
        'wrong_wiring or two_others or the_command or a_table_of',
    ),
    'workers that are killed, disks and parts that hang until a time is over': (
        'test/run/fleet/test_tasks.py -k a_killed_process or that_is_given_up',
        'test/cli/test_many.py -k every_engine',
        'test/run/test_hanging_disk.py -k holds_up_the_end or without_end',
        'test/run/test_session_end.py -k hangs',
    ),
    'a copy of the package in a process': ('test/cli/test_elsewhere.py',),
    'pages that are looked at, and streams that run, for long': (
        'test/run/monitor/test_hours.py -k leaves_the_heap',
        'test/run/monitor/test_browser.py -k leaves_the_heap',
        'test/measure/uncertainty/test_vibration.py -k does_not_fire',
        'test/run/test_rig_publisher.py -k modal',
        'test/model/simulation/test_added_effect.py -k it_is_discovered',
    ),
    'processes that are killed, hang, or start again and again; another vendor': (
        'test/ros/test_estimator_node.py -k another_vendors or a_disk_that_hangs or a_dump_of or the_log_file or '
        'signals_end_it',
        'test/ros/test_lifecycle.py -k a_signal_ends or the_zero_holds',
        'test/ros/test_late_recorder.py',
        'test/ros/test_filter_topics.py',
        'test/ros/test_running.py',
        'test/ros/test_transforms.py -k the_node_publishes or without_tf2_msgs',
        'test/ros/test_markers.py -k a_late_rviz',
        'test/ros/test_chain_node.py -k the_frames_lead or a_prefix',
        'test/ros/test_camera_node.py -k a_parameter_that',
        'test/ros/test_description.py -k a_signal_ends',
        'test/ros/test_compensator_node.py -k with_offsets_that_stay or that_hangs or killed_and or after_an_error or '
        'that_does_not_run or a_signal_ends or lets_the_offsets',
        'test/ros/test_shaper_action.py -k not (is_shaped or is_rejected)',
        'test/ros/test_shaper_node.py -k the_limits_come',
    ),
}
"""Entries by reason: what is slow and tries no room, or what a room's quick tests notice as well."""


@cache
def _words_of(entry: str) -> tuple[str, Callable[[str], bool]]:
    """The path of an entry, and whether its words choose a name."""
    path, _, words = entry.partition(' -k ')

    def holds(node: ast.expr, name: str) -> bool:
        match node:
            case ast.Name(word):
                return word.lower() in name
            case ast.UnaryOp(ast.Not(), inner):
                return not holds(inner, name)
            case ast.BoolOp(ast.And(), parts):
                return all(holds(part, name) for part in parts)
            case ast.BoolOp(ast.Or(), parts):
                return any(holds(part, name) for part in parts)
        raise ValueError(f'{entry}: words, and, or, not, brackets')

    if not words:
        return path, lambda name: True
    tree = ast.parse(words, mode='eval').body
    return path, lambda name: holds(tree, name.lower())


def chooses(entry: str, test: str) -> bool:
    """Whether an entry chooses a test, named as pytest does. Raises ValueError if its words cannot be read."""
    path, words = _words_of(entry)
    file, _, name = test.partition('::')
    return (file == path or file.startswith(f'{path}/')) and words(name)


def _any(entries: Iterable[str], test: str) -> bool:
    return any(chooses(entry, test) for entry in entries)


SLOW_ENTRIES = (*(e for entries in SLOW.values() for e in entries), *(e for r in ROOMS.values() for e in r.slow))
QUICK_ENTRIES = tuple(e for room in ROOMS.values() for e in room.tests)
TIERS = ('quick', 'slow')


def tier_of(test: str, statistics: bool) -> str:
    """The tier of a test, named as pytest does; ``statistics``: whether it is so marked."""
    slow = statistics or (_any(SLOW_ENTRIES, test) and not _any(QUICK_ENTRIES, test))
    return TIERS[slow]


def entries_of(name: str) -> tuple[str, ...]:
    """What ``make test ROOM=name`` runs: the tests of a folder of test/, the quick tests of a room of the mutants."""
    return (f'test/{name}', *(ROOMS[name].tests if name in ROOMS else ()))
