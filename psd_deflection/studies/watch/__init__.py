# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Since when a rig is not its model, in a recording: what ``replay --watch`` says, as a study."""
