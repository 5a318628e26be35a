"""The link as a beam: load to deflection and back, tube sections.

The real-time path needs only :class:`LinkStatics`; ``section`` serves ``psd-deflection design``.
"""

from psd_deflection.model.link.statics import LinkStatics

__all__ = ['LinkStatics']
