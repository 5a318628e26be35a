# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The rig in numbers: loads -> static pose and modes (``link``) -> beams on the tip plate (``optics``) -> detectors
(``psd``) -> amplifier and converter (``electronics``); all that is not the thesis's model is an *effect*."""
