# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Names of frames and services of the nodes. It needs no rclpy, so any module may import it."""

from __future__ import annotations

from psd_deflection.records import MOST_PSDS

END, END_REST = 'end_effector', 'end_effector_rest'
"""Frames of a chain of links: the end effector, and where it were if no link bent."""

ZERO, RECORD = '~/zero', '~/record'
SERVICES = (ZERO, RECORD)
"""Services of the node; ``~`` stands for the node's name."""

BASE, REST, TIP = 'link_base', 'link_tip_rest', 'link_tip'
PSDS = tuple(f'psd_{n}' for n in range(1, MOST_PSDS + 1))
"""Frames: the clamp, the unloaded tip, the tip, the PSDs that a rig may have."""
