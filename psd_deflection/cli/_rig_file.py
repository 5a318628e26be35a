"""The rig file that a command writes: the user's with what was found, or one that describes the rig."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from psd_deflection.base.errors import ConfigError
from psd_deflection.cli._report import warn
from psd_deflection.rig.parameter_files import parameter_text


def rig_file(params_file: str | None, name: str, described: Callable[[], str], edit: Callable[[str, Path], str]) -> str:
    """The text of the file ``name``: ``edit`` of the user's file and its path, comments kept.

    Without a file of the user, or if it cannot be edited, which is warned of, ``edit`` of what ``described`` gives.
    """
    if params_file is not None:
        path = Path(params_file)
        text = parameter_text(path)
        try:
            return edit(text, path)
        except ConfigError as error:
            warn(f'{error}: {name} has its values without its comments')
    return edit(described(), Path(name))
