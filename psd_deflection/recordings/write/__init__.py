# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Writes bags, MCAP, CSV and Rerun."""
