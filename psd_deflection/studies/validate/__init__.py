# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Estimates against an independent reference: the offset between the clocks, and what the two differ by."""
