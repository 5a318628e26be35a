# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What every room needs: arithmetic, errors, files, foreign YAML, tables, pages, sequence numbers."""
