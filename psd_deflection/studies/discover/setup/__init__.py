# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a recording's set-up, before and beside the physics."""
