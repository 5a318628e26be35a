# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Pointing of an altazimuth telescope, 44 stars of one night: a plant for ``discover_in``."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from psd_deflection.model.simulation.declaration import Effect, EffectParameter
from psd_deflection.records import FloatArray, IntArray
from psd_deflection.studies.discover.plants import Model, Plant, plant_effect

ARCSECONDS = 3600.0 * 180.0 / np.pi
HIGHEST = 8  # Order of a harmonic, at most.
PHYSICAL = ('CA', 'NPAE', 'AN', 'AW', 'TF', 'TX')


def _term(name: str) -> Effect:
    return plant_effect(name, EffectParameter('size', 'arcsec', -2000.0, 2000.0, 20.0, 'of the term'))


def _harmonics() -> list[str]:
    named = itertools.product('AES', 'SC', 'AE', range(1, HIGHEST + 1))
    words = [f'H{what}{wave}{of}{order if order > 1 else ""}' for what, wave, of, order in named]
    # The tilt of the azimuth axis and the flexure have names of their own.
    return [w for w in words if w not in ('HESA', 'HECA', 'HECE', 'HSSE', 'HSCE')]


class AuxTel(Plant):
    """``known``: physical terms that the model has."""

    channels = ('across', 'up')
    units = ('arcsec', 'arcsec')
    cases = ('night',)

    def __init__(self, path: Path, known: Sequence[str] = ()) -> None:
        """Raises OSError if there is no file."""
        with path.open() as stream:
            rows = np.radians(np.loadtxt(stream))
        self.azimuth, self.elevation = rows[:, 0], rows[:, 1]
        rotated = np.mod(rows[:, 2] - rows[:, 0] + np.pi, 2.0 * np.pi) - np.pi
        self._observed = ARCSECONDS * np.stack([rotated * np.cos(self.elevation), rows[:, 3] - self.elevation])
        self.nuisance = tuple(_term(name) for name in ('IA', 'IE', *known))
        names = [*PHYSICAL, *_harmonics()]
        self.library = tuple(_term(name) for name in names if name not in known)

    def measured(self) -> list[FloatArray]:
        """How far across and up, arcsec on the sky, each star was from where it was commanded."""
        return [self._observed]

    def inputs(self) -> Mapping[str, Sequence[FloatArray]]:
        """Azimuth and elevation, rad."""
        return {'azimuth': [self.azimuth], 'elevation': [self.elevation]}

    def variables(self) -> Mapping[str, Sequence[FloatArray]]:
        """Elevation, which the tube hangs by, and the place on the sky, as a direction: azimuth has no ends."""
        a, e = self.azimuth, self.elevation
        place = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        return {'elevation': [e], 'place on the sky': [place]}

    def parts(self) -> Sequence[IntArray]:
        """Each star is left out by itself."""
        return [np.arange(len(self.azimuth))]

    def simulate(self, model: Model) -> list[FloatArray]:
        """Return the sum of the terms."""
        out = np.zeros_like(self._observed)
        for name, values in model.items():
            out += values['size'] * self._picture(name)
        return [out]

    def _picture(self, name: str) -> FloatArray:
        """(2, n): what 1 arcsec of a term does across and up."""
        a, e = self.azimuth, self.elevation
        none, one = np.zeros_like(a), np.ones_like(a)
        physical: dict[str, tuple[FloatArray, FloatArray]] = {
            'IA': (np.cos(e), none),
            'IE': (none, one),
            'CA': (one, none),
            'NPAE': (np.sin(e), none),
            'AN': (np.sin(a) * np.sin(e), np.cos(a)),
            'AW': (np.cos(a) * np.sin(e), -np.sin(a)),
            'TF': (none, np.cos(e)),
            'TX': (none, 1.0 / np.tan(e)),
        }
        if name in physical:
            return np.stack(physical[name])
        what, wave, of, order = name[1], name[2], name[3], float(name[4:] or 1)
        angle = order * (a if of == 'A' else e)
        value = np.sin(angle) if wave == 'S' else np.cos(angle)
        if what == 'E':
            return np.stack([none, value])
        return np.stack([value * np.cos(e) if what == 'A' else value, none])
