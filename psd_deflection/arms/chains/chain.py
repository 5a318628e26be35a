# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Links in series: the end effector's rigid pose, its deflected pose, and their difference with covariance.

A link is clamped in its frame ``link_base``; Z leads along it. ``mount`` places this frame in the tip of the link
before, and the joint turns it there. At rest the tip is at (0, 0, L). The rig measures dX, dY and theta of
the tip. The tilts of the tip come from the link as a beam, in one of two ways:

- ``end_force``: a force at the end effector is all that loads the chain, and it has a lever on each tip. The force is
  found from all deflections by least squares; each residual counts by the strain energy that it stands for. With
  the moments M about X and Y at the tip, phi = -3/2 dY/L + Mx L/4EI and omega = 3/2 dX/L + My L/4EI
  (from dX = F L^3/3EI + M L^2/2EI and omega = F L^2/2EI + M L/EI).
- ``ratio``: phi = -k dY/L, omega = k dX/L with the rig file's slope ratio k. A force at the tip gives k = 3/2.

The poses are composed without approximation. The covariance is of first order: each tip's errors are carried to the
end effector by the adjoint of what lies between (Barfoot, State Estimation for Robotics, 2017, 7.1). It holds what the
assumption may be wrong by, too: of ``ratio`` the tilts by the moments that a force at the end would have; of
``end_force`` a share of these tilts, because a stiffness is not known exactly, and the tilts of moments that would
explain what no force at the end does.
"""

from __future__ import annotations

import collections
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from psd_deflection.arms.chains.transform import IDENTITY, Transform, cross_matrix, rotation_about, shift
from psd_deflection.base.errors import ConfigError
from psd_deflection.model.link.statics import LinkStatics
from psd_deflection.records import DeflectionEstimate, FloatArray

SLOPES = ('end_force', 'ratio')
FORCE_RATIO = 1.5
"""Slope ratio of a link under a force at its tip."""

STIFFNESS_DOUBT = 0.05
"""Share by which a link's bending stiffness may differ from the rig file's, one standard deviation."""
UNEXPLAINED = 0.5
"""Slope ratio of a moment less that of a force: a deflection that no force at the end explains is by a moment or by a
force.
"""

_WEAKEST = 1e-9
"""A direction of the force that bends the chain less than this share of the strongest one is not seen."""


@dataclass(frozen=True, slots=True, eq=False)
class ChainLink:
    """One link. ``mount``: ``link_base`` at joint angle 0, in the tip frame of the link before (or in the base).

    ``statics``: length and stiffnesses. ``slope_ratio``: k, with its standard deviation ``slope_ratio_sd``.
    ``axis``: unit vector of the joint in the frame ``mount``.
    """

    name: str
    mount: Transform
    statics: LinkStatics
    slope_ratio: float = FORCE_RATIO
    slope_ratio_sd: float = 0.0
    axis: FloatArray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    @property
    def length(self) -> float:
        """L, m."""
        return self.statics.length

    def base(self, angle: float) -> Transform:
        """``link_base`` in the tip frame of the link before, at this angle of the joint, rad."""
        return self.mount @ rotation_about(self.axis, angle) if angle else self.mount


class TipDeflection(NamedTuple):
    """What one rig measured: ``pose`` (dX, dY, theta), m, m, rad; ``covariance`` (3, 3)."""

    pose: FloatArray
    covariance: FloatArray


class EndEffector(NamedTuple):
    """The end effector of a deflected chain.

    ``rigid``, ``deflected``: its pose in the base. ``deflection``: the deflected pose in the frame of the rigid one.
    ``covariance`` (6, 6): of position (m) and rotation (rad) about the fixed axes of that frame, as ROS orders them.
    ``of_model`` (6, 6): that part of it which the assumption about the load leaves.
    ``tips``: the pose of each tip in its own rest frame. ``angles``: of the joints, rad.
    """

    rigid: Transform
    deflected: Transform
    deflection: Transform
    covariance: FloatArray
    of_model: FloatArray
    tips: tuple[Transform, ...]
    angles: tuple[float, ...]

    @property
    def vector(self) -> FloatArray:
        """(6,): translation, m, and rotation vector, rad, of the deflection."""
        return np.concatenate([self.deflection.position, self.deflection.rotation_vector])

    @property
    def deviations(self) -> FloatArray:
        """(6,): standard deviations of :attr:`vector`, m and rad."""
        return np.sqrt(np.diag(self.covariance))


class Chain:
    """``links`` from the base on; ``end``: the end effector in the frame of the last tip; ``slopes``: see above.

    Raises ConfigError if there is no link, two have one name, or ``slopes`` is unknown.
    """

    def __init__(self, links: Sequence[ChainLink], end: Transform = IDENTITY, slopes: str = SLOPES[0]) -> None:
        if not links:
            raise ConfigError('a chain has at least one link')
        names = [link.name for link in links]
        for name in names:
            if names.count(name) > 1:
                raise ConfigError(f'two links have the name {name}')
        if slopes not in SLOPES:
            raise ConfigError(f'slopes = {slopes}: must be one of {", ".join(SLOPES)}')
        self.links = tuple(links)
        self.end = end
        self.slopes = slopes
        self._rest: _Rest | None = None

    def rigid(self, angles: Sequence[float] | None = None) -> Transform:
        """The end effector's pose in the base while no link is deflected. ``angles``: of the joints, rad; all 0."""
        return self._at(angles).end

    def compose(self, tips: Sequence[TipDeflection], angles: Sequence[float] | None = None) -> EndEffector:
        """The end effector, from each link's deflection and the ``angles`` of the joints (rad; all 0)."""
        rest = self._at(angles)
        if len(tips) != len(self.links):
            raise ValueError(f'{len(tips)} deflections for {len(self.links)} links')
        # (dX, dY, dZ, phi, omega, theta) of each tip, one below the other.
        measured = np.concatenate([tip.pose for tip in tips])
        state = rest.tip_of_measured @ measured
        state = state.reshape(-1, 6)

        # Forward: every frame in the base, as it is now.
        clamped: list[FloatArray] = []
        frame = IDENTITY
        poses, ends = [], []
        for link, angle, (dx, dy, dz, phi, omega, theta) in zip(self.links, rest.angles, state, strict=True):
            frame = frame @ link.base(angle) @ shift(0.0, 0.0, link.length)
            clamped.append(frame.rotation)
            pose = Transform(_tilted(theta, phi, omega), np.array([dx, dy, dz]))
            frame = frame @ pose
            poses.append(pose)
            ends.append(frame.position)
        deflected = frame @ self.end
        deflection = rest.end.inverse() @ deflected

        # What a small change of each tip does to the end effector, in the frame of the rigid one.
        carried = np.empty((6, 6 * len(self.links)))
        for i, (rotation, at, (_, _, _, _, omega, _), pose) in enumerate(zip(clamped, ends, state, poses, strict=True)):
            to_end = rest.end.rotation.T @ rotation
            lever = rotation.T @ (deflected.position - at)
            # Rotation vector of small changes of phi, omega and theta in R = Ry(omega) Rx(phi) Rz(theta).
            axes = np.column_stack([[math.cos(omega), 0.0, -math.sin(omega)], [0.0, 1.0, 0.0], pose.rotation[:, 2]])
            block = carried[:, 6 * i : 6 * i + 6]
            block[:3, :3], block[3:, :3] = to_end, 0.0
            block[:3, 3:] = -to_end @ cross_matrix(lever) @ axes
            block[3:, 3:] = to_end @ axes

        jacobian = carried @ rest.tip_of_measured
        covariance = np.zeros((6, 6))
        for i, (link, tip) in enumerate(zip(self.links, tips, strict=True)):
            columns = jacobian[:, 3 * i : 3 * i + 3]
            covariance += columns @ tip.covariance @ columns.T
            if link.slope_ratio_sd:
                per_ratio = np.array([-tip.pose[1], tip.pose[0]]) / link.length
                by_ratio = carried[:, 6 * i + 3 : 6 * i + 5] @ per_ratio * link.slope_ratio_sd
                covariance += np.outer(by_ratio, by_ratio)
        of_model = self._of_model(rest, measured, carried)
        return EndEffector(rest.end, deflected, deflection, covariance + of_model, of_model, tuple(poses), rest.angles)

    def _of_model(self, rest: _Rest, measured: FloatArray, carried: FloatArray) -> FloatArray:
        """(6, 6): covariance of what the assumption about the load leaves.

        ``measured`` (3N,); ``carried`` (6, 6N): what a small change of each tip does to the end effector.
        """
        count = len(self.links)
        # Of the tilts (phi, omega) alone.
        carried = carried.reshape(6, count, 6)[:, :, 3:5]
        by_moment = carried * (rest.tilt_of_moment @ measured).reshape(count, 2)
        if self.slopes == 'ratio':
            # One load makes all of them.
            wrong = by_moment.reshape(6, -1) @ np.ones((2 * count, 1))
        else:
            residual = (rest.unexplained @ measured).reshape(count, 3)[:, 1::-1]
            lengths = np.array([[link.length] for link in self.links])
            doubted = STIFFNESS_DOUBT * (by_moment @ np.ones(2))
            wrong = np.hstack((doubted, (carried * (UNEXPLAINED * residual / lengths)).reshape(6, -1)))
        return np.asarray(wrong @ wrong.T, np.float64)

    def tips_under(self, force: FloatArray, angles: Sequence[float] | None = None) -> FloatArray:
        """(N, 3): dX, dY, theta of each tip under ``force`` (3,), N in the base, at the end effector; to first order.

        m, m, rad.
        """
        return (self._at(angles).measured_of_force @ force).reshape(-1, 3)

    def _at(self, angles: Sequence[float] | None) -> _Rest:
        wanted = tuple(angles) if angles is not None else (0.0,) * len(self.links)
        if len(wanted) != len(self.links):
            raise ValueError(f'{len(wanted)} angles for {len(self.links)} joints')
        # Another thread may put another one here meanwhile.
        rest = self._rest
        if rest is None or rest.angles != wanted:
            self._rest = rest = _Rest(self, wanted)
        return rest


class _Rest:
    """What depends on the angles of the joints alone."""

    def __init__(self, chain: Chain, angles: tuple[float, ...]) -> None:
        self.angles = angles
        tips = []
        frame = IDENTITY
        for link, angle in zip(chain.links, angles, strict=True):
            frame = frame @ link.base(angle) @ shift(0.0, 0.0, link.length)
            tips.append(frame)
        self.end = frame @ chain.end
        # A force F (3,) at the end effector to the load (Fx, Fy, Tz) and the moments (Mx, My) at each tip.
        loads = [_load_of_force(tip, self.end.position) for tip in tips]
        self.measured_of_force = np.vstack(
            [_bent(link.statics, load) for link, load in zip(chain.links, loads, strict=True)]
        )
        self.tip_of_measured = np.zeros((6 * len(tips), 3 * len(tips)))
        for i, link in enumerate(chain.links):
            ratio = link.slope_ratio if chain.slopes == 'ratio' else FORCE_RATIO
            self.tip_of_measured[6 * i : 6 * i + 6, 3 * i : 3 * i + 3] = _tip_of_own(ratio / link.length)
        force_of_measured = self._force_of_measured(chain.links)
        # (2N, 3N): phi and omega of each tip by the moments there. (3N, 3N): what no force at the end explains.
        self.tilt_of_moment = np.vstack(
            [
                link.length / (4.0 * link.statics.bending_stiffness) * load[3:] @ force_of_measured
                for link, load in zip(chain.links, loads, strict=True)
            ]
        )
        self.unexplained = np.eye(3 * len(tips)) - self.measured_of_force @ force_of_measured
        if chain.slopes == 'end_force':
            for i in range(len(tips)):
                self.tip_of_measured[6 * i + 3 : 6 * i + 5] += self.tilt_of_moment[2 * i : 2 * i + 2]

    def _force_of_measured(self, links: Sequence[ChainLink]) -> FloatArray:
        """(3, 3N): the force at the end effector of all deflections, by least squares in strain energy."""
        root = np.sqrt(1.0 / np.concatenate([np.diag(link.statics.compliance) for link in links]))
        return np.asarray(np.linalg.pinv(root[:, None] * self.measured_of_force, rcond=_WEAKEST) * root, np.float64)


def _tip_of_own(ratio_per_metre: float) -> FloatArray:
    """(6, 3): dX, dY, theta to (dX, dY, dZ, phi, omega, theta), the tilts proportional to the deflection."""
    out = np.zeros((6, 3))
    out[0, 0] = out[1, 1] = out[5, 2] = 1.0
    out[3, 1], out[4, 0] = -ratio_per_metre, ratio_per_metre
    return out


def _load_of_force(tip: Transform, end: FloatArray) -> FloatArray:
    """(5, 3): a force in the base at ``end`` to (Fx, Fy, Tz, Mx, My) in the frame of ``tip``."""
    force = tip.rotation.T
    moment = tip.rotation.T @ cross_matrix(end - tip.position)
    return np.vstack([force[:2], moment[2:], moment[:2]])


def _bent(statics: LinkStatics, load: FloatArray) -> FloatArray:
    """(3, 3): the force of which ``load`` (5, 3) is to dX, dY, theta. A moment bends by M L^2/2EI."""
    out: FloatArray = statics.compliance @ load[:3]
    by_moment = statics.length**2 / (2.0 * statics.bending_stiffness)
    out[0] += by_moment * load[4]
    out[1] -= by_moment * load[3]
    return out


def _tilted(theta: float, phi: float, omega: float) -> FloatArray:
    return Rotation.from_euler('YXZ', (omega, phi, theta)).as_matrix()


KEPT = 64
"""Estimates of each link that are kept, and times that may wait for them."""

PATIENCE = 25
"""Blocks of the first link for which a time waits for the other links: half a second on the rig of the thesis."""

NEXT = 1.5
"""Blocks at most this many block lengths apart are neighbours."""


class Joined(NamedTuple):
    """All links at one time. ``tips``: in the order of the links, or () if one is missing.

    ``missing``: numbers of the links that are (from 0).
    """

    t_ns: int
    tips: tuple[TipDeflection, ...]
    missing: tuple[int, ...] = ()


class _At(NamedTuple):
    t_ns: int
    pose: FloatArray
    covariance: FloatArray


class Joiner:
    """``blocks_ns``: the length of each link's blocks, ns. For one thread at a time.

    ``joined``: times of which all links were there. ``missing``: for each link, at how many times it was not.
    ``newest_ns``: for each link the stamp of its last estimate, or None.

    The common times are the stamps of the first link's blocks. Each other link is interpolated linearly between the two
    of its blocks around that time, so that a composed estimate waits for at most one further block. With the share u of
    the way from block 0 to block 1 and the noise of blocks independent, the covariance is

        (1 - u)^2 C0 + u^2 C1 + q q^T,     q = u (1 - u)/2 (x1 - 2 x0 + x-1),

    where q is what the straight line leaves out of a motion that the last three blocks follow.

    No estimate is held beyond its block: if one of the two blocks has none, the link is missing at that time.
    """

    def __init__(self, blocks_ns: Sequence[int]) -> None:
        self._blocks_ns = tuple(blocks_ns)
        self.joined = 0
        self.missing = [0] * len(self._blocks_ns)
        self._begin()

    def _begin(self) -> None:
        self.newest_ns: list[int | None] = [None] * len(self._blocks_ns)
        self._known: list[collections.deque[_At]] = [collections.deque(maxlen=KEPT) for _ in self._blocks_ns]
        self._waiting: collections.deque[_At] = collections.deque(maxlen=KEPT)
        self._began_ns: int | None = None

    def put(self, link: int, estimate: DeflectionEstimate) -> list[Joined]:
        """Take an estimate of a link (from 0); return what can be joined now, in order."""
        at = _At(estimate.t_ns, np.array(estimate.pose), np.array(estimate.covariance).reshape(3, 3))
        known = self._known[link]
        if known and at.t_ns <= known[-1].t_ns:
            # Its clock was laid anew: what came before belongs to another time.
            self._begin()
            known = self._known[link]
        if link == 0 and known and self._began_ns is not None:
            lost = round((at.t_ns - known[-1].t_ns) / self._blocks_ns[0]) - 1
            self.missing[0] += max(lost, 0)
        known.append(at)
        self.newest_ns[link] = at.t_ns
        if link == 0:
            self._waiting.append(at)
        if self._began_ns is None:
            if None in self.newest_ns:
                return []
            # Nobody misses a link that has not begun.
            self._began_ns = max(known[0].t_ns for known in self._known)
        return self._ready(self._began_ns)

    def _ready(self, began_ns: int) -> list[Joined]:
        out: list[Joined] = []
        while self._waiting:
            at = self._waiting[0]
            if at.t_ns < began_ns:
                self._waiting.popleft()
                continue
            late = self._waiting[-1].t_ns - at.t_ns > PATIENCE * self._blocks_ns[0]
            tips = [TipDeflection(at.pose, at.covariance)]
            missing = []
            for link in range(1, len(self._known)):
                if self._known[link][-1].t_ns < at.t_ns and not late:
                    return out
                tip = self._between(link, at.t_ns)
                if tip is None:
                    missing.append(link)
                    self.missing[link] += 1
                else:
                    tips.append(tip)
            self._waiting.popleft()
            if missing:
                out.append(Joined(at.t_ns, (), tuple(missing)))
            else:
                self.joined += 1
                out.append(Joined(at.t_ns, tuple(tips)))
        return out

    def _between(self, link: int, t_ns: int) -> TipDeflection | None:
        """The link at ``t_ns``, None if its two blocks around it are not there."""
        known = self._known[link]
        after = next((i for i, k in enumerate(known) if k.t_ns >= t_ns), 0)
        if known[after].t_ns == t_ns:
            return TipDeflection(known[after].pose, known[after].covariance)
        neighbours = NEXT * self._blocks_ns[link]
        if not after or known[after].t_ns - known[after - 1].t_ns > neighbours:
            return None
        earlier, later = known[after - 1], known[after]
        u = (t_ns - earlier.t_ns) / (later.t_ns - earlier.t_ns)
        pose = (1.0 - u) * earlier.pose + u * later.pose
        covariance = (1.0 - u) ** 2 * earlier.covariance + u**2 * later.covariance
        if after > 1 and earlier.t_ns - known[after - 2].t_ns <= neighbours:
            curvature = 0.5 * u * (1.0 - u) * (later.pose - 2.0 * earlier.pose + known[after - 2].pose)
            covariance = covariance + np.outer(curvature, curvature)
        return TipDeflection(pose, covariance)
