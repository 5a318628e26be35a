# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""How true the camera is: rendered frames, 10,000 of them as bad as a laboratory makes them."""

import math
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from blind import render
from blind.campaign import conclude, options
from psd_deflection.camera import boards
from psd_deflection.camera.answer import FrameAnswer, Status
from psd_deflection.camera.boards import Board
from psd_deflection.camera.opencv import opencv
from psd_deflection.camera.reference import CameraReference
from psd_deflection.camera.settings import CameraSettings
from psd_deflection.camera.target import target_of

REST = 4
RUN = 20  # Frames of one rendered rig, after those at rest.
SIGMAS = 5.0


def settings_of(scene: render.Scene, rest: int = 0) -> CameraSettings:
    m, d, view, spacing, radius = tuple(scene.matrix), tuple(scene.distortion), scene.view, scene.spacing, scene.radius
    return CameraSettings(rest_frames=rest, matrix=m, distortion=d, view=view, spacing=spacing, radius=radius)


def rested(
    scene: render.Scene, settings: CameraSettings, frames: int, still: Any, rng: np.random.Generator
) -> CameraReference:
    """What has seen so many frames of the plate at rest, ``still`` without noise."""
    reference = CameraReference(replace(settings, rest_frames=frames), target_of)
    for _ in range(frames):
        reference.take(0, render.developed(scene, still, rng))
    return reference


def random_scene(rng: np.random.Generator) -> Any:
    """A camera, a target and a light as a laboratory may have them."""
    lens, white = rng.uniform(-0.25, 0.1), rng.uniform(120.0, 250.0)
    return render.Scene(
        focal=rng.uniform(1200.0, 2600.0),
        centre=(rng.uniform(300.0, 340.0), rng.uniform(220.0, 260.0)),
        distortion=(lens, rng.uniform(-0.1, 0.1), *rng.uniform(-1e-3, 1e-3, 2)) if rng.random() < 0.7 else (),
        distance=rng.uniform(0.38, 0.6),
        roll=rng.uniform(-0.6, 0.6),
        tilt=tuple(rng.uniform(-0.3, 0.3, 2)),
        aim=tuple(rng.uniform(-0.012, 0.012, 2)),
        view='base' if rng.random() < 0.3 else 'outside',
        black=rng.uniform(5.0, 50.0),
        white=white,
        slope=tuple(rng.uniform(-0.6, 0.6, 2)),
        blur=rng.uniform(0.3, 2.0),
        read_noise=rng.uniform(0.5, 6.0),
        shot_noise=rng.uniform(0.0, 0.4),
    )


def random_motion(rng: np.random.Generator) -> Any:
    """A link that rings: bending and twist together, some mm and degrees."""
    amplitude, twist = rng.uniform(0.0, 4e-3, 2), rng.uniform(0.0, 0.05)
    phase, still = rng.uniform(0.0, 2 * np.pi, 3), rng.uniform(-2e-3, 2e-3, 2)

    def motion(t: float) -> Any:
        dx = still[0] + amplitude[0] * math.sin(2 * math.pi * 14.0 * t + phase[0])
        dy = still[1] + amplitude[1] * math.sin(2 * math.pi * 14.0 * t + phase[1])
        theta = twist * math.sin(2 * math.pi * 21.0 * t + phase[2])
        return render.Pose(dx, dy, theta, -1.5 * dy / 0.585, 1.5 * dx / 0.585)

    return motion


def moved(rng: np.random.Generator) -> render.Pose:
    """A tip that is off by millimetres and degrees."""
    dx, dy = rng.uniform(-3e-3, 3e-3, 2).tolist()
    return render.Pose(dx, dy, rng.uniform(-0.05, 0.05))


HURTS = (
    *('none', 'motion blur', 'long exposure', 'occluder', 'occluder of its colour', 'missing disc', 'second target'),
    *('ghost', 'over-exposed', 'blooming', 'out of focus', 'dark', 'far away', 'outside', 'glare', 'clutter'),
    *('nothing', 'lines of noise'),
)


def adverse(
    rng: np.random.Generator, scene: render.Scene, motion: Any, hurt: str
) -> tuple[Any, tuple[float, float, float]]:
    """One frame with ``hurt`` done to it, and the truth: the mean over the exposure."""
    t = rng.uniform(0.0, 1.0)
    if hurt in {'far away', 'outside'}:
        # The plate is really there: the camera stays where it was.
        dx, dy = rng.choice([-1, 1], 2) * rng.uniform(0.02, 0.08, 2)
        away = render.Pose(float(dx), float(dy), z=rng.uniform(-0.02, 0.02))
        if hurt == 'far away':
            away = render.Pose(z=(-1.0 if scene.view == 'outside' else 1.0) * rng.uniform(0.3, 6.0))
        base_motion = motion

        def motion(t: float) -> Any:
            return replace(base_motion(t), dx=base_motion(t).dx + away.dx, dy=base_motion(t).dy + away.dy, z=away.z)

    exposure = {'motion blur': rng.uniform(2e-3, 8e-3), 'long exposure': rng.uniform(8e-3, 33e-3)}.get(hurt, 3e-4)
    instants = 24 if exposure > 1e-3 else 2
    poses = render.over_exposure(motion, t, exposure, instants)
    truth = render.mean_of(poses)
    if hurt == 'out of focus':
        scene = replace(scene, blur=rng.uniform(2.0, 12.0))
    if hurt == 'dark':
        scene = replace(scene, black=rng.uniform(2, 6), white=rng.uniform(8, 30))
    if hurt == 'missing disc':
        scene = replace(scene, discs=2)
    if hurt == 'nothing':
        scene = replace(scene, discs=0)
    grey = render.clean(scene, poses)
    rows, columns = grey.shape
    v, u = np.mgrid[:rows, :columns]
    cx, cy = render.pixel_of(scene, poses[0], 0.0, scene.spacing * rng.integers(-1, 2))
    pixel = scene.focal / scene.distance
    r = scene.radius * pixel
    angle = rng.uniform(0, 2 * np.pi)
    at = (cx + r * math.cos(angle), cy + r * math.sin(angle))
    size = rng.uniform(0.05, 1.2) * r
    if hurt in {'occluder', 'occluder of its colour'}:
        across = (u - at[0]) * math.cos(angle) + (v - at[1]) * math.sin(angle)
        along = -(u - at[0]) * math.sin(angle) + (v - at[1]) * math.cos(angle)
        cover = (np.abs(across) < size) & (np.abs(along) < size * rng.uniform(0.3, 3.0))
        edge = gaussian_filter(cover.astype(float), rng.uniform(0.3, 2.0))
        colour = rng.choice([scene.black, scene.white]) if 'colour' in hurt else rng.uniform(0, 255)
        grey = grey * (1 - edge) + colour * edge
    if hurt == 'second target':
        shift = rng.integers(-200, 200, 2)
        grey = np.maximum(grey, np.roll(grey, shift, (0, 1)))
    if hurt == 'ghost':
        # Nearer than that, two pictures are a motion that was exposed twice, and their mean is right.
        apart = rng.uniform(4.0, 14.0)
        shift = np.rint([apart * math.sin(angle), apart * math.cos(angle)]).astype(int)
        grey = grey + rng.uniform(0.1, 1.0) * (np.roll(grey, shift, (0, 1)) - scene.black)
    if hurt in {'over-exposed', 'blooming'}:
        grey = grey * rng.uniform(1.2, 6.0)
    if hurt == 'blooming':
        grey = np.minimum(grey, 2000.0)
        spill = np.maximum(grey - 255.0, 0.0)
        down = np.cumsum(spill, axis=0) * (spill > 0)
        grey = grey + 0.02 * np.roll(down, 3, axis=0) + gaussian_filter(spill, 6.0) * rng.uniform(0.1, 1.0)
    if hurt == 'glare':
        spot = np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / (2 * (size + 3) ** 2))
        grey = grey + rng.uniform(20, 400) * spot
    if hurt == 'clutter':
        for _ in range(int(rng.integers(3, 25))):
            x, y, q = rng.uniform(0, columns), rng.uniform(0, rows), rng.uniform(3, 50)
            base_motion = np.hypot(u - x, (v - y) * rng.uniform(0.6, 1.6)) < q
            grey = np.where(base_motion, rng.uniform(0, 255), grey)
    if hurt == 'lines of noise':
        grey = grey + rng.normal(0, rng.uniform(2, 15), (rows, 1))
    sd = np.sqrt(scene.read_noise**2 + scene.shot_noise**2 * np.maximum(grey, 0.0))
    return np.clip(np.rint(grey + sd * rng.standard_normal(grey.shape)), 0, 255).astype(np.uint8), truth


def runs(frames: int, seed: int) -> Iterator[tuple[str, FrameAnswer, tuple[float, float, float]]]:
    """What was done to a frame, its answer, the truth."""
    number = done = 0
    while done < frames:
        number += 1
        rng = np.random.default_rng([seed, number])
        scene, motion = random_scene(rng), random_motion(rng)
        reference = rested(scene, settings_of(scene), REST, render.clean(scene, [render.Pose()]), rng)
        if reference.rest is None:
            # The plate at rest is not whole in the picture: another rig.
            continue
        for _ in range(min(RUN, frames - done)):
            hurt = str(rng.choice(HURTS))
            image, truth = adverse(rng, scene, motion, hurt)
            yield hurt, reference.take(0, image)[0], truth
            done += 1


def off_by(answer: FrameAnswer, truth: tuple[float, float, float]) -> float:
    """The largest error of the three in units of its own sd."""
    assert answer.covariance is not None
    off = np.array([answer.dx, answer.dy, answer.theta]) - truth
    return float(np.max(np.abs(off) / np.sqrt(np.diag(answer.covariance))))


def adverse_table(frames: int, seed: int) -> bool:
    """Print what became of each kind of frame; True if no answer is wrong."""
    rejected: Counter[str] = Counter()
    reasons: dict[str, Counter[str]] = {}
    sigmas: dict[str, list[float]] = {}
    sds: dict[str, list[float]] = {}
    for hurt, answer, truth in runs(frames, seed):
        sigmas.setdefault(hurt, [])
        if answer.status is not Status.OK:
            rejected[hurt] += 1
            reasons.setdefault(hurt, Counter())[str(answer.status)] += 1
            continue
        sigmas[hurt].append(off_by(answer, truth))
        assert answer.covariance is not None
        sds.setdefault(hurt, []).append(1e6 * math.sqrt(max(answer.covariance[0, 0], answer.covariance[1, 1])))
    print('frame with               frames  rejected  worst/sd  rms/sd  sd um  reason')
    total = wrong = 0
    for hurt in HURTS:
        errors = np.array(sigmas.get(hurt, []))
        count = len(errors) + rejected[hurt]
        total, wrong = total + count, wrong + int(np.sum(errors > SIGMAS))
        worst = f'{errors.max():8.2f} {np.sqrt(np.mean(errors**2)):7.2f}' if len(errors) else f'{"":8} {"":7}'
        sd = f'{np.median(sds[hurt]):6.2f}' if hurt in sds else f'{"":6}'
        reason = ', '.join(f'{r} {n}' for r, n in reasons.get(hurt, Counter()).most_common(3))
        print(f'{hurt:24} {count:6} {100 * rejected[hurt] / max(count, 1):7.1f}%  {worst} {sd}  {reason}')
    share = 100 * sum(rejected.values()) / max(total, 1)
    print(f'{total} adverse frames: {share:.1f} % rejected, {wrong} answers beyond {SIGMAS:g} sd of their own')
    return wrong == 0


SCALES = {
    '640 x 480': render.Scene(),
    '1920 x 1080': render.Scene(width=1920, height=1080, focal=5000.0, centre=(960.0, 520.0), blur=1.0),
}
"""The thesis's scale: a target of 66 mm fills most of the height."""


def bound_of(scene: render.Scene) -> float:
    """Cramer-Rao bound of the place of the middle disc in the image, px a coordinate: noise over the summed slopes."""
    shift = 0.05 * scene.distance / scene.focal
    single = replace(scene, discs=1)
    ends = [render.clean(single, [render.Pose(dx=s * shift)]) for s in (1.0, -1.0)]
    slope = (ends[0] - ends[1]) / 0.1
    # Rounding to whole grey levels is noise too.
    return math.sqrt((scene.read_noise**2 + 1.0 / 12.0) / float(np.sum(slope**2)))


def accuracy_table(frames: int, seed: int) -> bool:
    """Print errors at the thesis's scale by discs; True if all bounds are kept."""
    fine = True
    print('images       frames  centre px  bound px    dX um  bound  in 95 %    dY um  bound  in 95 %', end='')
    print('    theta mdeg  bound  in 95 %')
    for name, scene in SCALES.items():
        rng = np.random.default_rng(seed)
        reference = rested(scene, settings_of(scene), 8, render.clean(scene, [render.Pose()]), rng)
        off, centres, inside = [], [], []
        for _ in range(frames):
            pose = moved(rng)
            (answer,) = reference.take(0, render.photograph(scene, [pose], rng))
            assert answer.target is not None
            assert answer.covariance is not None
            off.append([answer.dx - pose.dx, answer.dy - pose.dy, answer.theta - pose.theta])
            inside.append(np.abs(off[-1]) < 1.96 * np.sqrt(np.diag(answer.covariance)))
            true = [render.pixel_of(scene, pose, *c) for c in render.centres_of(scene)]
            centres.append(answer.target.points - np.array(true))
        scales = np.array([1e6, 1e6, math.degrees(1e3)])
        rms = np.sqrt(np.mean(np.square(off), axis=0)) * scales
        # The rest is a mean of eight frames.
        (bounds,) = math.sqrt(1.0 + 1.0 / 8.0) * scales * pose_bounds(scene, discs_picture, slice(None))
        centre, bound = float(np.sqrt(np.mean(np.square(centres)))), bound_of(scene)
        print(f'{name:12} {frames:6}  {centre:9.4f}  {bound:8.4f}', end='')
        for value, least, share in zip(rms, bounds, np.mean(inside, axis=0), strict=True):
            print(f'    {value:6.3f} {least:6.3f}  {share:7.3f}', end='')
        print()
        fine &= centre < 0.03 and centre < 1.5 * bound and max(rms[0], rms[1]) < 10.0 and rms[2] < 30.0
    return fine


BOARD_THETA = 0.003  # Largest rms error of theta by a board, degrees: a tenth of what is asked of the discs.
VIEWS = {
    '640 x 480': render.Scene(focal=1700.0, roll=0.02),
    '1920 x 1080': render.Scene(width=1920, height=1080, focal=4200.0, centre=(960.0, 520.0), blur=1.0, roll=0.02),
}
"""Both targets seen by the same camera from the same place; a board of 70 x 90 mm fills most of the height."""


def _board(settings: CameraSettings) -> Board:
    target = target_of(settings)
    assert isinstance(target, Board)
    return target


def board_picture(settings: CameraSettings) -> Any:
    """How a board of these settings is drawn: (scene, pose) -> grey levels without noise."""
    target = _board(settings)
    texture = boards.picture(target.board, (round(target.size[0] * 2e4), round(target.size[1] * 2e4))) / 255.0
    return lambda scene, pose: render.board(scene, pose, texture, target.size)


def discs_picture(scene: render.Scene, pose: render.Pose) -> Any:
    return render.clean(scene, [pose])


def pose_bounds(scene: render.Scene, picture: Any, *nears: Any) -> Any:
    """Cramer-Rao bounds (masks, 3) of dX m, dY m, theta rad of one frame, with all six of the pose unknown. From the
    pixels of each mask."""
    shift = 0.25 * scene.distance / scene.focal
    rotation = shift / 0.03
    slopes = []
    for name, step in (('dx', shift), ('dy', shift), ('theta', rotation), ('phi', 0.02), ('omega', 0.02), ('z', 2e-3)):
        ends = [picture(scene, replace(render.Pose(), **{name: sign * step})) for sign in (1.0, -1.0)]
        slopes.append((ends[0] - ends[1]) / (2.0 * step))
    variance = scene.read_noise**2 + 1.0 / 12.0
    rows = [np.array([slope[mask].ravel() for slope in slopes]) for mask in nears]
    return np.array([np.sqrt(np.diag(np.linalg.inv(r @ r.T / variance))[:3]) for r in rows])


def near_corners(scene: render.Scene, settings: CameraSettings) -> Any:
    """The pixels around the inner corners of the chessboard that show nothing else."""
    size = _board(settings).size
    across, up = (np.arange(1, round(s / settings.square)) * settings.square - s / 2 for s in size)
    at = render.pixels_of(scene, render.Pose(), np.array([[x, y] for x in across for y in up]))
    reach = min(7.0, 0.5 * (settings.square - settings.marker) * scene.focal / scene.distance)
    v, u = np.mgrid[: scene.height, : scene.width]
    mask = np.zeros(v.shape, dtype=bool)
    for x, y in at:
        mask |= np.hypot(u - x, v - y) < reach
    return mask


def theta_error(scene: render.Scene, settings: CameraSettings, picture: Any, frames: int, seed: int) -> float:
    """Rms error of theta over ``frames`` moved frames, degrees."""
    rng = np.random.default_rng(seed)
    reference = rested(scene, settings, 4, picture(scene, render.Pose()), rng)
    off = []
    for _ in range(frames):
        pose = moved(rng)
        (answer,) = reference.take(0, render.developed(scene, picture(scene, pose), rng))
        off.append(answer.theta - pose.theta)
    return math.degrees(float(np.sqrt(np.mean(np.square(off)))))


def boards_table(frames: int, seed: int, *, short: bool = False) -> bool:
    """Print theta by a ChArUco board beside theta by discs in the same view; True if the board's is good."""
    fine = True
    print('theta, degrees         by discs           by a ChArUco board                  better than discs')
    print('images       tilt      rms     bound      rms     of corners  of all pixels   rms    bound  all pixels')
    for name, view in list(VIEWS.items())[: 1 if short else None]:
        for tilt in (0.0,) if short else (0.0, 5.0, 10.0):
            scene = replace(view, tilt=(math.radians(tilt), 0.0))
            discs = settings_of(scene)
            board = replace(discs, target='charuco')
            picture = board_picture(board)
            everywhere = np.ones((scene.height, scene.width), dtype=bool)
            disc = theta_error(scene, discs, discs_picture, frames, seed)
            (of_disc,) = np.degrees(pose_bounds(scene, discs_picture, everywhere)[:, 2])
            corner = theta_error(scene, board, picture, frames, seed)
            mask = near_corners(scene, board)
            of_corners, of_all = np.degrees(pose_bounds(scene, picture, mask, everywhere)[:, 2])
            sizes = f'{disc:.5f}  {of_disc:.5f}    {corner:.5f}  {of_corners:.5f}    {of_all:.5f}'
            ratios = f'{disc / corner:9.1f}  {of_disc / of_corners:6.1f}  {of_disc / of_all:9.1f}'
            print(f'{name:12} {tilt:4.0f}   {sizes} {ratios}')
            fine &= corner <= BOARD_THETA
    print(f'theta by the board is {"" if fine else "NOT "}within {BOARD_THETA:g} degrees')
    return fine


def cost_table(frames: int, seed: int) -> None:
    """Print the processor time of a frame beside OpenCV's own finder of circles, which gives no pose."""
    cv2 = opencv()
    wanted = cv2.SimpleBlobDetector_Params()
    wanted.blobColor, wanted.minArea, wanted.maxArea = 255, 50.0, 1e5
    finder = cv2.SimpleBlobDetector_create(wanted)
    print('images       ms a frame  findCirclesGrid  ratio')
    for name, scene in SCALES.items():
        rng = np.random.default_rng(seed)
        images = [render.photograph(scene, [render.Pose(dx=1e-4 * i)], rng) for i in range(frames)]
        reference = CameraReference(settings_of(scene, 2), target_of)
        for image in images[:3]:
            reference.take(0, image)
        stamps = []
        # In turn: what else the machine does falls on both.
        for image in images:
            began = time.process_time()
            reference.take(0, image)
            middle = time.process_time()
            cv2.findCirclesGrid(image, (1, 3), flags=cv2.CALIB_CB_SYMMETRIC_GRID, blobDetector=finder)
            stamps.append((began, middle, time.process_time()))
        ms = 1e3 * np.median(np.diff(stamps), axis=0)
        print(f'{name:12} {ms[0]:10.1f}  {ms[1]:15.1f}  {ms[0] / ms[1]:5.2f}')


def main() -> int:
    parser = options(__doc__)
    parser.add_argument('--frames', type=int, default=10_000)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--only', choices=('adverse', 'accuracy', 'boards', 'cost'))
    args = parser.parse_args()
    opencv().setNumThreads(1)
    began, fine = time.perf_counter(), True
    if args.only in (None, 'accuracy'):
        fine &= accuracy_table(min(args.frames // 10, 200), args.seed)
    if args.only == 'boards' or (args.only is None and args.frames >= 100):
        fine &= boards_table(min(max(args.frames // 50, 3), 20), args.seed, short=args.frames < 100)
    if args.only in (None, 'cost'):
        cost_table(min(40, args.frames // 10 + 3), args.seed)
    if args.only in (None, 'adverse'):
        fine &= adverse_table(args.frames, args.seed)
    return conclude(f'{time.perf_counter() - began:.0f} s', fine)


if __name__ == '__main__':
    sys.exit(main())
