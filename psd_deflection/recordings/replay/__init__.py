# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A recording through the pipeline: computed again, compared, simulated, watched."""
