"""The way of a discovery, step by step, with a search that is given: what it asks, and what is made of its answer."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import numpy as np
import pytest

from psd_deflection.model.simulation.catalogue import catalogue, make_active
from psd_deflection.model.simulation.declaration import ActiveEffect
from psd_deflection.model.simulation.simulator import ForwardModel
from psd_deflection.rig.config import replace_values
from psd_deflection.studies.check.result import Finding
from psd_deflection.studies.discover import discover as answer
from psd_deflection.studies.discover.discover import Discovery, discover, pose_change
from psd_deflection.studies.discover.laws.laws import FoundLaw
from psd_deflection.studies.discover.observation import Observation
from psd_deflection.studies.discover.search import proposals, weighing
from psd_deflection.studies.discover.search.comparison import Comparison
from psd_deflection.studies.discover.search.fit import Fit, refit
from psd_deflection.studies.discover.search.hold_out import HeldOut
from psd_deflection.studies.discover.search.localise import Dependence, Localisation
from psd_deflection.studies.discover.search.screen import Screen
from psd_deflection.studies.discover.search.search import Search, SearchResult
from psd_deflection.studies.discover.search.signatures import SignatureBank
from psd_deflection.studies.discover.search.weighing import NamedEffect, Rival, Unknown
from psd_deflection.studies.discover.search.workspace import Workspace
from psd_deflection.studies.discover.setup.hidden import mistakes
from psd_deflection.studies.discover.setup.noise import NoiseModel
from psd_deflection.studies.discover.setup.setup import said

from .test_formulas import RIG, observed

ROTATION = make_active('sensor_rotation', {'psd': 2, 'angle': 0.03}, 'test')
LSB = RIG.converter.volts_per_count
NOWHERE = Localisation((), (), 0.0, 1.0, np.zeros((1, 6, 6)), ())
Screening = Callable[[Comparison, Fit | None], Screen]


def without(*names: str) -> list[str]:
    """The catalogue but these."""
    return [n for n in catalogue() if n not in names]


class Given:
    """Stands for the search: its answers are ``fits`` (name of each effect, chi-square), one for each search."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *fits: tuple[Sequence[str], float]) -> None:
        self.fits, self.bases = list(fits), list[tuple[ActiveEffect, ...]]()
        self.workspaces, self.screens = list[Workspace](), list[Screening]()
        self.noises = list[list[NoiseModel]]()
        self.steps = 0.0
        self.gap = 0.0
        given = self

        class Searching:
            penalty = 4.0

            def __init__(self, ws: Workspace, screen: Screening, progress: object) -> None:
                self.workspace, self.trace = ws, list[str]()
                given.workspaces.append(ws)
                given.screens.append(screen)

            def run(self) -> SimpleNamespace:
                ws = self.workspace
                given.bases.append(ws.base)
                ws.noise = list(ws.noise)
                given.noises.append(ws.noise)
                names, chi2 = given.fits.pop(0) if given.fits else ((), 0.0)
                effects = tuple(SimpleNamespace(effect=SimpleNamespace(name=n), label=n) for n in names)
                null = refit(ws, ())
                fit = dataclasses.replace(
                    null, effects=cast(Any, effects), chi2=chi2, free=tuple((i, 'x') for i in range(len(names)))
                )
                return SimpleNamespace(null=null, fit=fit, search=self)

        def credible(search: Any, result: Any, fit: Fit, heldout: Any, steps: float, look: weighing.Look) -> Any:
            given.steps = steps
            return fit, heldout, look(fit, result.null)

        monkeypatch.setattr(answer, 'Search', Searching)
        monkeypatch.setattr(answer, 'accept', lambda search, result, rng: ([], result.fit))
        monkeypatch.setattr(answer, 'credible', credible)
        monkeypatch.setattr(answer, '_answer', lambda *a: a)
        monkeypatch.setattr(answer, 'localise', lambda *a, **k: (a, k))


class Asked(NamedTuple):
    """What the answer is made of."""

    workspace: Workspace
    search: Any
    result: Any
    fit: Fit
    heldout: Any
    left: Any
    lattice: ActiveEffect | None
    rng: np.random.Generator
    seed: int
    progress: object
    checked: Any


def asked(*recordings: Observation, **given: Any) -> Asked:
    return Asked(*cast(Any, discover(recordings, given.pop('rig', None), **given)))


def stated(o: Observation, rate: float, rig_rate: float = 1000.0) -> Observation:
    rig = replace_values(o.rig, {'converter.sample_rate_hz': rig_rate})
    return dataclasses.replace(o, rig=rig, stated_rate_hz=rate)


TURNED = np.array([1.0, -1.0, 1.0, 1.0, 1.0, 1.0])


def test_the_lines_that_put_the_file_right_are_those_of_all_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    Given(monkeypatch)
    o = observed(warm=None)
    plain = asked(o, seed=7)
    assert (plain.checked.lines, plain.checked.findings, plain.checked.gap, plain.checked.known) == ({}, [], 0.0, ())
    assert (plain.lattice, plain.seed, plain.heldout) == (None, 7, [])
    assert plain.rng.standard_normal() == np.random.default_rng(7).standard_normal()
    assert plain.workspace.base == ()
    # All recordings have another rate than the file states, and the same one.
    rate = {'converter.sample_rate_hz': 1000.0}
    assert asked(stated(o, 500.0), o).checked.lines == rate
    assert asked(stated(o, 500.0), stated(o, 400.0)).checked.lines == rate
    two = asked(stated(o, 500.0), stated(o, 500.0, 800.0))
    assert two.checked.lines == {}
    assert [f.name for f in two.checked.findings] == ['sample_rate', 'sample_rate']
    wrong = dataclasses.replace(stated(o, 500.0), volts=o.volts * TURNED)
    got = asked(wrong).checked
    assert got.lines == {**rate, 'psd_1.axes': ['x', '-y']}
    # What was found of the recording comes first, then the wiring.
    assert [f.name for f in got.findings] == ['sample_rate', 'channel_sign']
    # The gap was that of the file's wiring: block means over 20 samples, m.
    simulated = ForwardModel(RIG, []).expect(o.loads, None).volts.T
    off = ((o.volts * TURNED - simulated)[:, [0, 1, 3, 4]] * RIG.sensitivities.ravel()).reshape(60, 20, 4)
    assert got.gap == pytest.approx(float(np.sqrt(np.mean(off.mean(axis=1) ** 2))), rel=1e-6)


def test_effects_of_the_rig_file_are_known(monkeypatch: pytest.MonkeyPatch) -> None:
    Given(monkeypatch)
    rig = replace_values(RIG, {'effects.e.name': 'creep', 'effects.e.amplitude': 0.1})
    o = dataclasses.replace(observed(warm=None), rig=rig)
    for got in (asked(o), asked(observed(warm=None), rig=rig)):
        assert [a.effect.name for a in got.checked.known] == ['creep']
        assert [a.effect.name for a in got.workspace.base] == ['creep']


def test_signatures_are_kept_for_recordings_as_they_were(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not if one was put right, began in motion, or has late loads."""
    Given(monkeypatch)
    o = observed(warm=None)
    loaded = dataclasses.replace(o, volts=o.volts[300:], loads=o.loads[300:])
    unknown = dataclasses.replace(o, unknown_load=(10, 0))
    for seen, delays, kept in (
        (o, [], True),
        (o, [-0.01], True),
        (o, [0.01, -0.01], False),
        (dataclasses.replace(o, volts=o.volts * TURNED), [], False),
        (loaded, [], False),
        (unknown, [], False),
        (dataclasses.replace(o, unknown_load=(0, 10)), [], True),
    ):
        monkeypatch.setattr(answer, 'likely_delays', lambda _, found=delays: found)
        bank = SignatureBank()
        got = asked(seen, bank=bank)
        assert (bank._nominal is not None) == kept
        # The last moments' loads are noted after the end: one sample more than the longest delay.
        ended = 11 if max(delays, default=0.0) > 0.0 else seen.unknown_load[1]
        cut = got.workspace.observations[0].volts
        first = seen.unknown_load[0]
        gone = np.flatnonzero(np.isnan(cut).all(axis=1)).tolist()
        assert gone == [*range(first), *range(len(cut) - ended, len(cut))]


def test_how_a_recording_began_is_adjusted_and_not_told() -> None:
    """From the first known load on; a recording that began at rest and unloaded has nothing to adjust."""
    o = observed(warm=None)
    cut = dataclasses.replace(o, volts=o.volts[350:], loads=o.loads[350:])
    assert answer._beginnings(Workspace([o])) == []
    ws = Workspace([o, cut])
    (active,) = answer._beginnings(ws)
    assert (active.effect.name, active.values['recording']) == ('beginning', 2.0)
    before, after = ws.residual([])[0], ws.residual([active])[0]
    # Chi-square of values of unit variance, where the ringing was worth thousands.
    assert float(after @ after) < ws.size + 4.0 * math.sqrt(2.0 * ws.size)
    assert float(before @ before) > 10.0 * ws.size
    blind = dataclasses.replace(o, loads=np.where(np.arange(1200)[:, None] < 350, 0.0, o.loads), unknown_load=(350, 0))
    volts = blind.volts.copy()
    volts[:350] = np.nan
    ws = Workspace([dataclasses.replace(blind, volts=volts)])
    (active,) = answer._beginnings(ws)
    # It rings from sample 350 on.
    assert active.effect.apply is not None
    pose = ForwardModel(RIG, [active]).run(np.zeros((1200, 3))).pose
    quiet = ForwardModel(RIG, []).run(np.zeros((1200, 3))).pose
    moved = np.abs(pose - quiet).max(axis=0)
    assert not moved[:350].any()
    assert moved[350] > 0.0
    after = ws.residual([active])[0]
    assert float(after @ after) < ws.size + 4.0 * math.sqrt(2.0 * ws.size)


def test_a_large_effect_is_told_from_how_the_recording_began() -> None:
    """The ringing that the effect makes larger and the one of the beginning are fitted together."""
    gain = make_active('sensor_gain', {'psd': 1, 'x': 0.04, 'y': -0.06}, 'here')
    o = observed(effects=(gain,), warm=None)
    found = discover([dataclasses.replace(o, volts=o.volts[350:], loads=o.loads[350:])], RIG)
    assert [e.active.effect.name for e in found.effects] == ['sensor_gain']
    assert (found.verdict, found.unknown, found.nuisance) == ('effects_found', (), ())
    (named,) = found.effects
    assert abs(named.active.values['y'] + 0.06) < 4.0 * named.sd['y']
    assert found.floors < 1.1


def test_coarse_steps_are_taken_out_before_the_search(monkeypatch: pytest.MonkeyPatch) -> None:
    given = Given(monkeypatch)
    fine = observed(warm=None)
    o = dataclasses.replace(fine, volts=np.rint(fine.volts / (64 * LSB)) * 64 * LSB)
    got = asked(o)
    assert got.lattice is not None
    step = got.lattice.values['step']
    assert step == pytest.approx(64 * LSB, rel=1e-3)
    # In every model of the search, and in none afterwards.
    assert given.bases == [(got.lattice,)]
    assert got.workspace.base == ()
    np.testing.assert_allclose(got.workspace.observations[0].volts / step, np.rint(o.volts / step))
    assert given.steps == pytest.approx(2.0 * o.volts.size * math.log(step / LSB))
    assert asked(o, without=['quantisation']).lattice is None
    assert given.steps == 0.0
    assert asked(fine).lattice is None
    assert given.steps == 0.0


def names_of(screen: Screen) -> set[str]:
    return {c.effect.name for c in screen.candidates}


def test_what_is_screened_is_the_catalogue_and_the_mistakes(monkeypatch: pytest.MonkeyPatch) -> None:
    """But what is left out, what the readings show at once, and what is known from afar."""
    given = Given(monkeypatch)
    left_out = without('sensor_rotation', 'sensor_gain', 'quantisation')
    o = observed(warm=None)
    bank = SignatureBank()
    got = asked(o, without=left_out, bank=bank)
    ws, screen = got.workspace, given.screens[0]
    common = {'sensor_rotation', 'sensor_gain', 'sensitivity', 'link_length', 'sample_rate'}
    first = screen(ws, None)
    assert names_of(first) == common
    assert len(bank._kept) == len(first.candidates)
    fit = refit(ws, [ROTATION], iterations=0)
    # Beside a large effect all signatures are made anew: a jump shows, too.
    assert far(fit, ws)
    asked_before = ws.simulations
    beside = screen(ws, fit)
    assert names_of(beside) == common | {'jump'}
    assert ws.simulations - asked_before > len(beside.candidates)
    assert len(bank._kept) == len(first.candidates)
    near = refit(ws, [dataclasses.replace(ROTATION, values={'psd': 2.0, 'angle': 1e-5})], iterations=0)
    asked_before = ws.simulations
    assert names_of(screen(ws, near)) == common
    # One, to look for lines beside it.
    assert ws.simulations == asked_before + 1
    # Two recordings have a zero each.
    got = asked(o, o, without=left_out)
    assert 'zero' in names_of(given.screens[-1](got.workspace, None))


def far(fit: Fit, ws: Workspace) -> bool:
    return fit.chi2 > 10.0 * len(fit.residual)


@pytest.mark.parametrize(('lead', 'plain_taken'), [(9.9, True), (10.1, False)])
def test_a_mistake_that_needs_an_effect_must_be_much_better(
    monkeypatch: pytest.MonkeyPatch, lead: float, plain_taken: bool
) -> None:
    """By ten in BIC against the best without such mistakes, which is searched for without them."""
    # Two effects against three: 4 for each parameter.
    given = Given(
        monkeypatch, (('link_length', 'creep'), 100.0), (('creep', 'damping', 'tip_mass'), 100.0 + lead - 4.0)
    )
    o = observed(warm=None)
    got = asked(o, without=without('sensor_rotation'))
    assert len(given.screens) == 2
    assert [a.effect.name for a in got.fit.effects] == (
        ['creep', 'damping', 'tip_mass'] if plain_taken else ['link_length', 'creep']
    )
    assert got.search is got.result.search
    assert 'sensitivity' not in names_of(given.screens[1](got.workspace, None))
    # Noise is that of the search that is taken: each estimates it anew.
    assert got.workspace.noise is given.noises[int(plain_taken)]


@pytest.mark.parametrize('names', [('zero', 'creep'), ('link_length', 'zero')])
def test_a_mistake_of_one_channel_or_alone_needs_no_second_search(
    monkeypatch: pytest.MonkeyPatch, names: tuple[str, ...]
) -> None:
    alone = Given(monkeypatch, (names, 100.0))
    asked(observed(warm=None))
    assert len(alone.screens) == 1


def test_what_is_left_is_looked_at_beside_what_is_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    for names in ((), ('creep',)):
        Given(monkeypatch, (names, 100.0))
        got = asked(observed(warm=None))
        (ws, residual, jacobian, rng), more = got.left
        assert ws is got.workspace
        assert residual is got.fit.residual
        assert rng is got.rng
        if names:
            assert jacobian is got.fit.jacobian
            np.testing.assert_array_equal(more['explained'], got.result.null.residual - got.fit.residual)
        else:
            assert jacobian is None
            assert more['explained'] is None


def test_starting_values_come_from_the_residual_and_the_readings(monkeypatch: pytest.MonkeyPatch) -> None:
    t = np.arange(1200) * 1e-3
    o = observed(warm=None)
    volts = o.volts.copy()
    volts[:, 0] += 0.1 * np.sin(2 * np.pi * 77.0 * t)
    ringing = np.zeros(1200)
    ringing[:600] = 0.1 * np.sin(2 * np.pi * 200.0 * t[:600])
    volts[:, 3] += ringing
    ws = Workspace([dataclasses.replace(o, volts=volts)])
    found = answer._proposals(ws)
    assert sorted(found['spectral']) == pytest.approx([77.0, 200.0], abs=0.1)
    assert found['line'] == pytest.approx([77.0], abs=0.1)
    noise = float(RIG.noises.max())
    assert found['highest'] == proposals.highest_voltages(ws.observations, True, noise)
    assert found['highest_dots'] == proposals.highest_voltages(ws.observations, False, noise)
    assert found['highest'] != found['highest_dots']


@pytest.mark.repeatable
def test_the_same_seed_gives_the_same_answer_whatever_is_kept(named: Discovery) -> None:
    seen, bank, few = observed(9, (ROTATION,), warm=None), SignatureBank(), without('sensor_rotation')
    answers = [named.tree(), *(discover([seen], RIG, without=few, bank=bank).tree() for _ in range(2))]
    costs = [a.pop('provenance')['forward_simulations'] for a in answers]
    assert answers[0] == answers[1] == answers[2]
    # The second time nothing need be simulated anew.
    assert costs[0] == costs[1] > costs[2]


# What is made of the answer of a search.


def test_an_estimate_is_wrong_by_what_the_effects_move() -> None:
    """A turned sensor against the same readings without it, by the formula of the simplest solver's geometry."""
    ws = Workspace([observed(warm=None), observed(1, warm=None)])
    force = make_active('tip_force', {'x': 2.0, 'y': -3.0}, 'test')
    fit = refit(ws, [force], iterations=0)
    per = RIG.link.length**3 / (3.0 * RIG.link.bending_stiffness)
    dx, dy, theta = pose_change(ws, fit)
    # At rest: the force rings in at once, and the estimate swings to less than twice of it.
    assert 0.8 * 2.0 * per < dx < 2.0 * 2.0 * per
    assert 0.8 * 3.0 * per < dy < 2.0 * 3.0 * per
    assert dx / dy == pytest.approx(2.0 / 3.0, rel=0.02)
    assert theta < 1e-3 * dy / RIG.link.length * 10.0
    turned = pose_change(ws, refit(ws, [ROTATION], iterations=0))
    assert max(turned) > 0.0
    assert pose_change(ws, refit(ws, (), iterations=0)) == (0.0, 0.0, 0.0)
    # Blocks that are not there do not count.
    volts = ws.observations[0].volts.copy()
    volts[500:] = np.nan
    half = Workspace([dataclasses.replace(ws.observations[0], volts=volts)])
    assert all(math.isfinite(v) for v in pose_change(half, refit(half, [force], iterations=0)))


def test_effects_that_only_stood_in_for_a_law_are_taken_out(monkeypatch: pytest.MonkeyPatch) -> None:
    a, b, c = (
        make_active('creep', {'amplitude': 0.1}, 't'),
        make_active('sensor_gain', {'psd': 1, 'x': 0.1}, 't'),
        make_active('sensor_gain', {'psd': 2, 'x': 0.1}, 't'),
    )
    asked_for: list[int] = []

    def without_one(search: object, result: object, fit: Any, index: int) -> Any:
        asked_for.append(index)
        return SimpleNamespace(effects=tuple(e for j, e in enumerate(fit.effects) if j != index))

    monkeypatch.setattr(answer, 'without_one', without_one)
    search = cast(Search, SimpleNamespace(trace=[]))
    law = cast(FoundLaw, SimpleNamespace(beside=(b,)))
    held = [HeldOut(float(i), 1.0) for i in range(3)]
    fit = cast(Fit, SimpleNamespace(effects=(a, b, c)))
    left, heldout = answer._beside(law, search, cast(SearchResult, None), fit, held)
    assert left.effects == (b,)
    assert heldout == [held[1]]
    assert asked_for == [2, 0]
    assert search.trace == [f'{e.label} only stood in for the law' for e in (c, a)]


@pytest.fixture(scope='module')
def named() -> Discovery:
    """A turned sensor, among two."""
    return discover([observed(9, (ROTATION,), warm=None)], RIG, without=without('sensor_rotation'))


def answered(found: Discovery, **given: Any) -> Discovery:
    """The answer once more, from what the search had left."""
    ws = given.pop('workspace', found.workspace)
    fit = given.pop('fit', found.fit)
    whole: dict[str, Any] = {
        'search': SimpleNamespace(workspace=ws, penalty=4.0, trace=[], alternatives=lambda *_: []),
        'result': found.search,
        'fit': fit,
        'heldout': [HeldOut(30.0, 1.0)] * len(fit.effects),
        'left': NOWHERE,
        'lattice': None,
        'rng': np.random.default_rng(0),
        'seed': 3,
        'progress': lambda _: None,
        'checked': answer._Checked([], {}, (), 0.0),
    }
    return answer._answer(ws, *{**whole, **given}.values())


FOLLOWS = dataclasses.replace(NOWHERE, p=0.0, excess=200.0, dependences=(Dependence('x2', 'dot_y', 200.0, 1e-9),))


@pytest.mark.parametrize(
    ('left', 'effects', 'lattice', 'asked_for'),
    [(NOWHERE, 1, False, 0), (FOLLOWS, 1, False, 1), (FOLLOWS, 1, True, 0), (NOWHERE, 0, False, 1)],
)
def test_a_law_is_looked_for_where_something_remains(
    monkeypatch: pytest.MonkeyPatch, named: Discovery, left: Localisation, effects: int, lattice: bool, asked_for: int
) -> None:
    """In a place, or in no single one; not among coarse steps, whose noise varies with the signal."""
    calls: list[tuple[Any, ...]] = []
    monkeypatch.setattr(answer, 'find_law', lambda *a: calls.append(a))
    monkeypatch.setattr(answer, 'localise', lambda *a, **k: NOWHERE)
    fit = named.fit if effects else named.search.null
    steps = make_active('quantisation', {'step': 8 * LSB}, 't') if lattice else None
    if lattice:
        monkeypatch.setattr(proposals, 'coarse_step', lambda _: (8 * LSB, 1e-9))
    got = answered(named, left=left, fit=fit, lattice=steps)
    assert len(calls) == asked_for
    if calls:
        ws, null, beside, penalty, excess, *_ = calls[0]
        assert (ws, null, beside, penalty, excess) == (named.workspace, named.search.null, fit, 4.0, left.excess)
    assert got.law is None
    assert named.workspace.base == ()
    assert [e.active.effect.name for e in got.effects] == ['sensor_rotation'] * effects + ['quantisation'] * lattice
    assert got.verdict == ('effects_found' if not asked_for and effects else 'unknown_effect')
    if lattice:
        # A fiftieth of what the steps explain is more.
        assert 0.02 * 2.0 * answer._lattice_gain(named.workspace, cast(ActiveEffect, steps)) > 200.0
        assert got.unknown == ()


def test_what_remains_is_unknown_by_three_rules(monkeypatch: pytest.MonkeyPatch, named: Discovery) -> None:
    """In a place; in none, if the gap is beyond the floor; or sizes are tied. Else all is explained."""
    monkeypatch.setattr(answer, 'find_law', lambda *a: None)
    monkeypatch.setattr(answer, 'localise', lambda *a, **k: NOWHERE)
    in_place = answered(named, left=FOLLOWS)
    (u,) = in_place.unknown
    assert u.signature.startswith('on x2')
    explained = named.search.null.chi2 - named.fit.chi2
    assert u.explains == pytest.approx(200.0 / (200.0 + explained))
    nowhere = answered(named, fit=named.search.null)
    assert nowhere.unknown[0].signature.endswith('in no single place or band')
    assert nowhere.unknown[0].explains == 1.0
    assert answered(named, fit=named.search.null, left=FOLLOWS).unknown[0].explains == 1.0
    monkeypatch.setattr(answer, 'tied', lambda *a: (Unknown('tied', (), 1.0, remains=False),))
    assert answered(named).verdict == 'unknown_effect'
    monkeypatch.setattr(answer, 'tied', lambda *a: ())
    plain = answered(named)
    assert (plain.verdict, plain.unknown, plain.seed) == ('effects_found', (), 3)
    # The gap before was that with the file's wiring, if that was wrong.
    wired = answered(named, checked=answer._Checked([], {}, (), 0.5))
    assert wired.gap_before == wired.gap_heldout_before == 0.5
    assert plain.gap_before == named.workspace.gap(named.search.null.difference)
    known = (make_active('creep', {'amplitude': 0.1}, 't'),)
    assert answered(named, checked=answer._Checked([], {}, known, 0.0)).active_effects == [
        *known,
        plain.effects[0].active,
    ]


def test_mistakes_of_the_setup_are_told_apart_from_effects(monkeypatch: pytest.MonkeyPatch, named: Discovery) -> None:
    """With their lines and what stands for them; their rivals and all that is not settled stay in the answer."""
    monkeypatch.setattr(answer, 'localise', lambda *a, **k: NOWHERE)
    length = next(e for e in mistakes(1, [], []) if e.name == 'link_length')
    active = ActiveEffect(length, {'error': 0.02})
    rival = Rival(active, {}, 1.0, named.fit)
    entries = [
        NamedEffect(active, {}, 0.0, 44.0, HeldOut(9.0, 1.0), ('creep',), (rival,), (), None),
        NamedEffect(ROTATION, {'angle': 1e-4}, 0.0, 9.0, HeldOut(9.0, 1.0), ('creep', 'damping'), (), (), None),
    ]
    monkeypatch.setattr(answer, 'named_effects', lambda *a: list(entries))
    fit = dataclasses.replace(named.fit, effects=(active, *named.fit.effects), free=((1, 'angle'),))
    bare = dataclasses.replace(fit, effects=(active,), free=(), jacobian=np.empty((len(fit.residual), 0)))
    noise = Finding('noise_level', 'x1 y1 x2 y2', 3.0, 'amplifier.noise: 0.006')
    first = Finding('channel_sign', 'y1', -1.0, 'x')
    for lattice, told in ((None, True), (make_active('quantisation', {'step': 8 * LSB}, 't'), False)):
        monkeypatch.setattr(answer, 'noise_finding', lambda _: [noise])
        monkeypatch.setattr(proposals, 'coarse_step', lambda _: (8 * LSB, 1e-9))
        checked = answer._Checked([first], {'psd_1.axes': ['x', '-y']}, (), 0.0)
        got = answered(named, fit=fit, checked=checked, lattice=lattice)
        names = ['channel_sign', 'link_length', *['noise_level'] * told]
        assert [f.name for f in got.setup] == names
        assert (got.setup[1].evidence, got.setup[1].equivalent) == (44.0, ('creep',))
        assert got.lines == {'psd_1.axes': ['x', '-y'], 'link.length': 0.5967}
        assert [e.active.effect.name for e in got.effects] == ['sensor_rotation', *['quantisation'] * (not told)]
        assert got.rivals == (named.fit,)
        assert got.unsettled == ('creep', 'damping')
    # The file's own lines are not changed by an answer.
    assert checked.lines == {'psd_1.axes': ['x', '-y']}
    entries[:] = entries[:1]
    only = answered(named, fit=bare)
    assert (only.effects, only.moves, only.verdict) == ((), (0.0, 0.0, 0.0), 'nothing_missing')


def test_an_experiment_is_planned_for_the_three_that_are_nearest(
    monkeypatch: pytest.MonkeyPatch, named: Discovery
) -> None:
    """For one alone once the budget is spent."""
    monkeypatch.setattr(answer, 'localise', lambda *a, **k: NOWHERE)
    asked_for: list[tuple[object, list[int]]] = []
    monkeypatch.setattr(answer, 'suggest', lambda ws, best, equal: asked_for.append((best, equal)))

    def named_effects(*given: Any) -> list[NamedEffect]:
        given[-1]('best', [1, 2, 3, 4, 5])
        return []

    monkeypatch.setattr(answer, 'named_effects', named_effects)
    for spent, count in ((named.workspace.budget - 100, 3), (named.workspace.budget, 1)):
        monkeypatch.setattr(named.workspace, 'simulations', spent)
        answered(named)
        assert asked_for[-1] == ('best', [1, 2, 3, 4, 5][:count])


def test_lines_are_those_of_the_first_recordings_rig() -> None:
    o = observed(warm=None)
    other = replace_values(RIG, {'link.length': 0.4, 'amplifier.sensitivity': 1e-3})
    ws = cast(Workspace, SimpleNamespace(observations=[o, dataclasses.replace(o, rig=other)]))
    length = next(e for e in mistakes(2, [], []) if e.name == 'link_length')
    fit = cast(Fit, SimpleNamespace(effects=(ActiveEffect(length, {'error': 0.02}),)))
    assert said(ws, fit, 0, 1.0)[1] == {'link.length': pytest.approx(0.5967)}
    zero = next(e for e in mistakes(2, [], []) if e.name == 'zero')
    for recording, name in ((1.0, 'seen'), (2.0, 'other')):
        ws = cast(Workspace, SimpleNamespace(observations=[o, dataclasses.replace(o, name='other')]))
        values = {'recording': recording, 'of_reading': 0.0, 'x1': 1e-3, 'y1': 0.0, 'x2': 0.0, 'y2': 0.0}
        fit = cast(Fit, SimpleNamespace(effects=(ActiveEffect(zero, values),)))
        assert said(ws, fit, 0, 1.0)[0][0].where == name


@pytest.mark.parametrize(('beside', 'left_after'), [(True, FOLLOWS), (True, NOWHERE), (False, FOLLOWS)])
def test_beside_a_law_only_those_effects_stay_that_belong_to_it(
    monkeypatch: pytest.MonkeyPatch, named: Discovery, beside: bool, left_after: Localisation
) -> None:
    """What is left is looked at again beside them. The law is told if it is unknown what remains."""
    (effect,) = named.fit.effects
    law = SimpleNamespace(beside=(effect,) if beside else ())
    null = named.search.null
    looked: list[tuple[Any, ...]] = []

    def localise(ws: object, residual: object, known: object, rng: object, explained: object = None) -> Localisation:
        looked.append((residual, known, explained))
        return left_after

    monkeypatch.setattr(answer, 'find_law', lambda *_: law)
    monkeypatch.setattr(answer, 'localise', localise)
    monkeypatch.setattr(answer, 'without_one', lambda search, result, fit, index: null)
    got = answered(named, left=FOLLOWS)
    residual, known, explained = looked[0]
    if beside:
        assert residual is named.fit.residual
        assert known is named.fit.jacobian
        np.testing.assert_array_equal(explained, null.residual - named.fit.residual)
        assert got.fit is named.fit
    else:
        assert residual is null.residual
        assert (known, explained) == (None, None)
        assert got.fit is null
    assert [e.active.effect.name for e in got.effects] == ['sensor_rotation'] * beside
    told = left_after is FOLLOWS
    assert (got.law is not None, got.verdict) == (told, 'unknown_effect' if told else 'effects_found')
    assert got.left is left_after
