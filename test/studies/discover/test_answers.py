# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What discover proposes, names and writes, piece by piece: against counts by hand and sentences."""

import dataclasses
import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from psd_deflection import __version__
from psd_deflection.model.simulation import simulator
from psd_deflection.model.simulation.catalogue import catalogue, make_active
from psd_deflection.model.simulation.declaration import ActiveEffect, Effect, EffectParameter, Proposal
from psd_deflection.model.simulation.laws import Law, LawTerm
from psd_deflection.model.simulation.physics import Physics, dots_on_plate
from psd_deflection.model.simulation.samples import SimulatedSamples
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.records import FloatArray
from psd_deflection.rig.parameter_files import nested
from psd_deflection.studies.check.result import Finding
from psd_deflection.studies.discover import planning, trees
from psd_deflection.studies.discover.discover import discover
from psd_deflection.studies.discover.experiment import Limits, ModelSums, Piece, Setting
from psd_deflection.studies.discover.hidden import beginning, mistakes, only_in
from psd_deflection.studies.discover.laws import FoundLaw
from psd_deflection.studies.discover.planning import Discrimination, Plan, Suggestion
from psd_deflection.studies.discover.recorded import Recorded, compared, snapped
from psd_deflection.studies.discover.report import Discovery
from psd_deflection.studies.discover.search import proposals, weighing
from psd_deflection.studies.discover.search import workspace as comparing
from psd_deflection.studies.discover.search.fit import Fit, HeldOut
from psd_deflection.studies.discover.search.localise import Cell, Dependence, Localisation
from psd_deflection.studies.discover.search.screen import Candidate, candidates, promising, signature_columns
from psd_deflection.studies.discover.search.weighing import Alternative, NamedEffect, Unknown, unknown_of
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.setup import finding_of_effect, likely_delays, likely_jumps

from .test_formulas import RIG, make_observation

EVERY = catalogue()


@pytest.fixture(scope='module')
def workspace() -> Workspace:
    """Two recordings, the second without temperature."""
    return Workspace([make_observation(), make_observation(1, name='second', warm=None)])


def of_setup(name: str) -> Effect:
    listed = mistakes(2, [0.04, -0.02], [(1, 2, 3e-3)])
    return next(e for e in listed if e.name == name)


def some_samples(**given: Any) -> SimulatedSamples:
    rng, n = np.random.default_rng(0), 8
    rows = {'pose': rng.normal(size=(3, n)), 'dots': rng.normal(size=(4, n)), 'beams': rng.normal(size=(4, n))}
    t = np.arange(n, dtype=np.float64) * 1e-3
    return SimulatedSamples(t, 0.0 * t, rng.normal(size=(3, n)), Physics.of(RIG), **{**rows, **given})


def test_what_a_mistake_does_is_what_its_name_says() -> None:
    before = Physics.of(RIG)
    for name, changed in (
        ('sensitivity', 'sensitivity'),
        ('link_length', 'length'),
        ('bending_frequency', 'bending_frequency'),
        ('torsion_frequency', 'torsion_frequency'),
    ):
        after = Physics.of(RIG)
        configure = of_setup(name).configure
        assert configure is not None
        configure(after, {'error': 0.25})
        np.testing.assert_allclose(getattr(after, changed), 1.25 * np.asarray(getattr(before, changed)))
    after = Physics.of(RIG)
    configure = of_setup('sample_rate').configure
    assert configure is not None
    configure(after, {'error': 0.25})
    # A quarter more samples a second.
    assert 1.0 / after.period == pytest.approx(1250.0)
    configure = of_setup('zero').configure
    assert configure is not None
    moved = {'x1': 1e-3, 'y1': -2e-3, 'x2': 3e-3, 'y2': 4e-3}
    for of_reading, sign, place in ((0.0, 1.0, 'beams'), (1.0, -1.0, 'centers')):
        after = Physics.of(RIG)
        configure(after, {**moved, 'of_reading': of_reading})
        want = getattr(before, place) + sign * np.array([[1e-3, -2e-3], [3e-3, 4e-3]])
        np.testing.assert_allclose(getattr(after, place), want)
        other = 'centers' if place == 'beams' else 'beams'
        np.testing.assert_array_equal(getattr(after, other), getattr(before, other))


def test_late_loads_are_those_of_later_and_a_jump_stays() -> None:
    samples = some_samples()
    loads = samples.loads.copy()
    apply = of_setup('load_delay').apply
    assert apply is not None
    apply(samples, {'late_by': 2.5e-3}, {})
    np.testing.assert_allclose(samples.loads[:, :5], 0.5 * (loads[:, 2:7] + loads[:, 3:8]))
    np.testing.assert_allclose(samples.loads[:, 6:], loads[:, [7, 7]])
    for psd in (1, 2):
        samples = some_samples()
        dots = samples.dots.copy()
        jump = of_setup('jump')
        assert jump.apply is not None
        where = {p.name: p.nominal for p in jump.parameters}
        jump.apply(samples, {**where, 'psd': psd, 'jump_x': 0.5, 'jump_y': -0.25}, {})
        change = np.zeros((4, 8))
        change[2 * psd - 2, 3:], change[2 * psd - 1, 3:] = 0.5, -0.25
        np.testing.assert_allclose(samples.dots, dots + change)


def test_a_recording_that_begins_in_motion_rings_out() -> None:
    """Free motion of each mode, a cos + b sin at its own frequency, from its start on."""
    effect = beginning([0.0, 3e-3])
    names = [f'{wave}_{axis}' for axis in ('dx', 'dy', 'theta') for wave in ('cos', 'sin')]
    assert [p.name for p in effect.parameters] == ['recording', *names]
    values = dict(zip(names, (1.0, -0.5, 0.3, 0.2, -0.7, 0.9), strict=True))
    p = Physics.of(RIG)
    assert effect.apply is not None
    for recording, start in ((1, 0.0), (2, 3e-3)):
        samples = some_samples()
        pose = samples.pose.copy()
        effect.apply(samples, {**values, 'recording': recording}, {})
        modes = [(p.bending_frequency, p.bending_damping_ratio)] * 2 + [(p.torsion_frequency, p.torsion_damping_ratio)]
        for axis, (frequency, zeta) in enumerate(modes):
            w = 2 * math.pi * frequency
            for i, t in enumerate(samples.t - start):
                root = complex(-zeta * w, w * math.sqrt(1 - zeta**2))
                a, b = values[names[2 * axis]], values[names[2 * axis + 1]]
                added = ((a - 1j * b) * np.exp(root * t)).real if t >= 0.0 else 0.0
                assert samples.pose[axis, i] - pose[axis, i] == pytest.approx(added, abs=1e-12)


@pytest.mark.repeatable
def test_a_motion_that_is_asked_for_again_is_kept_and_gives_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Effects of a PSD leave where the dots fall; any other, other loads and a look ahead simulate it anew."""
    fallen = list[int]()

    def fall(pose: FloatArray, beams: FloatArray, physics: Physics) -> FloatArray:
        fallen.append(1)
        return dots_on_plate(pose, beams, physics)

    monkeypatch.setattr(simulator, 'PIECE', 700)
    monkeypatch.setattr(simulator, 'dots_on_plate', fall)
    observations = [make_observation(), make_observation(1, name='second', warm=None)]
    observations[1].volts[100:200, :3] = np.nan
    workspace = Workspace(observations)
    pieces = sum(-(-len(o.loads) // 700) for o in observations)

    def added(beside: Workspace, *effects: ActiveEffect) -> float:
        """How often the dots' places were simulated, in pieces; the means are those of a new workspace."""
        fallen.clear()
        got = beside.simulate(effects)
        count = len(fallen)
        assert all(map(np.array_equal, got, Workspace(beside.observations).simulate(effects)))
        return count / pieces

    creep = make_active('creep', {'amplitude': 0.1}, 'test')
    lag = make_active('amplifier_lag', {'time_constant': 1e-3}, 'test')
    rotated = [make_active('sensor_rotation', {'psd': 2, 'angle': angle}, 'test') for angle in (0.01, 0.02)]
    first = ActiveEffect(of_setup('zero'), {**{p.name: p.nominal for p in of_setup('zero').parameters}, 'x1': 1e-3})
    assert [added(workspace, *given) for given in ((), (), (rotated[0],), (rotated[1],))] == [1.0, 1.0, 0.0, 0.0]
    assert added(workspace, lag) == 2.0  # At two phases between the samples, and not at them.
    assert [added(workspace, *given) for given in ((creep,), (rotated[0],))] == [1.0, 0.0]
    assert [added(workspace, creep, *given) for given in ((rotated[0],), (rotated[1],), ())] == [1.0, 0.0, 0.0]
    # The zero is of the first recording.
    assert [added(workspace, *given) for given in ((), (first,), (first,), (rotated[0],))] == [1.0, 1.0, 0.5, 0.5]
    early = make_active('channel_skew', {'psd': 1, 'delay': -3e-3}, 'test')
    assert [added(workspace, *given) > 0.0 for given in ((), (early,), ())] == [True, True, False]
    heavier = workspace.loaded(0, 2.0 * observations[0].loads)
    assert [added(heavier), added(workspace)] == [0.5, 0.0]
    monkeypatch.setattr(comparing, 'MOST_KEPT', sum(len(o.loads) for o in observations) - 1)
    long = Workspace(observations)
    assert [added(long), added(long), added(long)] == [1.0, 1.0, 1.0]


def test_an_effect_of_one_recording_acts_in_that_alone() -> None:
    everywhere = make_active('creep', {'amplitude': 0.1}, 'test')
    first, second = (ActiveEffect(of_setup('zero'), {'recording': n}) for n in (1.0, 2.0))
    assert only_in([everywhere, first, second], 0) == [everywhere, first]
    assert only_in([everywhere, first, second], 1) == [everywhere, second]


def test_a_mistake_is_reported_with_its_line(workspace: Workspace) -> None:
    def words(name: str, **values: float) -> tuple[Any, dict[str, object]]:
        fit = cast(Fit, SimpleNamespace(effects=(None, ActiveEffect(of_setup(name), values))))
        (finding,), lines = finding_of_effect(workspace, fit, 1, 33.0)
        assert (finding.name, finding.evidence) == (name, 33.0)
        return finding, lines

    finding, lines = words('link_length', error=0.02)
    assert (finding.where, finding.value, finding.fix) == ('link.length', 1.02, 'link.length: 0.5967')
    assert lines == {'link.length': 0.5967}
    finding, lines = words('sample_rate', error=-0.2)
    assert (finding.where, finding.value) == ('converter.sample_rate_hz', 0.8)
    assert lines == {'converter.sample_rate_hz': 800.0}
    fit = cast(Fit, SimpleNamespace(effects=(ActiveEffect(of_setup('sensitivity'), {'error': 0.5}),)))
    for several in (workspace, Workspace(workspace.observations[:1])):
        _, lines = finding_of_effect(several, fit, 0, 33.0)
        assert lines == {'amplifier.sensitivity': 1.5 * RIG.amplifier.sensitivity}
    for late, word in ((0.04, 'late: subtract 0.04 s from them'), (-0.04, 'early: add 0.04 s to them')):
        finding, lines = words('load_delay', late_by=late)
        assert (finding.where, finding.value, lines) == ('load_fx load_fy load_tz', late, {})
        assert finding.fix == f'the recorded load times are 0.04 s {word}'
    finding, lines = words('jump', recording=2.0, psd=1.0, time_us=2_500_000.0, jump_x=3e-6, jump_y=-4e-6)
    assert (finding.where, finding.value, lines) == ('psd_1', 2.5, {})
    assert finding.fix.startswith('PSD 1 of second jumps by 3 µm along x and -4 µm along y')
    finding, lines = words('zero', recording=2.0, x1=1e-4, y1=-2e-4, x2=0.0, y2=5e-5)
    assert (finding.where, finding.value, lines) == ('second', 2e-4, {})
    assert finding.fix == 'overrides of second: psd_1.zero: [0.0001, -0.0002], psd_2.zero: [0.0, 5e-05]'


def test_delays_and_jumps_are_looked_for_where_they_show() -> None:
    """The shift at which the readings follow the loads best, and its neighbours; the step that gains most."""
    o = make_observation(history=np.repeat(np.random.default_rng(3).uniform(-20, 20, (12, 3)), 400, axis=0), warm=None)
    for shift in (40, -40):
        late = Workspace([dataclasses.replace(o, loads=np.roll(o.loads, shift, axis=0))])
        assert likely_delays(late) == pytest.approx(sorted(s / 1000.0 + shift / 1000.0 for s in (-4, 0, 4)))
    # Late by one fine block: no delay at all is looked for anyway.
    late = Workspace([dataclasses.replace(o, loads=np.roll(o.loads, 4, axis=0))])
    assert likely_delays(late) == pytest.approx([0.004, 0.008])
    # Late or early by half of one, or by one sample: found from there or from the next.
    for shift in (2, -2, 1, -1):
        late = Workspace([dataclasses.replace(o, loads=np.roll(o.loads, shift, axis=0))])
        assert min(abs(delay - shift / 1000.0) for delay in likely_delays(late)) < 0.0025
    # The last loads of a recording may be noted after its end: it is compared without them.
    for shift, excluded in ((40, 45), (-1, 0)):
        late = compared(Recorded((dataclasses.replace(o, loads=np.roll(o.loads, shift, axis=0)),), RIG, ()))[1]
        assert np.isnan(late.observations[0].volts[:, 0]).sum() == excluded
    # The link follows its loads as simulated: nothing is late.
    assert (likely_delays(Workspace([o])), likely_delays(Workspace([make_observation()]))) == ([], [])
    part = 0.01 * np.random.default_rng(0).standard_normal((6, 300))
    part[4, 120:] += 2.0
    part[3, 120:] -= 1.0
    # Of the same step 49 fine blocks tell nothing.
    fake = cast(Workspace, SimpleNamespace(split=lambda r: [r, r[:, 96:145]], fine=[4, 4], observations=[o, o]))
    # n1 n2/n (2^2 + 1^2) = 360: beyond 50.
    for size in (1.0, 0.4):
        ((recording, psd, time),) = likely_jumps(fake, size * part)
        assert (recording, psd) == (1, 2)
        assert time == pytest.approx(0.48)
    assert likely_jumps(fake, 0.35 * part) == []


def declared(*parameters: EffectParameter, **given: Any) -> Effect:
    full = {'name': 'made_up', 'stage': 'psd', 'point': 'dots', 'apply': lambda *_: None}
    return Effect(summary='', equation='', source='', needs='', parameters=parameters, **{**full, **given})


def listed(effect: Effect, **columns: list[float]) -> list[Candidate]:
    """Its candidates."""
    return list(candidates([effect], Physics.of(RIG), columns))


def test_a_candidate_has_its_choices_and_shapes_fixed() -> None:
    choice = EffectParameter('way', '', 0, 1, 1, '', kind='choice', choices=(0, 1))
    size = EffectParameter('size', 'V', -1.0, 1.0, 0.1, '', nominal=0.5)
    shape = EffectParameter('f', 'Hz', 1.0, 60.0, 1.0, '', nominal=5.0, kind='shape', grid=(2.0, 50.0, 70.0))
    got = listed(declared(choice, size, shape))
    assert [(c.start['way'], c.start['f'], c.start['size'], c.free) for c in got] == [
        (way, f, 0.5, ('size',)) for way in (0.0, 1.0) for f in (2.0, 50.0)
    ]
    assert [c.variant for c in got] == [('made_up', way) for way in (0.0, 0.0, 1.0, 1.0)]
    assert (len({c.key for c in got}), [c.off['size'] for c in got]) == (4, [0.5] * 4)
    # Peaks of the residual's spectrum besides the grid; lines instead of it.
    ways: tuple[tuple[Proposal, list[float]], ...] = (('spectral', [7.0, 2.0, 50.0]), ('line', [9.0]))
    for propose, wanted in ways:
        named = dataclasses.replace(shape, propose=propose)
        got = listed(declared(size, named), spectral=[7.0, 61.0], line=[9.0])
        assert [c.start['f'] for c in got] == wanted
    # What a small dose does not show is probed at the values to try.
    probed = EffectParameter('limit', 'V', 0.0, 1.0, 0.1, '', grid=(0.2, 0.4))
    got = listed(declared(probed, finite=True))
    assert [(c.start['limit'], c.free, c.one_sided) for c in got] == [(0.2, ('limit',), True), (0.4, ('limit',), True)]
    got = listed(declared(dataclasses.replace(probed, propose='highest'), finite=True), highest=[0.9])
    assert [c.start['limit'] for c in got] == [0.9]
    for least, nominal, one_sided in ((0.0, 0.0, True), (-1.0, 0.0, False), (0.5, 0.5, True), (0.4, 0.5, False)):
        (only,) = listed(declared(dataclasses.replace(size, minimum=least, nominal=nominal)))
        assert only.one_sided == one_sided
    two = listed(declared(size, dataclasses.replace(size, name='other', minimum=0.0, nominal=0.0)))
    assert [c.one_sided for c in two] == [False]


def test_coefficients_of_a_finite_effect_scale_its_probe() -> None:
    for power, want in ((1, 0.2 * 9.0), (2, 0.2 * 3.0), (0, 0.2)):
        probed = EffectParameter('radius', 'm', 0.0, 9.0, 0.1, '', grid=(0.2,), power=power)
        (c,) = listed(declared(probed, finite=True))
        assert c.from_coefficients(np.array([9.0])).values['radius'] == pytest.approx(want)
        # A negative coefficient is a very small one.
        least = c.from_coefficients(np.array([-1.0])).values['radius']
        assert least == pytest.approx(0.2 * 1e-4 ** (1.0 / power) if power else 0.2)


class Linear:
    """Stands for a workspace: what it simulates is ``of`` the last effect's values."""

    def __init__(self, of: Any) -> None:
        self.of, self.asked = of, 0

    def simulate(self, effects: list[ActiveEffect]) -> list[FloatArray]:
        self.asked += 1
        return [np.full((6, 2), float(sum(self.of(a.values) for a in effects)))]


def test_a_signature_is_the_change_by_one_probe() -> None:
    size = EffectParameter('a', 'V', -1.0, 1.0, 0.1, '', nominal=0.3)
    phase = EffectParameter('p', 'rad', -7.0, 7.0, 1.0, '', kind='phase', partner='a')
    (c,) = listed(declared(size, phase, EffectParameter('q', 'm', -1.0, 1.0, 0.25, '', kind='coupled')))
    plant = Linear(lambda v: 100.0 * v['a'] + 1000.0 * v['p'] + v['a'] * (7.0 * v['q'] + 3.0))
    base = [ActiveEffect(c.effect, {'a': 1.0, 'p': 0.0, 'q': 0.0})]
    nominal = [np.full((6, 2), 103.0 + 30.9)]
    first, second, third = signature_columns(c, cast(Workspace, plant), nominal, base)
    # One probe more of a; a probe of it at a quarter turn; beside a probe of a one of q.
    assert first[0][0, 0] == pytest.approx(103.0 * 0.1)
    assert second[0][0, 0] == pytest.approx(103.0 * 0.1 + 1000.0 * math.pi / 2 - 30.9)
    assert third[0][0, 0] == pytest.approx(0.4 * 7.0 * 0.25)
    assert plant.asked == 4
    # At its greatest value it is probed downward.
    (c,) = listed(declared(dataclasses.replace(size, nominal=1.0)))
    ((column,),) = signature_columns(c, cast(Workspace, Linear(lambda v: v['a'] ** 2)), [np.full((6, 2), 1.0)], [])
    assert column[0, 0] == pytest.approx(1.0 - 0.9**2)
    (c,) = listed(declared(EffectParameter('limit', 'V', 0.0, 1.0, 0.1, '', grid=(0.2,)), finite=True))
    ((column,),) = signature_columns(
        c, cast(Workspace, Linear(lambda v: 5.0 * v['limit'])), [np.full((6, 2), 0.25)], []
    )
    assert column[0, 0] == pytest.approx(0.75)


def test_lines_come_strongest_first_each_once() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(4096) * 1e-3
    rows = [rng.standard_normal((4096, 6)) for _ in range(2)]
    sines = ((33.3, 0.9, 0), (71.7, 1.5, 3), (120.1, 0.75, 2), (200.2, 0.62, 1))
    for f, size, c in sines:
        rows[0][:, c] += size * np.sin(2 * np.pi * f * t)
    rows[1][:, 4] += 3.0 * np.sin(2 * np.pi * 71.75 * t)
    rows[1][:, 5] += 9.0 * np.sin(2 * np.pi * 1.5 * t)
    got = proposals.spectral_peaks(rows, [np.ones(6)] * 2, [1e-3] * 2)
    # That of 71.75 Hz in the other recording is the same; below 2 Hz is motion; three are enough.
    assert got == pytest.approx([71.75, 33.3, 120.1], abs=0.01)
    assert proposals.spectral_peaks(rows, [np.ones(6)] * 2, [1e-3] * 2, 4)[-1] == pytest.approx(200.2, abs=0.02)
    assert proposals.spectral_peaks([r[:255] for r in rows], [np.ones(6)] * 2, [1e-3] * 2) == []
    assert proposals.spectral_peaks(rows, [np.full(6, 1e6)] * 2, [1e-3] * 2) == pytest.approx(got, abs=1e-4)
    # By the noise of its channel: a line in a channel ten times as noisy is ten times as weak.
    scaled = np.ones(6)
    scaled[3] = 10.0
    assert proposals.spectral_peaks(rows[:1], [scaled], [1e-3])[0] == pytest.approx(33.3, abs=0.01)
    assert proposals.persistent([71.7, 33.3], rows[:1], [np.ones(6)], [1e-3]) == [71.7, 33.3]
    # A line of half the recording, or one that turns its phase halfway, is no hum.
    faded, rotated = rng.standard_normal((4096, 6)), rng.standard_normal((4096, 6))
    sine = np.sin(2 * np.pi * 50.0 * t)
    faded[:, 0] += 2.0 * sine * np.repeat([1.0, 1.0, 1.0, 0.3], 1024)
    rotated[:, 0] += 2.0 * sine * np.repeat([1.0, 1.0, 1.0, -1.0], 1024)
    for rows_of in (faded, rotated):
        assert proposals.persistent([50.0], [rows_of], [np.ones(6)], [1e-3]) == []
        assert proposals.persistent([50.0], [rows_of[:3072]], [np.ones(6)], [1e-3]) == [50.0]


@pytest.mark.parametrize(('counts', 'observed'), [(1, False), (2, False), (3, True), (10.3, True), (40, True)])
def test_a_step_is_coarse_from_three_counts_on(counts: float, observed: bool) -> None:
    """All readings are whole multiples of it; its deviation is that of rounding to counts, 1/sqrt(12)."""
    lsb = RIG.converter.volts_per_count
    rng = np.random.default_rng(2)
    k = np.rint(rng.uniform(-300, 300, (2000, 6)))
    volts = np.rint(k * counts) * lsb
    o = dataclasses.replace(make_observation(), volts=volts, loads=np.zeros((2000, 3)), temperature=None)
    coarse = proposals.coarse_step(o)
    assert (coarse is not None) == observed
    if coarse is not None:
        values = np.unique(k)
        assert coarse[0] == pytest.approx(float(values @ np.rint(values * counts) / (values @ values)) * lsb, rel=1e-9)
        assert coarse[1] == pytest.approx(lsb / math.sqrt(12.0 * float(values @ values)), rel=1e-9)
        # The readings are put on it; if the rig file states steps, it is no news.
        for known in ((), (make_active('quantisation', {'step': 0.5}, 'test'),)):
            ready = snapped(Recorded((o,), RIG, known))
            assert (ready.stated, ready.known, ready.value_grid_stated) == (known, (), bool(known))
            assert ready.value_grid is not None
            assert ready.value_grid.values['step'] == (0.5 if known else coarse[0])
            np.testing.assert_allclose(ready.observations[0].volts, k * coarse[0], rtol=1e-9)
    # Readings between the steps, and there are none; few values prove nothing.
    off = o.volts.copy()
    off[::50] += 0.31 * counts * lsb
    assert counts < 40 or proposals.coarse_step(dataclasses.replace(o, volts=off)) is None
    assert proposals.coarse_step(dataclasses.replace(o, volts=np.sign(o.volts) * counts * lsb)) is None


def test_the_best_of_each_variant_is_tried() -> None:
    def score(name: str, gain: float, dof: int = 1) -> Any:
        return SimpleNamespace(gain=gain, dof=dof, candidate=SimpleNamespace(variant=(name,)))

    gains = (100.0, 90.0, 60.0, 55.0, 29.0, 31.0)
    scores = [score(name, gain, 9 if name == 'b' else 1) for name, gain in zip('aabcde', gains, strict=True)]
    assert [s.candidate.variant[0] for s in promising(scores, 3.0, 0.3, 9)] == ['a', 'c', 'b', 'e']
    assert len(promising(scores, 3.0, 0.3, 2)) == 2
    assert (promising([score('a', 0.0)], 3.0, 0.0, 9), promising([], 3.0, 0.3, 9)) == ([], [])


def reported_of(alternative: str, separation: float, reverse: float, possible: float) -> Discrimination:
    return Discrimination(alternative, 'creep', separation, reverse, possible)


def test_a_plan_says_what_it_separates() -> None:
    piece, other = Piece('push', ('constant:0,-5,0:3',)), Piece('wait', ('constant:0,0,0:1', 'constant:0,0,0:2'))
    limits = Limits(seconds=30.0)
    warm = Setting('while it is warm', {'link.length': 0.4}, 5.0)
    rows = ('damping', 30.0, 40.0, 50.0), ('tip_mass', 90.0, 22.0, 99.0), ('x', 1.0, 2.0, 21.5)
    reports = tuple(reported_of(*row) for row in rows)
    plan = Plan(warm, (piece, piece, other), reports, limits, 500.0)
    assert (plan.words, plan.seconds) == ('push, 2 times; then wait, while it is warm', 9.0)
    assert plan.loads[:1500].tolist() == plan.loads[1500:3000].tolist() == [[0.0, -5.0, 0.0]] * 1500
    assert plan.script == ['constant:0,-5,0:3', 'constant:0,-5,0:3', 'constant:0,0,0:1', 'constant:0,0,0:2']
    assert plan.useful
    assert plan.sentence == (
        'Record next, 9 s: push, 2 times; then wait, while it is warm. It tells creep from damping, tip_mass '
        '(chi-square 40 at least, 21.6 needed); nothing within the limits tells x apart.'
    )
    assert dataclasses.replace(plan, discriminations=reports[:1]).sentence.endswith(
        'from damping (chi-square 40 at least, 21.6 needed).'
    )
    idle = dataclasses.replace(
        plan, setting=Setting(), discriminations=(reports[2], dataclasses.replace(reports[2], alternative='y'))
    )
    assert not idle.useful
    assert idle.words == 'push, 2 times; then wait'
    assert idle.sentence == 'No recording within the limits would tell creep from x, y.'
    tree = plan.tree()
    assert tree['celsius'] == warm.knots
    assert idle.tree()['celsius'] is None
    assert (tree['seconds'], tree['sample_rate_hz'], tree['overrides']) == (9.0, 500.0, {'link.length': 0.4})
    names = ('name', 'instead_of', 'separation', 'reverse', 'possible', 'separable')
    assert tree['rivals'][1] == dict(zip(names, ('tip_mass', 'creep', 90.0, 22.0, 99.0, True), strict=True))
    assert (tree['useful'], tree['loads'], tree['limits']['seconds']) == (True, plan.script, 30.0)
    assert [reported_of('x', 0.0, 0.0, p).separable for p in (21.5, 21.6)] == [False, True]
    assert Suggestion('do', 21.7).text == 'do: in simulation this separates them by 4.7 standard deviations'
    assert planning.rate_of(RIG, Setting('', {'converter.sample_rate_hz': 250.0})) == 250.0
    assert planning.rate_of(RIG, Setting()) == 1000.0


def test_pieces_are_put_together_as_long_as_each_is_worth_it() -> None:
    """A minute costs 0.02; a further piece must add 0.02; beyond a chi-square of 60 there is nothing more to gain."""

    def shows(gain: float, seconds: float) -> ModelSums:
        return ModelSums(np.array([[gain]]), [], [], seconds)

    observed = [(Piece(n, ()), shows(g, s)) for n, g, s in (('a', 30.0, 10.0), ('b', 25.0, 1.0), ('c', 1.0, 1.0))]

    def together(seconds: float) -> Any:
        value, chosen = planning.best_combination(observed, shows(0.0, 0.0), lambda s: s.apart[0], seconds)
        return value, ''.join(p.words for p in chosen)

    # 30/60 - 0.02/6 against 25/60 - 0.02/60; then the same again; then nothing is left to gain.
    assert together(60.0) == (pytest.approx(1.0 - 0.02 * 20.0 / 60.0), 'aa')
    assert together(11.0) == (pytest.approx(55.0 / 60.0 - 0.02 * 11.0 / 60.0), 'ab')
    assert together(10.9)[1] == 'a'
    assert together(1.0) == (pytest.approx(24.98 / 60.0), 'b')
    assert together(0.5) == (0.0, '')
    # One piece is there in any case, even if it is worth nothing.
    poor = [(Piece('c', ()), shows(0.0, 1.0))]
    assert len(planning.best_combination(poor, shows(0.0, 0.0), lambda s: s.apart[0], 9.0)[1]) == 1


def micrometres(value: float) -> str:
    return f'{1e6 * value:.3g} µm'


def left_with(**given: Any) -> Localisation:
    full = {'cells': (), 'dependences': (), 'excess': 100.0, 'p': 0.0, 'map': np.zeros((1, 6, 6)), 'spans': ()}
    return Localisation(**{**full, **given})


def test_what_remains_is_reported_in_words() -> None:
    cells = (
        Cell('y2', 0, (1.0, 2.5), (9.0, 17.0), (), 9.0, 0.009, 50.0),
        Cell('x1', 0, (0.0, 1.0), (0.0, 2.0), (), 5.0, 0.011, 20.0),
    )
    depends = tuple(
        Dependence('x2', name, gain, p) for name, gain, p in (('load_fx', 60.0, 1e-9), ('dot_x', 50.0, 1.1e-3))
    )
    (u,) = unknown_of(left_with(cells=cells, dependences=depends), 300.0, 5e-6, 3e-6, worded=micrometres)
    assert u.signature == (
        'on y2, x2; 4 µm rms (1.7 times the noise remain); follows load_fx; mostly odd; '
        'strongest at 1.0 to 2.5 s, 9 to 17 Hz'
    )
    assert (u.rms, u.explains) == pytest.approx((4e-6, 0.25))
    many = tuple(Dependence('x2', f'load_{i}', 10.0, 1e-9) for i in range(9))
    (u,) = unknown_of(left_with(dependences=many), 0.0)
    assert u.depends_on == tuple(f'load_{i}' for i in range(6))
    assert 'follows load_0, load_1, load_2;' in u.signature
    for second, lagging in ((1, True), (2, False)):
        depends = tuple(
            Dependence('x2', 'history of load_fx' if i == second else 'dot_x', 10.0, 1e-9) for i in range(3)
        )
        assert ('hysteretic' in unknown_of(left_with(dependences=depends), 0.0)[0].signature) == lagging
    # Twice as much of one kind is most of it.
    both = dict.fromkeys((20.0, 19.9, 5.1, 5.0), 'odd and even parts')
    for even, word in {20.1: 'mostly even', **both, 4.9: 'mostly odd'}.items():
        depends = (Dependence('x2', 'dot_x^2', even, 1e-9), Dependence('x2', 'dot_x', 10.0, 1e-9))
        assert word in unknown_of(left_with(dependences=depends), 0.0)[0].signature
    # What coarse steps do varies with the signal: a fiftieth of what they explain is nothing else.
    assert unknown_of(left_with(excess=99.0), 0.0, steps=5000.0) == ()
    assert unknown_of(left_with(excess=101.0), 0.0, steps=5000.0) != ()


def test_a_gap_that_remains_is_never_left_unreported() -> None:
    noise = cast(Workspace, SimpleNamespace(floor=lambda: 1e-6, worded=micrometres))
    assert weighing.unnamed_gap(noise, 9e-6, 1.5e-6) == ()
    (u,) = weighing.unnamed_gap(noise, 3e-6, 1.6e-6)
    assert u.signature == '1.25 µm remain, 1.6 times the noise, in no single place or band'
    assert (u.rms, u.explains) == pytest.approx((math.sqrt(1.56) * 1e-6, (1.6 / 3) ** 2))
    assert u.unexplained


def named_effect(active: ActiveEffect, **given: Any) -> NamedEffect:
    full = {'sd': {}, 'p': 1e-9, 'delta_bic': 50.0, 'heldout': HeldOut(20.0, 2.0), 'equivalent': ()}
    return NamedEffect(active, **{**full, 'fitted_alternatives': (), 'alternatives': (), 'suggestion': None, **given})


def test_numbers_of_json_are_finite() -> None:
    assert [trees.number(v) for v in (math.nan, math.inf, -math.inf, 1.5)] == [0.0, 1e300, -1e300, 1.5]
    active = make_active('damping', {'bending_ratio': 0.03}, 't')
    tree = trees.parameters_of(named_effect(active, sd={'bending_ratio': math.inf}))
    assert tree == {'bending_ratio': {'value': 0.03, 'sd': 1e300, 'unit': ''}}
    rotated = named_effect(make_active('sensor_rotation', {'psd': 2, 'angle': 0.1}, 't'))
    assert trees.parameters_of(rotated) == {'psd': 2, 'angle': {'value': 0.1, 'sd': 0.0, 'unit': 'rad'}}
    assert nested({'a.b': (1, 2), 'a.c.d': 'x', 'e': 3}) == {'a': {'b': [1, 2], 'c': {'d': 'x'}}, 'e': 3}


FEW = ('sensor_rotation', 'sensor_gain', 'bending_stiffness')
HIDDEN = {'psd': 2, 'angle': 0.03}


@pytest.fixture(scope='module')
def study() -> Discovery:
    """A turned sensor in 1.2 s, looked for among three effects."""
    o = make_observation(9, (make_active('sensor_rotation', HIDDEN, 'test'),))
    return discover([o], RIG, without=[name for name in EVERY if name not in FEW])


def test_every_number_of_the_answer_is_that_of_its_model(study: Discovery) -> None:
    """Gaps from simulations made here: rms of block means of 20 samples over the four dots, m."""
    (named,) = study.effects
    assert named.active.effect.name == 'sensor_rotation'
    assert abs(named.active.values['angle'] - 0.03) < 4.0 * named.sd['angle']
    (o,) = study.workspace.observations

    def gaps(*effects: ActiveEffect) -> FloatArray:
        off = o.volts - ForwardModel(RIG, list(effects)).expect(o.loads, o.temperature).volts.T
        dots = off[:, [0, 1, 3, 4]] * RIG.sensitivities.ravel()
        return np.asarray(np.sqrt(np.mean(dots.reshape(60, 20, 4).mean(axis=1) ** 2, axis=0)))

    before, after = gaps(), gaps(named.active)
    assert study.gap_before == study.gap_heldout_before == pytest.approx(float(np.sqrt(np.mean(before**2))), rel=1e-6)
    assert study.gap_after == pytest.approx(float(np.sqrt(np.mean(after**2))), rel=1e-6)
    for i, name in enumerate(('x1', 'y1', 'x2', 'y2')):
        assert study.per_channel[name] == pytest.approx((before[i], after[i]), rel=1e-6)
    floor = float(
        np.sqrt(np.mean((study.workspace.noise[0].sigma[[0, 1, 3, 4]] * RIG.sensitivities.ravel()) ** 2 / 20.0))
    )
    assert study.gap_floor == pytest.approx(floor, rel=1e-6)
    assert study.floors == pytest.approx(study.gap_after / floor)
    assert study.gap_heldout_after == pytest.approx(study.gap_after, rel=0.1)
    assert study.gap_heldout_after > study.gap_after
    assert study.waterfall == (
        ('as described', study.gap_before),
        ('+ sensor_rotation', study.gap_after),
        ('noise alone', study.gap_floor),
    )
    assert (study.verdict, study.unknown, study.setup, study.law, study.values) == ('effects_found', (), (), None, {})
    assert (study.seed, study.known, study.alternative_fits, study.unsettled) == (0, (), (), ())
    assert study.active_effects == [named.active]
    h = 1e-4
    plus = ActiveEffect(named.active.effect, {**named.active.values, 'angle': named.active.values['angle'] + h})
    slope = (
        ForwardModel(RIG, [plus]).expect(o.loads, o.temperature).volts
        - ForwardModel(RIG, [named.active]).expect(o.loads, o.temperature).volts
    ) / h
    information = float(((slope / study.workspace.noise[0].sigma[:, None]) ** 2).sum())
    assert named.sd['angle'] == pytest.approx(information**-0.5, rel=0.01)
    gain = study.search.null.chi2 - study.fit.chi2
    assert named.delta_bic == pytest.approx(gain - math.log(6 * 1200 / 20), rel=1e-9)
    assert named.heldout.gain == pytest.approx(0.5 * gain, rel=0.05)
    assert named.p == 0.0 or named.p < 1e-12
    assert repr(study) == (
        f'<Discovery effects_found: sensor_rotation (psd 2); gap {1e6 * study.gap_before:.3g} µm → '
        f'{1e6 * study.gap_after:.3g} µm (noise alone: {1e6 * study.gap_floor:.3g} µm)>'
    )
    assert {c.channel for c in study.where.cells[:2]} <= {'x2', 'y2'}
    # Reading the answer costs simulations too.
    assert 0 < study.simulations <= study.workspace.simulations


def test_the_answer_is_written_as_it_is(study: Discovery) -> None:
    tree = study.tree()
    (named,) = study.effects
    assert tree['gap'] == {
        'unit': 'm',
        'before': study.gap_before,
        'after': study.gap_after,
        'floor': study.gap_floor,
        'heldout_before': study.gap_heldout_before,
        'heldout_after': study.gap_heldout_after,
        'per_channel': {
            k: {'before': a, 'after': b, 'heldout': study.heldout_per_channel[k]}
            for k, (a, b) in study.per_channel.items()
        },
    }
    assert tree['remaining'] == {'rms': study.gap_after, 'floors': study.floors}
    (effect,) = tree['effects']
    assert (effect['name'], effect['stage']) == ('sensor_rotation', 'psd')
    assert effect['evidence'] == {
        'delta_bic': named.delta_bic,
        'p': named.p,
        'heldout_gain': named.heldout.gain,
        'heldout_gain_error': named.heldout.error,
    }
    assert (effect['suggested_experiment'], effect['rivals'], effect['equivalent']) == (None, [], [])
    cells = [c for c in study.where.cells if c.p < 0.05]
    assert [(w['channel'], w['recording'], w['when'], w['band_hz']) for w in tree['where']] == [
        (c.channel, 'seen', list(c.when), list(c.band)) for c in cells
    ]
    assert [w['statistic'] for w in tree['where']] == [c.statistic for c in cells]
    assert [w['depends_on'] for w in tree['where']] == [list(c.depends_on) for c in cells]
    source = tree['provenance']
    assert (source['version'], source['seed'], source['forward_simulations']) == (__version__, 0, study.simulations)
    (o,) = study.workspace.observations
    (recording,) = source['recordings']
    assert recording['sha256'] == o.hashed()
    assert recording['seconds'] == pytest.approx(1.2)
    assert (recording['noise_v'], recording['coloured']) == (study.workspace.noise[0].sigma.tolist(), [False] * 6)
    before, after = 1e6 * study.gap_before, 1e6 * study.gap_after
    size = trees.size_of(named)
    dx, dy, theta = (1e6 * v for v in study.moves)
    off = f'ΔX {dx:.3g} µm, ΔY {dy:.3g} µm, θ {theta:.3g} µrad'
    assert study.sentence == (
        f'sensor_rotation (psd 2) is missing from the model; adding it closes the gap from {before:.3f} to {after:.3f} '
        f'µm, {study.floors:.2f} times the noise floor ({1e6 * study.gap_floor:.3f} µm). '
        f'Fitted: sensor_rotation {size}. Without it an estimate is wrong by up to {off}.'
    )


def named_as(name: str, **values: float) -> NamedEffect:
    return NamedEffect(make_active(name, values, 'test'), {}, 0.0, 100.0, HeldOut(1.0, 0.1), (), (), (), None)


def test_an_estimate_is_called_wrong_only_for_what_is_corrected(study: Discovery) -> None:
    rotated, lag = study.effects[0], named_as('amplifier_lag', time_constant=1e-4)
    soft = named_as('bending_stiffness', scale=-0.02)
    right = 'The estimates of the pose are right without; the simulated motion, and with it the wrench, is not.'
    not_corrected = 'An estimate is not corrected for amplifier_lag.'
    wrong = 'Without them an estimate is wrong by up to ΔX 1 µm, θ 2 µrad.'

    def description_of(*effects: NamedEffect, moves: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> str:
        return dataclasses.replace(study, effects=effects, moves=moves).sentences()[-1]

    assert (description_of(soft, moves=(1e-10, 1e-10, 9.9e-10)), description_of(lag)) == (right, not_corrected)
    assert (description_of(soft, lag), description_of(rotated, soft, moves=(1e-6, 0.0, 2e-6))) == (not_corrected, wrong)
    assert description_of(rotated, lag, lag, moves=(1e-6, 0.0, 2e-6)) == f'{wrong} {not_corrected}'


def test_wrong_notes_that_do_the_same_are_named(study: Discovery) -> None:
    soft, twists = (named_as(f'{way}_stiffness', scale=-0.2, moves_frequency=0.0) for way in ('bending', 'torsional'))
    same = 'times the noted ones would do the same: check'
    for effects, words in (
        ([soft], f'Forces 1.25 {same} the scale.'),
        ([twists], f'Torques 1.25 {same} the arm.'),
        ([soft, twists], f'Forces 1.25 times the noted ones and torques 1.25 {same} the scale and the arm.'),
        ([named_as('bending_stiffness', scale=-0.2, moves_frequency=1.0)], ''),
        ([soft, study.effects[0]], ''),
    ):
        sentences = dataclasses.replace(study, effects=tuple(effects)).sentences()
        assert [s for s in sentences if same in s] == ([words] if words else [])


def test_places_are_reported_if_one_in_twenty_by_chance(study: Discovery) -> None:
    first = study.where.cells[0]
    cells = tuple(dataclasses.replace(first, p=p) for p in (0.0, 0.0499, 0.05, 1.0))
    changed = dataclasses.replace(study, where=dataclasses.replace(study.where, cells=cells))
    assert [place['p'] for place in changed.tree()['where']] == [0.0, 0.0499]
    assert study.tree()['moves'] == dict(zip(('dx_m', 'dy_m', 'theta_rad'), study.moves, strict=True))


def test_the_law_is_written_with_the_first_unknown(study: Discovery) -> None:
    law = Law('law_y2', 'psd', 'y2', (LawTerm('product', ('load_fx',), 1e-6),))
    other = Law('law_beam_y2', 'optics', 'beam_y2', law.terms)
    further = Law('law_x1', 'psd', 'x1', law.terms)
    fits = dataclasses.replace(study.fit, effects=study.fit.effects * 3), study.fit
    of_law = FoundLaw(law, (further,), *fits, ('y2',), (other,), 1e-9, 30.0, HeldOut(9.0, 2.0), 3e-7)
    unknown = (Unknown('first', ('load_fx',), 0.75, rms=2e-6), Unknown('second', (), 0.5))
    first, second = dataclasses.replace(study, unknown=unknown, law=of_law).tree()['unknown']
    assert second == {'signature': 'second', 'depends_on': [], 'explains': 0.5, 'rms': 0.0, 'law': None}
    written = first.pop('law')
    assert first == {'signature': 'first', 'depends_on': ['load_fx'], 'explains': 0.75, 'rms': 2e-6}
    head = {'stage': 'psd', 'acts_on': 'y2', 'channels': ['y2'], 'variables': ['load_fx'], 'kind': law.kind}
    assert written == head | {
        'expression': law.expression,
        'further': [further.expression],
        'heldout_after': 3e-7,
        'beside': [a.label for a in study.fit.effects],
        'equivalent': [
            {'stage': 'optics', 'acts_on': 'beam_y2', 'variables': ['load_fx'], 'expression': other.expression}
        ],
        'evidence': {'delta_bic': 30.0, 'p': 1e-9, 'heldout_gain': 9.0, 'heldout_gain_error': 2.0},
    }
    assert dataclasses.replace(study, unknown=unknown).tree()['unknown'][0]['law'] is None


def test_other_answers_have_other_sentences(study: Discovery) -> None:
    (named,) = study.effects
    floor = f'{1e6 * study.gap_floor:.3f} µm'
    after = f'{1e6 * study.gap_after:.3f} µm, {study.floors:.2f} times the noise floor ({floor})'
    before = f'{1e6 * study.gap_before:.3f}'

    def sentence(**given: Any) -> str:
        """Without what the effects do to an estimate."""
        return dataclasses.replace(study, **given).sentence.partition(' Without ')[0]

    assert sentence(verdict='nothing_missing', effects=()) == f'Nothing is missing: the gap is {after}.'
    # Without a stated noise nothing says that nothing is missing.
    remains = f'{1e6 * study.gap_after:.3f} µm remains and follows nothing, as noise does.'
    without = sentence(verdict='nothing_missing', effects=(), gap_floor=math.inf)
    message = 'Nothing is missing as far as these readings show'
    assert without == f'{message}: {remains} How exact the readings are is not stated.'
    assert sentence(verdict='unknown_effect', effects=(), unknown=(Unknown('', (), 1.0),)) == (
        f'An effect that is not in the catalogue: the gap is {after}.'
    )
    assert sentence(verdict='unknown_effect', unknown=(Unknown('', (), 0.5),)) == (
        'sensor_rotation (psd 2) explains part, but an unknown effect remains: '
        f'the gap goes from {before} µm to {after}. Fitted: sensor_rotation {trees.size_of(named)}.'
    )
    two = (named, dataclasses.replace(named, equivalent=('a', 'b'), sd={}))
    description_of_two = sentence(effects=two)
    assert description_of_two.startswith(
        'sensor_rotation (psd 2) and sensor_rotation (psd 2) (or a, b: this data cannot tell) are missing from the '
        f'model; adding them closes the gap from {before} to {after}.'
    )
    assert description_of_two.count('Fitted') == 1
    assert sentence(effects=two, verdict='unknown_effect', unknown=(Unknown('', (), 1.0, unexplained=False),)).endswith(
        f' close the gap from {before} to {after}, but their sizes are tied: '
        'one effect that is not in the catalogue is likelier.'
    )
    mirrored = Finding('channel_sign', 'y1', -1.0, 'y', 9.0, ('load_sign of fy',))
    setup = (Finding('channel_sign', 'y1', -1.0, 'x'), mirrored)
    assert sentence(verdict='nothing_missing', effects=(), setup=setup) == (
        'The set-up is not as the rig file or the recording says: channel sign (y1). '
        f'Nothing is missing besides: the gap is {after}.'
    )
    by_hand = Finding('load_time', 'load 1', -0.099, 'note it')
    assert (
        sentence(verdict='nothing_missing', effects=(), setup=(by_hand,)) == f'Nothing is missing: the gap is {after}.'
    )
    late = Finding('load_delay', 'load_fx load_fy load_tz', 0.4, 'subtract')
    assert sentence(setup=(late,)) == (
        'The set-up is not as the rig file or the recording says: load delay (0.4 s late). '
        'sensor_rotation (psd 2) is missing from the model besides; adding it and putting the set-up right together '
        f'close the gap from {before} to {after}. Fitted: sensor_rotation {trees.size_of(named)}.'
    )
    length = Finding('link_length', 'link.length', 1.02, 'link.length: 0.5967', 0.0, ('creep', 'sensitivity'))
    alike = dataclasses.replace(study, setup=(length,))
    assert 'recording says, or one effect is missing: link length (link.length; or creep, sens' in alike.sentence
    causes = '(or creep, sensitivity: this data cannot tell)'
    assert alike.lines()[1] == f'set-up: link_length link.length {causes}: link.length: 0.5967'
    assert '<td>creep, sensitivity</td>' in alike.files()['report.html']
    mistakes = dataclasses.replace(study, setup=(dataclasses.replace(length, equivalent=('sensitivity',)),)).sentence
    assert 'says: link length (link.length; or sensitivity: this data cannot tell). sensor_rotation' in mistakes
    unannotated = Finding('load_coverage', late.where, 0.5, 'note it')
    partly = {'verdict': 'unknown_effect', 'unknown': (Unknown('', (), 0.5),)}
    described = sentence(setup=(unannotated,), **partly)
    assert 'says: load coverage. sensor_rotation (psd 2) and the set-up put right explain part, but' in described
    assert dataclasses.replace(study, setup=(unannotated,)).lines()[1] == 'set-up: load_coverage: note it'
    tree = dataclasses.replace(study, setup=setup[:1], unknown=(Unknown('s', ('d',), 0.4, True, 2e-6),)).tree()
    assert tree['unknown'] == [{'signature': 's', 'depends_on': ['d'], 'explains': 0.4, 'rms': 2e-6, 'law': None}]
    assert tree['setup'] == [
        {'name': 'channel_sign', 'where': 'y1', 'value': -1.0, 'fix': 'x', 'evidence': 0.0, 'equivalent': []}
    ]
    alternative = Alternative(named.active, {'angle': 1e-3}, 4.0, study.fit)
    more = dataclasses.replace(study, effects=(dataclasses.replace(named, fitted_alternatives=(alternative,)),))
    parameters = {'psd': 2, 'angle': {'value': named.active.values['angle'], 'sd': 1e-3, 'unit': 'rad'}}
    listed = {'name': 'sensor_rotation', 'parameters': parameters, 'delta_bic': 4.0}
    assert more.tree()['effects'][0]['rivals'] == [listed]
