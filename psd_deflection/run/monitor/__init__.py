# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The live page: shows the rig in a browser and loads nothing from outside hosts."""
