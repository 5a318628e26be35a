# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What is the rig? Every parameter, once; rig files; the rig made of them; its wiring."""
