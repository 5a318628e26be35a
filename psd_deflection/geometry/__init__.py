"""The plate: where PSDs and beams are, pose <-> dots, and how well that placement is conditioned. Each formula once.

``layout``: :class:`Geometry` and its checks. ``plate``: pose <-> dots under parallel beams. ``rays``: dots under
beams and on surfaces of any direction. ``linear``: design and gain matrices, condition, error bound.
``placement``: which places of the sensors are best.
"""

from psd_deflection.geometry.layout import Geometry

__all__ = ['Geometry']
