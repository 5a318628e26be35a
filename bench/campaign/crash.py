# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``make campaign NAME=crash``: kill -9 while recording, at any instant: the file opens, lacks less than a second."""

import os
import random
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path

from rosbags.rosbag2 import Reader

from blind.campaign import conclude, options
from psd_deflection.base.log import null_log
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.repair import recover
from psd_deflection.rig.config import Rig, load_rig
from psd_deflection.run.session import Session
from tools.program import PSD_DEFLECTION, WAIT_S, Program

ALLOWED_S = 1.0


def daemon(rig: Rig) -> None:
    """The child: records until it is killed."""
    session = Session(rig, null_log)
    session.start()
    signal.pause()


def left_by_a_kill(rig: Rig, bags: Path, after_s: float) -> tuple[Path, int]:
    """The folder that a daemon leaves that is killed ``after_s`` after its first chunk, and when, ns."""
    child = os.fork()
    if child == 0:
        try:
            daemon(rig)
        finally:
            os._exit(1)
    deadline = time.monotonic() + WAIT_S
    while not any(p.stat().st_size > 20_000 for p in bags.glob('*/*.mcap')):
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
            raise SystemExit('the daemon records nothing')
        time.sleep(0.005)
    time.sleep(after_s)
    os.kill(child, signal.SIGKILL)
    killed_ns = time.time_ns()
    os.waitpid(child, 0)
    (folder,) = bags.iterdir()
    return folder, killed_ns


def evaluate(folder: Path, killed_ns: int) -> float:
    """Seconds between the last sample that is left and the kill; AssertionError if a reader disagrees."""
    before = [int(b.t_ns[-1]) for b in open_recording(folder).blocks()]
    recover(folder)
    after = [int(b.t_ns[-1]) for b in open_recording(folder).blocks()]
    assert after == before, 'recover changed what is in it'
    with Reader(folder) as reader:
        theirs = sum(1 for c, _, _ in reader.messages() if c.topic == '/psd/samples')
        assert theirs == len(before), f'rosbags has {theirs} blocks, our reader {len(before)}'
    return (killed_ns - before[-1]) / 1e9


def main() -> int:
    parser = options(__doc__)
    parser.add_argument('--times', type=int, default=200)
    parser.add_argument('--seed', type=int, default=1)
    args = parser.parse_args()
    chance = random.Random(args.seed)
    with tempfile.TemporaryDirectory() as name:
        bags, port = Path(name) / 'bags', str(Path(name) / 'port')
        rig_process = Program([*PSD_DEFLECTION, 'simulate', '--serve', '--link', port])
        rig_process.until('port: ')
        rotating = {'bag_max_duration': 0.7}
        lost = []
        try:
            for number in range(args.times):
                more = rotating if number % 4 == 3 else {}
                rig = load_rig(None, {'port': port, 'record': True, 'bag_dir': str(bags), 'keep_zero': False, **more})
                folder, killed_ns = left_by_a_kill(rig, bags, chance.uniform(0.0, 1.5))
                lost.append(evaluate(folder, killed_ns))
                shutil.rmtree(bags)
        finally:
            rig_process.end()
    worst = max(lost)
    times = f'{min(lost):.3f} to {worst:.3f} s, mean {sum(lost) / len(lost):.3f} s (allowed {ALLOWED_S:g} s)'
    text = f'{len(lost)} kills: all opened, all recovered, all read by rosbags; lost {times}'
    return conclude(text, worst <= ALLOWED_S)


if __name__ == '__main__':
    sys.exit(main())
