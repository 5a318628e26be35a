# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The thesis's target, three white discs: found, fitted at the rims, judged."""
