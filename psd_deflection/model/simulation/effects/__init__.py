# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""One physical effect per file; each file declares one ``EFFECT``."""
