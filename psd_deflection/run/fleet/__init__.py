# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Many recordings: which they are, one task for each on one of several engines, and the rows that come out."""
