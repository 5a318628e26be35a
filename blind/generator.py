# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A second rig simulation, written from docs/simulation.md alone, without ``psd_deflection.model.simulation``."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter
from scipy.stats import norm

from blind import law_forms

Array = npt.NDArray[np.float64]
Spec = Mapping[str, Any]
RATE, FINER = 1000.0, 5
STEP = 1.0 / (RATE * FINER)
EI = 69e9 * math.pi / 4.0 * (0.0159**4 - 0.0138**4)
GJ = 24e9 * math.pi / 2.0 * (0.0159**4 - 0.0138**4)
PLACES = ((0.0, 0.070), (-0.100, 0.0))
MM_PER_V = 0.5e-3
LSB = 20.0 / 65536.0
SIGMA = 2e-3


def find(effects: Sequence[Spec], name: str) -> list[Spec]:
    """Return all effects of that name."""
    return [e for e in effects if e['name'] == name]


def _rk4(a: Array, b: Array) -> tuple[Array, Array]:
    """Return one step of classical Runge-Kutta for y' = a y + b u with u held: y <- p y + q u."""
    n = len(a)
    ha = STEP * a
    p = np.eye(n) + ha @ (np.eye(n) + ha / 2.0 @ (np.eye(n) + ha / 3.0 @ (np.eye(n) + ha / 4.0)))
    q = STEP * (np.eye(n) + ha / 2.0 @ (np.eye(n) + ha / 3.0 @ (np.eye(n) + ha / 4.0))) @ b
    return p, q


def _march(a: Array, b: Array, held: Array, start: Array) -> Array:
    """States (n * FINER, 2) from ``start`` (2,); ``held`` (n, 1) is the input from each sample to the next. FINER steps
    make a sample; within a sample the input is held. So the matrices of the steps are multiplied once, and the loop
    runs over samples."""
    p, q = _rk4(a, b)
    reach, push = [np.eye(2)], [np.zeros((2, 1))]
    for _ in range(FINER):
        reach.append(p @ reach[-1])
        push.append(p @ push[-1] + q)
    (p11, p12), (p21, p22) = reach[-1].tolist()
    q1, q2 = push[-1][:, 0].tolist()
    x, v = float(start[0]), float(start[1])
    first, second = [], []
    for u in held[:, 0].tolist():
        first.append(x)
        second.append(v)
        x, v = p11 * x + p12 * v + q1 * u, p21 * x + p22 * v + q2 * u
    at_samples, out = np.column_stack((first, second)), np.empty((len(held), FINER, 2))
    for j in range(FINER):
        out[:, j] = at_samples @ reach[j].T + held @ push[j].T
    return out.reshape(-1, 2)


def _oscillator(frequency: float, ratio: float) -> tuple[Array, Array]:
    w = 2.0 * math.pi * frequency
    return np.array([[0.0, 1.0], [-w * w, -2.0 * ratio * w]]), np.array([[0.0], [w * w]])


def motion(loads: Array, length: float, effects: Sequence[Spec], warm: Array | None = None) -> Array:
    """Tip pose (n * FINER, 3): dX, dY, theta on the fine grid. ``warm`` (n,), K, for laws of the temperature."""
    f = loads.copy()
    known = dict(zip(law_forms.LOADS, loads.T, strict=True))
    known['temperature'] = np.zeros(len(loads)) if warm is None else warm
    at = np.arange(len(loads)) / RATE
    for e in find(effects, 'law_load'):
        f[:, law_forms.LOADS.index(e['where'])] += e['size'] * law_forms.added(e, known, at, 1.0 / RATE)
    for e in find(effects, 'load_direction'):
        c, s = math.cos(e['angle']), math.sin(e['angle'])
        f[:, :2] = f[:, :2] @ np.array([[c, s], [-s, c]])
    for e in find(effects, 'load_offset'):
        f[:, 2] = f[:, 2] + e['x'] * f[:, 1] - e['y'] * f[:, 0]
    stiff_b, stiff_t = EI, GJ
    f_b, f_t, z_b, z_t = 14.0, 21.0, 0.02, 0.02
    for e in find(effects, 'bending_stiffness'):
        stiff_b *= 1.0 + e['scale']
        f_b *= math.sqrt(1.0 + e['scale']) if e.get('moves_frequency') else 1.0
    for e in find(effects, 'torsional_stiffness'):
        stiff_t *= 1.0 + e['scale']
        f_t *= math.sqrt(1.0 + e['scale']) if e.get('moves_frequency') else 1.0
    for e in find(effects, 'damping'):
        z_b, z_t = e['bending_ratio'], e['torsion_ratio']
    give_b = length**3 / (3.0 * stiff_b)
    give_t = length / stiff_t
    for e in find(effects, 'clamp_bending_compliance'):
        # Root moment F L turns the root by c F L; the tip moves L times that.
        give_b = give_b + e['compliance'] * length * length
    for e in find(effects, 'clamp_torsional_compliance'):
        give_t = give_t + e['compliance']
    for e in find(effects, 'tip_mass'):
        # k = m w^2 of the massless spring with the mass that gives 14 Hz.
        k = 1.0 / give_b
        m = k / (2.0 * math.pi * f_b) ** 2
        f_b = math.sqrt(k / (m + e['mass'])) / (2.0 * math.pi)
    static = f * np.array([give_b, give_b, give_t])
    for e in find(effects, 'alien_cubic_spring'):
        static = static * (1.0 + e['size'] * (static / np.array([1e-3, 1e-3, 1e-2])) ** 2)
    for e in find(effects, 'alien_quadratic_load'):
        static[:, 1] += e['size'] * f[:, 1] ** 2
    for e in find(effects, 'law_link'):
        static[:, law_forms.LOADS.index(e['where'])] += e['size'] * law_forms.added(e, known, at, 1.0 / RATE)
    for e in find(effects, 'clamp_friction'):
        for axis in {1: (0, 1), 2: (2,), 3: (0, 1, 2)}[int(e['axis'])]:
            half, follower = 0.5 * e['width'] * (length, length, 1.0)[axis], 0.0
            for i, x in enumerate(static[:, axis].tolist()):
                static[i, axis] = follower = min(max(follower, x - half), x + half)
    sag = np.zeros(3)
    for e in find(effects, 'self_weight'):
        # Its moment w L^2/2 turns the clamp too.
        clamp = sum(c['compliance'] for c in find(effects, 'clamp_bending_compliance'))
        sag[1] -= e['weight_per_length'] * (length**4 / (8.0 * stiff_b) + clamp * length**3 / 2.0)
    for name, lever in (('tip_force', give_b), ('mount_tilt', length)):
        for e in find(effects, name):
            sag[:2] += e['x'] * lever, e['y'] * lever
    pose, creeps = np.empty((len(loads) * FINER, 3)), find(effects, 'creep')
    for axis, (frequency, ratio) in enumerate(((f_b, z_b), (f_b, z_b), (f_t, z_t))):
        a2, b2 = _oscillator(frequency, ratio)
        rows = static[:, axis]
        total = rows.copy()
        for e in creeps:
            # The creep so far drives the oscillator, constant over a sample.
            total = total + e['amplitude'] * law_forms.lag(rows, e['time_constant'], 1.0 / RATE)
        states = _march(a2, b2, total[:, None], np.zeros(2))
        pose[:, axis] = states[:, 0] + sag[axis]
        if axis < 2:
            for e in find(effects, 'second_bending_mode'):
                a3, b3 = _oscillator(e['frequency'], e['damping_ratio'])
                ringing = _march(a3, b3, total[:, None], np.zeros(2))[:, 0]
                if int(e['shares']) == 1:
                    ringing = ringing - states[:, 0]
                elif int(e['shares']) == 2:
                    ringing = ringing - np.repeat(total, FINER)
                pose[:, axis] += e['gain'] * ringing
    for e in find(effects, 'alien_soft_mode'):
        # A spring that stiffens with speed: not in the catalogue.
        speed = np.gradient(pose[:, 1], STEP)
        pose[:, 1] = pose[:, 1] + e['size'] * speed * np.abs(speed)
    return pose


def flat_dots(poses: Array) -> Array:
    """Dots (n, 4), m, of ``poses`` (n, 3) of a plate that stays parallel to the PSDs."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    out = np.empty((len(poses), 4))
    for i, (lx, ly) in enumerate(PLACES):
        x, y = lx - poses[:, 0], ly - poses[:, 1]
        out[:, 2 * i], out[:, 2 * i + 1] = c * x + s * y - lx, c * y - s * x - ly
    return out


def between(poses: Array) -> Array:
    """Poses (n / 20, 3) in the middle of each block, between two samples: by the cubic through four of them."""
    a, b, c, d = (poses[9 + i :: 20] for i in (-1, 0, 1, 2))
    return np.asarray((9.0 * (b + c) - a - d) / 16.0)


def optics(
    pose: Array, t: Array, warm: Array, length: float, effects: Sequence[Spec], loads: Array | None = None
) -> Array:
    """Dots (n, 4), m, by intersecting each beam with the plate in space."""
    n = len(pose)
    k = sum(e['slope_ratio'] for e in find(effects, 'plane_tilt'))
    phi, omega, theta = -k * pose[:, 1] / length, k * pose[:, 0] / length, pose[:, 2]
    cp, sp, co, so, ct, st = np.cos(phi), np.sin(phi), np.cos(omega), np.sin(omega), np.cos(theta), np.sin(theta)
    # Columns of R = Ry(omega) Rx(phi) Rz(theta): the plate's own X and Y in space.
    ex = np.stack((co * ct + so * sp * st, cp * st, -so * ct + co * sp * st), axis=1)
    ey = np.stack((-co * st + so * sp * ct, cp * ct, so * st + co * sp * ct), axis=1)
    middle = np.column_stack((pose[:, 0], pose[:, 1], np.full(n, length)))
    dots = np.empty((n, 4))
    for i in range(2):
        place = np.array(PLACES[i])
        beam = np.tile(place, (n, 1))
        for e in find(effects, 'sensor_position'):
            if int(e['psd']) == i + 1:
                place = place + np.array([e['x'], e['y']])
                if e['aimed']:
                    beam = beam + np.array([e['x'], e['y']])
        for e in find(effects, 'laser_pointing_drift'):
            if int(e['psd']) == i + 1:
                beam = beam + t[:, None] * np.array([e['rate_x'], e['rate_y']])
        for e in find(effects, 'law_optics'):
            column = law_forms.DOTS.index(e['where'])
            if column // 2 == i and loads is not None:
                known = {**dict(zip(law_forms.LOADS, loads.T, strict=True)), 'temperature': warm}
                beam[:, column % 2] += e['size'] * law_forms.added(e, known, t, STEP)
        for e in find(effects, 'refraction'):
            beam = beam + warm[:, None] * np.array([e['x'], e['y']])
        # middle + a ex + b ey = (beam, s): three equations for a, b and the height s.
        system = np.zeros((n, 3, 3))
        system[:, :, 0], system[:, :, 1] = ex, ey
        system[:, 2, 2] = -1.0
        right = np.column_stack((beam, np.zeros(n))) - middle
        solved = np.linalg.solve(system, right[:, :, None])[:, :, 0]
        dots[:, 2 * i : 2 * i + 2] = solved[:, :2] - place
    return dots


def _clip_spot(x: Array, radius: float, profile: int) -> tuple[Array, Array]:
    """Centroid and light left of a spot at x between edges at +-5 mm."""
    half = 0.005
    if profile == 2:
        s = radius / 2.0
        a, b = (-half - x) / s, (half - x) / s
        transmitted = norm.cdf(b) - norm.cdf(a)
        return x + s * (norm.pdf(a) - norm.pdf(b)) / transmitted, transmitted
    # Strips of an even disc, by trapezoids at the angles where they are equally fine: no closed form here.
    angle = np.linspace(0.0, np.pi, 100_001)
    u, weight = -np.cos(angle), np.sin(angle) ** 2
    step = angle[1]
    full = np.concatenate(([0.0], np.cumsum(0.5 * step * (weight[1:] + weight[:-1]))))
    first_moment = weight * u
    first = np.concatenate(([0.0], np.cumsum(0.5 * step * (first_moment[1:] + first_moment[:-1]))))
    hi, lo = (np.arccos(-np.clip((edge - x) / radius, -1.0, 1.0)) for edge in (half, -half))
    light = np.interp(hi, angle, full) - np.interp(lo, angle, full)
    moment = np.interp(hi, angle, first) - np.interp(lo, angle, first)
    return x + radius * moment / light, light / full[-1]


def sensors(dots: Array, t: Array, warm: Array, effects: Sequence[Spec]) -> tuple[Array, Array]:
    """What the PSDs report: dots (n, 4) m and sums (n, 2) V."""
    m = dots.copy()
    light = np.full((len(m), 2), 5.0)
    for i in range(2):
        cols = (2 * i, 2 * i + 1)

        def mine(name: str, psd: int = i + 1) -> list[Spec]:
            return [e for e in find(effects, name) if int(e['psd']) == psd]

        for e in mine('spot_clipping'):
            for c in cols:
                m[:, c], transmitted = _clip_spot(m[:, c], e['radius'], int(e['profile']))
                light[:, i] *= transmitted
        for e in mine('ambient_light'):
            share = e['level'] / (light[:, i] + e['level'])
            m[:, cols[0]] += share * (e['x'] - m[:, cols[0]])
            m[:, cols[1]] += share * (e['y'] - m[:, cols[1]])
            light[:, i] += e['level']
        for e in mine('sensor_rotation'):
            z = (m[:, cols[0]] + 1j * m[:, cols[1]]) * np.exp(-1j * e['angle'])
            m[:, cols[0]], m[:, cols[1]] = z.real, z.imag
        for e in mine('sensor_nonlinearity'):
            r2 = m[:, cols[0]] ** 2 + m[:, cols[1]] ** 2
            for c in cols:
                m[:, c] += e['k'] * r2 * m[:, c]
        for e in mine('axis_crosstalk'):
            x, y = m[:, cols[0]].copy(), m[:, cols[1]].copy()
            m[:, cols[0]], m[:, cols[1]] = x + e['xy'] * y, y + e['yx'] * x
        for e in mine('sensor_gain'):
            m[:, cols[0]] *= 1.0 + e['x']
            m[:, cols[1]] *= 1.0 + e['y']
        for e in mine('thermal_drift'):
            m[:, cols[0]] += e['x'] * warm
            m[:, cols[1]] += e['y'] * warm
    _alien_sensors(m, t, warm, effects)
    for e in (*find(effects, 'law_psd'), *find(effects, 'law_electronics')):
        if e['form'] != 'jitter':
            known = {**dict(zip(law_forms.DOTS, m.T, strict=True)), 'temperature': warm}
            m[:, law_forms.DOTS.index(e['where'])] += e['size'] * law_forms.added(e, known, t, STEP)
    return m, light


def _alien_sensors(m: Array, t: Array, warm: Array, effects: Sequence[Spec]) -> None:
    """Effects that are in no catalogue, each on PSD 1 or 2; changes ``m`` in place."""
    added: dict[str, tuple[int, Callable[[], Array]]] = {
        'alien_square_crosstalk': (0, lambda: m[:, 1] ** 2),
        'alien_thermal_square': (3, lambda: warm**2),
        'alien_rectifier': (2, lambda: np.abs(m[:, 3])),
        'alien_beat': (1, lambda: np.sin(2 * np.pi * (0.3 + 0.02 * t) * t)),
    }
    gains = {'alien_gain_drift': (1, t), 'alien_thermal_gain': (3, warm)}
    for e in effects:
        name, size = e['name'], e.get('size', 0.0)
        if name in added:
            m[:, added[name][0]] += size * added[name][1]()
        elif name in gains:
            m[:, gains[name][0]] *= 1.0 + size * gains[name][1]
        elif name == 'alien_walk':
            steps = np.random.default_rng(int(e['seed'])).normal(size=len(t) // FINER + 1)
            m[:, 0] += size * np.repeat(np.cumsum(steps), FINER)[: len(t)]
        elif name == 'alien_backlash':
            held = m[0, 3]
            for i, v in enumerate(m[:, 3].tolist()):
                m[i, 3] = held = min(max(held, v - size), v + size)


def electronics(m: Array, light: Array, t: Array, effects: Sequence[Spec]) -> Array:
    """Volts (n, 6) at the samples, before noise."""
    fine = np.column_stack((m[:, :2] / MM_PER_V, light[:, 0], m[:, 2:] / MM_PER_V, light[:, 1]))
    for e in find(effects, 'amplifier_lag'):
        tau = e['time_constant']
        decay = math.exp(-STEP / tau)
        # The response to a straight piece of input, solved by hand.
        ahead = 1.0 - tau / STEP * (1.0 - decay)
        previous = 1.0 - decay - ahead
        driven = previous * fine[:-1] + ahead * fine[1:]
        fine = lfilter([1.0], [1.0, -decay], np.vstack((fine[:1], driven)), axis=0)
    volts = fine[::FINER].copy()
    at = t[::FINER]
    for e in find(effects, 'channel_skew'):
        i = 3 * (int(e['psd']) - 1)
        late = np.clip(at - e['delay'], 0.0, None)
        volts[:, i : i + 3] = CubicSpline(t, fine[:, i : i + 3])(late)
    for e in find(effects, 'mains_interference'):
        sizes, phases = np.array(e['amplitude']), np.array(e['phase'])
        volts += sizes * np.sin(2.0 * math.pi * e['frequency'] * at[:, None] + phases)
    return volts


def output(volts: Array, effects: Sequence[Spec], bits: int = 16) -> Array:
    """Clipping, coarse steps, the own steps of a converter of so many bits over +-10 V."""
    v = volts
    for e in find(effects, 'amplifier_saturation'):
        v, cols = v.copy(), [0, 1, 2, 3, 4, 5] if e['sums'] else [0, 1, 3, 4]
        v[:, cols] = np.clip(v[:, cols], -e['limit'], e['limit'])
    for e in find(effects, 'quantisation'):
        v, cols = v.copy(), [0, 1, 3, 4] if e.get('sums', 1) == 0 else [0, 1, 2, 3, 4, 5]
        v[:, cols] = e['step'] * np.round(v[:, cols] / e['step'])
    lsb = LSB * 2.0 ** (16 - bits)
    half = 2 ** (bits - 1)
    return np.clip(np.round(v / lsb), -half, half - 1) * lsb


def noise(n: int, kind: str, seed: int) -> Array:
    """(n, 6) V: ``white``, ``heavy`` (Student's t, 4 degrees), ``coloured`` (AR 0.5), ``loud`` (1.5 sigma), ``flicker``
    (white, and 1/f noise that is as much at 0.3 to 30 Hz)."""
    rng = np.random.default_rng(seed)
    if kind == 'flicker':
        return SIGMA * flicker(n, math.exp(rng.uniform(math.log(0.3), math.log(30.0))), rng)
    if kind == 'heavy':
        return SIGMA * rng.standard_t(4, size=(n, 6)) / math.sqrt(2.0)
    e = rng.normal(size=(n, 6))
    if kind == 'loud':
        return 1.5 * SIGMA * e
    return SIGMA * (coloured(e, 0.5) if kind == 'coloured' else e)


def coloured(e: Array, memory: float) -> Array:
    """White noise (n, ...) as an autoregression: each value is ``memory`` times the last one, and something new."""
    new = np.concatenate((e[:1], math.sqrt(1.0 - memory**2) * e[1:]))
    return np.asarray(lfilter([1.0], [1.0, -memory], new, axis=0))


def flicker(n: int, corner: float, rng: np.random.Generator) -> Array:
    """(n, 6): white noise of unit variance, and 1/f noise whose density is as much at ``corner`` Hz. A part of a noise
    four times as long: its ends do not meet."""
    spectrum = np.fft.rfft(rng.normal(size=(4 * n, 6)), axis=0)
    f = np.fft.rfftfreq(4 * n, 1.0 / RATE)
    f[0] = f[1]
    return np.asarray(np.fft.irfft(spectrum * np.sqrt(1.0 + corner / f)[:, None], 4 * n, axis=0)[:n])


def jitter(volts: Array, effects: Sequence[Spec], seed: int) -> Array:
    """Noise (n, 6), V, whose rms follows the size of one channel's own voltage."""
    out = np.zeros_like(volts)
    for e in find(effects, 'law_electronics'):
        if e['form'] == 'jitter':
            c = (0, 1, 3, 4)[law_forms.DOTS.index(e['where'])]
            hiss = np.random.default_rng(seed + 1).normal(size=len(volts))
            out[:, c] = e['size'] / law_forms.FULL[e['where']] * np.abs(volts[:, c]) * hiss
    return out


def electronic_noise(
    n: int, seed: int, *, sigmas: Sequence[float] = (SIGMA,) * 6, memory: float = 0.0, heavy: bool = False
) -> Array:
    """(n, 6) V of rms ``sigmas``, with a ``memory`` as :func:`coloured` has it."""
    rng = np.random.default_rng(seed)
    new = rng.standard_t(4, size=(n, 6)) / math.sqrt(2.0) if heavy else rng.normal(size=(n, 6))
    return np.asarray((coloured(new, memory) if memory else new) * np.asarray(sigmas))


def present(n: int, seed: int, share: float = 0.0, burst: int = 0) -> npt.NDArray[np.bool_]:
    """Which of n samples arrive: ``share`` of them lost one by one, and of every 200 ``burst`` together."""
    rng = np.random.default_rng(seed)
    here = rng.random(n) >= share
    if burst:
        for start in range(0, n - 200, 200):
            first = start + int(rng.integers(0, 200 - burst))
            here[first : first + burst] = False
    return here


class Generator:
    """One recording's design; ``length`` m; ``loads`` (n, 3); ``temperature`` (n,)."""

    def __init__(self, loads: Array, temperature: Array, length: float) -> None:
        self.loads, self.temperature, self.length = loads, temperature, length
        self._poses: dict[str, Array] = {}

    def clean(self, effects: Sequence[Spec]) -> Array:
        """Volts (n, 6) without noise, before clipping and steps."""
        moving = [e for e in effects if e['name'] in LINK]
        key = repr(moving)
        warmer = self.temperature - self.temperature[0]
        if key not in self._poses:
            if len(self._poses) > 2:
                self._poses = {k: v for k, v in self._poses.items() if k == '[]'}
            self._poses[key] = motion(self.loads, self.length, moving, warmer)
        pose = self._poses[key]
        t = np.arange(len(pose), dtype=np.float64) * STEP
        warm = np.repeat(warmer, FINER)
        dots = optics(pose, t, warm, self.length, effects, np.repeat(self.loads, FINER, axis=0))
        m, light = sensors(dots, t, warm, effects)
        return electronics(m, light, t, effects)

    def record(self, effects: Sequence[Spec], kind: str, seed: int) -> Array:
        """Volts (n, 6) as read by a converter."""
        clean = self.clean(effects)
        return output(clean + noise(len(clean), kind, seed) + jitter(clean, effects, seed), effects)


LINK = {
    *('bending_stiffness', 'torsional_stiffness', 'clamp_bending_compliance', 'clamp_torsional_compliance'),
    *('clamp_friction', 'creep', 'damping', 'tip_mass', 'second_bending_mode', 'self_weight', 'mount_tilt'),
    *('load_offset', 'load_direction', 'alien_cubic_spring', 'alien_quadratic_load', 'alien_soft_mode'),
    *('law_load', 'law_link', 'tip_force'),
}
"""Effects that change the motion, and with it the slow part of a run."""
