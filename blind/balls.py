# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""Balls that fall from a bridge, filmed: a plant for ``discover_in``."""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree
from zipfile import BadZipFile, ZipFile

import numpy as np

from psd_deflection.model.simulation.declaration import Effect, EffectParameter
from psd_deflection.records import FloatArray
from psd_deflection.studies.discover.plants import Model, Plant, plant_effect

FILE = 'Ball_drops_data.xls'
GRAVITY, AIR = 9.81, 1.2  # m/s^2; kg/m^3.
OUNCE = 0.0283495
BALLS = {
    'Baseball': (5.0, 22.25),
    'Blue Basketball': (18.0, 75.0),
    'Green Basketball': (16.0, 73.25),
    'Golf Ball': (1.62, 13.8),
    'Tennis Ball': (2.0, 20.75),
    'Whiffle Ball 1': (1.0, 22.8),
    'Whiffle Ball 2': (1.0, 22.8),
    'Yellow Whiffle Ball': (1.5, 29.0),
    'Orange Whiffle Ball': (1.5, 29.0),
}
"""Ounces and circumference, cm, as those who measured wrote down."""
BEGIN, AROUND = 10, 6
READING = 0.05  # m rms, of a height in a picture: their first heights, before the ball moves, differ by so much.
STEPS = 8  # Of the simulation between two heights.
UNEVEN = 5e-3  # s by which a step of time may differ from the usual; the record ends at the last that differs more.
SHEET = '{http://schemas.openxmlformats.org/spreadsheetml/2006/main}'

LIBRARY = (
    plant_effect('quadratic_drag', EffectParameter('coefficient', '', 0.0, 3.0, 0.02, 'of the cross-section')),
    plant_effect('linear_drag', EffectParameter('drag', 'kg/(m s)', 0.0, 0.5, 0.01, 'by radius and speed')),
    plant_effect('hole_drag', EffectParameter('coefficient', '', 0.0, 3.0, 0.05, 'more, of balls with holes')),
    plant_effect('carried_air', EffectParameter('share', '', 0.0, 3.0, 0.1, 'of the air displaced, as mass')),
    plant_effect('buoyancy', EffectParameter('share', '', 0.0, 3.0, 0.1, 'of the weight of the air displaced')),
    plant_effect('updraught', EffectParameter('speed', 'm/s', -5.0, 5.0, 0.2, 'of the air')),
    plant_effect('height_scale', EffectParameter('scale', '', -0.2, 0.2, 0.005, 'of all heights')),
)


def read(path: Path) -> dict[str, FloatArray]:
    """Of each ball (n, 3): number of the drop, time (s), height (m). Raises OSError if there is no file, ValueError if
    it is no such table."""
    out = {}
    try:
        with ZipFile(path) as book:
            sheets = ElementTree.fromstring(book.read('xl/workbook.xml')).iter(f'{SHEET}sheet')
            for number, sheet in enumerate(sheets, start=1):
                tree = ElementTree.fromstring(book.read(f'xl/worksheets/sheet{number}.xml'))
                cells = [[c.findtext(f'{SHEET}v') for c in row] for row in tree.iter(f'{SHEET}row')]
                full = [[float(v) for v in row[:3] if v] for row in cells[1:] if all(row[:3]) and len(row) >= 3]
                out[re.sub(r'\s+', ' ', sheet.attrib['name']).strip()] = np.array(full)
    except (BadZipFile, KeyError, ElementTree.ParseError) as error:
        raise ValueError(f'{path}: is no table of drops ({error})') from None
    return out


def _periods(times: FloatArray) -> int:
    """Heights until the steps of time become uneven."""
    steps = np.diff(times)
    uneven = np.flatnonzero(np.abs(steps - np.median(steps)) > UNEVEN)
    return int(uneven[-1]) + 1 if len(uneven) else len(times)


class Balls(Plant):
    """``drop``: 1 or 2."""

    channels = ('height',)
    units = ('m',)
    library: tuple[Effect, ...] = LIBRARY
    noise = (READING,)
    period = 1.0 / 15.0

    def __init__(self, folder: Path, drop: int = 1) -> None:
        """Raises OSError if ``folder`` has no such file, ValueError if a ball is not in it."""
        tables = read(folder / FILE)
        missing = sorted(set(BALLS) - set(tables))
        if missing:
            raise ValueError(f'{folder / FILE}: has no {", ".join(missing)}')
        self.cases = tuple(BALLS)
        self.times, self.heights = list[FloatArray](), list[FloatArray]()
        self.start = list[tuple[float, float]]()
        for name in BALLS:
            _, t, h = tables[name][tables[name][:, 0] == drop].T
            count = _periods(t)
            near = slice(BEGIN - AROUND, BEGIN + AROUND + 1)
            _, speed, height = np.polyfit(t[near] - t[BEGIN], h[near], 2).tolist()
            self.start.append((height, speed))
            self.times.append(t[BEGIN:count] - t[BEGIN])
            self.heights.append(h[BEGIN:count])
        ounces, around = np.array(list(BALLS.values())).T
        self.mass, self.radius = OUNCE * ounces, 0.01 * around / (2.0 * math.pi)
        self._holes = np.array(['Whiffle' in name for name in BALLS], dtype=np.float64)

    def measured(self) -> list[FloatArray]:
        """Height, m."""
        return [h[None, :] for h in self.heights]

    def inputs(self) -> Mapping[str, Sequence[FloatArray]]:
        """Time since the start, s."""
        return {'time': self.times}

    def simulate(self, model: Model) -> list[FloatArray]:
        """Return all balls at once, with the midpoint rule."""

        def of(name: str, parameter: str) -> float:
            return model[name][parameter] if name in model else 0.0

        air = AIR * 4.0 / 3.0 * math.pi * self.radius**3
        moved = self.mass + of('carried_air', 'share') * air
        weight = GRAVITY * (self.mass - of('buoyancy', 'share') * air)
        coefficient = of('quadratic_drag', 'coefficient') + self._holes * of('hole_drag', 'coefficient')
        square = 0.5 * AIR * math.pi * self.radius**2 * coefficient
        straight = of('linear_drag', 'drag') * self.radius
        wind, scale = of('updraught', 'speed'), 1.0 + of('height_scale', 'scale')

        def push(v: FloatArray) -> FloatArray:
            return np.asarray(-(weight + (square * np.abs(v - wind) + straight) * (v - wind)) / moved)

        count = max(len(t) for t in self.times)
        # Each ball has times of its own; after its last it goes on.
        longer = [t[-1] + self.period * np.arange(1, count - len(t) + 1) for t in self.times]
        times = np.stack([np.concatenate([t, more]) for t, more in zip(self.times, longer, strict=True)])
        h, v = np.array(self.start).T / scale
        out = np.empty((count, len(h)))
        for i in range(count):
            out[i] = h
            if i + 1 < count:
                step = (times[:, i + 1] - times[:, i]) / STEPS
                for _ in range(STEPS):
                    mid = v + 0.5 * step * push(v)
                    h, v = h + step * mid, v + step * push(mid)
        return [scale * out[None, : len(t), i] for i, t in enumerate(self.times)]
