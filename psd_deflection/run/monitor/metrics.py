# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The numbers of a run as OpenMetrics text, for Prometheus and whatever else reads it.

Source: OpenMetrics 1.0 (2020). Counters end in ``_total``, a unit is the end of the family's name, and nothing
follows ``# EOF``. Units are SI. A number that is not known has no line.
"""

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from psd_deflection import __version__
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.run.monitor.feed import BlockResult
from psd_deflection.run.session import Session

CONTENT_TYPE = 'application/openmetrics-text; version=1.0.0; charset=utf-8'
PREFIX = 'psd_deflection_'

Labels = Mapping[str, str]


class Family(NamedTuple):
    """Numbers of one kind. ``name``: without prefix and, of a counter, without ``_total``; it ends with ``unit``.

    ``kind``: counter, gauge or info. ``samples``: labels and value.
    """

    name: str
    kind: str
    about: str
    samples: tuple[tuple[Labels, float], ...]
    unit: str = ''


def counter(name: str, about: str, value: float) -> Family:
    """A count since the start of the run."""
    return Family(name, 'counter', about, (({}, value),))


def memory(name: str, about: str, size: int) -> Family:
    """What something takes, bytes."""
    return Family(name, 'gauge', about, (({}, size),), 'bytes')


def counters(name: str, label: str, about: str, values: Mapping[str, int]) -> Family:
    """Counts since the start of the run, by ``label``."""
    return Family(name, 'counter', about, tuple(({label: word}, count) for word, count in sorted(values.items())))


def of_pipeline(pipeline: Pipeline) -> list[Family]:
    """What was computed."""
    count = pipeline.counters
    return [
        counter('blocks', 'Blocks of samples that were judged', count.blocks),
        counter('estimates', 'Blocks that have an estimate', count.estimates),
        counter('estimates_degraded', 'Estimates that do not come from all detectors', count.degraded),
        counters('blocks_rejected', 'cause', 'Blocks without an estimate', count.rejected),
        counter('contradictions', 'Blocks whose readings contradict each other', pipeline.estimator.contradictions),
    ]


def of_session(session: Session) -> list[Family]:
    """What was acquired, lost, rejected and recorded, and what was computed."""
    device, recorder = session.acquisition.counters, session.recorder
    out = [
        counter('samples', 'Samples that the device sent', device.samples),
        counters('samples_lost', 'cause', 'Samples that never came', device.lost_by),
        counter('samples_dropped', 'Samples that came, and for which this machine was too slow', device.queue_dropped),
        counters('frames_bad', 'reason', 'Frames of the wire that could not be read', device.bad_frames),
        counter('device_disconnects', 'Times that the port was gone', device.disconnects),
        counter('device_restarts', 'Times that the device began anew', device.restarts),
        counters('messages_rejected', 'topic', 'Messages of other nodes that could not be used', session.rejected),
        counter('record_dropped', 'Messages for which the disk was too slow', recorder.dropped),
        Family('recording', 'gauge', '1 while a recording is written', (({}, float(recorder.folder is not None)),)),
        *of_pipeline(session.pipeline),
    ]
    if device.temperature is not None:
        about = 'Temperature that the device measures'
        out.append(Family('device_temperature_celsius', 'gauge', about, (({}, device.temperature),), 'celsius'))
    if session.watcher is not None:
        watch = session.watcher.watch
        out.append(counter('watch_alarms', 'Times that the rig was found to be no longer its model', watch.alarms))
        raised = float(watch.alarm is not None)
        out.append(Family('watch_alarm', 'gauge', '1 while the rig is not its model', (({}, raised),)))
    return out


def of_block(block: BlockResult) -> list[Family]:
    """The newest block: sums, and the estimate with its standard deviations if there is one."""
    sums = tuple(({'psd': str(psd)}, value) for psd, value in enumerate(block.spots.sums, start=1))
    out = [Family('sum_volts', 'gauge', 'Sum signal of a detector', sums, 'volts')]
    best = block.estimate
    if best is not None:
        sd = [math.sqrt(best.covariance[i]) if best.covariance[i] >= 0.0 else math.nan for i in (0, 4, 8)]
        out += [
            _across('deflection_meters', 'Deflection of the tip across the link', best.dx, best.dy),
            _across('deflection_sd_meters', 'Standard deviation of the deflection', sd[0], sd[1]),
            Family('twist_radians', 'gauge', 'Twist of the tip about the link', (({}, best.theta),), 'radians'),
            Family('twist_sd_radians', 'gauge', 'Standard deviation of the twist', (({}, sd[2]),), 'radians'),
        ]
    return out


def _across(name: str, about: str, x: float, y: float) -> Family:
    return Family(name, 'gauge', about, (({'axis': 'x'}, x), ({'axis': 'y'}, y)), 'meters')


def text_of(families: Iterable[Family]) -> str:
    """The exposition of ``families`` and of the version."""
    version = Family('build', 'info', 'The program', (({'version': __version__}, 1.0),))
    lines = []
    for family in (version, *families):
        name = PREFIX + family.name
        lines.append(f'# TYPE {name} {family.kind}')
        lines += [f'# UNIT {name} {family.unit}'] if family.unit else []
        lines.append(f'# HELP {name} {family.about}')
        ending = {'counter': '_total', 'info': '_info'}.get(family.kind, '')
        lines += [f'{name}{ending}{_labels(labels)} {_number(value)}' for labels, value in family.samples]
    return '\n'.join([*lines, '# EOF', ''])


def _labels(labels: Labels) -> str:
    words = ','.join(f'{name}="{_escaped(text)}"' for name, text in labels.items())
    return f'{{{words}}}' if words else ''


def _escaped(text: str) -> str:
    # Words of a device may hold halves of a surrogate pair, which UTF-8 does not have.
    clean = text.encode(errors='replace').decode()
    return clean.replace('\\', r'\\').replace('\n', r'\n').replace('"', r'\"')


def _number(value: float) -> str:
    if math.isinf(value):
        return '+Inf' if value > 0.0 else '-Inf'
    return 'NaN' if math.isnan(value) else f'{value:.17g}'
