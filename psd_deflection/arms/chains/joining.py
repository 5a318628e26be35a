# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Joins the estimates of several rigs, whose blocks do not coincide, at common times.

The common times are the stamps of the first link's blocks. Each other link is interpolated linearly between the two of
its blocks around that time, so that a composed estimate waits for at most one further block. With the share u
of the way from block 0 to block 1 and the noise of blocks independent, the covariance is

    (1 - u)^2 C0 + u^2 C1 + q q^T,     q = u (1 - u)/2 (x1 - 2 x0 + x-1),

where q is what the straight line leaves out of a motion that the last three blocks follow.

No estimate is held beyond its block: if one of the two blocks has none, the link is missing at that time.
"""

from __future__ import annotations

import collections
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from psd_deflection.arms.chains.chain import TipDeflection
from psd_deflection.records import DeflectionEstimate, FloatArray

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
        zero, one = known[after - 1], known[after]
        u = (t_ns - zero.t_ns) / (one.t_ns - zero.t_ns)
        pose = (1.0 - u) * zero.pose + u * one.pose
        covariance = (1.0 - u) ** 2 * zero.covariance + u**2 * one.covariance
        if after > 1 and zero.t_ns - known[after - 2].t_ns <= neighbours:
            curvature = 0.5 * u * (1.0 - u) * (one.pose - 2.0 * zero.pose + known[after - 2].pose)
            covariance = covariance + np.outer(curvature, curvature)
        return TipDeflection(pose, covariance)
