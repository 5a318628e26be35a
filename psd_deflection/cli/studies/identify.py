# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find the modes of the link in a recording: frequencies, damping ratios, and the input shaper that does not ring them.

Record a few seconds in which the link rings: release a load, or knock on the link. Stretches in which it
rings alone are found without knowing the loads. If it never does, the spectrum of its motion in operation is
fitted instead, with wider intervals. --out writes a page with spectra, ring-downs and shapers, identify.json, and
rig.yaml with the modes in it.

  psd-deflection identify recordings/run
  psd-deflection identify run.csv --params-file my_rig.yaml --out modes
  psd-deflection identify run.csv --json
"""

import argparse

from psd_deflection.cli._progress import stage
from psd_deflection.cli.studies._answer import answer, answer_arguments, opened_recording, progress, recording_arguments
from psd_deflection.studies.identify.identify import identify, read_identify


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    recording_arguments(parser)
    answer_arguments(parser, 'report.html, identify.json and rig.yaml')


def run(args: argparse.Namespace) -> int:
    """Identify."""
    problem = read_identify(opened_recording(args), progress(args))
    with stage('looking for modes', quiet=args.json):
        modes = identify(problem)
    return answer(args, modes)
