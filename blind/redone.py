# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The thesis's experiment redone, with the product's own commands: camera, calibrate, validate, replay."""

import base64
import contextlib
import html
import io
import itertools
import json
import math
import shlex
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from scipy.interpolate import CubicSpline
from tqdm import tqdm

from blind import generator, misaligned, render
from blind.campaign import conclude, options
from blind.generator import Array
from psd_deflection.base.charts import SMALL, Chart, Colour, Panel, Series
from psd_deflection.base.charts import drawn as drawn_chart
from psd_deflection.base.pages import page
from psd_deflection.base.pages import table as table_of
from psd_deflection.camera.opencv import opencv
from psd_deflection.cli.main import main as psd_deflection
from psd_deflection.records import CHANNELS
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
SHOWN = (('theta', 2, 'θ / °', math.degrees(1.0)), ('dx', 0, 'ΔX / mm', 1e3), ('dy', 1, 'ΔY / mm', 1e3))
"""Axes in the order of the thesis: name, column, label, factor."""
SYMBOLS = {'theta': 'θ', 'dx': 'ΔX', 'dy': 'ΔY'}
STYLES: dict[str, tuple[str, Colour]] = {
    'wls_sidebar': ('weights [0.03, 0.5, 10, 0.1]', 'red'),
    'wls_link': ('weights [3, 0.5, 10, 0.1]', 'orange'),
    'wls': ('WLS', 'green'),
    'iterative': ('iterative', 'violet'),
    'exact': ('exact', 'blue'),
}
PRINTED = {'theta': ('-7.4 %', '1.5 %'), 'dx': ('84 %', '21 %'), 'dy': ('5.8 %', '5.2 %')}
"""Table 5.1 of the thesis: iterative, weighted least squares."""
NUMBERS = {'sidebar_right_50N': '5.12-5.14', 'sidebar_right_30N': '5.15-5.17', 'sidebar_right_10N': '5.18-5.20'}
NUMBERS |= {'link_50N': '5.21-5.26', 'link_30N': '5.27-5.29'}
CALM = 1.0  # s at the end of a recording in which the link rests under its weight.
STEMS = ('before', 'after')
RIGS = {f'{stem}{place}': 'wls' if place else 'exact' for stem in STEMS for place in ('', '_sidebar', '_link')}
RIGS['one_side'] = 'exact'
"""Rig files, and the method that the summary has of each. ``one_side``: calibrated by the right side alone."""


class Curves(NamedTuple):
    """``t`` (n,) s; ``poses``: by method (n, 3), m, m, rad."""

    t: Array
    poses: Mapping[str, Array]


Drawn = Mapping[str, Mapping[str, Curves]]
Cameras = Mapping[str, Mapping[str, Array]]
Answers = Mapping[str, Mapping[str, Any]]


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
        roll=math.radians(rng.uniform(-2.0, 2.0)),
        tilt=tuple(rng.uniform(-0.04, 0.04, 2)),
        slope=(0.2, -0.1),
        shot_noise=0.1,
    )
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(NOMINAL, folder / 'nominal.yaml')
    camera = {'camera.matrix': scene.matrix, 'camera.distortion': list(scene.distortion)}
    target = {'target.spacing': scene.spacing, 'target.radius': scene.radius}
    (folder / 'camera.yaml').write_text(yaml.safe_dump(target | camera))
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
    save(made.folder / f'{load_case.name}.csv', ('t', *CHANNELS), np.column_stack((t, volts)))
    at = CubicSpline(t, pose)
    k = made.truth['link.slope_ratio'] / misaligned.LENGTH

    def observed(instant: float) -> render.Pose:
        dx, dy, theta = (float(v) for v in at(instant))
        return render.Pose(dx, dy, theta, -k * dy, k * dx)

    images = made.folder / load_case.name
    images.mkdir()
    cv2 = opencv()
    starts = np.arange(0.02, t[-1] - 0.02, 1.0 / plan.rate)
    listed, true = ['file,t,exposure'], []
    still = render.clean(made.scene, [render.Pose()])
    for number, start in enumerate(starts.tolist()):
        poses = render.over_exposure(observed, start, plan.exposure, plan.instants)
        rests = start + plan.exposure < plan.rest
        image = render.developed(made.scene, still if rests else render.clean(made.scene, poses), rng)
        name = f'{number:04}.png'
        cv2.imwrite(str(images / name), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        listed.append(f'{name},{start + CLOCK:.9f},{plan.exposure}')
        true.append((start + plan.exposure / 2, *render.mean_of(poses)))
    (images / 'frames.csv').write_text('\n'.join(listed) + '\n')
    save(made.folder / f'{load_case.name}_truth.csv', ('t', *AXES), np.array(true))


def table(path: Path) -> dict[str, Array]:
    """Columns of a CSV; what is empty or a word is NaN."""
    rows: Any = np.genfromtxt(path, delimiter=',', names=True, dtype=np.float64)
    return {name: rows[name] for name in rows.dtype.names or ()}


def save(path: Path, head: Sequence[str], rows: Array) -> None:
    np.savetxt(path, rows, '%.9g', ',', header=','.join(head), comments='')


def zeroed(made: Bench, name: str) -> dict[str, object]:
    """Return the zero before the load, as ~/zero takes it: the mean reading of the unloaded link, m."""
    rows = table(made.folder / f'{name}.csv')
    at = {n: float(v[rows['t'] < 0.9 * made.plan.rest].mean() * generator.MM_PER_V) for n, v in rows.items()}
    return {f'psd_{n}.zero': [at[f'x{n}'], at[f'y{n}']] for n in (1, 2)}


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
    poses: dict[str, Array] = {}
    for variant in ('', *(f'_{place}' for place in WEIGHTS)):
        out = f'{load_case.name}_{stem}{variant}.csv'
        made.run('replay', f'{load_case.name}.csv', '--params-file', f'{stem}{variant}.yaml', '--out', out)
        rows = table(made.folder / out)
        for name in ('wls',) if variant else ('wls', 'iterative', 'exact'):
            poses[f'{name}{variant}'] = np.column_stack([rows[f'{name}_{axis}'] for axis in AXES])
    return Curves(rows['t'], poses)


def evaluated(made: Bench, load_case: HeldLoad, stem: str, source: str) -> Any:
    """Return the answer of ``validate``: by the camera, its clock put right, or by the truth."""
    reference = f'{load_case.name}_{source}.csv'
    align = ['--align', '--exposure', str(made.plan.exposure)] if source == 'camera' else []
    rig = ('--params-file', f'{stem}.yaml')
    words = ('--reference', reference, '--solver', 'all', *rig, *align, '--json')
    return json.loads(made.run('validate', f'{load_case.name}.csv', *words))


def calibrated(made: Bench, runs: Sequence[HeldLoad], stem: str) -> str:
    references = itertools.chain.from_iterable(('--reference', f'{h.name}_camera.csv') for h in runs)
    words = ('--exposure', str(made.plan.exposure), '--params-file', 'nominal.yaml', '--quiet')
    message = made.run('calibrate', *(f'{h.name}.csv' for h in runs), *references, *words, '--out', f'{stem}_found')
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
    body = _body(made, summary, drawn, cameras, answers)
    (folder / 'page.html').write_text(page('The experiment of the thesis, redone', body))
    return summary


def _summary(made: Bench, link: Sequence[HeldLoad], answers: Answers) -> dict[str, Any]:
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
    clock, limit = answers[link[0].name]['after camera']['offset'], made.plan.limit
    out = {'seed': made.plan.seed, 'deflection': {'across': across, 'twist': twist}, 'limit': limit, 'shares': shares}
    out['clock'] = {'true': -CLOCK, 'value': clock['value'], 'interval': clock['interval']}
    return {**out, 'holds': all(v <= limit for v in shares['after'].values())}


def _on_the_link(forces: Sequence[float], summary: Mapping[str, Any], answers: Answers) -> str:
    scale = {axis: summary['deflection']['twist' if axis == 'theta' else 'across'] for axis in SYMBOLS}
    rows = []
    for words, stem in (('rig file', 'before'), ('calibrated', 'after')):
        for method, (label, _) in STYLES.items():
            solver, _, weights = method.partition('_')
            cells = []
            for force in forces:
                answer = answers[f'link_{force:.0f}N'][f'{stem}{"_" if weights else ""}{weights} truth']
                errors = answer['solvers'][solver]
                cells += [f'{100 * errors[axis]["largest"] / scale[axis]:.3f}' for axis in SYMBOLS]
            rows.append((words if method == 'wls_sidebar' else '', label, *cells))
    head = [f'{force:.0f} N, {SYMBOLS[axis]}' for force in forces for axis in SYMBOLS]
    return table_of(('rig', 'method', *head), rows)


def relative_errors(curves: Curves, camera: Mapping[str, Array]) -> dict[str, Array]:
    """By method (3,): the mean at the end of a recording over that of the camera, less one."""
    late = curves.t > curves.t[-1] - CALM
    observed = camera['t'] > camera['t'][-1] - CALM
    reference = np.array([np.nanmean(camera[axis][observed]) for axis in ('dx', 'dy', 'theta')])
    return {method: poses[late].mean(axis=0) / reference - 1.0 for method, poses in curves.poses.items()}


def _table_51(name: str, drawn: Drawn, cameras: Cameras) -> str:
    methods = ('wls_sidebar', 'wls', 'iterative', 'exact')
    errors = {stem: relative_errors(curves, cameras[name]) for stem, curves in drawn[name].items()}
    rows = []
    for axis, column, _, _ in SHOWN:
        cells = [f'{100 * errors[stem][m][column]:+.2f} %' for stem in ('before', 'after') for m in methods]
        rows.append((SYMBOLS[axis], *PRINTED[axis], *cells))
    labels = ('by hand', 'WLS', 'iterative', 'exact')
    head = ('', 'thesis: iterative', 'thesis: WLS', *(f'before: {n}' for n in labels), *(f'after: {n}' for n in labels))
    return table_of(head, rows)


def _over_time(words: str, two: Mapping[str, Curves], camera: Mapping[str, Array], on_link: bool) -> Chart:
    panels = []
    for stem, curves in two.items():
        rig = {'before': 'rig file', 'after': 'calibrated'}[stem]
        for name, column, label, factor in SHOWN:
            styles = {m: style for m, style in STYLES.items() if on_link or m != 'wls_link'}
            series = [Series(s[0], curves.t, factor * curves.poses[m][:, column], s[1]) for m, s in styles.items()]
            series.append(Series('camera', camera['t'], factor * camera[name], 'text', 'points'))
            panels.append(Panel(series, 'time / s', f'{rig}: {label}', height=SMALL))
    return Chart(f'{words}: camera and methods over time', panels, beside=3)


def _body(made: Bench, summary: Mapping[str, Any], drawn: Drawn, cameras: Cameras, answers: Answers) -> Iterator[str]:
    largest = f'sidebar_right_{made.plan.forces[0]:.0f}N'
    code = base64.b64encode((made.folder / f'{largest}.png').read_bytes()).decode()
    words = ', '.join(f'{symbol} {100 * summary["shares"]["after"][axis]:.3f} %' for axis, symbol in SYMBOLS.items())
    yield '<h1>The experiment of the thesis, redone</h1>'
    yield (
        f'<p class=verdict>Calibrated on the sidebar alone, the rig is at most {words} of the 50 N deflection off on '
        f'the link: the bound of {100 * summary["limit"]:g} % {"holds" if summary["holds"] else "does not hold"}.</p>'
    )
    yield f'<img width="320" alt="the target: three white discs on black" src="data:image/png;base64,{code}">'
    yield '<h2>The weight moves to the link</h2><p class=quiet>Largest error, in percent of the deflection at 50 N.</p>'
    yield _on_the_link(made.plan.forces, summary, answers)
    yield (
        '<p>Hung on one side only, the weight turns and bends the link in the same proportion at every load: '
        f'{100 * summary["shares"]["one_side"]["theta"]:.2f} % in θ remain. It has to hang on both sides.</p>'
    )
    yield '<h2>Table 5.1 anew</h2><p class=quiet>Error relative to the camera, on the sidebar at rest.</p>'
    yield _table_51(largest, drawn, cameras)
    yield '<h2>Figures 5.12 to 5.29 anew</h2><p class=quiet>Above: the rig as its file says. Below: calibrated.</p>'
    for name, two in drawn.items():
        title = f'Figures {NUMBERS[name]}: {name}' if name in NUMBERS else name
        yield f'<h3>{title}</h3>'
        yield drawn_chart(_over_time(title, two, cameras[name], name.startswith('link')))
    yield '<h2>What was hidden</h2>'
    rows = [(name, f'{value:+.5g}') for name, value in made.truth.items()]
    yield table_of(('parameter', 'true value, SI units'), rows)
    yield '<h2>What calibrate says</h2>' + ''.join(f'<p>{html.escape(line)}</p>' for line in summary['calibrate'])
    lines = html.escape('\n'.join(dict.fromkeys(made.typed)))
    yield f'<h2>Commands</h2><pre role="group" tabindex="0" aria-label="commands">{lines}</pre>'


def main(argv: Sequence[str] | None = None) -> int:
    parser = options(__doc__)
    parser.add_argument('--out', type=Path, default=Path('build/thesis'), help='a new folder (default %(default)s)')
    parser.add_argument('--seed', type=int, default=1, help='of the rig')
    parser.add_argument('--short', action='store_true', help='50 N only, few frames: some seconds, less precise')
    args = parser.parse_args(argv)
    if args.out.exists() and any(args.out.iterdir()):
        parser.error(f'--out {args.out}: is not empty')
    summary = redone(args.out, replace(SHORT if args.short else Plan(), seed=args.seed))
    for stem, axes in summary['shares'].items():
        words = ', '.join(f'{axis} {100.0 * share:.3f} %' for axis, share in axes.items())
        print(f'{stem:15s} largest error on the link: {words}')
    limit = f'{"within" if summary["holds"] else "BEYOND"} {100.0 * summary["limit"]:g} %'
    return conclude(f'{limit} after calibration; see {args.out / "page.html"}', summary['holds'])


if __name__ == '__main__':
    raise SystemExit(main())
