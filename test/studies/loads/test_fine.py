# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Means of a few samples: by hand."""

from __future__ import annotations
