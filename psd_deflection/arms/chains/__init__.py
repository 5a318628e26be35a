# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Links in series, each with its own rig: from their deflections to that of the end effector, with covariance."""
