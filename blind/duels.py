# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""discover_in beside other programs and published figures. ``python -m blind.duels [--only silverbox]``.

The machines were measured by others and their data are no part of this repository: they are read from a folder. Each
duel is judged by the peer's own measure, on data that the fit has not seen where the peer has such. A missing file, a
peer that is not installed and a machine of which there is no model have a row that says so. Peers are looked for in
this Python, and in the folder ``--peers`` (``pip install --target FOLDER pysindy sysidentpy``).
"""

from __future__ import annotations

import hashlib
import math
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from blind.auxtel import AuxTel
from blind.balls import Balls
from blind.boom import Boom
from blind.campaign import options
from blind.duel_peers import Answers, Subset, arx, best_subset, narx, rms, sindy, sindy_balls
from blind.emps import Emps
from blind.measured import DATA
from blind.silverbox import TESTS, Silverbox, rmse
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.plant_search import PlantDiscovery, discover_in
from psd_deflection.studies.discover.plants import Model
from psd_deflection.studies.discover.trees import size_of

Progress = Callable[[str], None]
SUBSET = 'every subset of three by BIC, as with MuJoCo sysid'
PULSES = 'DATA_EMPS_PULSES.mat'
PULSES_SHA256 = '0eab75bb1f6b16228ee78791343a88bf9bfd9a51036ac9807d7b5fc11c0e1704'
EMPS_S = 24.84
"""Length of a recording of the drive, simulated in one piece."""
EMPS_START = 20
"""Samples of the drive's test that do not count."""


@dataclass(frozen=True, slots=True)
class Figure:
    """``measure``, with its unit; what ``peer`` reaches by it, or why there is no figure; ours. Smaller is better."""

    measure: str
    peer: str
    theirs: float | str
    ours: float

    def better(self) -> str:
        """Who wins, by the digits that are printed."""
        if isinstance(self.theirs, str):
            return ''
        theirs, ours = float(worded(self.theirs)), float(worded(self.ours))
        return 'even' if theirs == ours else 'ours' if ours < theirs else 'the peer'


@dataclass(frozen=True, slots=True)
class Answer:
    """What was ``message``, and the figures."""

    message: str
    figures: Sequence[Figure]


@dataclass(frozen=True, slots=True)
class Duel:
    """``file``, below the folder of the data, with its SHA-256, '' if it was never here; where it is from; what the
    model lacks, and what of the data is left out. ``run``: None if there is no model of the machine.
    """

    file: str
    sha256: str
    source: str
    lacks: str
    excluded: str
    run: Callable[[Path, Progress], Answer] | None


def worded(value: float) -> str:
    """Three digits."""
    return f'{value:.3g}'


def answer_words(found: PlantDiscovery) -> str:
    """Return the effects with their sizes, and whether something is unknown."""
    words = [f'`{e.active.effect.name}` {size_of(e)}' for e in found.effects]
    return '; '.join([*words, *(['the rest is called unknown'] if found.unknown else [])]) or 'nothing is missing'


def model_of(found: PlantDiscovery) -> Model:
    """Return the effects and the nuisance that were found."""
    return {
        a.effect.name: dict(a.values) for a in (*(e.active for e in found.effects), *(a for a, _ in found.nuisance))
    }


def _subset_row(measure: str, factor: float, subset: Subset, ours: float) -> Figure:
    return Figure(measure, f'{SUBSET}: {", ".join(subset.names)}', factor * subset.unseen, ours)


def auxtel(folder: Path, progress: Progress) -> Answer:
    """On the sky: two channels, so the root of 2 times the gap, which is the rms over both."""
    plant = AuxTel(folder / 'auxtel.txt')
    found = discover_in(plant, progress=progress)
    sky = math.sqrt(2.0)
    function = None if found.remainder is None else found.remainder.function
    unseen = sky * (found.gap_heldout_after if function is None else function.heldout)
    chosen = sky * (found.gap_heldout_after if function is None else function.heldout_as_shaped)
    sizes = 'on the sky, each star left out, sizes refitted, terms and smoothness chosen with all stars; arcsec'
    figures = (
        Figure(sizes, 'TPOINT, 24 terms (published)', 7.38, chosen),
        Figure('the same, but our smoothness too is found without the star; arcsec', 'TPOINT, as above', 7.38, unseen),
        Figure(
            'named terms alone, as above; arcsec',
            'TPOINT, 6 physical terms (published)',
            20.2,
            sky * found.gap_heldout_after,
        ),
        _subset_row(sizes, sky, best_subset(plant, is_linear=True), chosen),
    )
    words = '' if function is None else f'; a smooth function of {" and ".join(function.variables)}'
    return Answer(answer_words(found) + words, figures)


def silverbox(folder: Path, progress: Progress) -> Answer:
    """Return the official tests, each simulated in one piece from its first state."""
    plant = Silverbox(folder / 'silverbox')
    found = discover_in(plant, progress=progress)
    ours = tests_of(plant, lambda span: plant.run(model_of(found), np.array([span[0]]), span[1] - span[0])[:, 0])
    figures = [
        Figure(
            'multisine test, error over standard deviation; %',
            'the best grey boxes (published)',
            0.44,
            ours['multisine'][1],
        )
    ]
    for peer in (arx, sindy, narx):
        progress(f'Silverbox: {peer.__name__}')
        theirs = _asked(plant, peer)
        for name in TESTS:
            words = f'{name} test, rms error; mV'
            if isinstance(theirs, str):
                figures.append(Figure(words, peer.__name__, theirs, ours[name][0]))
            else:
                figures.append(Figure(words, theirs[0], theirs[1][name][0], ours[name][0]))
    figures += [
        Figure(f'{name} test, error over standard deviation; %', '', 'none is published here', ours[name][1])
        for name in TESTS
        if name != 'multisine'
    ]
    return Answer(answer_words(found), figures)


def tests_of(plant: Silverbox, simulated: Callable[[tuple[int, int]], FloatArray]) -> dict[str, tuple[float, float]]:
    """Of each test the rms error, mV, and its share of the standard deviation, %."""
    out = {}
    for name, span in TESTS.items():
        residual, share = rmse(plant.y[slice(*span)], simulated(span))
        out[name] = 1e3 * residual, 1e2 * share
    return out


def _asked(
    plant: Silverbox, peer: Callable[[Silverbox], tuple[str, Answers]]
) -> str | tuple[str, dict[str, tuple[float, float]]]:
    """Return the peer's name and figures, or why there are none."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')
            words, answers = peer(plant)
    except ImportError as error:
        return f'not installed ({error.name})'
    by_first = {span: answers[name] for name, span in TESTS.items()}
    return words, tests_of(plant, lambda span: by_first[span])


def emps(folder: Path, progress: Progress) -> Answer:
    """Found on the training record; the test record is simulated in one piece."""
    found = discover_in(Emps(('coulomb_friction', 'force_offset'), folder / 'emps'), progress=progress)
    figures = []
    for record, words in (('emps.csv', 'training record'), (PULSES, 'official test record, unseen')):
        measure = f'{words}, {EMPS_S} s simulated in one piece without feedback, rms; mm'
        try:
            theirs = Emps((), folder / 'emps', record=record, segment=EMPS_S)
        except OSError:
            figures.append(Figure(measure, 'published terms', f'not run: {record} is not there', math.nan))
            continue
        if record == PULSES:
            measure = f'{measure} (SHA-256 {checked(folder / "emps" / record, PULSES_SHA256)})'
        lacking = Emps(('coulomb_friction', 'force_offset'), folder / 'emps', record=record, segment=EMPS_S)
        ours = 1e3 * _apart(lacking, model_of(found))
        figures.append(Figure(measure, 'published terms, simulated here', 1e3 * _apart(theirs, {}), ours))
    return Answer(answer_words(found), figures)


def _apart(plant: Emps, model: Model) -> float:
    (measured,), (simulated,) = plant.measured(), plant.simulate(model)
    return rms((measured - simulated)[0, -(-EMPS_START // 10) :])


def boom(folder: Path, progress: Progress) -> Answer:
    """What is left of readings at lengths that the fit has not seen."""
    plant = Boom(folder / 'boom')
    found = discover_in(plant, progress=progress)
    measure = 'rms on lengths that the fit has not seen; mm'
    published = 1e3 * rms(
        np.concatenate([m - s for m, s in zip(plant.measured(), plant.simulate({}), strict=True)], axis=1)
    )
    ours = 1e3 * found.gap_heldout_after
    figures = (
        Figure(measure, 'their nominal model with their EI, simulated here', published, ours),
        _subset_row(f'{measure}; the peer chooses its terms with all lengths', 1e3, best_subset(plant), ours),
    )
    return Answer(answer_words(found), figures)


def balls(folder: Path, progress: Progress) -> Answer:
    """Found on the first drop of each ball, judged on the second."""
    fitted, tested = (Balls(folder / 'falling_balls', drop) for drop in (1, 2))
    found = discover_in(fitted, progress=progress)

    def figures(simulated: Sequence[FloatArray]) -> tuple[float, float]:
        apart = [h - s for h, s in zip(tested.heights, simulated, strict=True)]
        return rms(np.concatenate(apart)), float(np.mean([abs(a[-1]) for a in apart]))

    ours = figures([s[0] for s in tested.simulate(model_of(found))])
    vacuum = figures([s[0] for s in tested.simulate({})])
    try:
        peer, answers = sindy_balls(fitted, tested)
        theirs: tuple[float | str, float | str] = figures(answers)
    except ImportError as error:
        peer, theirs = 'PySINDy', (f'not installed ({error.name})',) * 2
    subset = best_subset(fitted)
    out = []
    for i, words in enumerate(('rms of the height', 'error of the last height, mean of nine balls')):
        measure = f'second drop, unseen, {words}; m'
        out += [Figure(measure, 'free fall in vacuum', vacuum[i], ours[i]), Figure(measure, peer, theirs[i], ours[i])]
    out.append(
        _subset_row('first drop, each ball left out, rms; m', 1.0, subset, found.gap_heldout_after),
    )
    return Answer(answer_words(found), out)


DUELS: Mapping[str, Duel] = {
    'auxtel': Duel(
        'auxtel.txt',
        '8d4e50cc846ad00f10fb7a53c1677f8d9e05f411b0a4adc9caf3fc3e0fcfd3a3',
        'technical note TSTN-014 of Rubin Observatory, runs/run-202003.rst; CC-BY-4.0',
        'every term but the zeros of the two encoders',
        'the angle of the rotator',
        auxtel,
    ),
    'silverbox': Duel(
        'silverbox/SNLS80mV.csv',
        'ae62d5a91230c10f76e6dd02c8a4fac3c9d4d8a95fbf50e87cb0c4885003e0f1',
        'nonlinearbenchmark.org (Wigren and Schoukens 2013), read from biaslab/nsi-silverbox; no licence named',
        'the cubic spring and all that is not linear',
        'the search uses 25,050 of 65,062 training samples; nothing of the tests',
        silverbox,
    ),
    'emps': Duel(
        'emps/emps.csv',
        '76aff130fb8f51337a5ba1c86bb7db1a43aa8f470f4bd9699ec369141784b88e',
        'nonlinearbenchmark.org (Janot, Gautier and Brunot 2019), read from wmkouw/NSI-EMPS; MIT licence',
        'Coulomb friction and offset',
        'nine of ten samples of the position; the reference position',
        emps,
    ),
    'boom': Duel(
        'boom/readings.csv',
        '6ba56f85d5bab1cdc6c4965be12e1886d03578c1fd80102384bb7ea054a863a9',
        'StanleyWang1/GIRAF, DATA/cantilever_deflection; figures only, no licence named',
        'gravity and a root that gives way; EI is nuisance',
        'nothing',
        boom,
    ),
    'kuka': Duel(
        'kuka/forward_identification_without_raw_data.mat',
        '',
        'KUKA KR300 R2500 (Weigand and others 2022, doi 10.26204/DATA/5); MIT and CC-BY-SA-4.0',
        '',
        '',
        None,
    ),
    'balls': Duel(
        'falling_balls/Ball_drops_data.xls',
        '942b2d68abfff3828ca323de491435d4ec27c3a22e62cee0cbdf52c2e8d1c0ed',
        'briandesilva/discovery-of-physics-from-data (de Silva and others 2020); MIT licence',
        'all of the air: it is free fall in vacuum',
        'volleyball and bowling ball (no weight is written down, or as in the paper); the first nine heights of a drop',
        balls,
    ),
}
HEAD = 'duel | source, licence | SHA-256 | the model lacks | left out of the data | what was said'
FIGURES = 'duel | by the measure | peer | its figure | ours | better'


def line(*cells: str) -> str:
    """Return a row of a table."""
    return '| ' + ' | '.join(c.replace('|', '/') for c in cells) + ' |'


def checked(path: Path, sha256: str) -> str:
    """Return the first digits of the file's SHA-256, and whether it is the one that is known."""
    is_read = hashlib.sha256(path.read_bytes()).hexdigest()
    words = 'as known' if is_read == sha256 else 'NOT the one that is known' if sha256 else 'none is known'
    return f'`{is_read[:12]}`, {words}'


def rows(name: str, duel: Duel, folder: Path, progress: Progress) -> tuple[str, list[str]]:
    """Return the row of the first table, and those of the second."""
    path = folder / duel.file
    if not path.is_file():
        why = f'not run: {duel.file} is not there'
        return line(name, duel.source, '', duel.lacks, duel.excluded, why), [line(name, why, '', '', '', '')]
    known = checked(path, duel.sha256)
    if duel.run is None:
        why = 'not run: there is no model of it here'
        return line(name, duel.source, known, duel.lacks, duel.excluded, why), [line(name, why, '', '', '', '')]
    answer = duel.run(folder, progress)
    first = line(name, duel.source, known, duel.lacks, duel.excluded, answer.message)
    return first, [figure_row(name, f) for f in answer.figures]


def figure_row(name: str, figure: Figure) -> str:
    """Return a row of the second table."""
    theirs = figure.theirs if isinstance(figure.theirs, str) else worded(figure.theirs)
    ours = '' if math.isnan(figure.ours) else worded(figure.ours)
    return line(name, figure.measure, figure.peer, theirs, ours, figure.better())


def main(argv: Sequence[str] | None = None) -> int:
    """Print two tables: the data with what was said, and the figures. 3 if no data are there at all."""
    parser = options(__doc__)
    parser.add_argument('--data', type=Path, default=DATA, help='folder with the data (default: %(default)s)')
    parser.add_argument('--only', choices=tuple(DUELS), action='append', help='this duel alone; may be given again')
    parser.add_argument('--peers', type=Path, help='a folder that peers were installed into')
    args = parser.parse_args(argv)
    if args.peers is not None:
        sys.path.append(str(args.peers))
    names = args.only or list(DUELS)
    tables = [rows(n, DUELS[n], args.data, lambda w: print(f'... {w}', file=sys.stderr)) for n in names]
    for head, body in ((HEAD, [t[0] for t in tables]), (FIGURES, [r for t in tables for r in t[1]])):
        cells = head.split(' | ')
        print('\n'.join([line(*cells), line(*('---' for _ in cells)), *body, '']))
    return 0 if any((args.data / DUELS[n].file).is_file() for n in names) else 3


if __name__ == '__main__':
    sys.exit(main())
