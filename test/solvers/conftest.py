"""The golden answers: computed by an independent audit of the source, in SI, at full precision."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from psd_deflection.solvers import Geometry


class Golden:
    """``golden['G5']`` is a case; ``geometry`` the rig of all of them."""

    def __init__(self, path: Path) -> None:
        content = json.loads(path.read_text())
        self.cases: dict[str, dict[str, Any]] = {case['name']: case for case in content['cases']}
        self.constants: dict[str, Any] = content['constants']

    def geometry(self, name: str | None = None, slope_ratio: float = 1.5) -> Geometry:
        zeros = np.zeros((2, 2)) if name is None else np.array(self.cases[name]['m0'])
        return Geometry(np.array([[0.0, 0.070], [-0.100, 0.0]]), zeros, np.zeros(2), 0.585, slope_ratio)

    def dots(self, name: str) -> tuple[float, ...]:
        return tuple(float(v) for pair in self.cases[name]['readings'] for v in pair)


@pytest.fixture(scope='session')
def golden() -> Golden:
    return Golden(Path(__file__).parent.parent / 'data' / 'golden.json')
