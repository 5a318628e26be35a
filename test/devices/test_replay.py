# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A recording as a device: paced by a clock that the test owns."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import psd_deflection
from psd_deflection.base.errors import ConfigError, DeviceError
from psd_deflection.base.log import texts
from psd_deflection.devices.registry import make_source
from psd_deflection.devices.replay import Pacer, Replay
from psd_deflection.devices.source import Sample, SourceEndedError
from psd_deflection.rig.config import load_rig
from psd_deflection.run.acquisition import Acquisition
from psd_deflection.run.arrivals import Arrival, Ended
from test.heard import WAIT_S

BAGS = Path(__file__).parent.parent.parent / 'bags'


class Clock:
    """Time that passes only where someone waits."""

    def __init__(self) -> None:
        self.t_ns = 77_000_000_000

    def now(self) -> int:
        return self.t_ns

    def wait(self, seconds: float) -> None:
        self.t_ns += round(seconds * 1e9)


def replay(path: Path, stamps: str = 'now') -> tuple[Replay, Clock]:
    source = make_source(load_rig(overrides={'source': 'replay', 'port': str(path), 'replay.stamps': stamps}))
    assert isinstance(source, Replay)
    clock = Clock()
    source._pacer = Pacer(clock.now, clock.wait)
    source.open(2.0)
    source.start()
    return source, clock


def all_of(source: Replay) -> list[Sample]:
    samples: list[Sample] = []
    while True:
        try:
            samples += [e for e in source.read(0.1).events if isinstance(e, Sample)]
        except SourceEndedError:
            return samples


@pytest.mark.parametrize('name', ['clean', 'lost_samples'])
def test_every_recorded_sample_comes_as_it_was(name: str) -> None:
    recorded = psd_deflection.open(BAGS / name).samples
    samples = all_of(replay(BAGS / name, 'recorded')[0])
    assert [s.seq for s in samples] == recorded['seq'].tolist()
    assert [s.t for s in samples] == recorded['t_ns'].tolist()
    assert [s.flags for s in samples] == recorded['flags'].tolist()
    wanted = np.stack([recorded[c] for c in ('x1', 'y1', 'sum1', 'x2', 'y2', 'sum2')], axis=1)
    np.testing.assert_array_equal(np.array([s.readings for s in samples], np.float32), wanted)


def test_it_takes_as_long_as_the_recording_and_stamps_with_now() -> None:
    recorded = psd_deflection.open(BAGS / 'clean').samples
    source, clock = replay(BAGS / 'clean')
    started = clock.t_ns
    samples = all_of(source)
    lasts = int(recorded['t_ns'][-1] - recorded['t_ns'][0])
    # The pacer starts with the first block's last sample, 19 ms in.
    assert clock.t_ns - started == pytest.approx(lasts - 19_000_000, abs=1_000_000)
    assert np.diff([s.t for s in samples]).tolist() == np.diff(recorded['t_ns']).tolist()
    assert samples[-1].t == pytest.approx(clock.t_ns, abs=1_000_000)


def test_the_reader_ends_with_the_recording(tmp_path: Path) -> None:
    rows = ''.join(f'{i / 1000:.3f},0.1,0.2,5,0.3,0.4,5\n' for i in range(100))
    path = tmp_path / 'run.csv'
    path.write_text('t,x1,y1,sum1,x2,y2,sum2\n' + rows)
    logged: list[str] = []
    acquisition = Acquisition(load_rig(overrides={'source': 'replay', 'port': str(path)}), texts(logged.append))
    acquisition.open()
    acquisition.start()
    items: list[Any] = []
    while not items or not isinstance(items[-1], Ended):
        items.append(acquisition.queue.get(timeout=WAIT_S))
    acquisition.stop()
    assert sum(len(i.raw.seq) for i in items if isinstance(i, Arrival)) == 100
    assert any('at its end' in s for s in logged)


def test_error_names_a_file_that_is_not_a_recording(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match='no such recording'):
        make_source(load_rig(overrides={'source': 'replay', 'port': str(tmp_path / 'x')})).open(1.0)
    with pytest.raises(ConfigError, match='name the recording'):
        make_source(load_rig(overrides={'source': 'replay'}))


def test_a_rig_of_another_rate_is_rejected(tmp_path: Path) -> None:
    rows = ''.join(f'{i / 500:.3f},0,0,5,0,0,5\n' for i in range(100))
    path = tmp_path / 'slow.csv'
    path.write_text('t,x1,y1,sum1,x2,y2,sum2\n' + rows)
    with pytest.raises(DeviceError, match='sample_rate_hz 500'):
        Acquisition(load_rig(overrides={'source': 'replay', 'port': str(path)}), texts(print)).open()
