"""Print a script with which your shell completes commands and options.

Save the output where your shell looks for it. For bash this is the file
~/.local/share/bash-completion/completions/psd-deflection, for zsh _psd-deflection in a folder of $fpath.

  psd-deflection completion bash
  psd-deflection completion zsh
"""

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Sequence
from typing import Any

from psd_deflection.base.errors import ConfigError

SHELLS = ('bash', 'zsh', 'tcsh')

FILES = (
    'ARM.urdf',
    'CHAIN.yaml',
    'X.csv',
    'X.parquet',
    'REC',
    'IN',
    'FILE',
    'OUT',
    'RIG.yaml',
    'CAMERA.yaml',
    'FILE.yaml',
    'FILE.png',
    'FILE.png|svg|pdf',
    'DIR|FILE.png|svg|pdf',
    'PORT',
    'PATH',
)
FOLDERS = ('DIR', 'FOLDER', 'CALIBRATION')
"""Names of values in the help that are to be completed as paths; a bag is a folder, and completed as a file is."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('shell', choices=SHELLS)


def run(args: argparse.Namespace) -> int:
    """Print the script."""
    if importlib.util.find_spec('shtab') is None:
        raise ConfigError('completion needs shtab: `pip install shtab`')
    import shtab

    # Only here: the parser of all commands, which imports all of them.
    from psd_deflection.cli.main import COMMANDS, make_parser

    print(shtab.complete(make_parser(COMMANDS, _Completed), shell=args.shell))
    return 0


class _Completed(argparse.Action):
    """An argument that takes a value; shtab reads from ``complete`` how the value is completed."""

    def __init__(self, option_strings: Sequence[str], dest: str, **named: Any) -> None:
        super().__init__(option_strings, dest, **named)
        import shtab

        name = self.metavar or dest.upper()
        if name in FOLDERS:
            self.complete = shtab.DIRECTORY
        elif name in FILES:
            self.complete = shtab.FILE

    def __call__(
        self, parser: object, namespace: argparse.Namespace, values: Any, option_string: object = None
    ) -> None:
        """Keep the value, as argparse does itself."""
        setattr(namespace, self.dest, values)
