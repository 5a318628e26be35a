# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Whether calibrate tells the truth: rigs with random misalignments, made by :mod:`blind.misaligned`."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from blind import generator, misaligned
from blind.campaign import chunk, options, over
from blind.generator import Array
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.model.simulation.catalogue import effects_to_values
from psd_deflection.records import DeflectionEstimate
from psd_deflection.rig.config import Rig, replace_values, rig_from_values
from psd_deflection.rig.parameter_files import flattened
from psd_deflection.studies.budget.certificate import CertificateProblem, certify
from psd_deflection.studies.budget.inputs import INPUTS, REFERENCE_INPUTS, read_inputs
from psd_deflection.studies.calibrate.calibrate import OPEN, Calibration, calibrate
from psd_deflection.studies.calibrate.check import check
from psd_deflection.studies.calibrate.dark import dark_levels, values_of_levels
from psd_deflection.studies.calibrate.fit import NAMES
from psd_deflection.studies.calibrate.observation import CalibrationRun
from psd_deflection.studies.calibrate.result import result, values_of

HOLDS, SECONDS = 24, 2.5
AFTER, AFTER_SECONDS = 8, 1.5
SIZE = 20
BORDER = 0.04  # How far from the limit a share must be for the two Fisher informations to agree on its side.
GROUPS = (
    *('psd_1.rotation', 'psd_2.rotation', 'psd_1.gain', 'psd_2.gain', 'psd_1.center', 'psd_2.center'),
    *('psd_1.nonlinearity', 'psd_2.nonlinearity'),
)
"""Groups that are moved: a camera shows three tolerances of them."""
Z95 = 1.959964
CHI95 = 7.814728  # Chi-square of three degrees of freedom.


class Score(NamedTuple):
    """One rig. ``z``: by parameter, error over its standard deviation. ``inside``: share of published poses within
    their 95 % ellipsoid; ``axes`` (3,): within 1.96 standard deviations; ``noise_only``: within the ellipsoid of the
    noise. ``before``, ``after`` (3,): rms errors of the pose. ``gap``: held out, before and after, m. ``unreported``:
    parameters that the Fisher information leaves open and calibrate does not report; ``message``: the reverse.
    ``moved``: the group that was moved, or ''; ``named``: what --check says, '' if it holds; ``like``: what it cannot
    tell that from."""

    z: dict[str, float]
    inside: float
    axes: Array
    noise_only: float
    before: Array
    after: Array
    gap: tuple[float, float]
    unreported: list[str]
    message: list[str]
    moved: str
    named: str
    like: list[str]


def run_of(recorded: misaligned.Recorded) -> CalibrationRun:
    t = np.arange(len(recorded.volts)) / generator.RATE
    return CalibrationRun('blind', t, recorded.volts, t[recorded.frames], recorded.reference)


def darkened(rig: Rig, light: tuple[misaligned.Light, misaligned.Light], rng: np.random.Generator) -> Rig:
    """Return the rig file's content after a recording of ten seconds with both lasers off."""
    volts = misaligned.darkness(light, 10.0, rng)
    run = CalibrationRun('dark', np.arange(len(volts)) / generator.RATE, volts, np.zeros(0), np.zeros((0, 3)))
    return replace_values(rig, values_of_levels(dark_levels([run], rig)))


def calibrated_rig(rig: Rig, run: CalibrationRun) -> tuple[Rig, Calibration]:
    calibration = calibrate([run], rig)
    values, effects = values_of(calibration, 'today')
    more = flattened({'effects': effects_to_values(effects)}, 'effects') if effects else {}
    return replace_values(rig, {**values, **more}), calibration


def measured(rig: Rig, volts: Array, zero_after: int = 25) -> tuple[Array, Array, Array]:
    """Blocks (n,), poses (n, 3), covariances (n, 3, 3) of a run whose zero is taken after that many blocks."""
    pipeline = Pipeline(rig)
    estimates: list[DeflectionEstimate] = []
    cut = zero_after * SIZE
    for first, part in ((0, volts[:cut]), (cut, volts[cut:])):
        records = [r for r in pipeline.process(chunk(part, first)) if isinstance(r, DeflectionEstimate) and r.primary]
        if first:
            estimates += records
        elif pipeline.zero() is None:
            raise RuntimeError(f'no zero: {pipeline.zero_rejected}')
    block, pose, covariance = (np.array([getattr(e, n) for e in estimates]) for n in ('block', 'pose', 'covariance'))
    return block, pose, covariance.reshape(-1, 3, 3)


def shares_left_open(truth: Mapping[str, float], pose: Array, frames: npt.NDArray[np.int64]) -> dict[str, float]:
    """Of each parameter the standard deviation after over before, by this generator's own derivatives."""
    at = pose[frames][::4]
    names = list(truth)
    tolerances = np.array([misaligned.tolerance(n) for n in names])
    slopes = np.empty((len(at), 4, len(names)))
    for i, name in enumerate(names):
        up, down = dict(truth), dict(truth)
        up[name] += 1e-2 * tolerances[i]
        down[name] -= 1e-2 * tolerances[i]
        slopes[:, :, i] = (misaligned.dots(up, at) - misaligned.dots(down, at)) / 2e-2
    by_pose = np.empty((len(at), 4, 3))
    for i, step in enumerate((1e-6, 1e-6, 1e-5)):
        d = np.eye(3)[i] * step
        by_pose[:, :, i] = (misaligned.dots(truth, at + d) - misaligned.dots(truth, at - d)) / (2 * step)
    moved = by_pose * misaligned.CAMERA
    # A polynomial of degree 6 through 21 samples has 0.23 of a sample's variance in its middle.
    dot = 0.23 * (generator.MM_PER_V * generator.SIGMA) ** 2
    covariance = np.einsum('nij,nkj->nik', moved, moved) + dot * np.eye(4)
    weighted = np.linalg.solve(covariance, slopes)
    information = 4.0 * np.einsum('nij,nik->jk', slopes, weighted)
    posterior = np.linalg.inv(information + np.eye(len(names)))
    return dict(zip(names, np.sqrt(np.diag(posterior)).tolist(), strict=True))


def shifted(truth: Mapping[str, float], group: str, rng: np.random.Generator) -> dict[str, float]:
    """Return the rig after one group moved by three tolerances, each parameter of it to a side by chance."""
    out = dict(truth)
    for name in out:
        if name.startswith(group):
            out[name] += 3.0 * misaligned.tolerance(name) * float(rng.choice((-1.0, 1.0)))
    return out


def score(seed: int, lit: bool = False) -> Score:
    """One rig. ``lit``: in the light of a room, which is another one after the calibration; --dark is done in both."""
    rng = np.random.default_rng([20, seed])
    truth = misaligned.draw(rng)
    pose = misaligned.poses(misaligned.pushes(rng, HOLDS, SECONDS))
    first = misaligned.draw_light(rng) if lit else None
    recorded = misaligned.record(truth, pose, rng, outliers=0.01, light=first)
    nominal = rig_from_values({})
    rig, calibration = calibrated_rig(nominal if first is None else darkened(nominal, first, rng), run_of(recorded))
    light = None if first is None else misaligned.relit(first, rng)
    if light is not None:
        rig = darkened(rig, light, rng)
    sd = calibration.sd
    z = {n: float((calibration.values[i] - truth[n]) / sd[i]) for i, n in enumerate(NAMES) if n in truth}
    later = misaligned.poses(misaligned.pushes(rng, AFTER, AFTER_SECONDS))
    volts = misaligned.record(truth, later, rng, light=light).volts
    middle = generator.between(later)
    block, estimate, covariance = measured(rig, volts)
    error = estimate - middle[block]
    distance = np.einsum('ni,nij,nj->n', error, np.linalg.inv(covariance), error)
    _, _, noise = measured(replace_values(rig, {'covariance': 'noise', 'consistency': 'report'}), volts)
    noise_distance = np.einsum('ni,nij,nj->n', error, np.linalg.inv(noise), error)
    block_0, estimate_0, _ = measured(nominal, volts)
    error_0 = estimate_0 - middle[block_0]
    alone = {next(iter(d.parts)) for d in calibration.undetermined if len(d.parts) == 1}
    shares = shares_left_open(truth, pose, recorded.frames)
    package_shares = {n: s for n, s in shares.items() if n in NAMES}
    # Told alone, or as the largest part of what moves together.
    reported = alone | {max(d.parts, key=lambda n: abs(d.parts[n])) for d in calibration.undetermined}
    every = {n for d in calibration.undetermined for n in d.parts}
    unreported = [n for n, s in package_shares.items() if s > OPEN + BORDER and n not in every]
    message = [n for n in reported & alone if package_shares.get(n, 1.0) < OPEN - BORDER]
    group = GROUPS[seed // 2 % len(GROUPS)] if seed % 2 else ''
    moved = shifted(truth, group, rng) if group else truth
    later_motion = misaligned.poses(misaligned.pushes(rng, 12, SECONDS))
    again = misaligned.record(moved, later_motion, rng, outliers=0.01, light=light)
    checked = check([run_of(again)], rig)
    axes = np.abs(error) <= Z95 * np.sqrt(np.einsum('nii->ni', covariance))
    inside, noise_only = (float(np.mean(d <= CHI95)) for d in (distance, noise_distance))
    before, after = (np.sqrt(np.mean(e**2, axis=0)) for e in (error_0, error))
    gap = calibration.gap.heldout_before, calibration.gap.heldout_after
    named = '' if checked.unchanged else checked.groups[0].group
    shown = z, inside, axes.mean(axis=0), noise_only, before, after, gap
    return Score(*shown, unreported, message, group, named, checked.like)


def errors_over_sd(seed: int, reference: float) -> dict[str, float]:
    """By parameter, of a rig with unequal channels; ``reference``: noise of the reference, by that of the camera."""
    rng = np.random.default_rng([21, seed])
    truth = misaligned.draw(rng)
    sigma = generator.SIGMA * np.exp(rng.uniform(np.log(0.25), np.log(2.0), 6))
    pose = misaligned.poses(misaligned.pushes(rng, HOLDS, SECONDS))
    sds = [reference * sd for sd in misaligned.CAMERA]
    recorded = misaligned.record(truth, pose, rng, sigma=sigma, reference_sd=sds)
    calibration = calibrate([run_of(recorded)], rig_from_values({}))
    return {n: float((calibration.values[i] - truth[n]) / calibration.sd[i]) for i, n in enumerate(NAMES) if n in truth}


REFERENCE_SCALE = 5e-4  # Relative standard deviation of the lengths, and of the angles, of the reference.
POINTING = 2e-6  # rad, standard deviation by which a beam has turned since the zero was taken.
DRIFT, WARMER, AREA = 40e-6, 2.0, 10e-3
"""Largest drift of a detector, 1/K of its length, over so many K; its length, m."""
CERTIFIED = {
    **dict.fromkeys(('reference_scale', 'reference_angle_scale'), REFERENCE_SCALE),
    **dict.fromkeys(('profile_change', 'air_gradient', 'air_step', 'interference', 'bracket_temperature'), 0.0),
}
CERTIFIED |= {'pointing_drift': POINTING, 'drift_coefficient': DRIFT, 'temperature_change': WARMER, 'zero_blocks': 25.0}
"""Inputs of the certificate as this generator has them."""
STATED, HELD = 6, 4  # Poses of each rig, one estimate at each, and blocks for which each is held.


class Certified(NamedTuple):
    """One rig. ``covered`` (n, 3): whether U covers the error of each pose; ``ratio`` (n, 3): the error over U."""

    covered: npt.NDArray[np.bool_]
    ratio: Array


def certified(seed: int) -> Certified:
    """Return one rig: calibrated by a reference whose scale is wrong, certified, and measured after it has drifted."""
    rng = np.random.default_rng([22, seed])
    truth = misaligned.draw(rng)
    # Half as long as the others: U is to hold of a short calibration, too.
    pose = misaligned.poses(misaligned.pushes(rng, HOLDS // 2, SECONDS))
    lengths, angles = (1.0 + rng.normal(0.0, REFERENCE_SCALE, 2)).tolist()
    recorded = misaligned.record(truth, pose, rng)
    scaled = replace(recorded, reference=recorded.reference * (lengths, lengths, angles))
    rig, calibration = calibrated_rig(rig_from_values({}), run_of(scaled))
    poses = rng.uniform(-1.0, 1.0, (STATED, 3)) * (2e-3, 2e-3, 0.015)
    inputs = read_inputs(None, CERTIFIED, declared=(*INPUTS, *REFERENCE_INPUTS))
    asked = [(x, y, theta) for x, y, theta in poses.tolist()]
    stated = certify(CertificateProblem(rig, result(calibration, 'today'), inputs, asked)).stated
    held = np.repeat(np.vstack((np.zeros(3), poses)), [25 * SIZE, *([HELD * SIZE] * STATED)], axis=0)
    volts = misaligned.record(truth, held, rng).volts
    beams = rng.normal(0.0, POINTING * misaligned.LENGTH, 4)
    detectors = rng.uniform(-1.0, 1.0, 4) * DRIFT * WARMER * AREA
    volts[25 * SIZE :, [0, 1, 3, 4]] += (beams + detectors) / generator.MM_PER_V
    # Of the estimates alone: their own covariances are not asked.
    _, estimates, _ = measured(replace_values(rig, {'covariance': 'noise', 'consistency': 'report'}), volts)
    # The last block of each pose: the step to it is over.
    error = estimates[HELD - 1 :: HELD] - poses
    uncertainty = np.stack([c.uncertainty for c in stated])
    return Certified(np.abs(error) <= uncertainty, error / uncertainty)


def table_of_certificates(rigs: Sequence[Certified]) -> Iterator[str]:
    covered = np.stack([rig.covered for rig in rigs])
    ratio = np.sqrt(np.mean(np.stack([rig.ratio for rig in rigs]) ** 2, axis=(0, 1)))
    yield '| | ΔX | ΔY | θ | all |\n|---|---|---|---|---|'
    x, y, t = covered.mean(axis=(0, 1)).tolist()
    words = f'U covers the error, {len(rigs)} rigs of {STATED} poses'
    yield f'| {words} | {x:.1%} | {y:.1%} | {t:.1%} | {covered.mean():.1%} |'
    yield f'| rms of error over U (of a normal one 0.51) | {ratio[0]:.2f} | {ratio[1]:.2f} | {ratio[2]:.2f} | |'


def table_of_errors(scale: float, errors: Sequence[Mapping[str, float]]) -> Iterator[str]:
    for words, part in (('gains', '.gain_'), ('all parameters', '')):
        z = np.array([v for e in errors for name, v in e.items() if part in name])
        yield f'| {scale:g} | {words} | {np.mean(np.abs(z) <= Z95):.1%} of {z.size} | {np.sqrt(np.mean(z**2)):.2f} |'


def table(scores: Sequence[Score]) -> Iterator[str]:
    every_z = np.array([list(s.z.values()) for s in scores])
    moved = [s for s in scores if s.moved]
    still = [s for s in scores if not s.moved]
    length = np.array([1.0, 1.0, 0.1])
    yield '| parameter | inside 95 % | rms of error over sd |\n|---|---|---|'
    for name in scores[0].z:
        z = np.array([s.z[name] for s in scores])
        yield f'| {name} | {np.mean(np.abs(z) <= Z95):.1%} | {np.sqrt(np.mean(z**2)):.2f} |'
    yield f'| all | {np.mean(np.abs(every_z) <= Z95):.1%} | |'
    before, after = (np.sqrt(np.mean([getattr(s, n) ** 2 for s in scores], axis=0)) for n in ('before', 'after'))
    yield ''
    yield '| published pose | ΔX | ΔY | θ | joint |\n|---|---|---|---|---|'
    inside = np.mean([s.axes for s in scores], axis=0)
    joint, alone = (np.mean([getattr(s, n) for s in scores]) for n in ('inside', 'noise_only'))
    yield f'| inside 95 %, total | {inside[0]:.1%} | {inside[1]:.1%} | {inside[2]:.1%} | {joint:.1%} |'
    yield f'| inside 95 %, noise alone | | | | {alone:.1%} |'
    for words, e in (('before', before), ('after', after)):
        yield f'| rms error {words} | {e[0] * 1e6:.2f} µm | {e[1] * 1e6:.2f} µm | {np.degrees(e[2]) * 1e3:.2f} mdeg | |'
    yield ''
    norms = [[np.linalg.norm(e * length) for e in (s.before, s.after)] for s in scores]
    worse = sum(bool(s.gap[1] > s.gap[0] or b > a) for s, (a, b) in zip(scores, norms, strict=True))
    yield f'- rigs that came out worse: {worse} of {len(scores)}'
    unreported = sum(len(s.unreported) for s in scores)
    yield f'- parameters that the Fisher information leaves open and nothing reports: {unreported} of {every_z.size}'
    yield f'- parameters reported as open that it does not leave open: {sum(len(s.message) for s in scores)}'
    named = sum(s.named == s.moved for s in moved) / max(len(moved), 1)
    like = sum(s.moved in (s.named, *s.like) for s in moved) / max(len(moved), 1)
    yield f'- --check: the moved group is named in {named:.1%} of {len(moved)}, or among the like: {like:.1%}'
    yield f'- --check: false alarms in {sum(bool(s.named) for s in still) / max(len(still), 1):.1%} of {len(still)}'


def main(argv: Sequence[str] | None = None) -> int:
    parser = options(__doc__, jobs=2)
    parser.add_argument('--rigs', type=int, default=200)
    parser.add_argument('--light', action='store_true', help='1 to 4 %% of other light, which changes; --dark is used')
    parser.add_argument('--unequal', action='store_true', help='parameters alone, of rigs with unequal channels')
    parser.add_argument('--certificate', action='store_true', help='whether the U of a certificate covers the truth')
    args = parser.parse_args(argv)
    if args.certificate:
        print('\n'.join(table_of_certificates(list(over(certified, range(args.rigs), args.jobs, 'rigs')))))
        return 0
    if args.unequal:
        print('| noise of the reference, x | of | inside 95 % | rms of error over sd |\n|---|---|---|---|')
        for scale in (0.1, 1.0, 4.0):
            errors = list(over(partial(errors_over_sd, reference=scale), range(args.rigs), args.jobs, 'rigs'))
            print('\n'.join(table_of_errors(scale, errors)))
        return 0
    scores = list(over(partial(score, lit=args.light), range(args.rigs), args.jobs, 'rigs'))
    print('\n'.join(table(scores)))
    for number, s in enumerate(scores):
        if s.moved != s.named or s.unreported or s.message:
            reported = f'moved {s.moved or "nothing"}, named {s.named or "nothing"} {s.like}'
            print(f'rig {number}: {reported}; {s.unreported} {s.message}')
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
