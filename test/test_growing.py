# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What lives long and can be made to grow by others has a bound.

The rule: in the rooms that run, a map, set, list or queue that an object keeps, and that its code fills with what it
did not choose itself (a key that is no constant, an element that is appended), is a bounded one (``base.bounds``, a
deque with ``maxlen``), or stands in the table below with what bounds it.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import psd_deflection

PACKAGE = Path(psd_deflection.__file__).parent
ROOMS = ('run', 'ros', 'devices', 'camera', 'arms', 'measure')
UNBOUNDED = {
    *('dict', 'set', 'list', 'Counter', 'defaultdict', 'OrderedDict', 'deque', 'SimpleQueue', 'Queue', 'LifoQueue'),
}
GROWS = {'append', 'appendleft', 'add', 'setdefault', 'extend', 'update', 'put', 'put_nowait', 'insert'}

BOUNDED_BY = {
    'arms/compensation/response.py:_rows': 'MOST_ROWS',
    'arms/compensation/response.py:candidates': 'the joints of the arm',
    'arms/inputs.py:_reported': 'LONGEST_LIST',
    'camera/lens.py:_grids': 'one size of image a camera',
    'camera/reference.py:_waiting': '20 MOST_REST, or twice rest.frames',
    'devices/contract_frames.py:_early': 'what comes before START is answered, in 2 s',
    'devices/dataq.py:_list': 'the simulated device: its 11 channels',
    'devices/thorlabs.py:_ports': 'two ports',
    'devices/thorlabs.py:_queue': 'the simulated device: two answers a poll',
    'devices/udp_port.py:_candidates': 'MOST_SENDERS',
    'devices/udp_port.py:_notices': 'one a port: that others send',
    'measure/averaging.py:_pending': 'one block',
    'measure/correction.py:_beams': 'the rig: at most six',
    'measure/correction.py:_sensors': 'the rig: at most six',
    'measure/correction.py:known': 'our own names',
    'measure/estimation.py:_subset_solvers': 'sets of at most six PSDs',
    'measure/health.py:_noises': 'the rig: at most six',
    'measure/motion/inertia.py:reported': 'MOST_TOLD',
    'measure/motion/modal.py:_waiting': 'MOST_LOADS',
    'measure/pipeline.py:misfits': 'one a part of the rig',
    'measure/pipeline.py:findings': 'our own sentences',
    'measure/pipeline.py:rejected': 'our own causes',
    'measure/timing.py:_minima': 'WINDOW_S',
    'measure/uncertainty/noise.py:_blocks': 'emptied when it is full',
    'measure/uncertainty/noise.py:_sums': 'emptied with the blocks',
    'measure/uncertainty/block_estimator.py:_pending': 'sets of at most six PSDs',
    'measure/uncertainty/block_estimator.py:_subsets': 'sets of at most six PSDs',
    'measure/watch.py:_learned': 'LEARN',
    'measure/watch.py:_since': 'REMEMBER',
    'run/hello.py:_under_way': 'MOST_UNDER_WAY',
    'ros/gate.py:_latched': 'the latched inputs of a node',
    'ros/camera.py:_since': 'one second',
    'ros/chain.py:_inputs': 'the links of the chain',
    'ros/follow.py:_goals': 'MOST_WAITING, and MOST_GOALS a second that end within ANSWER_S of being replaced',
    'ros/chain.py:_reported': 'the links of the chain',
    'ros/chain.py:_sinks': 'the links of the chain',
    'ros/node.py:_lines': 'MOST_LINES',
    'ros/node.py:_published': 'our own topics',
    'ros/sinks.py:_publishers': 'our own topics',
    'ros/sinks.py:_subscriptions': 'our own topics',
    'run/alarm_out.py:_logged': 'two ways, and alarms that wait',
    'run/alarm_out.py:_waiting': 'MOST_WAITING',
    'run/alarm_out.py:_ways': 'a command and an address',
    'run/chain.py:sessions': 'the links of the chain',
    'run/fleet/tasks.py:_ready': 'the slots of the engine',
    'run/fleet/tasks.py:_to_retry': 'the list that was given',
    'run/fleet/tasks.py:_under_way': 'the slots of the engine',
    'run/monitor/feed.py:_queue': 'QUEUE_ITEMS',
    'run/monitor/foxglove.py:_channels': 'our own topics',
    'run/monitor/foxglove.py:_looking': 'VIEWERS',
    'run/monitor/foxglove.py:_numbers': 'our own topics',
    'run/monitor/foxglove.py:_present': 'our own parameters',
    'run/monitor/foxglove.py:_waiting': 'BACKLOG_BYTES',
    'run/monitor/foxglove.py:subscriptions': 'one a topic',
    'run/monitor/gated.py:_looked_through': 'VIEWERS',
    'run/monitor/gated.py:viewers': 'VIEWERS',
    'run/monitor/shown_recording.py:_requests': 'one a connection to the page, which is answered before the next',
    'run/monitor/start.py:parts': 'three views',
    'run/processing.py:_latencies': 'one second',
    'run/processing.py:_requests': 'MOST_WAITING; of those that are waited for, one a thread',
    'run/arrivals.py:_items': 'queue_blocks, RECORDED_RESTARTS',
    'run/arrivals.py:flags': 'one block',
    'run/arrivals.py:readings': 'one block',
    'run/arrivals.py:seq': 'one block',
    'run/arrivals.py:t': 'one block',
    'run/recorder.py:_writing': 'MOST_THREADS',
    'run/recorder.py:queue': 'QUEUE_BYTES',
    'run/rate_limited_log.py:reasons': 'MOST_REASONS',
    'run/rig_publisher.py:_environment': 'our own names',
    'run/watcher.py:_segments': 'watch_memory and watch_minutes',
    'run/watcher.py:items': 'watch_memory',
}
"""``FILE:ATTRIBUTE`` and what bounds it."""


def test_what_others_can_make_grow_has_a_bound() -> None:
    found = {name for path, tree in _modules() for name in _growing(path, tree)}
    new = sorted(found - set(BOUNDED_BY))
    assert new == [], 'bound it (base.bounds), or say below what bounds it'
    assert not set(BOUNDED_BY) - found, 'these are not there any more'


def test_nothing_is_cached_for_ever_by_a_word_of_others() -> None:
    for path, tree in _modules():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and node.args.args and any(map(_is_endless, node.decorator_list)):
                raise AssertionError(f'{path}: {node.name} is cached without a bound; give lru_cache a maxsize')


def _modules() -> Iterator[tuple[str, ast.Module]]:
    for room in ROOMS:
        for path in sorted((PACKAGE / room).rglob('*.py')):
            yield str(path.relative_to(PACKAGE)), ast.parse(path.read_text())


def _growing(path: str, tree: ast.Module) -> list[str]:
    """``PATH:ATTRIBUTE`` of each container of an object that is not bounded and grows in this module."""
    kept = {name for node in ast.walk(tree) for name in _kept(node)}
    return [f'{path}:{name}' for name in sorted(kept & {name for node in ast.walk(tree) for name in _grown(node)})]


def _kept(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None and _is_unbounded(node.value):
        for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
            if isinstance(target, ast.Attribute):
                yield target.attr
    # A field of a dataclass.
    if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and isinstance(node.value, ast.Call):
        factory = next((k.value for k in node.value.keywords if k.arg == 'default_factory'), None)
        if factory is not None and _name(factory) in UNBOUNDED:
            yield node.target.id


def _is_unbounded(value: ast.expr) -> bool:
    if isinstance(value, ast.Dict | ast.Set | ast.List):
        return not (value.keys if isinstance(value, ast.Dict) else value.elts)
    if not isinstance(value, ast.Call) or _name(value.func) not in UNBOUNDED:
        return False
    return not any(k.arg in ('maxlen', 'maxsize') for k in value.keywords)


def _grown(node: ast.AST) -> Iterator[str]:
    targets: list[ast.expr] = []
    if isinstance(node, ast.Assign | ast.AugAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        if isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Attribute):
            yield node.target.attr
    for target in targets:
        if isinstance(target, ast.Subscript) and not isinstance(target.slice, ast.Constant):
            yield _name(target.value) if isinstance(target.value, ast.Attribute) else ''
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in GROWS:
        yield _name(node.func.value) if isinstance(node.func.value, ast.Attribute) else ''


def _is_endless(decorator: ast.expr) -> bool:
    if isinstance(decorator, ast.Call):
        unlimited = any(k.arg == 'maxsize' and ast.unparse(k.value) == 'None' for k in decorator.keywords)
        return _name(decorator.func) == 'lru_cache' and unlimited
    return _name(decorator) == 'cache'


def _name(node: ast.expr) -> str:
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ''
