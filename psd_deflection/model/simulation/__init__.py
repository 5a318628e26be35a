# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The rig in numbers: load history to link, optics, detectors and electronics.

The stages run in one direction, each vectorised over samples and without noise until the last:
loads (``load``) -> static pose and modes (``link``) -> beams on the tip plate (``optics``) ->
detector response (``psd``) -> amplifier and converter (``electronics``). The nominal rig is the
thesis's own model; everything else is an *effect*, each in its own file in ``effects/``.
"""
