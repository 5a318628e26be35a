# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the simulation is missing: compare, localise, screen, fit, select, report."""
