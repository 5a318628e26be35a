# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The tip's motion from the samples: pose and velocity by a Kalman filter on the link's modes."""
