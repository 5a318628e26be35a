# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Print a script with which your shell completes commands and options.

Save the output where your shell looks for it. For bash this is the file
~/.local/share/bash-completion/completions/psd-deflection, for zsh _psd-deflection in a folder of $fpath.

  psd-deflection completion bash
  psd-deflection completion zsh
"""

import argparse
from collections.abc import Sequence
from typing import Any

from psd_deflection.devices.port import SCHEMES

SHELLS = ('bash', 'zsh', 'tcsh')

FILES = (
    *('ARM.urdf', 'CHAIN.yaml', 'X.csv', 'X.parquet', 'REC', 'IN', 'FILE', 'OUT', 'RIG.yaml', 'CAMERA.yaml'),
    *('FILE.yaml', 'FILE.png', 'FILE.png|svg|pdf', 'DIR|FILE.png|svg|pdf', 'PATH'),
)
FOLDERS = ('DIR', 'FOLDER', 'CALIBRATION')
"""Names of values in the help that are to be completed as paths; a bag is a folder, and completed as a file is."""

_PORTS = ' '.join(f'{scheme}://' for scheme in SCHEMES)
_PORT_FUNCTION = {
    'bash': f"""
_psd_deflection_port() {{
  compgen -W '{_PORTS}' -- "$1"
  _shtab_compgen_files "$1"
}}
""",
    'zsh': f"""
_psd_deflection_port() {{
  _alternative 'network:network port:({_PORTS.replace(':', chr(92) + ':')})' 'file:file:_files'
}}
""",
}
_PORT_COMPLETED = dict.fromkeys(_PORT_FUNCTION, '_psd_deflection_port')
"""A port is a file, or an address of the network by its scheme."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('shell', choices=SHELLS)


def run(args: argparse.Namespace) -> int:
    """Print the script."""
    import shtab

    # Only here: the parser of all commands, which imports all of them.
    from psd_deflection.cli.main import COMMANDS, make_parser

    parser, functions = make_parser(COMMANDS, _Completed), _PORT_FUNCTION.get(args.shell, '')
    print(shtab.complete(parser, shell=args.shell, preamble=functions))
    return 0


class _Completed(argparse.Action):
    """An argument that takes a value; shtab reads from ``complete`` how the value is completed."""

    def __init__(self, option_strings: Sequence[str], dest: str, **named: Any) -> None:
        super().__init__(option_strings, dest, **named)
        import shtab

        name = self.metavar or dest.upper()
        if name == 'PORT':
            self.complete = {**shtab.FILE, **_PORT_COMPLETED}
        elif name in FOLDERS:
            self.complete = shtab.DIRECTORY
        elif name in FILES:
            self.complete = shtab.FILE

    def __call__(
        self, parser: object, namespace: argparse.Namespace, values: Any, option_string: object = None
    ) -> None:
        """Keep the value, as argparse does itself."""
        setattr(namespace, self.dest, values)
