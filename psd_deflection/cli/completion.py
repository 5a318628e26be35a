"""Print what makes your shell complete psd-deflection's commands and options.

The output goes where your shell looks for it: for bash
~/.local/share/bash-completion/completions/psd-deflection, for zsh _psd-deflection in a folder of $fpath.

  psd-deflection completion bash
  psd-deflection completion zsh
"""

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Iterator

from psd_deflection.errors import ConfigError

SHELLS = ('bash', 'zsh', 'tcsh')

FILES = ('REC', 'OUT', 'RIG.yaml', 'FILE.yaml', 'FILE.png|svg|pdf', 'PORT', 'PATH')
FOLDERS = ('DIR', 'FOLDER')
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

    parser = make_parser(COMMANDS)
    for action in _actions(parser):
        name = action.metavar or action.dest.upper()
        if name in FOLDERS:
            action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]
        elif name in FILES:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
    print(shtab.complete(parser, shell=args.shell))
    return 0


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Every argument of every command."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                yield from _actions(sub)
        elif action.nargs != 0:
            yield action
