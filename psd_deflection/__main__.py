# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""``python -m psd_deflection`` is the command line."""

import sys

from psd_deflection.cli.main import main

sys.exit(main())
