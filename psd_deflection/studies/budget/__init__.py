# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The error budget of a rig: the error of dX, dY and theta from each cause (thesis chapter 3, corrected).

``read_inputs`` and a rig make a ``Situation``; ``evaluate`` computes every cause and the totals to
first order; ``monte_carlo`` computes them through the exact chain.
"""
