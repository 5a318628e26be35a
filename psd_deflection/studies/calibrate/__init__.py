# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Estimates how a real rig differs from its rig file, from recordings with a reference or with known loads.

``observation``: a recording as arrays, and the rows that are fitted. ``fit``: parameters with their covariance.
``calibrate``: which of them the recordings determine, held-out motion, the answer. ``check``: whether an old
calibration still holds. ``dark``: what the PSDs read with the lasers off. ``result``, ``report``: calibration.json, the
rig file, the page. ``from_recordings`` alone reads files.
"""
