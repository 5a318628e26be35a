# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Recordings as arguments: one; or many, each for itself, where the room of fleets is installed."""

import argparse
import os

from psd_deflection.base.plugins import optional

FLEET = optional('psd_deflection.cli._fleet')
"""The work on many recordings, or None."""


def recordings_argument(parser: argparse.ArgumentParser, what: str) -> None:
    """Add REC..., ``what`` each is; without the room one REC."""
    many = '; a pattern or a .txt list of them' if FLEET else ''
    parser.add_argument('recordings', metavar='REC', nargs='+' if FLEET else 1, help=what + many)


def executor_option(parser: argparse.ArgumentParser) -> None:
    """Add --executor."""
    if FLEET:
        FLEET.executor_option(parser)


def each_option(parser: argparse.ArgumentParser) -> None:
    """Add --each and --executor, for the commands that else take all recordings together."""
    parser.set_defaults(each=False, executor=None)
    if FLEET:
        FLEET.each_option(parser)


def several(args: argparse.Namespace) -> list[str] | None:
    """The recordings by absolute path if there may be many, None if one is named. Raises UsageError, RecordingError."""
    names: list[str] | None = FLEET.several(args) if FLEET else None
    return names


def each_for_itself(args: argparse.Namespace) -> list[str] | None:
    """The recordings by absolute path with --each, else None. Raises UsageError and RecordingError."""
    names: list[str] | None = FLEET.each_for_itself(args) if FLEET else None
    return names


def absolute(path: str | None) -> str | None:
    """``path`` for workers that run in another folder."""
    return None if path is None else os.path.abspath(path)  # noqa: PTH100 - links stay as they are
