# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Joint offsets that put a deflected end effector back to where it were if the links were rigid."""
