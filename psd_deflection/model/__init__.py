# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What does physics say? The plate, the link, the detectors, the simulation, and dots back to the pose."""
