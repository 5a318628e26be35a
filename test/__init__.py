# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The tests; a package, so that the standard library's ``test`` does not hide it."""
