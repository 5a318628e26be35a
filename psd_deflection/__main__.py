"""``python -m psd_deflection`` is the command line."""

import sys

from psd_deflection.cli.main import main

sys.exit(main())
