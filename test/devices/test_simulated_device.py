# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The simulated rig as a device with the test's own clock and as a process; a recording as a device."""

import itertools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import psd_deflection
from psd_deflection.base.errors import ConfigError, DeviceError
from psd_deflection.base.log import null_log, texts
from psd_deflection.devices import PowerUp
from psd_deflection.devices import serve as module
from psd_deflection.devices.contract_frames import SimulatedFrames
from psd_deflection.devices.device import converter_parameters
from psd_deflection.devices.protocol import frames
from psd_deflection.devices.pseudo_terminal import PseudoTerminal, link_names, open_terminals
from psd_deflection.devices.registry import make_source
from psd_deflection.devices.replay import Pacer, Replay
from psd_deflection.devices.rig_feed import RigFeed
from psd_deflection.devices.serve import serve
from psd_deflection.devices.source import Sample, SourceEndedError
from psd_deflection.records import CHANNELS, FLAG_OVER_RANGE
from psd_deflection.rig.config import load_rig
from psd_deflection.run.acquisition import Acquisition
from psd_deflection.run.arrivals import Arrival, Ended
from psd_deflection.run.session import Session
from test.devices.conftest import no_load
from test.heard import WAIT_S

MS = 1_000_000


def device(
    seed: int = 0,
    skew_ppm: float = 0.0,
    first_seq: int = 0,
    lose: frozenset[int] = frozenset(),
    dark: tuple[tuple[int, int, int], ...] = (),
) -> SimulatedFrames:
    feed = RigFeed(load_rig(), no_load, seed=seed, dark=dark)
    return SimulatedFrames(feed, PowerUp(skew_ppm, first_seq), lose=lose)


def decoded(stream: bytes) -> list[frames.Frame]:
    return frames.FrameDecoder().feed(b'\x00' + stream)


def samples(stream: bytes) -> list[frames.SampleFrame]:
    return [f for f in decoded(stream) if isinstance(f, frames.SampleFrame)]


def test_device_sends_samples_at_1khz_and_hello_at_1hz() -> None:
    got = decoded(device().take(2500 * MS, room=1 << 30))
    taken = [f for f in got if isinstance(f, frames.SampleFrame)]
    assert [f.seq for f in taken] == list(range(2501))
    assert all(f.t_device_us == 1000 * f.seq for f in taken)
    assert sum(isinstance(f, frames.StatusFrame) for f in got) == 3
    hellos = [f for f in got if isinstance(f, frames.HelloFrame)]
    assert (len(hellos), hellos[0].version) == (3, 1)
    info = {'channels': list(CHANNELS), 'volts_per_count': 10.0 / 32768, 'sample_rate_hz': 1000.0}
    assert {name: hellos[0].info[name] for name in info} == info
    volts = np.array([f.counts for f in taken]) * 10.0 / 32768
    np.testing.assert_allclose(volts.std(axis=0), 2e-3, rtol=0.1)
    np.testing.assert_allclose(volts.mean(axis=0), [0, 0, 5, 0, 0, 5], atol=2e-4)


def test_it_sends_the_same_however_often_it_is_asked() -> None:
    full, parts = device(seed=3), device(seed=3)
    expected = full.take(500 * MS, room=1 << 30)
    assert b''.join(parts.take(t * MS, room=1 << 30) for t in range(501)) == expected


def test_it_answers_hello_and_ping_and_stops_and_starts() -> None:
    d = device(first_seq=1000)
    (hello,) = decoded(d.receive(frames.encode(frames.HelloRequestFrame()), 0))
    assert isinstance(hello, frames.HelloFrame)
    assert decoded(d.receive(frames.encode(frames.PingFrame(77)), 250 * MS)) == [frames.PongFrame(77, 1_250_000)]
    d.receive(frames.encode(frames.StopFrame()), 0)
    assert not samples(d.take(100 * MS))
    d.receive(frames.encode(frames.StartFrame()), 0)
    assert samples(d.take(101 * MS))[0].seq == 1101
    assert d.receive(b'rubbish\x00', 0) == b''


def test_samples_without_room_are_dropped_counted_and_flagged() -> None:
    d = device()
    d.take(100 * MS, room=0)
    got = samples(d.take(102 * MS))
    assert [(f.seq, f.flags) for f in got] == [(101, 2), (102, 0)]
    late = decoded(d.take(1000 * MS, room=1 << 30))
    assert [f.overruns for f in late if isinstance(f, frames.StatusFrame)] == [101]


def test_its_number_wraps_and_its_clock_runs_on() -> None:
    got = samples(device(first_seq=2**32 - 2).take(3 * MS))
    assert [f.seq for f in got] == [2**32 - 2, 2**32 - 1, 0, 1]
    assert np.diff([f.t_device_us for f in got]).tolist() == [1000] * 3


@pytest.mark.parametrize('skew', [0.0, 1000.0])
def test_a_fast_clock_takes_more_samples(skew: float) -> None:
    d = device(skew_ppm=skew)
    d.take(10_000 * MS, room=1 << 30)
    assert d.taken == round(10_000 * (1 + skew * 1e-6)) + 1


def test_losses_and_a_dark_laser_are_where_they_were_asked_for() -> None:
    got = samples(device(lose=frozenset({3, 4}), dark=((2, 10, 20),)).take(29 * MS))
    assert [f.seq for f in got] == [s for s in range(30) if s not in (3, 4)]
    low = [f.seq for f in got if f.counts[5] < 1000]
    assert low == list(range(10, 20))
    assert all(f.counts[2] > 1000 for f in got)


class Taking:
    """A line that always takes what it is given: what is missing then, the device dropped."""

    name = 'taking'

    def __init__(self) -> None:
        self.taken = b''

    def listen(self, seconds: float) -> bytes:
        return b''

    def send(self, stream: bytes) -> int:
        self.taken += stream
        return len(stream)


def test_a_process_that_wakes_late_catches_up_and_drops_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    # Half a second passes at each look at the clock: 500 samples, four times what the device may hold back.
    clock = itertools.count(0, 250 * MS)
    monkeypatch.setattr(module, 'time', SimpleNamespace(monotonic_ns=lambda: next(clock), sleep=lambda _: None))
    d = device()
    line = Taking()
    serve(d, line, lambda: d.taken > 1000)
    got = decoded(line.taken)
    assert [f.seq for f in got if isinstance(f, frames.SampleFrame)] == list(range(d.taken))
    assert {f.overruns for f in got if isinstance(f, frames.StatusFrame)} == {0}


def test_a_link_replaces_a_link_and_nothing_else(tmp_path: Path) -> None:
    mine = tmp_path / 'my_rig.yaml'
    mine.write_text('precious')
    for place in (mine, tmp_path, tmp_path / 'nothing' / 'port'):
        with pytest.raises(ConfigError, match=r'no link can be made there \((File exists|No such file or directory)\)'):
            PseudoTerminal(place)
    assert mine.read_text() == 'precious'
    first = PseudoTerminal(tmp_path / 'port')
    second = PseudoTerminal(tmp_path / 'port')
    first.close()
    assert str((tmp_path / 'port').readlink()) == second.name
    second.close()
    assert not (tmp_path / 'port').is_symlink()


def test_pair_ports_have_own_links_and_fail_together(tmp_path: Path) -> None:
    assert (link_names('rig', 1), link_names(None, 2)) == (['rig'], [None, None])
    links = link_names(str(tmp_path / 'rig'), 2)
    with open_terminals(links) as ports:
        assert [str(Path(str(link)).readlink()) for link in links] == [port.name for port in ports]
    assert list(tmp_path.iterdir()) == []
    (tmp_path / 'rig_2').write_text('precious')
    with pytest.raises(ConfigError, match='rig_2: no link'), open_terminals(links):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ['rig_2']


def test_a_converter_of_24_bits_sends_wide_samples_and_says_so() -> None:
    rig = load_rig(overrides={'converter.bits': 24})
    got = decoded(SimulatedFrames(RigFeed(rig, no_load)).take(500 * MS, room=1 << 30))
    hello = next(f for f in got if isinstance(f, frames.HelloFrame))
    reported = {'sample_rate_hz': 1000.0, 'bits': 24, 'full_scale': 10.0}
    assert converter_parameters(hello.info) == {f'converter.{name}': value for name, value in reported.items()}
    volts = np.array([f.counts for f in got if isinstance(f, frames.SampleFrame)]) * rig.converter.volts_per_count
    assert volts.shape == (501, 6)
    assert np.abs(volts.mean(axis=0) - [0.0, 0.0, 5.0, 0.0, 0.0, 5.0]).max() < 5e-4
    # The noise of 2 mV is a handful of steps of 16 bits, and thousands of 24.
    assert len(np.unique(volts[:, 0])) > 450


def test_twelve_bit_converter_saturates_at_last_step() -> None:
    rig = load_rig(overrides={'converter.bits': 12, 'amplifier.sum_nominal': 20.0})
    got = samples(SimulatedFrames(RigFeed(rig, no_load)).take(5 * MS, room=1 << 30))
    assert {f.counts[2] for f in got} == {2047}
    assert all(f.flags & FLAG_OVER_RANGE for f in got)


def test_a_hand_takes_the_place_of_the_cycle() -> None:
    hand = module.Hand(module.served_loads(1000.0))
    before = hand.take(5)
    assert before.shape == (5, 3)
    hand.hold(b'[1.0, 2, -3]\n')
    np.testing.assert_array_equal(hand.take(2), [[1.0, 2.0, -3.0]] * 2)
    for bad in (b'[1, 2]', b'[1, 2, NaN]', b'nonsense'):
        with pytest.raises(ValueError):
            hand.hold(bad)


def test_what_cannot_be_simulated_ends_before_it_begins() -> None:
    """A rate that a pair cannot do, and a device without a twin, which needs a port."""
    with pytest.raises(DeviceError, match=r'converter\.sample_rate_hz = 1000 is out of reach'):
        Session(load_rig(overrides={'source': 'thorlabs'}), null_log)
    with pytest.raises(ConfigError, match='name the recording'):
        Session(load_rig(overrides={'source': 'replay'}), null_log)


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


def table(folder: Path, rate_hz: float) -> Path:
    """A recording of a hundred samples."""
    rows = ''.join(f'{i / rate_hz:.3f},0.1,0.2,5,0.3,0.4,5\n' for i in range(100))
    (folder / 'run.csv').write_text('t,x1,y1,sum1,x2,y2,sum2\n' + rows)
    return folder / 'run.csv'


def test_the_reader_ends_with_the_recording(tmp_path: Path) -> None:
    path = table(tmp_path, 1000.0)
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


def test_a_rig_of_another_rate_is_rejected(tmp_path: Path) -> None:
    path = table(tmp_path, 500.0)
    with pytest.raises(DeviceError, match='sample_rate_hz 500'):
        Acquisition(load_rig(overrides={'source': 'replay', 'port': str(path)}), texts(print)).open()
