"""The link as a beam: load to deflection and back, tube sections.

What the real-time path needs is :class:`LinkStatics` alone; ``section`` serves ``psd-deflection design``.
"""

from psd_deflection.mechanics.statics import LinkStatics

__all__ = ['LinkStatics']
