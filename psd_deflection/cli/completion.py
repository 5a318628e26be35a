"""Print what makes your shell complete psd-deflection's commands and options.

The output goes where your shell looks for it: for bash
~/.local/share/bash-completion/completions/psd-deflection, for zsh _psd-deflection in a folder of $fpath.

  psd-deflection completion bash
  psd-deflection completion zsh
"""

from __future__ import annotations

import argparse
import importlib.util

from psd_deflection.errors import ConfigError

SHELLS = ('bash', 'zsh', 'tcsh')


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

    print(shtab.complete(make_parser(COMMANDS), shell=args.shell))
    return 0
