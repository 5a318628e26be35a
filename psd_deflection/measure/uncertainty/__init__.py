# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""How sure a block is: its noise from the stream, its dots at its stamp, its readings against each other."""
