# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Whether a robot runs, by what its drivers and controllers tell: the offsets of one that does not run hold."""

LEAST_SPEED = 1e-3
"""A speed scaling below it is a stop. Drivers tell shares or per cent."""
SILENT_S = 0.5
"""What comes again and again has ended if it was not heard for so long, s."""


class RobotWatch:
    """Nothing that was never heard counts. The times ``now`` are s of a clock that is never set."""

    def __init__(self) -> None:
        self._runs = True
        self._scaling = 1.0
        self._heard: dict[str, float] = {}

    def runs(self, value: bool) -> None:
        """The driver says whether the robot runs; it may say so once."""
        self._runs = value

    def scaled(self, now: float, scaling: float) -> None:
        """The driver says how fast the robot is, of what it was asked for; it says so again and again."""
        self._scaling = scaling
        self._heard['speed scaling'] = now

    def controlled(self, now: float) -> None:
        """The controller told its state, as it does again and again while it is active."""
        self._heard['state of the controller'] = now

    def fault(self, now: float) -> str:
        """Why the robot does not run; '' if it does, as far as one can tell."""
        if not self._runs:
            return 'the robot does not run'
        # NaN is no speed.
        if not self._scaling >= LEAST_SPEED:
            return f'the robot does not run: its speed scaling is {self._scaling:g}'
        ended = next((what for what, then in self._heard.items() if now - then > SILENT_S), '')
        return f'the robot does not run: its {ended} comes no more' if ended else ''
