# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Follows the measured deflection with joint offsets, within limits, and holds as soon as it cannot be trusted.

With the joints at q + o, the rigid pose T(q + o) and the measured deflection D, the end effector is
at T(q + o) D. It is to be at T(q). Each estimate moves o by a damped least squares step (Nakamura &
Hanafusa 1986) that lessens the difference on the chosen axes; a first-order lag lets the offsets
follow a load that is held, and not a vibration.

Nothing is sent until the compensation is enabled, everything is known and nothing is wrong. Then
the offsets begin where the controller has them. They hold (they keep their last value) while the
deflection is stale, not finite, too uncertain, too large or jumping, the joints are not known, leap
or do not follow, the robot does not run, or somebody else commands it. They move again after some
good estimates in a row, and go back to zero if that takes long or when the compensation is switched
off. A controller that does not tell what it has, or is elsewhere than it was sent, hears
nothing until that is corrected; if the compensation was switched off meanwhile, the offsets that it
still has go back to zero then. Whatever happens, what is sent moves by no more than ``max_rate``
times the time since something was sent.

What a controller tells is where the offsets begin, and never how well they do: that is measured, by
the joints' positions (:class:`JointResponse`) and the deflection.
"""

import math
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from psd_deflection.arms.chains.transform import Transform
from psd_deflection.arms.compensation.arm import Arm
from psd_deflection.arms.compensation.response import JointResponse
from psd_deflection.arms.compensation.settings import AXES, COMMANDS, CompensatorSettings
from psd_deflection.arms.inputs import LARGEST_POSITION
from psd_deflection.records import FloatArray

LONGEST_S = 0.1
"""A step is never longer than this: after a pause the offsets do not leap."""
FOLLOW_S = 0.3
"""For so long a joint may be away from its command, s: its controller lags."""
MOVED_SHARE = 0.1
"""Joints that moved by less than this share of what the offsets did do not follow them."""
LEAST_SD = 1e-10
"""Nobody measures a deflection to better than this, m or rad: one that says so does not know its
uncertainty."""
UNTOLD = 'the controller does not tell the offsets that it applies'
UNKNOWN_COMMAND = 'the controller does not tell the command that it has'
AWAITED = 'good deflections are awaited'
UNVERIFIED = 'not yet verified, the offsets have not been seen to move the joints of an arm at rest'
ARRIVED_SHARE = 0.01
"""What was sent has arrived if the controller tells it within this share of ``follow_error``."""
UNSEEN_SHARE = 0.1
"""Of what all offsets do to the end effector, what those of unverified joints may do."""
STOP_LATE_S = 1.0
"""A robot tells by this time at the latest that it does not run, s."""
FOREIGN = 1e-6
"""An offset that the controller tells is one from here on, rad or m."""
FOREIGN_S = 1.0
"""Age of what the controller tells, from which on nobody knows what it has, s."""


class State(StrEnum):
    """What the offsets do."""

    OFF = 'off'
    FOLLOWING = 'following'
    HOLDING = 'holding'
    RELEASING = 'releasing'


class Observed(NamedTuple):
    """A measured deflection. ``t``: its stamp, s; ``age``: time from the stamp to now, s.

    ``deflection`` and ``covariance`` (6, 6): in the frame of the rigid pose.
    """

    t: float
    deflection: Transform
    covariance: FloatArray
    age: float = 0.0


class Command(NamedTuple):
    """``offsets`` (n,) of the joints, rad or m; ``why``: reason for the state, '' if it follows, as was verified.

    ``residual``: distance of the end effector, by measured joints and deflection, from the rigid
    pose on the axes that are corrected, m; NaN until the joints were seen to follow. Of a dry one it
    is what would be left if they did. ``limited``: whether a limit keeps the offsets from what
    the deflection asks for. ``positions`` (n,): of the joints with the offsets, None if the output
    is offsets. ``sends``: whether the controller is to get it. ``foreign``: nothing is sent, and the
    controller has offsets.
    """

    offsets: FloatArray
    state: State
    why: str = ''
    residual: float = math.nan
    limited: bool = False
    positions: FloatArray | None = None
    sends: bool = False
    foreign: bool = False

    @property
    def text(self) -> str:
        """State and reason."""
        return f'{self.state}: {self.why}' if self.why else str(self.state)


class Compensator:
    """The offsets of the joints of ``arm``. The times ``now`` are seconds of a clock that is never set. For one thread.

    ``enabled``: whether the offsets follow; :meth:`enable` changes it. ``dry``: the joints do not
    get the offsets.
    """

    def __init__(self, arm: Arm, settings: CompensatorSettings, dry: bool = False) -> None:
        self.arm = arm
        self.settings = settings
        self.enabled = False
        self._dry = dry
        self._offsets = np.zeros(len(arm.names))
        self._wanted = self._offsets
        self._moved_t: float | None = None
        # Whether the controller gets what we say, and what it got last, when.
        self._speaks = dry
        # Whether the controller may still have offsets, though we have fallen silent.
        self._owed = False
        self._sent: tuple[FloatArray, float] | None = None
        self._joints: FloatArray | None = None
        self._joints_t = -math.inf
        self._last_move = self._offsets
        # What the offsets were when positions of the joints came last, and what was sent when the
        # controller told what it has.
        self._at_joints = self._at_has = self._offsets
        self.response = JointResponse(len(arm.names))
        self._verified, self._foreign = dry, ''
        # Output of commands: where the joints would be without offsets.
        self._pose: FloatArray | None = None
        # Output of commands: ``_pose`` when we fell silent with offsets in the command of the controller.
        self._left_pose: FloatArray | None = None
        # What the controller has, as it tells: its offsets, or its command with an output of commands.
        self._has: FloatArray | None = None
        self._has_t = -math.inf
        self._anchor: tuple[FloatArray, FloatArray] | None = None
        self._away_t: float | None = None
        self._stop = self._broken = ''
        # For how long it was so at the last :meth:`watch`.
        self._broken_s = 0.0
        self._other_publisher = False
        self._last: Observed | None = None
        self._last_now = -math.inf
        self._good = settings.good
        self._fault = self._unready = 'no deflection yet'
        self._held_t: float | None = None
        self._residual = math.nan
        self._limited = False

    @property
    def _rows(self) -> list[int]:
        return [AXES.index(axis) for axis in self.settings.axes]

    @property
    def _sums(self) -> bool:
        return self.settings.output == COMMANDS

    @property
    def remaining_offsets(self) -> FloatArray:
        """(n,): the offsets that the controller may still have, as far as one knows, rad or m."""
        if self._speaks or self._has is None:
            return self._offsets.copy()
        return self._offsets_of_command() if self._sums else self._has.copy()

    def _offsets_of_command(self) -> FloatArray:
        """Output of commands, while nothing is sent: the offsets that the command of the controller still has from us.

        Zeros if that command is not between what we sent last and the pose without offsets: somebody else's.
        """
        none = np.zeros(len(self._offsets))
        if self._left_pose is None or self._sent is None or self._has is None:
            return none
        sent, then = self._sent
        ours = sent - self._left_pose
        if self._has_t <= then:
            return ours
        offsets = self._has - self._left_pose
        inside = np.minimum(ours, 0.0) - FOREIGN <= offsets, offsets <= np.maximum(ours, 0.0) + FOREIGN
        return offsets if np.all(inside) else none

    @property
    def owed(self) -> bool:
        """Whether offsets that the controller has are to be taken back as soon as it tells them."""
        return self._owed and not self._speaks and bool(np.any(self.remaining_offsets))

    def controller_text(self, now: float) -> str:
        """What the controller tells that it has, rad or m, in words."""
        if self._has is None or now - self._has_t > FOREIGN_S:
            return 'nothing'
        return ', '.join(f'{v:.6f}' for v in self._has.tolist())

    def enable(self, wanted: bool) -> None:
        """Let the offsets follow from where the controller has them, or let them go back to zero.

        Joints that did not follow keep the offsets held until this is called again. Offsets that the controller has
        from before, whoever sent them, go back as well.
        """
        self._owed = self._owed or (not wanted and bool(self._foreign))
        if wanted == self.enabled and not self._broken:
            return
        self.enabled = wanted
        if self._broken:
            self._broken = ''
            self.response, self._verified = JointResponse(len(self._offsets)), self._dry
            self.response.begin(self._offsets)
        self._anchor = self._away_t = self._held_t = None

    def stop(self, why: str, *, other_publisher: bool = False) -> None:
        """Hold for as long as ``why`` is not '': the robot does not run, or, with ``other_publisher``, somebody else
        commands it.

        Joints that did not follow for ``STOP_LATE_S`` before that stood already. While another publisher commands,
        offsets that the controller still has after we fell silent are not taken back either.
        """
        if self._stop and not why and self._fault == self._stop:
            # That is over. What it waits for now is what comes next, or does not come.
            self._fault = AWAITED
        if why and not self._stop:
            self.response.forget_motion()
            if not other_publisher and self._broken_s <= STOP_LATE_S:
                self._broken = ''
        self._stop, self._other_publisher = why, other_publisher

    def controller_has(self, now: float, values: FloatArray) -> None:
        """What the controller tells, where ours begin: the offsets that it applies, or its command (n,), rad or m."""
        self._has, self._has_t = np.array(values, dtype=np.float64), now
        self._at_has = self._offsets if self._pose is None else self._pose + self._offsets

    def joints(self, now: float, positions: FloatArray, age: float = 0.0) -> None:
        """Where the joints are, offsets included unless ``dry``, in the order of the arm; ``age``, s, of the positions.

        Passed over if one is not finite or beyond ``LARGEST_POSITION``.
        """
        if not np.all(np.abs(positions) <= LARGEST_POSITION):
            return
        observed = np.array(positions, dtype=np.float64)
        before, then = self._joints, self._joints_t
        self._joints, self._joints_t = observed, now - max(age, 0.0)
        self._at_joints = self._offsets
        wrong = None
        if not self._stop:
            wrong = self.response.add(now, observed, self._offsets, self.settings.follow_error, self._arrived(now))
        if wrong is not None and self._speaks and not self._dry:
            self._broken = self._broken or self.response.wrong(self.arm.names, wrong)
        if before is None:
            return
        move, settings = observed - before, self.settings
        leap = float(np.abs(move).max())
        if leap > settings.max_joint_speed * min(max(self._joints_t - then, 0.02), 1.0):
            self._hold(f'the positions of the joints leap by {leap:.3g}')
        # No joint turns round so quickly, but two nodes that tell different positions look like
        # this.
        reversed_by = np.where(move * self._last_move < 0.0, np.minimum(np.abs(move), np.abs(self._last_move)), 0.0)
        if reversed_by.max() > settings.follow_error:
            self._hold(f'the positions of the joints go to and fro by {reversed_by.max():.3g}')
        self._last_move = move

    def _arrived(self, now: float) -> bool:
        """Whether the controller tells what it was sent; joints do not follow what is on its way."""
        if self._has is None or not self._speaks or self._dry or not (self._sums or self.settings.takeover):
            return True
        asked = self._offsets if self._pose is None else self._pose + self._offsets
        late = np.abs(self._has - asked).max() > ARRIVED_SHARE * self.settings.follow_error
        return not late and now - self._has_t <= self.settings.stale

    def observe(self, now: float, observed: Observed) -> Command:
        """Take a deflection at the time ``now``; return what :meth:`watch` gave last, with the state of now."""
        before, fault = self._last, self._rejection(now, observed)
        if fault:
            self._hold(fault)
            return self.command()
        back = before.t - observed.t if before is not None else -1.0
        if 0.0 <= back <= self.settings.stale:
            # Twice the same, or late on the way.
            return self.command()
        self._last, self._last_now = observed, now - max(observed.age, 0.0)
        if back > 0.0:
            self._hold(f'the stamps of the deflections go back by {back:.3g} s')
        elif before is not None:
            moved = _vector(before.deflection.inverse() @ observed.deflection)[self._rows]
            if np.abs(moved).max() > self.settings.jump:
                self._hold(f'the deflection jumps by {np.abs(moved).max():.3g}')
        if self._fault:
            self._good += 1
            if self._good < self.settings.good:
                return self.command()
            self._fault = ''
        nominal = self._nominal() if self.enabled and self._speaks else None
        if nominal is not None:
            elapsed = observed.t - before.t if before is not None else 0.0
            self._follow(nominal, observed.deflection, min(max(elapsed, 0.0), LONGEST_S))
        return self.command()

    def watch(self, now: float) -> Command:
        """What to send at the time ``now``. To be called often: here the offsets move, and deflections are missed."""
        self._look(now)
        if not self._speaks and self.enabled:
            self._unready = '' if self._fault else self._begin(now)
        elif self.owed and not self._other_publisher:
            self._unready = self._begin(now)
        self._foreign = self._look_for_foreign(now)
        self._give_up(now)
        passed = 0.0 if self._moved_t is None else max(now - self._moved_t, 0.0)
        elapsed, self._moved_t = min(passed, LONGEST_S), now
        self._broken_s = self._broken_s + passed if self._broken else 0.0
        if not self.enabled:
            self._wanted = np.zeros(len(self._offsets))
        elif self._fault:
            self._wanted = self._offsets
        if not self._speaks:
            # Nobody has them.
            self._offsets = self._wanted = np.zeros(len(self._offsets))
        limit = self.settings.max_rate * elapsed
        self._offsets = self._offsets + np.clip(self._wanted - self._offsets, -limit, limit)
        command = self.command()
        if command.state is State.OFF:
            # The one of no offset is the last before the silence.
            self._speaks, self._pose = False, None
        return command

    def sent(self, now: float, command: Command) -> None:
        """``command`` has been sent, at the time ``now``: from then on counts the time for the next step."""
        self._moved_t = now
        self._sent = command.offsets if command.positions is None else command.positions, now

    def command(self) -> Command:
        """What :meth:`watch` gave last, with the state of now."""
        offsets = self._offsets.copy()
        positions = self._pose + offsets if self._sums and self._pose is not None else None
        out = Command(offsets, State.FOLLOWING, '', self._residual, self._limited, positions, self._speaks)
        if not self.enabled:
            if self._speaks and np.any(offsets):
                return out._replace(state=State.RELEASING, why='going back to zero', residual=math.nan, limited=False)
            why, foreign = self._foreign or self._fault, bool(self._foreign)
            return out._replace(state=State.OFF, why=why, residual=math.nan, limited=False, foreign=foreign)
        why = self._fault or ('' if self._speaks else self._unready)
        if why or not self._speaks:
            return out._replace(state=State.HOLDING, why=why, residual=math.nan, limited=False)
        return out if self._verified else out._replace(why=UNVERIFIED)

    def _look_for_foreign(self, now: float) -> str:
        """Offsets that the controller tells while nothing is sent, in words; '' if there are none."""
        if self._speaks or self._dry or self._has is None or (now - self._has_t > FOREIGN_S and not self._sums):
            return ''
        if self._sums:
            offsets = self._offsets_of_command()
            worst = int(np.abs(offsets).argmax())
            what = f'the command of the controller keeps {offsets[worst]:.3g} from here at {self.arm.names[worst]}'
            return f'{what}: {self._unready}' if offsets[worst] else ''
        worst = int(np.abs(self._has).argmax())
        # What we sent last may still be on its way back to us.
        if abs(self._has[worst]) <= FOREIGN or (self._sent is not None and self._has_t - self._sent[1] <= FOLLOW_S):
            return ''
        what = f'the controller applies {self._has[worst]:.3g} at {self.arm.names[worst]}'
        return f'{what}: {self._unready}' if self._owed else f'{what}, which is not sent from here'

    def _begin(self, now: float) -> str:
        """Begin to speak, from where the controller is; the reason why not, or ''."""
        settings, has = self.settings, self._has
        offsets, pose = np.zeros(len(self._offsets)), None
        known = has is not None and now - self._has_t <= settings.stale
        if not known and (self._sums or settings.takeover):
            return self._untold
        if has is not None and known and not self._sums:
            offsets, worst = has, int(np.abs(has).argmax())
            if abs(has[worst]) > settings.max_offset:
                return f'the controller applies {has[worst]:.3g} at {self.arm.names[worst]}: beyond max_offset'
        elif has is not None and known:
            offsets = self._offsets_of_command()
            pose, away = has - offsets, np.abs(has - self._joints) if self._joints is not None else np.zeros(len(has))
            worst = int(away.argmax())
            if away[worst] > settings.follow_error:
                return f'{self.arm.names[worst]} is {away[worst]:.3g} from the command of the controller: follow_error'
        if self._sent is not None:
            sent, then = self._sent
            away = np.abs((offsets if pose is None else pose + offsets) - sent).max()
            if away > settings.max_rate * (now - then):
                return 'the controller is elsewhere than it was sent last: the rate allows for it soon'
            if known and away > FOREIGN and self._has_t - then <= FOLLOW_S:
                return 'the controller does not yet report what it was sent last'
        self._offsets = self._wanted = self._at_joints = offsets
        self._at_has = offsets if pose is None else pose + offsets
        self._pose, self._speaks, self._owed, self._verified = pose, True, False, self._dry
        self._left_pose = None
        self.response.begin(offsets)
        self._anchor = self._away_t = self._held_t = None
        return ''

    def _look(self, now: float) -> None:
        """Hold, or be silent, if something is wrong at this time."""
        stale, why = self.settings.stale, ''
        if self._speaks and not self._dry:
            why = self._not_followed(now)
        why = why or self._stop or self._broken
        if why:
            self._hold(why)
        elif self._fault in ('', AWAITED):
            if now - self._last_now > stale:
                self._hold(f'no deflection for {stale:g} s')
            elif now - self._joints_t > stale:
                self._hold(f'no positions of the joints for {stale:g} s')

    def _not_followed(self, now: float) -> str:
        """Why the joints or the controller do not do what was sent; '' if they do, as far as one can tell."""
        reported: list[tuple[FloatArray, FloatArray]] = []
        known = self._has is not None and now - self._has_t <= self.settings.stale
        if not known and (self._sums or self.settings.takeover):
            # It may come back with something else, so it hears nothing until it tells what it has.
            self._fall_silent()
            return self._untold
        if self._has is not None and known:
            reported.append((self._at_has, self._has))
        if self._pose is not None and self._joints is not None:
            reported.append((self._pose + self._at_joints, self._joints))
        return self._away(now, reported) or self._stands_still()

    @property
    def _untold(self) -> str:
        return UNKNOWN_COMMAND if self._sums else UNTOLD

    def _away(self, now: float, pairs: list[tuple[FloatArray, FloatArray]]) -> str:
        """Why what was asked is not what there is, of pairs of both. For ``FOLLOW_S`` it may be late; then nothing is
        sent."""
        away = np.max([np.abs(there - asked) for asked, there in pairs] or [np.zeros(len(self._offsets))], axis=0)
        worst = int(away.argmax())
        if away[worst] <= self.settings.follow_error:
            self._away_t = None
            return ''
        self._away_t = now if self._away_t is None else self._away_t
        why = f'{self.arm.names[worst]} is {away[worst]:.3g} from what it was sent'
        if now - self._away_t > FOLLOW_S:
            self._broken = why
            self._fall_silent()
        return why

    def _fall_silent(self) -> None:
        self._speaks, self._owed, self._left_pose = False, self.settings.takeover or self._sums, self._pose

    def _stands_still(self) -> str:
        """Joints that stand still while the offsets move: nobody adds them, or a protective stop."""
        if self._joints is None or self._broken or not self.enabled:
            return ''
        if self._anchor is None:
            self._anchor = self._at_joints, self._joints
        offsets, joints = self._anchor
        sent = np.abs(self._at_joints - offsets).max()
        if sent < self.settings.follow_error:
            return ''
        self._anchor = None
        if np.abs(self._joints - joints).max() < MOVED_SHARE * sent:
            self._broken = 'the joints do not move with the offsets'
        return self._broken

    def _give_up(self, now: float) -> None:
        """Let the offsets go if they were held for long. Those of an arm that stands stay: it would leap later."""
        if not (self.enabled and self._speaks and self._fault) or self._dry or self._stop or self._broken:
            self._held_t = None
            return
        self._held_t = now if self._held_t is None else self._held_t
        if 0.0 < self.settings.release_after < now - self._held_t:
            self.enabled = False

    def _nominal(self) -> FloatArray | None:
        """Where the joints are to be without offsets; None if that is not known."""
        if self._joints is None or self._dry:
            return self._joints
        if self._sums:
            return self._pose
        return self._joints - self._at_joints

    def _rejection(self, now: float, observed: Observed) -> str:
        settings = self.settings
        finite = all(np.all(np.isfinite(part)) for part in (*observed.deflection, observed.covariance))
        if not finite or not math.isfinite(observed.t):
            return 'the deflection is not finite'
        size = float(np.abs(_vector(observed.deflection)).max())
        if size > settings.max_deflection:
            return f'a deflection of {size:.3g} is more than the links can have'
        variances = np.diag(observed.covariance)[self._rows]
        if variances.min() < LEAST_SD**2:
            return 'the deflection does not say how certain it is'
        if math.sqrt(variances.max()) > settings.max_sd:
            return f'the deflection is uncertain by more than {settings.max_sd:g}'
        if abs(observed.age) > settings.stale:
            what = 'is older than' if observed.age > 0.0 else 'has a stamp ahead of our clock by more than'
            return f'the deflection {what} {settings.stale:g} s'
        if self._joints is None:
            return 'the positions of the joints are not known'
        if now - self._joints_t > settings.stale:
            return f'no positions of the joints for {settings.stale:g} s'
        return self._stop or self._broken

    def _hold(self, fault: str) -> None:
        self._fault, self._good = fault, 0
        self._wanted = self._offsets

    def _follow(self, nominal: FloatArray, deflection: Transform, elapsed: float) -> None:
        """Choose the offsets one step nearer to those at which T(q + o) D is T(q)."""
        settings, rows = self.settings, self._rows
        wanted = self.arm.pose(nominal)
        error = _vector(wanted.inverse() @ self.arm.pose(nominal + self._offsets) @ deflection)[rows]
        jacobian = self.arm.jacobian(nominal + self._offsets)
        in_wanted = np.vstack([wanted.rotation.T @ jacobian[:3], wanted.rotation.T @ jacobian[3:]])[rows]
        self._verified = (self._verified and not self.response.candidates) or self._observed_to_follow(in_wanted)
        self._residual = float(np.linalg.norm(self._measured_error(deflection, error)))
        square = in_wanted.T @ in_wanted + settings.damping**2 * np.eye(len(self._offsets))
        step = -np.linalg.solve(square, in_wanted.T @ error) * -math.expm1(-elapsed / settings.time_constant)
        # A joint that is beyond its limit by itself is not pulled back by us.
        low = np.clip(self.arm.lower - nominal, -settings.max_offset, 0.0)
        high = np.clip(self.arm.upper - nominal, 0.0, settings.max_offset)
        self._wanted = np.clip(self._offsets + step, low, high)
        clipped = np.abs(self._offsets + step - self._wanted).max() > 1e-12
        self._limited = bool(clipped or np.abs(step).max() > settings.max_rate * elapsed * (1.0 + 1e-9))

    def _observed_to_follow(self, jacobian: FloatArray) -> bool:
        """Whether the joints whose offsets count were seen to move with them."""
        known = self.response.known()
        doubtful = np.linalg.norm(jacobian @ np.where(known, 0.0, self._offsets))
        return bool(known.any() and doubtful <= UNSEEN_SHARE * np.linalg.norm(jacobian @ self._offsets))

    def _measured_error(self, deflection: Transform, error: FloatArray) -> FloatArray:
        """The difference with the joints where they were measured; NaN until they were seen to follow."""
        if self._dry or self._joints is None:
            return error
        if not self._verified:
            return np.full(1, math.nan)
        pose = self._pose
        if pose is None:
            slopes = np.where(self.response.known(), self.response.slopes, 1.0)
            pose = self._joints - slopes * self._at_joints
        return _vector(self.arm.pose(pose).inverse() @ self.arm.pose(self._joints) @ deflection)[self._rows]


def _vector(pose: Transform) -> FloatArray:
    """(6,): position and rotation vector."""
    return np.concatenate([pose.position, pose.rotation_vector])
