# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The plate: where PSDs and beams are, pose <-> dots, and how well that placement is conditioned. Each formula is
written once, here.

``layout``: :class:`Geometry` and its checks. ``plate``: pose <-> dots under parallel beams. ``rays``: dots under
beams and on surfaces of any direction. ``linear``: design and gain matrices, condition, error bound.
``placement``: the best places for the sensors.
"""

from psd_deflection.model.plate.layout import Geometry

__all__ = ['Geometry']
