# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The plate: where PSDs and beams are, pose <-> dots, and how well that placement is conditioned. Each formula is
written once, here."""

from psd_deflection.model.plate.layout import Geometry

__all__ = ['Geometry']
