# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The link as a beam: load to deflection and back, tube sections.

The real-time path needs only :class:`LinkStatics`; ``section`` serves ``psd-deflection design``.
"""

from psd_deflection.model.link.statics import LinkStatics

__all__ = ['LinkStatics']
