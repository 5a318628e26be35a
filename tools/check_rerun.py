# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Converts recordings for Rerun, reads them with its own reader and looks at its picture (``make demo NAME=rerun``)."""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import rerun.chunk
from PIL import Image

import psd_deflection
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.write.rerun_writer import APPLICATION, POSE, TIMELINE
from psd_deflection.records import FloatArray, IntArray
from tools.program import Program

BIN = Path(sys.executable).parent
WINDOW, VIEWER_S = '1500x900', 180.0
LIGHT = (255, 80, 60)
SHARE = 5e-4
"""Minimum share of pixels in a trace's colour (measured: 2e-3); an empty viewport has a few, from its icons."""


def need(true: bool, what: str) -> None:
    """End the program with the message ``what`` unless the condition holds."""
    if not true:
        raise SystemExit(f'FAILED: {what}')


class Written:
    """The rows of an ``.rrd``, entity by entity: times of all rows, which of them have values, and these."""

    def __init__(self, path: Path) -> None:
        reader = rerun.chunk.RrdReader(path)
        (recording,) = reader.recordings()
        need(recording.application_id == APPLICATION, f'{path}: the application is {recording.application_id}')
        need(len(reader.blueprints()) == 1, f'{path}: {len(reader.blueprints())} blueprints')
        self._chunks: dict[str, list[rerun.chunk.Chunk]] = {}
        for chunk in reader.stream():
            self._chunks.setdefault(chunk.entity_path.strip('/'), []).append(chunk)

    def rows(self, entity: str, component: str) -> tuple[IntArray, IntArray, FloatArray]:
        """Times (n,) ns of all rows, how many values each has (n,), and all values one after the other."""
        times, counts, values = [], [], []
        for chunk in self._chunks[entity]:
            if chunk.is_static:
                continue
            batch = chunk.to_record_batch()
            times.append(batch.column(TIMELINE).to_numpy(zero_copy_only=False).astype(np.int64))
            rows = batch.column(component).to_pylist()
            counts += [len(row or ()) for row in rows]
            values += [v for row in rows for v in row or ()]
        return np.concatenate(times), np.array(counts, np.int64), np.array(values, np.float64)


def check_poses(written: Written, recording: Recording) -> int:
    """Check the estimates and the breaks of the lines at missing ones; return the number of breaks."""
    series = recording.estimates()['/link_tip/deflection_with_covariance']
    if series.covariance is None:
        raise SystemExit('FAILED: the recording has no covariance')
    breaks, step = 0, float(np.median(np.diff(series.t_ns)))
    gone = np.flatnonzero(np.diff(series.t_ns) > 1.5 * step)
    for i, (name, _, _, scale, _) in enumerate(POSE):
        times, counts, values = written.rows(f'tip/{name}', 'Scalars:scalars')
        need(bool((np.diff(times) > 0).all()), f'{name}: times do not rise')
        words = f'{name}: {len(values)} values, {len(series.t_ns)} estimates'
        need(np.array_equal(times[counts == 1], series.t_ns), words)
        # Another machine's last bits may differ.
        need(np.allclose(values, series.pose[:, i] * scale, rtol=1e-9, atol=1e-9), f'{name} differs')
        empty = times[counts == 0]
        for k in gone:
            inside = (empty > series.t_ns[k]) & (empty < series.t_ns[k + 1])
            need(bool(inside.any()), f'{name}: the line goes on where nothing was measured, at {series.t_ns[k]} ns')
        breaks = len(empty)
        _, _, band = written.rows(f'tip/{name}/band', 'Scalars:scalars')
        sd = np.sqrt(series.covariance[:, i, i]) * scale
        need(np.allclose(np.diff(band.reshape(-1, 2), axis=1)[:, 0], 4.0 * sd, rtol=1e-6), f'{name}: the band differs')
    return breaks


def picture(files: list[Path], target: Path) -> bool:
    """Take a picture of ``files`` in the viewer on a virtual screen; False if that is not possible."""
    if shutil.which('xvfb-run') is None or not list(Path('/usr/share/vulkan/icd.d').glob('*.json')):
        print('no picture: it needs xvfb-run and a Vulkan driver (apt install xvfb mesa-vulkan-drivers)')
        return False
    target.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory() as home:
        # Without settings the viewer starts for the first time; usage statistics are off.
        environment = {**os.environ, 'HOME': home, 'XDG_RUNTIME_DIR': home, 'XDG_CONFIG_HOME': home}
        subprocess.run([BIN / 'rerun', 'analytics', 'disable'], env=environment, capture_output=True, check=True)
        command = ['xvfb-run', '-a', '-s', '-screen 0 1600x1000x24', str(BIN / 'rerun'), '--port', 'auto']
        command += ['--bind', '127.0.0.1', '--renderer', 'vulkan', '--screenshot-to', str(target)]
        command += ['--window-size', WINDOW, *map(str, files)]
        # Screen and viewer end together: they are one session.
        viewer = Program(command, Path.cwd(), env=environment, wait_s=VIEWER_S)
        status = viewer.wait()
    need(status == 0 and target.exists(), f'the viewer made no picture\n{viewer.text[-3000:]}')
    return True


def check_picture(path: Path) -> None:
    """Check that every trace is visible on the left, and the dots and beams at the top right."""
    pixels = np.asarray(Image.open(path).convert('RGB'), np.int64)
    height, width = pixels.shape[:2]
    left_half, above = pixels[:, : width // 2], pixels[: height // 3, width // 2 :]
    for name, part, color in (*((p[1], left_half, p[4]) for p in POSE), ('the light', above, LIGHT)):
        count = int((np.abs(part - np.array(color)).max(axis=-1) <= 24).sum())
        need(count >= SHARE * part[..., 0].size, f'{path}: {count} pixels of {name}: nothing is shown')


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('recordings', metavar='REC', nargs='+', type=Path)
    parser.add_argument('--out', metavar='DIR', type=Path, required=True, help='where the .rrd go')
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for path in args.recordings:
        target = args.out / f'{path.stem}.rrd'
        target.unlink(missing_ok=True)
        began = time.monotonic()
        subprocess.run([BIN / 'psd-deflection', 'convert', path, '--out', target], check=True)
        seconds = time.monotonic() - began
        subprocess.run([BIN / 'rerun', 'rrd', 'verify', target], check=True, capture_output=True)
        breaks = check_poses(Written(target), psd_deflection.open(path))
        print(f'  as recorded: poses and bands; {breaks} breaks; {target.stat().st_size} bytes, {seconds:.1f} s')
    shot = args.out / 'shot.png'
    if picture([target], shot):
        check_picture(shot)
        print(f'  the viewer shows {target}: {shot}')
    print('all is as it should be')
    return 0


if __name__ == '__main__':
    sys.exit(main())
