# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The errors a user can meet, each with the exit status that the command line gives it.

Every message is one line: what is wrong, where, and how to fix it. Any other exception is a defect
of this package and ends with a traceback.
"""

from collections.abc import Mapping

INTERRUPTED = 130

EXIT_STATUSES: Mapping[int, str] = {
    0: 'done',
    1: 'done, and the recording differs (replay --compare)',
    2: 'the command line: an option, its value, or two that do not fit',
    3: 'a parameter, a parameter file, or a package that is not installed',
    4: 'a recording or an output that cannot be read or written',
    5: 'the device: missing, in use, silent, or of another protocol',
    6: 'the geometry of the rig cannot be solved',
    7: 'a running daemon or a Dask scheduler: none answers, or it rejects',
    8: 'of many recordings some failed; the others are done',
    9: 'samples were dropped here: this machine was too slow for them',
    71: 'the machine: too little memory, no further thread, or no room in /dev/shm',
    INTERRUPTED: 'Ctrl-C before it was done (what runs until Ctrl-C ends with 0)',
}
"""What each exit status of ``psd-deflection`` means; its help and the documentation are made from this table."""


class PsdDeflectionError(Exception):
    """Base class of all errors that input, files or devices cause, not a defect of this package."""

    exit_status = 70


class UsageError(PsdDeflectionError):
    """An option is missing, has an invalid value, or contradicts another option.

    Example: ``--out run.png: .png cannot be written; use X.csv, X.mcap or a bag folder (X)``.
    """

    exit_status = 2


class ConfigError(PsdDeflectionError):
    """A parameter is unknown, of the wrong type or out of bounds; a parameter file is malformed.

    Example: ``rig.yaml: amplifier.noise = -1.0 V: must be at least 0.0``.
    """

    exit_status = 3


class RecordingError(PsdDeflectionError):
    """A recording is missing, empty, truncated, of another kind; it or another output cannot be written.

    Example: ``run.csv:17: column y2 holds 'abc', which is not a number``.
    """

    exit_status = 4


class DeviceError(PsdDeflectionError):
    """The port is missing or in use, no frame came in time, or the device speaks another version.

    Example: ``/dev/ttyACM0: no frame in 2 s; is the device powered and --baud right?``
    """

    exit_status = 5


class SolverError(PsdDeflectionError):
    """The rig's geometry cannot be solved; the message names the degeneracy.

    Example: ``psd_1.center and psd_2.center coincide: the twist cannot be seen``.
    """

    exit_status = 6


class DaemonError(PsdDeflectionError):
    """No running daemon or Dask scheduler answers, or it rejects what it was asked for.

    Example: ``http://127.0.0.1:8790/: no daemon answers``.
    """

    exit_status = 7


class SomeFailedError(PsdDeflectionError):
    """Of many recordings some failed, and the rest was done and written.

    Example: ``3 of 1000 recordings failed; the others are done``.
    """

    exit_status = 8


class SamplesDroppedError(PsdDeflectionError):
    """A run has ended, and samples that had been read were not processed. The log said when and why.

    Example: ``17252 samples were read and not processed: this machine is too slow``.
    """

    exit_status = 9


class MachineError(PsdDeflectionError):
    """The operating system gives no more memory, shared memory or thread (``ulimit -v``, ``-u``, a container's limits).

    Example: ``too little memory; see the limits of the shell (ulimit -v), the container or the unit``.
    """

    exit_status = 71
