# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The thesis's experiment redone, with the product's own commands: camera, calibrate, validate, replay."""

import contextlib
import csv
import io
import itertools
import json
import math
import shlex
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.interpolate import CubicSpline
from tqdm import tqdm

from blind import generator, misaligned, render
from blind.campaign import conclude, options
from blind.generator import Array
from blind.redone_page import Curves, page_of
from psd_deflection.camera.opencv import opencv
from psd_deflection.cli.main import main as psd_deflection
from psd_deflection.rig.parameter_files import with_values

ROOT = Path(__file__).resolve().parents[1]
NOMINAL = ROOT / 'config' / 'thesis_rig.yaml'
ARM = 0.585  # From the link to the weight on the sidebar, m.
LEAN = 0.054  # How far the weight's line is off the rig's Y axis, rad: 0.12 mm of dX at 50 N.
CLOCK = 7.3e-3  # By how much the camera's clock is ahead, s.
RAMP_S = 0.35  # Time in which a hand lets go of a weight, s.
LIMIT = 0.002  # Largest error on the link, as a share of the deflection at 50 N.
WEIGHTS = {'sidebar': (0.03, 0.5, 10.0, 0.1), 'link': (3.0, 0.5, 10.0, 0.1)}
"""Of the thesis, tuned by hand for either place of the load."""
AXES = ('dx', 'dy', 'theta')
STEMS = ('before', 'after')
RIGS = {
    'before': 'exact',
    'before_sidebar': 'wls',
    'before_link': 'wls',
    'after': 'exact',
    'after_sidebar': 'wls',
    'after_link': 'wls',
    'one_side': 'exact',
}
"""Rig files, and the method that the summary has of each. ``one_side``: calibrated by the right side alone."""


@dataclass(frozen=True)
class Plan:
    """How long and how fine. ``rest``, ``held``: s before and with the weight; ``shrink``: of the image."""

    forces: Sequence[float] = (50.0, 30.0, 10.0)
    rest: float = 1.5
    held: float = 3.0
    rate: float = 30.0
    exposure: float = 2e-3
    instants: int = 4
    shrink: int = 1
    seed: int = 1
    limit: float = LIMIT


SHORT = Plan(forces=(50.0,), rest=0.6, held=1.6, rate=12.0, limit=0.005)


@dataclass(frozen=True)
class HeldLoad:
    """One recording: ``side`` +1 or -1 of the sidebar, 0 on the link itself."""

    force: float
    side: int

    @property
    def name(self) -> str:
        place = {1: 'sidebar_right', -1: 'sidebar_left', 0: 'link'}[self.side]
        return f'{place}_{self.force:.0f}N'


@dataclass
class Bench:
    """The rig, its camera, and what was typed. ``truth``: misalignments by name."""

    plan: Plan
    folder: Path
    truth: Mapping[str, float]
    scene: render.Scene
    rng: np.random.Generator
    typed: list[str] = field(default_factory=list)

    def run(self, *words: str | Path) -> str:
        """Run a command of the product in the folder; its words. Raises RuntimeError if it fails."""
        line = [str(w) for w in words]
        self.typed.append(shlex.join(['psd-deflection', *line]))
        out, aside = io.StringIO(), io.StringIO()
        with contextlib.chdir(self.folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(aside):
            status = psd_deflection(line)
        if status:
            raise RuntimeError(f'{self.typed[-1]}: exit status {status}\n{out.getvalue()}{aside.getvalue()}')
        return out.getvalue()


def bench(folder: Path, plan: Plan) -> Bench:
    """Return a rig and a camera by chance. The folder gets their files: ``nominal.yaml`` and ``camera.yaml``."""
    rng = np.random.default_rng([5, plan.seed])
    truth = misaligned.draw(rng)
    scene = render.Scene(
        width=640 // plan.shrink,
        height=480 // plan.shrink,
        focal=2000.0 / plan.shrink,
        centre=(330.0 / plan.shrink, 228.0 / plan.shrink),
        distortion=(-0.2, 0.1, 1e-3, -1e-3),
        turn=math.radians(rng.uniform(-2.0, 2.0)),
        tilt=tuple(rng.uniform(-0.04, 0.04, 2)),
        slope=(0.2, -0.1),
        shot_noise=0.1,
    )
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(NOMINAL, folder / 'nominal.yaml')
    camera = {
        'target.spacing': scene.spacing,
        'target.radius': scene.radius,
        'camera.matrix': scene.matrix,
        'camera.distortion': list(scene.distortion),
    }
    (folder / 'camera.yaml').write_text(yaml.safe_dump(camera))
    return Bench(plan, folder, truth, scene, rng)


def motion(plan: Plan, load_case: HeldLoad) -> Array:
    """True poses (n, 3) at the samples: at rest, then a weight that a hand lets go of."""
    n = round((plan.rest + plan.held) * generator.RATE)
    t = np.arange(n) / generator.RATE
    share = 0.5 - 0.5 * np.cos(np.pi * np.clip((t - plan.rest) / RAMP_S, 0.0, 1.0))
    force = load_case.force * np.array([math.sin(LEAN), -math.cos(LEAN)])
    loads = share[:, None] * np.array([*force, load_case.side * ARM * force[1]])
    return misaligned.poses(loads)


def record(made: Bench, load_case: HeldLoad) -> None:
    """``NAME.csv``, what the PSDs say; ``NAME/``, the camera's images; ``NAME_truth.csv``, the pose at the images."""
    plan, rng = made.plan, made.rng
    pose = motion(plan, load_case)
    t = np.arange(len(pose)) / generator.RATE
    volts = misaligned.record(made.truth, pose, rng).volts
    with (made.folder / f'{load_case.name}.csv').open('w', newline='') as stream:
        rows = csv.writer(stream)
        rows.writerow(('t', 'x1', 'y1', 'sum1', 'x2', 'y2', 'sum2'))
        rows.writerows([f'{s:.9f}', *(f'{v:.9g}' for v in row)] for s, row in zip(t, volts.tolist(), strict=True))
    at = CubicSpline(t, pose)
    k = made.truth['link.slope_ratio'] / misaligned.LENGTH

    def observed(instant: float) -> render.Pose:
        dx, dy, theta = (float(v) for v in at(instant))
        return render.Pose(dx, dy, theta, -k * dy, k * dx)

    images = made.folder / load_case.name
    images.mkdir()
    cv2 = opencv()
    starts = np.arange(0.02, t[-1] - 0.02, 1.0 / plan.rate)
    listed, true = [], []
    still = render.clean(made.scene, [render.Pose()])
    for number, start in enumerate(starts.tolist()):
        poses = render.over_exposure(observed, start, plan.exposure, plan.instants)
        rests = start + plan.exposure < plan.rest
        image = render.developed(made.scene, still if rests else render.clean(made.scene, poses), rng)
        name = f'{number:04}.png'
        cv2.imwrite(str(images / name), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        listed.append((name, f'{start + CLOCK:.9f}', plan.exposure))
        true.append((f'{start + plan.exposure / 2:.9f}', *render.mean_of(poses)))
    for path, head, lines in (
        (images / 'frames.csv', ('file', 't', 'exposure'), listed),
        (made.folder / f'{load_case.name}_truth.csv', ('t', *AXES), true),
    ):
        with path.open('w', newline='') as stream:
            csv.writer(stream).writerows([head, *lines])


def table(path: Path) -> dict[str, Array]:
    """Columns of a CSV; what is empty or a word is NaN."""

    def number(cell: str) -> float:
        try:
            return float(cell)
        except ValueError:
            return math.nan

    with path.open(newline='') as stream:
        head, *rows = csv.reader(stream)
    return {name: np.array([number(row[i]) for row in rows]) for i, name in enumerate(head)}


def zeroed(made: Bench, name: str) -> dict[str, object]:
    """Return the zero before the load, as ~/zero takes it: the mean reading of the unloaded link, m."""
    rows = table(made.folder / f'{name}.csv')
    rest = rows['t'] < 0.9 * made.plan.rest
    return {
        f'psd_{n}.zero': [float(rows[f'{axis}{n}'][rest].mean() * generator.MM_PER_V) for axis in 'xy'] for n in (1, 2)
    }


def rig_files(made: Bench, stem: str, values: Mapping[str, object]) -> None:
    """``STEM.yaml`` with ``values``, and the same with either of the weights that were tuned by hand."""
    path = made.folder / f'{stem}.yaml'
    text = with_values(path.read_text(), dict(values), 'The zero before the load', path) if values else path.read_text()
    path.write_text(text)
    for place, weights in WEIGHTS.items():
        tuned = {'wls.weights': 'thesis', 'wls.row_scaling': list(weights)}
        words = f'Weights of the thesis, load on the {place}'
        (made.folder / f'{stem}_{place}.yaml').write_text(with_values(text, tuned, words, path))


def curves(made: Bench, load_case: HeldLoad, stem: str) -> Curves:
    """What every method says of a recording with the rig file ``STEM.yaml``, by ``replay``."""
    found: dict[str, Array] = {}
    t = np.empty(0)
    for variant in ('', *(f'_{place}' for place in WEIGHTS)):
        out = f'{load_case.name}_{stem}{variant}.csv'
        made.run('replay', f'{load_case.name}.csv', '--params-file', f'{stem}{variant}.yaml', '--out', out)
        rows = table(made.folder / out)
        t = rows['t']
        for name in ('wls',) if variant else ('wls', 'iterative', 'exact'):
            label = f'{name}{variant}'
            found[label] = np.column_stack([rows[f'{name}_{axis}'] for axis in AXES])
    return Curves(t, found)


def evaluated(made: Bench, load_case: HeldLoad, stem: str, by: str) -> Any:
    """Return the answer of ``validate``: by the camera, its clock put right, or by the truth."""
    reference = f'{load_case.name}_{by}.csv'
    align = ['--align', '--exposure', str(made.plan.exposure)] if by == 'camera' else []
    rig = ('--params-file', f'{stem}.yaml')
    words = ('--reference', reference, '--solver', 'all', *rig, *align, '--json')
    return json.loads(made.run('validate', f'{load_case.name}.csv', *words))


def calibrated(made: Bench, runs: Sequence[HeldLoad], stem: str) -> str:
    """``calibrate`` on some recordings: ``STEM.yaml``; what it says."""
    references = itertools.chain.from_iterable(('--reference', f'{h.name}_camera.csv') for h in runs)
    message = made.run(
        'calibrate',
        *(f'{h.name}.csv' for h in runs),
        *references,
        *('--exposure', str(made.plan.exposure), '--params-file', 'nominal.yaml', '--out', f'{stem}_found', '--quiet'),
    )
    shutil.copy(made.folder / f'{stem}_found' / 'rig.yaml', made.folder / f'{stem}.yaml')
    rig_files(made, stem, {})
    return message


def redone(folder: Path, plan: Plan, *, quiet: bool = False) -> dict[str, Any]:
    """Return the whole experiment: the content of ``summary.json``. ``folder`` must be new or empty."""
    made = bench(folder, plan)
    sidebar = [HeldLoad(force, side) for side in (1, -1) for force in plan.forces]
    link = [HeldLoad(force, 0) for force in plan.forces]
    every = [*sidebar, *link]
    bar = tqdm(total=3 * len(every) + 2, unit=' steps', disable=quiet, ncols=80)
    cameras: dict[str, dict[str, Array]] = {}
    for load_case in every:
        bar.set_description(load_case.name)
        record(made, load_case)
        bar.update()
        made.run('camera', load_case.name, '--params-file', 'camera.yaml', '--out', f'{load_case.name}_camera.csv')
        cameras[load_case.name] = table(made.folder / f'{load_case.name}_camera.csv')
        images = sorted((made.folder / load_case.name).glob('*.png'))
        shutil.copy(images[-1], made.folder / f'{load_case.name}.png')
        shutil.rmtree(made.folder / load_case.name)
        bar.update()
    bar.set_description('calibrate')
    shutil.copy(made.folder / 'nominal.yaml', made.folder / 'before.yaml')
    rig_files(made, 'before', zeroed(made, sidebar[0].name))
    message = calibrated(made, sidebar, 'after')
    bar.update()
    calibrated(made, [h for h in sidebar if h.side > 0], 'one_side')
    bar.update()
    drawn: dict[str, dict[str, Curves]] = {}
    answers: dict[str, dict[str, Any]] = {}
    for load_case in every:
        bar.set_description(f'validate {load_case.name}')
        if load_case.side >= 0:
            drawn[load_case.name] = {stem: curves(made, load_case, stem) for stem in STEMS}
        if load_case.side == 0:
            answers[load_case.name] = {f'{stem} truth': evaluated(made, load_case, stem, 'truth') for stem in RIGS}
            answers[load_case.name] |= {f'{stem} camera': evaluated(made, load_case, stem, 'camera') for stem in STEMS}
        bar.update()
    bar.close()
    summary = _summary(made, link, answers)
    summary['calibrate'] = message.strip().splitlines()
    (folder / 'summary.json').write_text(json.dumps(summary, indent=1) + '\n')
    page = page_of(made.folder, plan.forces, summary, drawn, cameras, answers, made.truth, made.typed)
    (folder / 'page.html').write_text(page)
    return summary


def _summary(made: Bench, link: Sequence[HeldLoad], answers: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Largest errors of ``exact`` on the link, as shares of the deflection at 50 N, by rig file and judge."""
    at = [motion(replace(made.plan, rest=0.0, held=5.0), HeldLoad(50.0, side))[-1] for side in (0, 1)]
    across, twist = float(np.hypot(*at[0][:2])), float(abs(at[1][2]))
    scale = dict(zip(AXES, (across, across, twist), strict=True))
    shares = {
        stem: {
            axis: max(answers[h.name][f'{stem} truth']['solvers'][solver][axis]['largest'] / scale[axis] for h in link)
            for axis in AXES
        }
        for stem, solver in RIGS.items()
    }
    clock = answers[link[0].name]['after camera']['offset']
    return {
        'seed': made.plan.seed,
        'deflection': {'across': across, 'twist': twist},
        'limit': made.plan.limit,
        'shares': shares,
        'clock': {'true': -CLOCK, 'value': clock['value'], 'interval': clock['interval']},
        'holds': all(v <= made.plan.limit for v in shares['after'].values()),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Do it, and say where the page is."""
    parser = options(__doc__)
    parser.add_argument('--out', type=Path, default=Path('build/thesis'), help='a new folder (default %(default)s)')
    parser.add_argument('--seed', type=int, default=1, help='of the rig')
    parser.add_argument('--short', action='store_true', help='50 N only, few frames: some seconds, less precise')
    args = parser.parse_args(argv)
    if args.out.exists() and any(args.out.iterdir()):
        parser.error(f'--out {args.out}: is not empty')
    found = redone(args.out, replace(SHORT if args.short else Plan(), seed=args.seed))
    for stem, axes in found['shares'].items():
        words = ', '.join(f'{axis} {100.0 * share:.3f} %' for axis, share in axes.items())
        print(f'{stem:15s} largest error on the link: {words}')
    answer = 'within' if found['holds'] else 'BEYOND'
    text = f'{answer} {100.0 * found["limit"]:g} % after calibration; see {args.out / "page.html"}'
    return conclude(text, found['holds'])


if __name__ == '__main__':
    raise SystemExit(main())
