# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Whether a rig is wired and set up as its rig file says, from how the dots answer to known pushes."""
