# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The fit through one block: exact on what it can follow, the mean where nothing moves, honest about its variance."""

from collections.abc import Sequence

import numpy as np
import pytest

from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.measure.uncertainty.block_fit import BlockFit, basis
from psd_deflection.measure.uncertainty.combinations import combinations_of
from psd_deflection.records import DeflectionEstimate, FloatArray, IntArray, RawChunk
from psd_deflection.rig.config import load_rig

PLACES = np.array([[0.0, 0.070], [-0.100, 0.0]])
SIGMA = 1e-6
SIZE = 20
ALL = np.arange(SIZE)
GAPS = [ALL, np.delete(ALL, [3, 11]), np.arange(8, 20), np.array([0, 1, 2, 3, 4, 5, 6, 13, 14, 15, 16, 19])]


def white(size: int = SIZE, sigma: float = SIGMA) -> FloatArray:
    gamma = np.zeros((4, 4, size))
    gamma[range(4), range(4), 0] = sigma**2
    return gamma


def fitter(gamma: FloatArray | None = None) -> BlockFit:
    out = BlockFit(SIZE, PLACES, PLACES)
    out.set_noise(white() if gamma is None else gamma)
    return out


def dots_of(pose: FloatArray) -> FloatArray:
    """Flat plate, (n, 4): m = R(-theta)(l - d) - c."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    out = []
    for x, y in PLACES:
        u, v = x - pose[:, 0], y - pose[:, 1]
        out += [c * u + s * v - x, -s * u + c * v - y]
    return np.stack(out, axis=1)


@pytest.mark.parametrize('size', [1, 2, 5, 9, 11, 12, 20, 64, 100])
def test_the_polynomials_are_orthonormal_and_start_with_the_mean(size: int) -> None:
    q = basis(size)
    np.testing.assert_allclose(q.T @ q, np.eye(q.shape[1]), atol=1e-13)
    np.testing.assert_allclose(q[:, 0], size**-0.5)
    orders = {1: 1, 2: 1, 5: 3, 9: 5, 11: 5, 12: 3, 20: 5, 64: 5, 100: 5}
    assert q.shape[1] == orders[size]


def test_last_combination_is_base_line_length() -> None:
    """Over the root of 2, without that of the beams; and the way back is the way there."""
    rng = np.random.default_rng(4)
    for _ in range(5):
        beams = PLACES + 5e-3 * rng.normal(size=(2, 2))
        of, dots = combinations_of(PLACES, beams), 1e-3 * rng.normal(size=(6, 4))
        at = PLACES + dots.reshape(6, 2, 2)
        length = np.linalg.norm(at[:, 0] - at[:, 1], axis=1)
        np.testing.assert_allclose(of.of(dots)[3], (length - np.linalg.norm(beams[0] - beams[1])) / 2**0.5, atol=1e-15)
        np.testing.assert_allclose(of.fixed(dots), of.of(dots)[3], atol=1e-15)
        for row, z in zip(dots, of.of(dots).T, strict=True):
            np.testing.assert_allclose(of.back(z[None], np.eye(4)[None])[0][0], row, atol=1e-15)


@pytest.mark.parametrize('slots', GAPS, ids=lambda s: f'{len(s)} samples')
def test_ringing_plate_with_lost_samples_is_followed(slots: IntArray) -> None:
    """14 and 21 Hz of some tenths of a millimetre, without noise: the mean is tens of micrometres off."""
    fit = fitter()
    t = (ALL - 9.5) * 1e-3
    worst = worst_of_mean = 0.0
    for block in range(60):
        at = t + 0.02 * block
        pose = np.stack((1e-4 * np.sin(88.0 * at), 5e-4 * np.cos(88.0 * at), 2e-3 * np.cos(132.0 * at + 0.3)), axis=1)
        when = 0.02 * block
        truth = dots_of(
            np.array([[1e-4 * np.sin(88.0 * when), 5e-4 * np.cos(88.0 * when), 2e-3 * np.cos(132.0 * when + 0.3)]])
        )[0]
        here = slots if block % 4 == 3 else ALL
        dots = dots_of(pose)[here]
        fitted = fit.fit(here, dots)
        sd = np.sqrt(fitted.covariance.diagonal())
        worst = max(worst, float((abs(fitted.dots - truth) / sd).max()))
        worst_of_mean = max(worst_of_mean, float(abs(dots.mean(axis=0) - truth).max()))
    assert worst < 2.5
    assert worst_of_mean > 3e-5


@pytest.mark.slow
def test_what_is_stated_of_a_dying_motion_is_its_error() -> None:
    """A mode of 14 Hz with 2 % of damping, from 0.1 mm to nothing: motion that is over is stated no longer."""
    rng = np.random.default_rng(4)
    squares = []
    for _ in range(24):
        fit, phase = fitter(), rng.uniform(0.0, 6.28)
        for block in range(180):
            t = 0.02 * block + (ALL - 9.5) * 1e-3
            where, truth = (
                1e-4 * np.exp(-1.76 * at) * np.cos(88.0 * at + phase) for at in (t, np.array([0.02 * block]))
            )
            fitted = fit.fit(ALL, rng.normal(0.0, SIGMA, (SIZE, 4)) + where[:, None] * [1.0, 0.0, 1.0, 0.0])
            if block >= 60:
                squares.append((fitted.dots[0] - truth[0]) ** 2 / fitted.covariance[0, 0])
    assert 0.85 < np.mean(squares) < 1.05


class Dense:
    """The fit as its text says it, with whole matrices: Gaussian coefficients, posterior mean, noise of any colour."""

    def __init__(self, gamma: FloatArray, beams: FloatArray) -> None:
        self.of = combinations_of(PLACES, beams)
        rotated = np.einsum('ac,cdl,bd->abl', self.of.turn, gamma, self.of.turn)
        size = gamma.shape[2]
        later = np.subtract.outer(np.arange(size), np.arange(size)).T
        back = rotated.transpose(1, 0, 2)
        self.noise_covariance = np.where(later >= 0, rotated[:, :, np.abs(later)], back[:, :, np.abs(later)])
        self.q = basis(size)
        orders = self.q.shape[1]
        powers = np.polynomial.polynomial.polyvander(np.arange(size) - 0.5 * (size - 1), orders - 1)
        self.middle = np.linalg.lstsq(powers, self.q, rcond=None)[0][0]
        self.size, self.orders = size, orders
        self.usual_v = np.array([np.diag(self.information(a, np.arange(size), orders)) for a in range(4)])
        self.squares, self.weight = np.zeros((4, orders)), np.ones((4, orders))
        self.long, self.blocks = np.zeros((4, orders)), np.full((4, orders), 12.0)

    def information(self, a: int, slots: IntArray, reported: int) -> FloatArray:
        """Covariance (told, told) of the coefficients by generalised least squares."""
        q = self.q[slots, :reported]
        return np.asarray(np.linalg.inv(q.T @ np.linalg.inv(self.noise_covariance[a, a][np.ix_(slots, slots)]) @ q))

    def usual(self) -> FloatArray:
        usual = np.maximum(self.late() - 0.5 * self.usual_v, 1e-9 * self.usual_v)
        return np.asarray(np.maximum(usual, self.long - 0.03 * self.usual_v))

    def late(self) -> FloatArray:
        return np.asarray(self.squares / np.maximum(self.weight, 1e-12))

    def last(self, a: int, excess: FloatArray, sure: FloatArray) -> None:
        """The mean of what goes on alike; where that is over, it begins anew."""
        reported, v = slice(len(excess)), self.usual_v[a, : len(excess)]
        self.blocks[a, reported] = np.minimum(self.blocks[a, reported] + sure, 250.0)
        self.long[a, reported] += sure * (excess - self.long[a, reported]) / self.blocks[a, reported]
        late = self.late()[a, reported]
        least = (0.35 + self.blocks[a, reported] * 0.65 / 250.0) * (v + np.maximum(late, 0.0))
        over = self.long[a, reported] - late > least
        self.long[a, reported] = np.where(over, late, self.long[a, reported])
        self.blocks[a, reported] = np.where(over, 12.0, self.blocks[a, reported])

    def fit(self, slots: IntArray, dots: FloatArray) -> tuple[tuple[float, ...], FloatArray, bool]:
        z, n = self.of.of(dots), len(slots)
        reported = min(self.orders, (n + 1) // 2)
        before, q = self.usual(), self.q[slots]
        weights, more, value, misfit = np.zeros((4, self.size)), np.zeros(4), np.zeros(4), False
        for a in range(4):
            precision = np.linalg.inv(self.noise_covariance[a, a][np.ix_(slots, slots)])
            noise_covariance = self.information(a, slots, reported)
            c = noise_covariance @ q[:, :reported].T @ precision @ (z[a] - z[a].mean())
            excess = c * c - np.diag(noise_covariance)
            sure = np.minimum(self.usual_v[a, :reported] / np.diag(noise_covariance), 1.0) ** 2
            self.squares[a, :reported] += (sure * excess - self.squares[a, :reported]) / 12.0
            self.weight[a, :reported] += (sure - self.weight[a, :reported]) / 12.0
            self.last(a, excess, sure)
            tau = self.usual()[a]
            sudden = c * c > 16.0 * (np.diag(noise_covariance) + before[a, :reported])
            tau[:reported] = np.where(sudden, np.maximum(excess, tau[:reported]), tau[:reported])
            if reported > 1 and n < self.size:
                expected = noise_covariance[1:, 1:] + np.diag(tau[1:reported])
                if c[1:] @ np.linalg.inv(expected) @ c[1:] > reported - 1 + 3.0 * (2.0 * (reported - 1)) ** 0.5:
                    tau[1:reported] = np.maximum(tau[1:reported], (c * c + np.diag(noise_covariance))[1:])
            if a == 3:
                # The length of the base line: what it does in one block is noise.
                tau = before[a]
            prior = np.diag(np.r_[0.0, 1.0 / tau[1:reported]])
            inverted = np.linalg.inv(q[:, :reported].T @ precision @ q[:, :reported] + prior)
            w = precision @ q[:, :reported] @ inverted @ self.middle[:reported]
            weights[a, slots] = w
            value[a] = w @ z[a]
            more[a] = float((self.middle - w @ q)[1:] ** 2 @ tau[1:])
            residual = z[a] - z[a].mean() - q[:, :reported] @ c
            free = n - reported
            if free > 0 and residual @ precision @ residual > free + 5.0 * (2.0 * free) ** 0.5:
                misfit = True
                more[a] += float(residual @ residual) / free
        covariance = np.einsum('as,abst,bt->ab', weights, self.noise_covariance, weights) + np.diag(more)
        dots, noise_covariance = self.of.back(value[None], covariance[None])
        return tuple(dots[0].tolist()), noise_covariance[0], misfit


@pytest.mark.parametrize('size', [5, 12, 20])
def test_the_fit_is_the_posterior_of_gaussian_coefficients(size: int) -> None:
    """Through rest, motion, jumps and gaps, with noise that has colour and is common to readings."""
    rng = np.random.default_rng(8)
    now, before = SIGMA * rng.normal(size=(2, 4, 4))
    gamma = np.zeros((4, 4, size))
    gamma[:, :, 0] = now @ now.T + before @ before.T + SIGMA**2 * np.eye(4)
    gamma[:, :, 1] = now @ before.T
    beams = PLACES + 1e-3 * rng.normal(size=(2, 2))
    fit, dense = BlockFit(size, PLACES, beams), Dense(gamma, beams)
    fit.set_noise(gamma)
    u = np.linspace(-1.0, 1.0, size)
    misfits = 0
    for block in range(190):
        e = rng.normal(size=(size + 1, 4))
        dots = e[1:] @ now.T + e[:-1] @ before.T + SIGMA * rng.normal(size=(size, 4))
        dots += (beams - PLACES).ravel()
        phase = block // 15
        if phase in (1, 4):
            dots += SIGMA * 10.0 ** (1 + block % 3) * np.sin(2.0 * u + block)[:, None] * [1.0, 0.5, 1.0, -0.3]
        if phase in (2, 5) and block % 5 == 0:
            dots[size // 3 :] += SIGMA * rng.choice([3.0, 8.0, 30.0]) * rng.normal(size=4)
        slots = np.arange(size)
        if phase in (3, 4, 5):
            slots = np.sort(rng.choice(size, int(rng.integers(1, size + 1)), replace=False))
        if phase > 5:
            # So few at one end that nothing is learnt of motion, and what was is forgotten.
            slots = np.arange(size - size // 3 - 1, size)
        got = fit.fit(slots, dots[slots])
        want, covariance, misfit = dense.fit(slots, dots[slots])
        sd = np.sqrt(np.diag(covariance))
        assert got.misfit == misfit, block
        np.testing.assert_allclose((np.array(got.dots) - want) / sd, 0.0, atol=1e-6, err_msg=str(block))
        np.testing.assert_allclose((got.covariance - covariance) / np.outer(sd, sd), 0.0, atol=1e-6, err_msg=str(block))
        misfits += misfit
    assert misfits > 0


def shaken(fit: BlockFit, hz: float, amplitude: float, blocks: int, seed: int = 5) -> tuple[FloatArray, FloatArray]:
    """Error over standard deviation (n,) of x1, and that (n,), of both plates' x that sway along with white noise."""
    rng = np.random.default_rng(seed)
    turn = 2.0 * np.pi * hz / 1000.0
    errors, sds = [], []
    for block in range(blocks):
        sway = amplitude * np.sin(turn * (block * SIZE + ALL) + 0.7)
        dots = np.outer(sway, [1.0, 0.0, 1.0, 0.0]) + rng.normal(0.0, SIGMA, (SIZE, 4))
        fitted = fit.fit(ALL, dots)
        sds.append(float(fitted.covariance[0, 0] ** 0.5))
        errors.append(fitted.dots[0] - amplitude * np.sin(turn * (block * SIZE + 9.5) + 0.7))
    return np.array(errors) / np.array(sds), np.array(sds)


@pytest.mark.slow
@pytest.mark.parametrize(('hz', 'amplitude'), [(5.0, 15e-6), (20.0, 15e-6), (30.0, 10e-6)])
def test_variance_covers_motion_curved_by_noise_level(hz: float, amplitude: float) -> None:
    z, _ = shaken(fitter(), hz, amplitude, 4000)
    assert 0.94 < np.mean(np.abs(z[500:]) < 1.959964) < 0.97


@pytest.mark.slow
def test_at_rest_the_memory_of_motion_adds_little_noise() -> None:
    z, sds = shaken(fitter(), 5.0, 0.0, 4000)
    assert np.std(z * sds) < 1.04 * SIGMA / SIZE**0.5 / 2.0**0.5 * 2.0**0.5
    assert np.mean(np.abs(z) < 1.959964) == pytest.approx(0.955, abs=0.012)


@pytest.mark.parametrize(('size', 'coloured'), [(64, True), (65, False)])
def test_colour_makes_the_weights_of_blocks_up_to_64_samples(size: int, coloured: bool) -> None:
    """Noise of the one lag: in motion the weights are those of generalised, or of ordinary, least squares."""
    gamma = np.zeros((4, 4, size))
    gamma[range(4), range(4), 0], gamma[range(4), range(4), 1] = SIGMA**2, 0.45 * SIGMA**2
    fit, rng = BlockFit(size, PLACES, PLACES), np.random.default_rng(7)
    fit.set_noise(gamma)
    powers = np.polynomial.polynomial.polyvander(np.linspace(-1.0, 1.0, size), 4)
    at = np.arange(size)
    for _ in range(100):
        dots = np.outer(1e-3 * powers @ rng.normal(size=5), [1.0, 0.0, 1.0, 0.0])
        dots += SIGMA * rng.normal(size=(size, 4))
        fit.fit(at, dots)
    toeplitz = np.eye(size) + 0.45 * (np.eye(size, k=1) + np.eye(size, k=-1))
    weight = np.linalg.inv(toeplitz) if coloured else np.eye(size)
    want = (np.linalg.inv(powers.T @ weight @ powers) @ powers.T @ weight @ dots)[0]
    got = fit.fit(at, dots).dots
    assert got[0] + got[2] == pytest.approx(want[0] + want[2], abs=2e-9)


def swaying(size: int, lost: tuple[int, ...] = ()) -> FloatArray:
    """Errors of ΔY over their standard deviations: 14 Hz of 0.3 mm, blocks of ``size``, of which slots are ``lost``."""
    rng, n = np.random.default_rng(1), 30_000
    seq = np.arange(n)
    volts = np.tile([0.0, 0.0, 5.0], (n, 2))
    volts[:, 1::3] -= 0.6 * np.sin(88.0 * 1e-3 * seq + 0.3)[:, None]
    volts += 2e-3 * rng.normal(size=volts.shape)
    seq = seq[~np.isin(seq % size, lost)]
    pipeline = Pipeline(load_rig(overrides={'block_size': size, 'min_samples': 5, 'solvers': ['exact']}))
    chunk = RawChunk(seq, seq * 1_000_000, volts[seq].astype(np.float32), np.zeros(len(seq), np.uint8))
    found = [r for r in pipeline.process(chunk) if isinstance(r, DeflectionEstimate) and r.t_ns > 5_000_000_000]
    return np.array([(r.dy - 3e-4 * np.sin(88.0e-9 * r.t_ns + 0.3)) / r.covariance[4] ** 0.5 for r in found])


def test_blocks_losing_their_end_cover_their_error() -> None:
    """Weights of some 1e-5 a block are weights: 0.93 were within three deviations, and the rms error was 6 um."""
    assert np.mean(np.abs(swaying(20, tuple(range(12, 20)))) < 3.0) > 0.99


@pytest.mark.parametrize('present', [range(10, 20), range(7, 20), range(11)])
def test_motion_that_begins_in_lost_samples_is_in_the_intervals(present: Sequence[int]) -> None:
    """After rest: coefficients far apart, each of which might be noise, are no noise together (200 um off at 0.6)."""
    rng, slots = np.random.default_rng(5), np.array(present)
    z = []
    for _ in range(60):
        fit = fitter()
        for _ in range(20):
            fit.fit(ALL, SIGMA * rng.normal(size=(SIZE, 4)))
        size, phase = 10.0 ** rng.uniform(-4.5, -2.8), rng.uniform(0.0, 2.0 * np.pi, size=2)
        t = np.append(ALL - 9.5, 0.0) * 1e-3
        y, theta = size * np.cos(88.0 * t + phase[0]), 4.0 * size * np.cos(132.0 * t + phase[1])
        dots = dots_of(np.stack((0.0 * t, y, theta), axis=1))
        fitted = fit.fit(slots, dots[slots] + SIGMA * rng.normal(size=(len(slots), 4)))
        z.append((np.array(fitted.dots) - dots[-1]) / np.sqrt(np.diag(fitted.covariance)))
    assert np.mean(np.abs(z) < 3.0) > 0.97
