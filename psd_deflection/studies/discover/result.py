# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The answer of discover for the rig, with its page."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from psd_deflection.studies.discover.conclusion import RigConclusion
from psd_deflection.studies.discover.report import sections
from psd_deflection.studies.study import PageSection


@dataclass(frozen=True, eq=False, repr=False)
class Discovery(RigConclusion):
    """See :class:`~psd_deflection.studies.discover.conclusion.RigConclusion`."""

    def sections(self) -> Iterable[PageSection]:
        """Return the gap step by step, what is missing, what is unknown, before and after, how it was found."""
        return sections(self)
