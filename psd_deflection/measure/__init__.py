# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What does a block become? Samples to records, the same live and in replay."""
