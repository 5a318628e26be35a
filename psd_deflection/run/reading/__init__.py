# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The reader thread: samples from the device, its clock, what it says of itself."""
