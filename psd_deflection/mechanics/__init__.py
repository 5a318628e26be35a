"""The link as a beam: load to deflection and back, tube sections, scaling, sensor placement.

What the real-time path needs is :class:`LinkStatics` alone; the rest serves ``psd-deflection design``.
"""

from psd_deflection.mechanics.statics import LinkStatics

__all__ = ['LinkStatics']
