# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measure the tip by a camera: a reference beside the PSDs, with the uncertainty of each frame.

IN is a folder of images with frames.csv (file,t,exposure; s, t is the start of the exposure), a video, or a device
(/dev/video0, or its number). The target is on the tip plate: three white discs in a line on black, a ChArUco
board or AprilTags. The first good frames are the rest: the camera may be turned in its plane. A frame that does not
show the whole target clearly has no answer, and its reason.

OUT.csv has t,dx,dy,theta,sd_dx,sd_dy,sd_theta,status (s, m, m, rad; t is the middle of the exposure); OUT.mcap and a
bag folder have /reference/deflection and /reference/deflection_with_covariance.

  psd-deflection camera target --out target.pdf
  psd-deflection camera frames --params-file camera.yaml --out reference.csv
  psd-deflection camera /dev/video0 --params-file camera.yaml --out run.mcap
  psd-deflection camera /dev/video0 --out run.csv --show now.png
  psd-deflection camera intrinsics shots/*.png --out camera_info.yaml
  ros2 run psd_deflection camera --ros-args -r image:=/camera/image_raw
"""

import argparse
import contextlib
import importlib.util
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tqdm import tqdm

from psd_deflection.base.bounds import Tally
from psd_deflection.base.errors import RecordingError, UsageError
from psd_deflection.base.files import replace_file
from psd_deflection.camera.answer import FrameAnswer, Status
from psd_deflection.camera.footage import Footage, Frame, read_image, read_settings
from psd_deflection.camera.intrinsics import calibrated
from psd_deflection.camera.opencv import opencv
from psd_deflection.camera.pictures import preview, printed
from psd_deflection.camera.reference import CameraReference
from psd_deflection.camera.settings import TARGETS, CameraSettings
from psd_deflection.camera.target import target_of
from psd_deflection.cli._display import Display
from psd_deflection.cli._options import need_folder, picture_name, recording_name, require_ros
from psd_deflection.cli._report import print_json, show, warn
from psd_deflection.cli._values import integer
from psd_deflection.recordings.formats.format import open_reference_file

PREVIEW_S = 1.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('what', metavar='IN', nargs='*', help='a video, a folder of images, a device; or see above')
    parser.add_argument(
        '--target', choices=TARGETS, help='kind of target (default circles, or target.kind of the file)'
    )
    parser.add_argument('--params-file', metavar='CAMERA.yaml', help='target.spacing, target.radius, camera.matrix …')
    parser.add_argument('--out', metavar='OUT', help='X.csv, X.mcap or a bag folder')
    parser.add_argument('--frames', type=integer('--frames', 1), metavar='N', help='stop after so many frames')
    parser.add_argument(
        '--show', metavar='FILE.png', help='once a second, write the frame with what was found in it to this picture'
    )
    parser.add_argument('--json', action='store_true', help='print the summary as JSON')


def run(args: argparse.Namespace) -> int:
    """Measure, print a target, or find the lens."""
    if not args.what:
        return _node(args)
    if args.out is None:
        raise UsageError('--out is missing: X.csv, X.mcap or a bag folder')
    settings = read_settings(args.params_file)
    if args.target is not None:
        settings = settings.of_kind(args.target)
    if args.what == ['target']:
        return _print_target(args, settings)
    if args.what[0] == 'intrinsics':
        return _intrinsics(args, settings)
    if len(args.what) > 1:
        raise UsageError(f'{args.what[1]}: one IN at a time')
    return _measure(args, settings)


def _node(args: argparse.Namespace) -> int:
    """The ROS node: it has no IN, but subscribes to images."""
    if args.out is not None or importlib.util.find_spec('rclpy') is None:
        raise UsageError('IN is missing: a video, a folder of images or a device; without IN it is a ROS node')
    require_ros()
    from psd_deflection.ros.camera import run_camera

    settings = read_settings(args.params_file)
    if args.target is not None:
        settings = settings.of_kind(args.target)
    return run_camera(args.ros_arguments, settings, Display().log)


def _print_target(args: argparse.Namespace, settings: CameraSettings) -> int:
    out = Path(picture_name('.pdf', '.png', '.svg')(args.out))
    need_folder(out)
    target = target_of(settings)
    with _saved(out):
        replace_file(out, printed(target, out.suffix[1:].lower()))
    if args.json:
        print_json({'out': args.out, 'parameters': target.describe()})
        return 0
    show(f'{out}: print it at 100 %, measure the line of 50 mm, and put this into CAMERA.yaml:')
    show(*target.describe())
    return 0


def _intrinsics(args: argparse.Namespace, settings: CameraSettings) -> int:
    out = Path(args.out)
    if out.suffix.lower() not in {'.yaml', '.yml'}:
        raise UsageError(f'--out {out}: the name must end in .yaml')
    need_folder(out)
    paths = args.what[1:]
    if not paths:
        raise UsageError('intrinsics: name the images of a ChArUco board, as in shots/*.png')
    board = settings.of_kind(args.target or 'charuco')
    bar = tqdm(paths, unit=' images', delay=1.0, leave=False, disable=True if args.json else None, ncols=80)
    with contextlib.closing(bar):
        intrinsics = calibrated(board, ((path, read_image(path)) for path in bar))
    with _saved(out):
        replace_file(out, intrinsics.as_yaml(out.stem).encode())
    if args.json:
        print_json({'out': args.out, **intrinsics.summary()})
        return 0
    show(f'{out}: {intrinsics.used} of {len(paths)} images used, rms {intrinsics.rms:.3f} px')
    show(*intrinsics.lines())
    for path, reason in intrinsics.excluded:
        warn(f'{path}: not used: {reason}')
    return 0


@contextlib.contextmanager
def _saved(out: Path, option: str = '--out') -> Iterator[None]:
    """Turn what the disk rejects into a RecordingError."""
    try:
        yield
    except OSError as error:
        raise RecordingError(f'{option} {out}: cannot be written ({error.strerror or error})') from None


def _measure(args: argparse.Namespace, settings: CameraSettings) -> int:
    out = Path(args.out)
    recording_name()(args.out)
    need_folder(out)
    opencv()
    footage = Footage(args.what[0], settings.exposure)
    reference = CameraReference(settings, target_of)
    reasons = Tally()
    valid: list[FrameAnswer] = []
    with contextlib.closing(open_reference_file(out)) as sink:
        for answer in _answers(args, footage, reference, _Preview(args.show)):
            reasons.add(answer.words)
            sink.put(answer.t_ns, answer.as_record(), answer.words)
            valid = [*valid[-999:], answer] if answer.status is Status.OK else valid
    _report(args, settings, reference, reasons, valid)
    return 0


class _Preview:
    """Writes the newest answered frame to ``path``, at most once in ``PREVIEW_S``, and the last; None: nothing."""

    def __init__(self, path: str | None) -> None:
        if path is not None and not path.lower().endswith('.png'):
            raise UsageError(f'--show {path}: the name must end in .png')
        self._path = None if path is None else Path(path)
        self._next_time = 0.0
        self._last: tuple[Any, FrameAnswer] | None = None
        if self._path is not None:
            need_folder(self._path)

    def take(self, frame: Frame, answers: list[FrameAnswer]) -> None:
        """The answer of this frame, if it is among ``answers``."""
        matching = [answer for answer in answers if answer.t_ns == frame.t_ns]
        if self._path is None or not matching:
            return
        self._last = frame.image, matching[-1]
        if time.monotonic() >= self._next_time:
            self._next_time = time.monotonic() + PREVIEW_S
            self.write()

    def write(self) -> None:
        """Write what is not written yet."""
        if self._path is not None and self._last is not None:
            with _saved(self._path, '--show'):
                replace_file(self._path, preview(*self._last))
            self._last = None


def _answers(
    args: argparse.Namespace, footage: Footage, reference: CameraReference, shown: _Preview
) -> Iterator[FrameAnswer]:
    frame: Frame | None = None
    frames: Iterator[Frame] = iter(footage)
    hidden = True if args.json else None
    bar = tqdm(
        frames, total=args.frames or footage.total, unit=' frames', delay=1.0, leave=False, disable=hidden, ncols=80
    )
    # A live camera is ended by Ctrl-C: what was measured until then stays.
    with contextlib.suppress(KeyboardInterrupt) if footage.live else contextlib.nullcontext():
        for number, frame in enumerate(bar, 1):
            answers = reference.take(frame.t_ns, frame.image)
            shown.take(frame, answers)
            yield from answers
            if number == args.frames:
                break
    bar.close()
    answers = reference.finish()
    if frame is not None:
        shown.take(frame, answers)
    shown.write()
    yield from answers


def _report(
    args: argparse.Namespace,
    settings: CameraSettings,
    reference: CameraReference,
    reasons: Tally,
    valid: list[FrameAnswer],
) -> None:
    good = reasons[str(Status.OK)]
    frames, rejected = reasons.total(), {words: count for words, count in reasons.most_common() if words != Status.OK}
    median = [
        sorted(math.sqrt(float(a.covariance[i, i])) for a in valid if a.covariance is not None)[len(valid) // 2]
        for i in range(3)
        if valid
    ]
    rest = reference.rest
    if args.json:
        print_json(
            {
                'out': args.out,
                'frames': frames,
                'answers': good,
                'rejected': rejected,
                'sd': dict(zip(('dx', 'dy', 'theta'), median, strict=False)),
                'rotation': None if rest is None else reference.rotation,
                'radius_scale': None if rest is None else rest.scale,
                'lens': bool(settings.matrix),
            }
        )
        return
    show(f'{args.out}: {good} of {frames} frames have an answer')
    for reason, count in rejected.items():
        show(f'  {count} rejected: {reason}')
    if rest is not None and median:
        dx, dy, theta = median
        sds = f'ΔX {dx * 1e6:.2f} µm, ΔY {dy * 1e6:.2f} µm, θ {math.degrees(theta):.5f}°'
        show(f'one sd, median of the last frames: {sds}')
        show(f'the camera is turned by {math.degrees(reference.rotation):+.3f}° in its plane, which is taken off')
        show(*reference.target.rest_words(rest))
    if not settings.matrix:
        warn(
            'camera.matrix is not given: the scale is that of target.spacing, lens distortion is not corrected; '
            '`psd-deflection camera intrinsics` finds both'
        )
