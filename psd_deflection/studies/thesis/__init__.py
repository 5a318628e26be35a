# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The methods of the thesis as printed, how they compare with the corrected ones, and its scaling study."""
