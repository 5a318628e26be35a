# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Every result of a study draws itself, and is a table."""

import importlib
import pkgutil
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import psd_deflection
from psd_deflection import studies
from psd_deflection.base.charts import Chart, Panel, TimeAxis
from psd_deflection.base.errors import ConfigError
from psd_deflection.measure.watch import Alarm
from psd_deflection.recordings.replay.simulated_recording import SimulatedRecording
from psd_deflection.records import Mark
from psd_deflection.studies.budget.certificate import CertificateProblem, certify
from psd_deflection.studies.budget.certificate_page import Certified, read_calibration
from psd_deflection.studies.budget.inputs import INPUTS, REFERENCE_INPUTS, read_inputs
from psd_deflection.studies.discover.isolable import isolable
from psd_deflection.studies.discover.loop import LoopResult
from psd_deflection.studies.discover.report import Discovery
from psd_deflection.studies.study import StudyResult
from psd_deflection.studies.watch.result import WatchedRun
from test.studies.discover.test_discover import Spring

# About every 50 ms, so that every stretch that is shown has one.
MARKS = [Mark(t_ns, f'bump {i}') for i, t_ns in enumerate(range(10_000_000, 3_600_000_000, 47_000_000))]
Maker = Callable[[Path], StudyResult]
PUSHES = [(0, 0, 0), (0, -40, -20), (40, 0, 15), (-40, 30, 0), (0, 40, 20), (0, 0, 0)]


@cache
def run() -> SimulatedRecording:
    gain = {'sensor_gain': {'psd': 1, 'y': 0.02}}
    simulated = psd_deflection.simulate(psd_deflection.load_rig(), PUSHES, seconds=0.6, effects=gain)
    vars(simulated)['marks'] = lambda: MARKS
    return simulated


def tracker(folder: Path) -> Path:
    """The true pose, as another instrument writes it, with its noise."""
    noise = np.random.default_rng(1).standard_normal(run().pose[::20].shape) * (1e-5, 1e-5, 5e-4)
    rows = zip(run().samples['t_ns'][::20] * 1e-9, (run().pose[::20] + noise).tolist(), strict=True)
    path = folder / 'tracker.csv'
    path.write_text('\n'.join(['t,dx,dy,theta', *(f'{t:.6f},{x},{y},{theta}' for t, (x, y, theta) in rows)]) + '\n')
    return path


@cache
def discovery() -> Discovery:
    return psd_deflection.discover([run()])


def certificate(folder: Path) -> StudyResult:
    psd_deflection.calibrate([run()], references=[tracker(folder)]).save(folder / 'new')
    rig, tree = read_calibration(folder / 'new')
    problem = CertificateProblem(
        rig, tree, read_inputs(None, {}, declared=(*INPUTS, *REFERENCE_INPUTS)), [], None, {}, 'rig.yaml'
    )
    return Certified(certify(problem), problem)


def watched(folder: Path) -> StudyResult:
    shifts = (('x1', 3_000_000_000, 2e-5), ('theta', 5_000_000_000, 1e-4))
    alarms = tuple(
        Alarm(since_ns=t, observed_ns=t + 1, channel=name, shift=shift, sd=shift / 10, also=())
        for name, t, shift in shifts
    )
    return WatchedRun(alarms, 'all', 0, {'recording': 'a'})


RESULTS: Mapping[str, tuple[Maker, Callable[[Any], int]]] = {
    'Budgeted': (lambda _: psd_deflection.budget(load=(0.0, -10.0, 0.0)), lambda r: len(r.budget.lines)),
    'Calibrated': (lambda _: psd_deflection.calibrate([run()]), lambda r: len(r.tree()['parameters'])),
    'Certified': (certificate, lambda r: len(r.certificate.poses)),
    'Checkup': (lambda _: psd_deflection.check(run()), lambda r: len(r.findings)),
    'Discovery': (lambda _: discovery(), lambda _: 3),
    'Identified': (lambda _: psd_deflection.identify(run()), lambda r: sum(len(axis.modes) for axis in r.axes)),
    'Isolability': (lambda _: isolable(psd_deflection.load_rig(), run().loads_applied), lambda r: len(r.effects)),
    'PlantDiscovery': (lambda _: psd_deflection.discover_in(Spring(0.3)), lambda _: 1),
    'LoopResult': (lambda _: LoopResult(discovery(), (), None, None), lambda _: 3),
    'Validated': (lambda folder: psd_deflection.validate(run(), tracker(folder)), lambda r: r.tree()['references']),
    'WatchedRun': (watched, lambda _: 2),
}
"""Each kind of result, with the rows of its table."""


def kinds(of: type[StudyResult] = StudyResult) -> set[str]:
    """Every class of result that can be made."""
    for module in pkgutil.walk_packages(studies.__path__, 'psd_deflection.studies.'):
        importlib.import_module(module.name)
    # Another test may have added a study of its own.
    names = {of.__name__} if not of.__abstractmethods__ and of.__module__.startswith('psd_deflection.') else set()
    return names.union(*(kinds(each) for each in of.__subclasses__()))


def test_every_kind_of_result_is_tested_here() -> None:
    assert kinds() == set(RESULTS)


@pytest.mark.parametrize('kind', RESULTS)
@pytest.mark.filterwarnings('ignore:.*lacks its parameters')
def test_a_result_draws_itself_and_is_a_table(kind: str, tmp_path: Path) -> None:
    make, rows = RESULTS[kind]
    result = make(tmp_path)
    assert type(result).__name__ == kind
    drawings = result.drawings()
    assert drawings
    for number, drawing in enumerate(drawings):
        figure = result.plot(number)
        assert figure.texts[0].get_text() == drawing.words
        if isinstance(drawing, Chart):
            assert len([a for a in figure.axes if a.get_visible()]) == len(drawing.panels)
    assert result.plot()._repr_png_()[:4] == b'\x89PNG'
    table = result.table()
    assert {len(column.values) for column in (table.index, *table.columns)} == {rows(result)}
    pytest.importorskip('pandas')
    frame = result.to_pandas()
    assert list(frame.attrs['units']) == [frame.index.name, *frame.columns]


@pytest.mark.parametrize('kind', ['Calibrated', 'Discovery', 'Identified', 'LoopResult', 'Validated'])
@pytest.mark.filterwarnings('ignore:.*lacks its parameters')
def test_every_chart_over_time_shows_the_marks(kind: str, tmp_path: Path) -> None:
    make, _ = RESULTS[kind]
    over = list(over_time(make(tmp_path)))
    assert over
    marks = {mark.text: mark.t_ns / 1e9 for mark in MARKS}
    for panel in over:
        rules = [rule for rule in panel.marked(words=True) if rule.words.startswith('bump')]
        assert rules
        assert [rule.at for rule in rules] == pytest.approx([marks[rule.words] for rule in rules], abs=0.002)


def over_time(result: StudyResult) -> Iterator[Panel]:
    for drawing in result.drawings():
        if isinstance(drawing, Chart):
            yield from (panel for panel in drawing.panels if isinstance(panel.over, TimeAxis))


def test_a_drawing_that_is_not_there_is_rejected() -> None:
    sound = WatchedRun((), 'all', 0, {})
    assert sound.drawings() == []
    with pytest.raises(ConfigError, match=r'^number: 0: no such drawing; there are none, for nothing was found$'):
        sound.plot()
    with pytest.raises(ConfigError, match=r'^number: -1: no such drawing; there are 0: what shifted'):
        watched(Path()).plot(-1)
