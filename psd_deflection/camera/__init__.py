# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Camera frames -> reference poses of the tip: targets, sub-pixel fits, poses with covariance. ``footage`` alone opens
files and devices."""
