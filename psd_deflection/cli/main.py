"""``psd-deflection``: finds the command and turns our errors into one line and an exit status.

Each command is a module of this package with ``SUMMARY``, ``add_arguments(parser)`` and
``run(args) -> int``; it is imported only when it is asked for, so that ``--help`` stays quick.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence

from psd_deflection import __version__
from psd_deflection.errors import PsdDeflectionError

COMMANDS: dict[str, str] = {
    'estimator': 'acquire, estimate, publish on ROS 2 and record (the daemon)',
    'replay': 'run a recording through the same pipeline',
    'simulate': 'simulate the rig: as a recording, or as a device on a pseudo-terminal',
    'design': 'size the link and place the sensors (appendix B, condition numbers)',
