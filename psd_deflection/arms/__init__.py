# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What do arms of such links do? Links in series, joint offsets, shaped motions."""
