# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The link's modes from its own motion, and the input shapers that do not ring them."""
