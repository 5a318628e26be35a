"""What the detectors saw in a recording, for the commands that look at every sample."""

from __future__ import annotations

import argparse

from psd_deflection.cli._progress import progress_of
from psd_deflection.cli._report import warn
from psd_deflection.measure.pipeline import Pipeline
from psd_deflection.recordings.read.readers import open_recording
from psd_deflection.recordings.read.references import TrustedSamples, read_run
from psd_deflection.recordings.recording import Recording
from psd_deflection.recordings.replay.engine import nominal_rig, rig_at_end
from psd_deflection.rig.config import Rig, load_rig


def opened(args: argparse.Namespace) -> tuple[Recording, Rig]:
    """The recording of ``args``, cut into the rig's blocks, and the rig: of --params-file, else of the recording.

    Raises RecordingError and ConfigError.
    """
    recording = open_recording(args.recording, namespace=args.namespace)
    rig = rig_at_end(recording) if args.params_file is None else load_rig(args.params_file)
    for warning in nominal_rig(recording, args.params_file):
        warn(warning)
    return recording.with_block_size(rig.estimator.block_size), rig


def seen_in(recording: Recording, rig: Rig, *, quiet: bool) -> TrustedSamples:
    """Its trusted samples, with a progress bar unless ``quiet``. Raises RecordingError if there are none."""
    with progress_of(recording.blocks(), quiet=quiet) as bar:
        return read_run(recording, Pipeline(rig), bar)
