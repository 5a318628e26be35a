# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Estimates how a real rig differs from its rig file, from recordings with a reference or with known loads."""
