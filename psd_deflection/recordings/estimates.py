# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A series of deflections: those of one topic of a recording, or those that a replay gives."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, overload

import numpy as np
import numpy.typing as npt

from psd_deflection.base.axes import ranges
from psd_deflection.base.drawings import plotted
from psd_deflection.base.errors import ConfigError
from psd_deflection.base.tables import Column, Table, columns_of, html_table
from psd_deflection.recordings.charts import estimates_chart, moments
from psd_deflection.records import FloatArray, IntArray, Mark

if TYPE_CHECKING:
    import pandas
    import xarray

    from psd_deflection.base.figures import ShownFigure


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class EstimateSeries:
    """Deflections in order of time.

    ``t_ns`` int64 (n,). ``pose`` (n, 3): dX m, dY m, theta rad. ``tilt`` (n, 2): phi, omega, rad. ``covariance``
    (n, 3, 3) of the pose. ``wrench`` (n, 3): load at the tip that the link model needs, N, N, N m, NaN if there is
    none. ``chi_square`` (n,): of the one redundant reading, NaN if it was not checked. ``covariance``, ``wrench`` and
    ``chi_square`` are None if the source has none. ``start_ns``: where ``t`` is 0; the first estimate if None.
    ``marks``: of the recording.
    """

    topic: str
    t_ns: IntArray
    pose: FloatArray
    tilt: FloatArray
    covariance: FloatArray | None = None
    wrench: FloatArray | None = None
    chi_square: FloatArray | None = None
    start_ns: int | None = None
    marks: tuple[Mark, ...] = ()

    def rows(self, chosen: npt.NDArray[np.bool_]) -> EstimateSeries:
        """The estimates at which ``chosen`` (n,) is True."""

        def part(values: FloatArray | None) -> FloatArray | None:
            return None if values is None else values[chosen]

        return EstimateSeries(
            self.topic,
            self.t_ns[chosen],
            self.pose[chosen],
            self.tilt[chosen],
            part(self.covariance),
            part(self.wrench),
            part(self.chi_square),
            marks=self.marks,
        )

    def __len__(self) -> int:
        return len(self.t_ns)

    @overload
    def __getitem__(self, part: str) -> npt.NDArray[Any]: ...

    @overload
    def __getitem__(self, part: slice) -> EstimateSeries: ...

    def __getitem__(self, part: str | slice) -> npt.NDArray[Any] | EstimateSeries:
        """Those of a part of time, ``estimates[1.0:2.0]``, s, whose times stay as they are; or a column of the table.

        Raises KeyError for a column that is not there.
        """
        if isinstance(part, str):
            return self.table().column(part)
        if not isinstance(part, slice) or part.step is not None:
            raise ConfigError(f'estimates[{part!r}]: must be a part of time, as estimates[1.0:2.0]')
        t = self.t
        first, last = (-np.inf if part.start is None else part.start), (np.inf if part.stop is None else part.stop)
        chosen = self.rows((t >= first) & (t < last))
        return replace(chosen, start_ns=self._start_ns)

    @property
    def t(self) -> FloatArray:
        """Time of each estimate (the middle of its block), s from ``start_ns``."""
        seconds: FloatArray = (self.t_ns - self._start_ns).astype(np.float64) * 1e-9
        return seconds

    @property
    def _start_ns(self) -> int:
        first = int(self.t_ns[0]) if len(self.t_ns) else 0
        return first if self.start_ns is None else self.start_ns

    @property
    def dx(self) -> FloatArray:
        """Displacement along X, (n,), m."""
        return self.pose[:, 0]

    @property
    def dy(self) -> FloatArray:
        """Displacement along Y, (n,), m."""
        return self.pose[:, 1]

    @property
    def theta(self) -> FloatArray:
        """Twist about Z, (n,), rad."""
        return self.pose[:, 2]

    @property
    def sd(self) -> FloatArray | None:
        """Standard deviations of dX m, dY m, theta rad, (n, 3), NaN if unknown; None without a covariance."""
        if self.covariance is None:
            return None
        variances = np.diagonal(self.covariance, axis1=1, axis2=2)
        return np.sqrt(np.where(variances >= 0.0, variances, np.nan))

    def table(self) -> Table:
        """The columns with their units, over ``t`` (s)."""
        axes = ('displacement along X', 'displacement along Y', 'twist about Z')
        columns = [
            Column('t_ns', self.t_ns, 'ns', 'time, since the epoch if the recording has it'),
            *columns_of(self.pose, ('dx', 'dy', 'theta'), ('m', 'm', 'rad'), axes),
            *columns_of(self.tilt, ('phi', 'omega'), ('rad', 'rad'), ('tilt about X', 'tilt about Y')),
        ]
        sd = self.sd
        if sd is not None:
            words = [f'standard deviation of the {axis}' for axis in axes]
            columns += columns_of(sd, ('sd_dx', 'sd_dy', 'sd_theta'), ('m', 'm', 'rad'), words)
        if self.wrench is not None:
            words = ['force along X at the tip', 'force along Y at the tip', 'torque about Z at the tip']
            columns += columns_of(self.wrench, ('fx', 'fy', 'tz'), ('N', 'N', 'N m'), words)
        if self.chi_square is not None:
            columns.append(Column('chi_square', self.chi_square, '', 'of the one redundant reading'))
        return Table(Column('t', self.t, 's', 'time'), columns, {'topic': self.topic})

    @property
    def duration(self) -> float:
        """Seconds from the first estimate to the end of the last: one step more, the median; 0 of fewer than two."""
        steps = np.diff(self.t_ns)
        return float(steps.sum() + np.median(steps)) * 1e-9 if len(steps) else 0.0

    def to_pandas(self, *, clock: bool = False) -> pandas.DataFrame:
        """One row an estimate over ``t`` (s), or over the time of day in UTC if ``clock``; ``.attrs['units']``: units.

        Raises ConfigError if pandas is not installed.
        """
        return self.table().to_pandas(clock=clock)

    def to_xarray(self) -> xarray.Dataset:
        """One variable a quantity over ``t`` (s), with ``units`` and ``long_name``.

        Raises ConfigError if xarray is not installed.
        """
        return self.table().to_xarray()

    def plot(self) -> ShownFigure:
        """dX, dY and theta over time with their 95 % intervals and the marks, as a matplotlib figure.

        Raises ConfigError if matplotlib is not installed.
        """
        marks = moments(self.marks, self._start_ns)
        return plotted(estimates_chart(self.t, self.pose, self.sd, self.topic, marks))

    def _summary(self) -> list[tuple[str, str]]:
        rows = [('estimates', str(len(self)))]
        if len(self):
            rows.append(('duration', f'{self.duration:.2f} s'))
            rows += ranges(self.pose)
        return rows

    def __repr__(self) -> str:
        return f'<EstimateSeries {self.topic}: {", ".join(f"{name} {value}" for name, value in self._summary())}>'

    def _repr_html_(self) -> str:
        return html_table(f'EstimateSeries {self.topic}', self._summary())
