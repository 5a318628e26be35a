# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recordings: bags, MCAP and CSV, read, written, recovered, compared and replayed."""
