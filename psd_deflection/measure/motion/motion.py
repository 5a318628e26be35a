# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The filter: block after block of poses in, pose and velocity of the tip out.

How fast the load wanders is not known and changes: a link at rest, in operation, and one whose load
has just been switched differ by six orders of magnitude. So each axis has K rates. In every block
the filter runs with all of them, and Bayes' rule weighs them by how well they predicted the samples
(a Markov chain says how likely a change is); the next block starts from mean and covariance of them
all (generalised pseudo-Bayes of first order, Bar-Shalom, Li & Kirubarajan 2001, 11.6.4). With rates
that the rig file states, K is 1.

The axes are filtered one by one. The noise that they share, because each pose is solved from the
same four readings, is followed through the gains, so that the covariance of the pose is that of the
errors.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from psd_deflection.base.arithmetic import FIXED
from psd_deflection.base.arithmetic.matrices import inverse
from psd_deflection.base.errors import ConfigError
from psd_deflection.measure.motion.inertia import Forced, Inertia
from psd_deflection.measure.motion.modal import BlockTables, KnownLoads, Oscillator, Pushed, joined_ns, split_ns
from psd_deflection.measure.motion.unseen import Innovations, UnseenLoads
from psd_deflection.measure.state import State, Value, mismatch, numbers
from psd_deflection.measure.uncertainty.block_fit import LARGEST
from psd_deflection.records import AppliedLoad, FloatArray, IntArray
from psd_deflection.rig.config import Rig

STEPPED, SMOOTH = 13, 10
"""Rates that are tried of a load that wanders by steps, and of one whose rate of change wanders; K
together."""
SMALLEST, STEP = 1e-2, 10.0**0.5
"""The static deflection wanders in one block by so many times the noise of a sample at the lowest
rate; from each rate to the next the factor."""
DOWN, UP, JUMPS = 0.03, 0.01, 0.01
"""Probability that the rate of the next block is the next one down, the next one up, any one at
all."""
UNKNOWN = 1.0
"""Standard deviation of each state at the start, m or rad: nothing is known."""
STEADY = 1e-9
"""The same of r/w, if the rig file states how the load wanders: it has no rate of change."""
LATE_S = 1.0
"""What late accelerations change fades to 1/e in this time."""

AXES = ('dX', 'dY', 'theta')
_PAIRS = ((0, 1), (0, 2), (1, 2))
_FIRST, _SECOND = (np.array(side) for side in zip(*_PAIRS, strict=True))
STATE, INERTIA = 'state.motion', 'state.inertia'
UNSEEN, LOADS = 'state.unseen', 'state.known_loads'
"""Names under which :meth:`ModalFilter.memory` is recorded; ``LOADS``: while nothing else is known.
"""


class TipState(NamedTuple):
    """The tip at ``t_ns``: ``pose`` (3,) m, m, rad; ``velocity`` (3,) m/s, m/s, rad/s; their covariances (3, 3).

    ``coasted``: time since the last sample that was used, s.
    """

    t_ns: int
    pose: FloatArray
    velocity: FloatArray
    covariance: FloatArray
    velocity_covariance: FloatArray
    coasted: float


class Predicted(NamedTuple):
    """Motion at n times: ``pose`` m, m, rad, ``velocity`` m/s, m/s, rad/s, ``variance`` of the pose, (n, 3) each."""

    pose: FloatArray
    velocity: FloatArray
    variance: FloatArray


class _Taken(NamedTuple):
    """Kept from the last block, to correct it if an acceleration arrives late: ``forced``, what the
    known accelerations did; ``gain`` (3, 4, N), how each sample moved the state at its end, 0 for a
    lost sample."""

    forced: Forced
    gain: FloatArray


class ModalFilter:
    """Holds pose, velocity and static deflection of the tip, at the last sample of the last block.

    ``inertia``: takes the accelerations of the base. A late one puts right what was computed of the
    last block. ``innovations``: of the run so far. ``coasted``: s since the last sample that was
    used. ``predictions_only``: times that the filter went on without samples. Raises ConfigError if blocks
    are too long.
    """

    part = 'the filter of the motion'
    prefixes = (STATE, INERTIA, UNSEEN, LOADS)

    def __init__(self, rig: Rig, compliance: tuple[float, float, float], gain: FloatArray, noise: FloatArray) -> None:
        """``compliance``: m/N, m/N, rad/(N m). ``gain`` (3, C): of the solver at rest. ``noise``: :meth:`set_noise`."""
        config, dynamics = rig.estimator, rig.dynamics
        size = config.block_size
        if size > LARGEST:
            raise ConfigError(f'filter = {config.filter}: needs a block_size of {LARGEST} at most, not {size}')
        self._size = size
        self._period = 1.0 / rig.converter.sample_rate_hz
        xp = self._xp = FIXED
        bending = Oscillator(dynamics.bending_frequency, dynamics.bending_damping_ratio, xp)
        torsion = Oscillator(dynamics.torsion_frequency, dynamics.torsion_damping_ratio, xp)
        self._modes = (bending, bending, torsion)
        self._w = np.array([mode.w for mode in self._modes])
        self._tables = BlockTables(self._modes, size, self._period)
        self._ahead = config.filter_ahead
        self._later = np.stack([mode.step(self._ahead) for mode in self._modes])
        self._later_covariance = np.stack([mode.added_covariance(np.array([self._ahead]))[0] for mode in self._modes])
        self._longest = config.filter_coast
        self._unseen = (
            UnseenLoads(self._modes, size * self._period, self._longest + self._ahead)
            if not any(config.filter_load_walk)
            else None
        )
        self._compliance = np.array(compliance)
        self._gain = gain
        stated = np.array(config.filter_load_walk) * self._compliance
        self._stated = (
            np.stack((np.square(stated), np.zeros(3)), axis=1)[:, None] if any(config.filter_load_walk) else None
        )
        self.levels = 1 if self._stated is not None else STEPPED + SMOOTH
        self._changes = _transitions((1,) if self._stated is not None else (STEPPED, SMOOTH))
        self.innovations = Innovations()
        self.predictions_only = 0
        self._known = KnownLoads(self._modes, self._compliance, size, self._period)
        self.inertia = Inertia(self._modes, rig.link.length)
        self._late_ones = 0
        self._times = self._period * np.arange(1.0, size + 1.0)
        self.set_noise(noise)
        self.forget()

    def forget(self) -> None:
        """Know nothing: the next block starts anew."""
        self._x = np.zeros((3, 4))
        self._p = np.tile(UNKNOWN * UNKNOWN * np.eye(4), (3, 1, 1))
        if self._stated is not None:
            self._p[:, 3, 3] = STEADY * STEADY
        self._shared = np.zeros((3, 4, 4))
        self._weights = np.full((3, self.levels), 1.0 / self.levels)
        self._index: int | None = None
        self._t_ns = 0
        self.coasted = 0.0
        self._taken: _Taken | None = None
        self._late = np.zeros((3, 2))
        if self._unseen is not None:
            self._unseen.forget()
        self._begin_unseen()

    def set_noise(self, gamma: FloatArray) -> None:
        """``gamma`` (C, C, N), m^2: covariance of reading c with reading d, so many samples later."""
        rotated = self._xp.einsum('ac,cdl,bd->abl', self._gain, gamma, self._gain)
        lags = np.arange(self._size)[:, None] - np.arange(self._size)
        toeplitz = np.where(lags >= 0, rotated.transpose(1, 0, 2)[..., np.abs(lags)], rotated[..., np.abs(lags)])
        noise = toeplitz[range(3), range(3)]
        self._noise = toeplitz[_FIRST, _SECOND]
        rates = self._stated
        if rates is None:
            seconds = self._size * self._period
            rates = np.zeros((3, self.levels, 2))
            steps = noise[:, 0, 0, None] / seconds * np.square(SMALLEST * self._xp.power_many(STEP, np.arange(STEPPED)))
            smooth = noise[:, 0, 0, None] / seconds * np.square(SMALLEST * self._xp.power_many(STEP, np.arange(SMOOTH)))
            rates[:, :STEPPED, 0] = steps
            rates[:, STEPPED:, 1] = smooth / (self._w[:, None] * seconds) ** 2
        self._rates = rates
        self._tables.fill(noise, rates)

    def is_new(self, load: AppliedLoad) -> bool:
        """Whether ``load`` differs from the last one that was reported."""
        return self._known.is_new(load)

    def load(self, load: AppliedLoad) -> None:
        """A known load that acts from its stamp on. One from before the samples that were used is seen in them."""
        self._known.add(load)

    def block(self, index: int, t_ns: int, slots: IntArray | None, poses: FloatArray | None) -> TipState | None:
        """The motion at the end of block ``index``, or None if nothing is known.

        ``t_ns``: time of the block's middle. ``slots`` (n,), ``poses`` (n, 3) m, m, rad: the
        samples that can be used, and which of the N places each has; None if there is none: then
        the filter coasts.
        """
        seconds = self._size * self._period
        if self._index is not None:
            self._pass_missed(index - self._index - 1, (t_ns - self._t_ns) / 1e9, seconds)
        self.inertia.forget_before(self._before_ns(t_ns))
        if self._index is None and slots is None:
            return None
        pushed = self._known.pushed(t_ns, self._index is None)
        forced = self._forced(t_ns)
        self._index, self._t_ns = index, t_ns
        if slots is None or poses is None:
            self._predict_only(seconds, forced)
            if pushed is not None:
                self._x = self._x + pushed.end
            if self.coasted > self._longest:
                self.forget()
                return None
        else:
            self._update(slots, poses, pushed, forced)
        return self._moved()

    def _pass_missed(self, missed: int, away: float, seconds: float) -> None:
        """Coast through ``missed`` blocks of ``seconds``; begin anew if the next one, ``away`` s, is too far."""
        # After a restart numbers and times do not agree.
        if missed < 0 or away > self._longest + 2.0 * seconds or abs(away - (missed + 1) * seconds) > 0.5 * seconds:
            self.forget()
            return
        self._take_late()
        for k in range(missed):
            self._predict_only(seconds, self._forced(self._t_ns + round(1e9 * (k + 1) * seconds)))

    def _predict_only(self, seconds: float, forced: Forced | None) -> None:
        if self.coasted == 0.0:
            self.predictions_only += 1
            self._begin_unseen()
        self.coasted += seconds
        phi = self._tables.phi
        self._x = self._xp.einsum('aij,aj->ai', phi, self._x)
        added = self._xp.einsum('ak,akij->aij', self._weights, self._tables.added)
        self._p = self._xp.einsum('aij,ajl,aml->aim', phi, self._p, phi) + added
        self._shared = self._xp.einsum('pij,pjl,pml->pim', phi[_FIRST], self._shared, phi[_SECOND])
        self._taken = None
        if forced is not None:
            self._x = self._x + forced.at[:, -1]
            self._p[:, 2, 2] += np.square(forced.doubt)
            self._taken = _Taken(forced, np.zeros((3, 4, self._size)))

    def _end_ns(self) -> int:
        """Time of the last sample of the last block."""
        return self._t_ns + round(0.5e9 * (self._size - 1) * self._period)

    def _before_ns(self, t_ns: int) -> int:
        """One sample before the block whose middle is at ``t_ns``."""
        return t_ns - round(0.5e9 * (self._size + 1) * self._period)

    def _begin_unseen(self) -> None:
        """What is seen of loads from here on does not depend on what was before."""
        self._swung = np.zeros((3, 4))
        if self._unseen is not None:
            self._unseen.begin()

    def _forced(self, t_ns: int) -> Forced | None:
        """What the base's accelerations do in the block whose middle is at ``t_ns``; None if none is known."""
        if not self.inertia.known:
            return None
        return self.inertia.forced(self._before_ns(t_ns), self._times)

    def _take_late(self) -> None:
        """Put right what accelerations did in the last block that were not known then.

        The samples of the block have shown some of it: what the filter would have found is linear
        in what is predicted. The mean square of what that changes is how far what is published was
        off, and will be.
        """
        came, self._late_ones = self.inertia.late - self._late_ones, self.inertia.late
        taken = self._taken
        decay = self._xp.exp(-self._size * self._period / LATE_S)
        self._late = decay * self._late if taken is not None else np.zeros((3, 2))
        if taken is None or not came or (now := self._forced(self._t_ns)) is None:
            return
        more = now.at - taken.forced.at
        self._late += (1.0 - decay) * np.square(more[:, -1, :2])
        self._x = self._x + more[:, -1] - self._xp.einsum('ain,an->ai', taken.gain, more[..., 0])
        self._swung = self._swung + more[:, -1]
        self._p[:, 2, 2] += np.square(np.maximum(now.doubt - taken.forced.doubt, 0.0))

    def _update(self, slots: IntArray, poses: FloatArray, pushed: Pushed | None, forced: Forced | None) -> None:
        gains = self._tables.gains(slots)
        predicted = self._xp.einsum('ani,ai->an', gains.observed, self._x)
        after = self._xp.einsum('aij,aj->ai', self._tables.phi, self._x)
        p = self._p + self._unforeseen(self.coasted) if self.coasted > 0.0 else self._p
        if pushed is not None:
            predicted = predicted + pushed.samples[:, slots]
            after = after + pushed.end
            p = p.copy()
            p[:, 2, 2] += pushed.variance
        if forced is not None:
            predicted = predicted + forced.at[:, slots, 0]
            after = after + forced.at[:, -1]
            p = p.copy()
            p[:, 2, 2] += np.square(forced.doubt)
        miss = poses.T - predicted
        levels = self.levels
        # Of x0, one sample before the block: what the block says, then with what was known.
        scaled = self._xp.einsum('aknm,am->akn', gains.precision, miss)
        score = self._xp.einsum('akin,an->aki', gains.pulled, miss)
        known = inverse(p)
        posterior = inverse((known[:, None] + gains.information).reshape(-1, 4, 4)).reshape(3, levels, 4, 4)
        squares = self._xp.einsum('an,akn->ak', miss, scaled) - self._xp.einsum(
            'aki,akij,akj->ak', score, posterior, score
        )
        size = gains.log_size - self._xp.log_det_by_pivots(posterior) + self._xp.log_det_by_pivots(p)[:, None]
        prior = self._xp.einsum('ak,kl->al', self._weights, self._changes)
        log_weights = self._xp.log_many(prior) - 0.5 * (size + squares)
        weights = self._xp.exp_many(log_weights - log_weights.max(axis=1, keepdims=True))
        weights /= self._xp.sum(weights, 1)[:, None]
        carried = self._xp.einsum('akij,akjl->akil', gains.transition, posterior)
        estimates = after[:, None] + self._xp.einsum('akin,an->aki', gains.smoothed, miss)
        estimates += self._xp.einsum('akij,akj->aki', carried, score)
        covariance = self._xp.einsum('akij,aklj->akil', carried, gains.transition) + gains.residual
        self._x = self._xp.einsum('ak,aki->ai', weights, estimates)
        apart = estimates - self._x[:, None]
        total = covariance + apart[..., :, None] * apart[..., None, :]
        self._p = self._xp.einsum('ak,akij->aij', weights, total)
        self._p = 0.5 * (self._p + self._p.transpose(0, 2, 1))
        mean = self._xp.einsum('ak,akin->ain', weights, gains.smoothed)
        mean += self._xp.einsum('akij,akjn->ain', weights[..., None, None] * carried, gains.pulled)
        transition = self._tables.phi - self._xp.einsum('ain,anj->aij', mean, gains.observed)
        noise = self._noise[:, slots[:, None], slots]
        both = self._xp.einsum('pin,pnm->pim', mean[_FIRST], noise)
        self._shared = self._xp.einsum('pij,pjl,pml->pim', transition[_FIRST], self._shared, transition[_SECOND])
        self._shared += self._xp.einsum('pim,pjm->pij', both, mean[_SECOND])
        self._weights = weights
        self.coasted = 0.0
        self._taken = None
        if forced is not None:
            gain = np.zeros((3, 4, self._size))
            gain[..., slots] = mean
            self._taken = _Taken(forced, gain)
        if self._unseen is not None:
            if pushed is not None:
                # What a known load did was foreseen.
                self._begin_unseen()
            self._swung = self._xp.einsum('aij,aj->ai', self._tables.phi, self._swung)
            if forced is not None:
                self._swung = self._swung + forced.at[:, -1]
            self._unseen.add(self._x - self._swung, self._p, self._rate())
        taken = self._xp.einsum('ak,ak->a', weights, squares).tolist()
        so_far = zip(self.innovations.squares, taken, strict=True)
        self.innovations = Innovations(tuple(a + b for a, b in so_far), self.innovations.samples + len(slots))

    def _rate(self) -> FloatArray:
        """Process noise (A, 2) by what was seen last."""
        return self._xp.einsum('ak,akc->ac', self._weights, self._rates)

    def _unforeseen(self, seconds: float) -> FloatArray:
        """What a load that nobody sees adds to the covariance (A, 4, 4) so long after the last sample."""
        out = np.zeros((3, 4, 4))
        if self._unseen is not None and seconds > 0.0:
            out[:, range(4), range(4)] = self._unseen.after(seconds)
        return out

    def _unsure(self) -> FloatArray:
        """Covariance (3, 4, 4) at the end of the block, with what the next messages about the base may put right."""
        if not self.inertia.known:
            return self._p
        p = self._p.copy()
        p[:, (0, 1), (0, 1)] += self._late
        p[:, 1, 1] += np.square(self.inertia.unsure(self._end_ns()))
        return p

    def _moved(self) -> TipState:
        """Of the end of the block, ``filter_ahead`` later."""
        x = self._xp.einsum('aij,aj->ai', self._later, self._x)
        if self.inertia.known and self._ahead > 0.0:
            x = x + self.inertia.forced(self._end_ns(), np.array([self._ahead])).at[:, 0]
        p = self._xp.einsum('aij,ajl,aml->aim', self._later, self._unsure(), self._later)
        p += self._xp.einsum('ac,acij->aij', self._rate(), self._later_covariance)
        p += self._unforeseen(self.coasted + self._ahead)
        shared = self._xp.einsum('pij,pjl,pml->pim', self._later[_FIRST], self._shared, self._later[_SECOND])
        t_ns = self._t_ns + round(1e9 * (0.5 * (self._size - 1) * self._period + self._ahead))
        pose, velocity = np.diag(p[:, 0, 0]), np.diag(self._w**2 * p[:, 1, 1])
        for k, (a, b) in enumerate(_PAIRS):
            pose[a, b] = pose[b, a] = shared[k, 0, 0]
            velocity[a, b] = velocity[b, a] = self._w[a] * self._w[b] * shared[k, 1, 1]
        return TipState(t_ns, x[:, 0], self._w * x[:, 1], pose, velocity, self.coasted)

    def predicted(self, seconds: FloatArray) -> Predicted:
        """The motion so long (n,) after the last block's last sample."""
        steps = np.stack([[mode.step(s) for s in seconds.tolist()] for mode in self._modes])
        added = np.stack([mode.added_covariance(seconds) for mode in self._modes])
        x = self._xp.einsum('anij,aj->nai', steps, self._x)
        if self.inertia.known:
            x = x + self.inertia.forced(self._end_ns(), seconds).at.transpose(1, 0, 2)
        p = self._xp.einsum('anij,ajl,anml->naim', steps, self._unsure(), steps)
        p += self._xp.einsum('ac,ancij->naij', self._rate(), added)
        p += np.stack([self._unforeseen(self.coasted + s) for s in seconds.tolist()])
        return Predicted(x[..., 0], self._w * x[..., 1], p[..., 0, 0])

    def load_walk(self) -> tuple[float, ...]:
        """How far the load wanders in a second by what was seen last, by its steps alone: N, N, N m."""
        return tuple((np.sqrt(self._rate()[:, 0]) / self._compliance).tolist())

    def state_dict(self) -> State:
        """What the next block depends on, besides the noise; {} if nothing is known."""
        out: State = {}
        held, waiting = self._known.state()
        if self._index is not None:
            times = (float(self._index), *split_ns(self._t_ns), self.coasted)
            arrays = [self._x, self._p, self._shared, self._weights]
            if self._unseen is not None:
                arrays.append(self._unseen.variances)
                out[UNSEEN] = (*self._swung.ravel().tolist(), *self._unseen.buffered())
            out[STATE] = (*times, *held, *_flat(arrays), *waiting)
        elif self._known:
            out[LOADS] = (*held, *waiting)
        if self.inertia.known:
            reported = [v for t_ns, deflection in self.inertia.reported for v in (*split_ns(t_ns), *deflection)]
            arrays = [self._late]
            if self._taken is not None:
                arrays += [self._taken.forced.at[..., :2], self._taken.forced.doubt, self._taken.gain]
            out[INERTIA] = (float(len(reported)), *reported, *_flat(arrays))
        return out

    def load_state_dict(self, values: Mapping[str, Value]) -> None:
        """Go on from a :meth:`state_dict`. Raises ValueError if it had another number of rates or samples."""
        if state := numbers(values, STATE, 'the state of the filter'):
            self._restore_state(state)
        if unseen := numbers(values, UNSEEN, 'states of the last blocks'):
            if self._unseen is None or not self._unseen.gather(unseen[12:]):
                raise mismatch(UNSEEN, unseen, 'states of as many blocks as the filter coasts')
            self._swung = np.reshape(unseen[:12], (3, 4))
        if loads := numbers(values, LOADS, 'known loads'):
            self._known.load_state(LOADS, loads)
        if inertia := numbers(values, INERTIA, 'accelerations of the base'):
            self._restore_inertia(inertia)

    def _restore_state(self, values: tuple[float, ...]) -> None:
        known = 8 + 12 + 48 + 48 + 3 * self.levels
        end = known + (self._unseen.variances.size if self._unseen is not None else 0)
        if len(values) < end or (len(values) - end) % 5:
            raise mismatch(
                STATE, values, f'the state of a filter with {self.levels} rates, {end} numbers and five a load'
            )
        self._index = int(values[0])
        self._t_ns = joined_ns(*values[1:3])
        self.coasted = values[3]
        x, p, shared, weights = np.split(np.array(values[8:known]), (12, 60, 108))
        self._x, self._p, self._shared = x.reshape(3, 4), p.reshape(3, 4, 4), shared.reshape(3, 4, 4)
        self._weights = weights.reshape(3, self.levels)
        self._begin_unseen()
        if self._unseen is not None:
            self._unseen.variances[:] = np.reshape(values[known:end], self._unseen.variances.shape)
        self._known.load_state(STATE, (*values[4:8], *values[end:]))

    def _restore_inertia(self, values: tuple[float, ...]) -> None:
        n = self._size
        reported = int(values[0]) + 1 if 0.0 <= values[0] < len(values) and np.isfinite(values).all() else 0
        known, taken = values[reported:], 6 * n + 3 + 12 * n
        if reported % 5 != 1 or len(known) not in (6, 6 + taken):
            raise mismatch(INERTIA, values, f'accelerations in blocks of {n} samples')
        rows = np.reshape(values[1:reported], (-1, 5)).tolist()
        self.inertia.reported = [(joined_ns(s, ns), tuple(deflection)) for s, ns, *deflection in rows]
        # Perhaps some came after the last block.
        self._late_ones = -1
        self._late = np.reshape(known[:6], (3, 2))
        if len(known) > 6:
            moved, doubt, gain = np.split(np.array(known[6:]), (6 * n, 6 * n + 3))
            at = np.concatenate((moved.reshape(3, n, 2), np.zeros((3, n, 2))), axis=2)
            self._taken = _Taken(Forced(at, doubt), gain.reshape(3, 4, n))


def _flat(arrays: Sequence[FloatArray]) -> list[float]:
    return [v for array in arrays for v in array.ravel().tolist()]


def _transitions(families: tuple[int, ...]) -> FloatArray:
    """(K, K): probability of rate l in the next block if it is k in this one; rows sum to 1.

    ``families``: numbers of rates of each kind, K together.
    """
    levels = sum(families)
    out = np.full((levels, levels), JUMPS / levels)
    first = 0
    for count in families:
        for k in range(first, first + count):
            out[k, max(k - 1, first)] += DOWN
            out[k, min(k + 1, first + count - 1)] += UP
            out[k, k] += 1.0 - DOWN - UP - JUMPS
        first += count
    return out
