# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The arithmetic in an order of its own: right, the same for floats and arrays, and used wherever bits are promised."""

import ast
import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psd_deflection.base.arithmetic import FIXED, LIBRARY, Arithmetic, FixedArithmetic, in_pairs
from psd_deflection.base.arithmetic.fixed import FixedFunctions
from psd_deflection.base.arithmetic.matrices import pivots, surely_positive
from psd_deflection.base.arithmetic.spectra import lagged_products, transform
from psd_deflection.records import FloatArray

PACKAGE = Path(__file__).parents[2] / 'psd_deflection'
ANGLES = np.concatenate((np.linspace(-7.0, 7.0, 4001), 1e-3 * np.linspace(-1.0, 1.0, 501), [9e5, -9e5]))


def ulps(got: FloatArray, want: FloatArray, least: float = 0.0) -> float:
    """Largest error in units of the last place of ``want``, or of ``least`` if that is larger."""
    return float((np.abs(got - want) / np.spacing(np.maximum(np.abs(want), least))).max())


def test_every_operation_has_an_order_of_its_own() -> None:
    ours = {name for name in vars(Arithmetic) if not name.startswith('_')}
    fixed = vars(FixedArithmetic) | vars(FixedFunctions)
    assert {name for name in fixed if not name.startswith('_')} == ours


def test_sine_and_cosine_are_within_two_ulps() -> None:
    # Near a multiple of pi the error counts against the rounding of the reduced angle, some 1e-17.
    assert ulps(FIXED.sin_many(ANGLES), np.sin(ANGLES), 1e-2) <= 2.0
    assert ulps(FIXED.cos_many(ANGLES), np.cos(ANGLES), 1e-2) <= 2.0
    # Beyond, whole turns are taken off first: a search that diverges gets some number between -1 and 1.
    assert abs(FIXED.sin(1e12)) <= 1.0
    assert FIXED.sin_many(np.array([1e12]))[0] == FIXED.sin(1e12)
    inner = ANGLES[np.abs(ANGLES) < 1.5]
    assert ulps(FIXED.tan_many(inner), np.tan(inner)) <= 4.0


def test_arcs_are_right_to_two_units_in_the_last_place() -> None:
    y, x = np.sin(ANGLES), np.cos(3.0 * ANGLES) * np.exp(np.cos(ANGLES))
    assert ulps(FIXED.atan2_many(y, x), np.arctan2(y, x)) <= 2.0
    within = np.linspace(-1.0, 1.0, 1001)
    assert max(abs(FIXED.asin(v) - math.asin(v)) for v in within.tolist()) < 1e-15
    assert max(abs(FIXED.atan(v) - math.atan(v)) for v in (10.0 * within).tolist()) < 1e-15


@pytest.mark.parametrize('y', [0.0, -0.0, 1.0, -1.0])
@pytest.mark.parametrize('x', [0.0, -0.0, 1.0, -1.0])
def test_arcs_on_the_axes_have_the_signs_of_the_standard(y: float, x: float) -> None:
    for got in (FIXED.atan2(y, x), float(FIXED.atan2_many(np.array(y), np.array(x)))):
        assert got == pytest.approx(math.atan2(y, x), abs=3e-16)
        assert math.copysign(1.0, got) == math.copysign(1.0, math.atan2(y, x))


def test_exponential_and_logarithm_are_within_two_ulps() -> None:
    x = np.concatenate((np.linspace(-690.0, 300.0, 3001), 1e-3 * np.linspace(-1.0, 1.0, 501)))
    assert ulps(FIXED.exp_many(x), np.exp(x)) <= 2.0
    # Beside 1 the logarithm is that of a difference that is exact.
    y = np.concatenate((np.exp(x), 1.0 + 1e-3 * np.linspace(-1.0, 1.0, 500)))
    assert ulps(FIXED.log_many(y), np.log(y)) <= 2.0
    assert max(abs(FIXED.expm1(v) / math.expm1(v) - 1.0) for v in np.linspace(-20.0, 1.0, 401).tolist()) < 2e-15


def test_what_is_not_finite_gives_no_number_and_no_error() -> None:
    for bad in (math.nan, math.inf, -math.inf):
        assert np.isnan([FIXED.sin(bad), FIXED.cos(bad), FIXED.atan2(bad, 1.0)]).all()
        many = FIXED.sin_many(np.array([bad])), FIXED.atan2_many(np.array([1.0]), np.array([bad]))
        assert np.isnan(many).all()
    assert FIXED.exp(-math.inf) == 0.0
    assert math.isnan(FIXED.exp(math.nan))
    assert FIXED.exp_many(np.array([-np.inf, 0.0])).tolist() == [0.0, 1.0]
    assert FIXED.log_many(np.array([0.0, 1.0])).tolist() == [-math.inf, 0.0]


@given(st.floats(-1e5, 1e5), st.floats(-1e5, 1e5))
def test_floats_and_arrays_have_the_same_bits(x: float, y: float) -> None:
    a, b = np.array([x]), np.array([y])
    assert (FIXED.sin_many(a)[0], FIXED.cos_many(a)[0]) == (FIXED.sin(x), FIXED.cos(x))
    assert (FIXED.atan2_many(b, a)[0], FIXED.hypot_many(a, b)[0]) == (FIXED.atan2(y, x), FIXED.hypot(x, y))
    small = x / 1e3
    assert FIXED.exp_many(np.array([small]))[0] == FIXED.exp(small)
    assert FIXED.power_many(a, 3)[0] == FIXED.power(x, 3)


@pytest.mark.parametrize('xp', [LIBRARY, FIXED])
def test_powers_and_roots(xp: Arithmetic) -> None:
    x = np.linspace(-2.0, 2.0, 9)
    for n in range(5):
        assert xp.power_many(x, n) == pytest.approx(x**n)
    assert xp.power_many(10.0, np.arange(4)) == pytest.approx(np.array([1.0, 10.0, 100.0, 1000.0]))
    assert (xp.power(3.0, 4), xp.square(-3.0), xp.root(2.25)) == (81.0, 9.0, 1.5)
    assert xp.total(v for v in (1.0, 2.0, 3.5)) == 6.5


SPECS = (
    ('asj,as->aj', (4, 20, 30), (4, 20)),
    ('ak,akbj,bj->ab', (4, 5), (4, 5, 4, 5), (4, 5)),
    ('ac,cdl,bd->abl', (3, 4), (4, 4, 20), (3, 4)),
    ('akin,aknm->akim', (3, 2, 4, 7), (3, 2, 7, 7)),
    ('i,i->', (6,), (6,)),
    ('i,ij,j->', (6,), (6, 6), (6,)),
    ('ij,jk->ik', (3, 4), (4, 20)),
    ('t,ti->i', (35,), (35, 9)),
    ('ast,tk->ask', (4, 100, 100), (100, 5)),
    ('cl,l->c', (4, 1), (1,)),
    ('npci,npcj->nij', (3, 8, 2, 4), (3, 8, 2, 4)),
)


@pytest.mark.parametrize('spec', SPECS, ids=lambda spec: str(spec[0]))
def test_sums_of_products_are_those_of_numpy(spec: tuple[str, *tuple[tuple[int, ...], ...]]) -> None:
    rng = np.random.default_rng(1)
    operands = [rng.normal(size=shape) for shape in spec[1:]]
    want = np.einsum(spec[0], *operands)
    assert FIXED.einsum(spec[0], *operands) == pytest.approx(want, rel=1e-12, abs=1e-12)
    rotated = [np.asfortranarray(a) for a in operands]
    np.testing.assert_array_equal(FIXED.einsum(spec[0], *rotated), FIXED.einsum(spec[0], *operands))


@pytest.mark.slow
@pytest.mark.parametrize('shape', [(3,), (), (2, 1500)])
@pytest.mark.parametrize('count', [*range(10), 20, 27])
def test_rows_are_added_in_pairs(count: int, shape: tuple[int, ...]) -> None:
    rows = np.random.default_rng(count).normal(size=(count, *shape))

    def added(rows: list[FloatArray]) -> FloatArray:
        if len(rows) < 2:
            return rows[0] if rows else np.zeros(shape)
        half = len(rows) // 2
        pairs = [rows[i] + rows[half + i] for i in range(half)]
        if len(rows) % 2:
            pairs[0] = pairs[0] + rows[-1]
        return added(pairs)

    wanted = added(list(rows))
    first = in_pairs(rows)
    np.testing.assert_array_equal(first, wanted)
    np.testing.assert_array_equal(in_pairs(-np.asfortranarray(rows)), -wanted)
    np.testing.assert_array_equal(first, wanted)
    for axis in range(rows.ndim):
        assert FIXED.sum(rows, axis) == pytest.approx(rows.sum(axis=axis))


def test_sums_in_threads_do_not_meet() -> None:
    rows = np.random.default_rng(0).normal(size=(8, 300, 20, 3))
    wanted = [[in_pairs(block).tolist() for block in blocks] for blocks in rows]
    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(lambda blocks: [in_pairs(block).tolist() for block in blocks], rows)) == wanted


@pytest.mark.parametrize('part', [1e-9, -1e-9, 1e-15, -1e-15, 0.0])
def test_definiteness_near_rounding_follows_pivots(part: float) -> None:
    rng = np.random.default_rng(5)
    vectors = np.linalg.qr(rng.normal(size=(12, 12)))[0]
    a = (vectors * [part, *np.linspace(0.1, 1.0, 11)]) @ vectors.T
    a = 0.5 * (a + a.T)
    assert FIXED.is_positive(a) is all(float(p) > 0.0 for p in pivots(a))
    assert (surely_positive(a) is None) is (abs(part) < 1e-12)
    if abs(part) > 1e-12:
        assert FIXED.is_positive(a) is (part > 0.0)


@pytest.mark.parametrize('size', [1, 2, 3, 5, 12, 27])
def test_matrices_are_solved_as_lapack_solves_them(size: int) -> None:
    rng = np.random.default_rng(size)
    a, b = rng.normal(size=(size, size)), rng.normal(size=(size, 4))
    square = a @ a.T + 0.1 * np.eye(size)
    scale = 1e-13 * np.linalg.cond(a)
    for xp in (LIBRARY, FIXED):
        assert xp.solve(a, b) == pytest.approx(np.linalg.solve(a, b), rel=scale, abs=scale)
        assert xp.solve(a, b[:, 0]) == pytest.approx(np.linalg.solve(a, b[:, 0]), rel=scale, abs=scale)
        assert xp.product(xp.inverse_of(square), square) == pytest.approx(np.eye(size), abs=1e-9)
        assert xp.log_det(square[None])[0] == pytest.approx(np.linalg.slogdet(square)[1], abs=1e-12)
        assert xp.log_det_by_pivots(square[None])[0] == pytest.approx(np.linalg.slogdet(square)[1], abs=1e-12)
        values, vectors = xp.eigen(square)
        assert values == pytest.approx(np.linalg.eigvalsh(square), rel=1e-12, abs=1e-12 * values[-1])
        assert (vectors * values) @ vectors.T == pytest.approx(square, abs=1e-12 * values[-1])
        assert xp.is_positive(square)
        assert not xp.is_positive(square - 1.01 * values[0] * np.eye(size))
        tall = rng.normal(size=(2 * size + 3, size))
        assert xp.pseudo_inverse(tall) == pytest.approx(np.linalg.pinv(tall), abs=1e-12)
        wanted = rng.normal(size=(len(tall), 2))
        assert xp.least_squares(tall, wanted) == pytest.approx(np.linalg.lstsq(tall, wanted, rcond=None)[0], abs=1e-12)


def test_many_small_matrices_are_solved_at_once_with_any_pivot() -> None:
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(7, 2, 2)), rng.normal(size=(7, 2, 5))
    a[0] = [[0.0, 1.0], [2.0, 0.0]]
    assert FIXED.solve(a, b) == pytest.approx(np.linalg.solve(a, b), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize('length', [1, 2, 7, 50, 600, 1000])
@pytest.mark.parametrize('count', [1, 2, 5])
def test_a_transform_is_that_of_numpy(length: int, count: int) -> None:
    series = np.random.default_rng(length).normal(size=(length, count))
    want = np.fft.rfft(series, axis=0)
    np.testing.assert_allclose(transform(series), want, rtol=0.0, atol=3e-15 * np.abs(want).max() * count)


@pytest.mark.parametrize('length', [20, 1000, 50_000])
def test_lagged_products_ignore_summation_order(length: int) -> None:
    rng = np.random.default_rng(length)
    series = np.column_stack((rng.normal(0.0, 3e-6, length), 1e-3 + rng.normal(0.0, 1e-6, length), np.zeros(length)))
    got = lagged_products(series, 3)
    want = [[[series[: length - lag, c] @ series[lag:, d] for lag in range(3)] for d in range(3)] for c in range(3)]
    size = np.sqrt(np.diagonal(got[:, :, 0]))
    np.testing.assert_allclose(got, want, rtol=0.0, atol=1e-5 * float(size.max()) ** 2)
    order = rng.permutation(length)
    assert (lagged_products(series[order], 1) == got[:, :, :1]).all()
    units = np.array(
        [2.0 ** (np.frexp(np.abs(column).max())[1] - (52 - length.bit_length()) // 2) for column in series.T]
    )
    full = np.rint(series[:, :2] / units[:2]).astype(int)
    exact = sum(int(a) * int(b) for a, b in zip(full[:-1, 0].tolist(), full[1:, 1].tolist(), strict=True))
    assert got[0, 1, 1] == exact * units[0] * units[1]


@pytest.mark.parametrize('count', [1, 2, 8, 12])
def test_nodes_and_weights_of_gauss_and_legendre(count: int) -> None:
    nodes, weights = FIXED.legendre(count)
    want = LIBRARY.legendre(count)
    assert nodes == pytest.approx(want[0], abs=1e-15)
    assert weights == pytest.approx(want[1], abs=1e-14)


# What a block or a rig goes through on its way to an estimate. Rooms whole, but for what the table below names.
PIPELINE = (
    *('measure/averaging.py', 'measure/pipeline.py', 'measure/estimation.py'),
    *('measure/correction.py', 'model/detector/volts.py', 'measure/health.py', 'measure/motion'),
    *('measure/uncertainty', 'model/solvers', 'model/plate/plate.py', 'model/plate/landing.py'),
    *('model/plate/layout.py', 'model/plate/linear.py', 'model/misalignment/model.py'),
    *('model/misalignment/rig.py', 'model/link/statics.py'),
    *('model/simulation/physics.py', 'model/simulation/tip_load.py'),
    *('model/simulation/effects/ambient_light.py', 'model/simulation/effects/axis_crosstalk.py'),
    *('model/simulation/effects/sensor_gain.py', 'model/simulation/effects/sensor_nonlinearity.py'),
    *('model/simulation/effects/sensor_rotation.py', 'model/simulation/effects/thermal_drift.py'),
    *('model/simulation/effects/sensor_position.py', 'model/simulation/effects/plane_tilt.py'),
)
NOT_OF_A_BLOCK = {
    # (file, function): why it may use what depends on the processor.
    ('model/plate/linear.py', 'condition_number'): 'told to people, by design alone',
    ('model/plate/linear.py', 'error_bound'): 'told to people, by design alone',
    ('model/plate/layout.py', 'check_twist'): 'compares with a bound',
    ('model/solvers/base_pair.py', '_reject_what_is_unseen'): 'compares with a bound',
    ('model/solvers/pose.py', '__init__'): 'compares with a bound',
    ('measure/uncertainty/consistency.py', 'survival'): 'told in /diagnostics alone',
    ('measure/uncertainty/vibration.py', 'why_moving'): 'compares with a bound; what it decides is recorded',
    ('measure/pipeline.py', 'zero'): 'what it finds is recorded and not computed again',
    ('measure/averaging.py', 'middles_ns'): 'adds whole numbers',
    ('measure/uncertainty/noise.py', '_autocovariance'): 'adds whole numbers',
    ('measure/health.py', '__init__'): 'a whole number to the power of one',
    ('measure/uncertainty/consistency.py', '__init__'): 'the suspect is told in /diagnostics alone',
    ('measure/uncertainty/consistency.py', 'add'): 'the suspect is told in /diagnostics alone',
    ('measure/uncertainty/block_estimator.py', 'noise_words'): 'told in /diagnostics alone',
}
MATRICES = {'linalg', 'fft', 'einsum', 'dot', 'vdot', 'inner', 'matmul', 'tensordot', 'trace', 'polyfit', 'convolve'}
FUNCTIONS = {
    'sin', 'cos', 'tan', 'arcsin', 'arccos', 'arctan', 'arctan2', 'exp', 'expm1', 'log', 'log1p', 'log2', 'log10',
    'power', 'float_power', 'hypot', 'sinh', 'cosh', 'tanh', 'cbrt', 'exp2', 'legendre',
}  # fmt: skip
SUMS = {'sum', 'mean', 'var', 'std', 'prod', 'cumsum', 'average'}
OF_MATH = {
    'sin', 'cos', 'tan', 'asin', 'acos', 'atan', 'atan2', 'exp', 'expm1', 'log', 'log1p', 'log2', 'log10', 'pow',
    'hypot', 'erf', 'erfc', 'fsum', 'dist', 'sumprod',
}  # fmt: skip


def processor_dependent(tree: ast.AST) -> list[tuple[int, str]]:
    """(line, words) of what rounds as the processor or a library chooses."""
    uses: list[tuple[int, str]] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
            uses.append((node.lineno, 'a @ b'))
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if node.value.id == 'np' and node.attr in MATRICES | FUNCTIONS | SUMS:
                uses.append((node.lineno, f'np.{node.attr}'))
            if node.value.id == 'math' and node.attr in OF_MATH:
                uses.append((node.lineno, f'math.{node.attr}'))
        if isinstance(node, ast.ImportFrom) and node.module == 'math':
            uses += [(node.lineno, f'math.{name.name}') for name in node.names if name.name in OF_MATH]
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in SUMS - {'sum'}:
            uses.append((node.lineno, f'.{node.func.attr}()'))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in ('sum', 'dot'):
            owner = node.func.value
            xp = isinstance(owner, ast.Name) and owner.id in ('xp', 'arithmetic')
            xp |= isinstance(owner, ast.Attribute) and owner.attr in ('_xp', 'xp')
            # Truths that are counted have no order.
            of_keep = isinstance(owner, ast.Name) and owner.id == 'keep'
            if not xp and not of_keep:
                uses.append((node.lineno, '.sum()'))
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow) and not isinstance(node.right, ast.Constant):
            uses.append((node.lineno, 'a ** b'))
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow) and isinstance(node.right, ast.Constant):
            constant = isinstance(node.left, ast.Constant)
            # numpy squares and takes roots of arrays without its power function.
            if node.right.value not in (2, 2.0) and not constant:
                uses.append((node.lineno, f'a ** {node.right.value!r}'))
    return uses


def functions_of(path: Path) -> list[tuple[str, ast.AST]]:
    """Each function, and what stands outside of functions, by name."""
    tree = ast.parse(path.read_text(encoding='utf-8'))
    out: list[tuple[str, ast.AST]] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            out.append((node.name, node))
    for node in tree.body:
        if not isinstance(node, ast.FunctionDef | ast.ClassDef):
            out.append(('', node))
    return out


def test_block_path_has_no_processor_dependent_code() -> None:
    files = [f for name in PIPELINE for f in (sorted((PACKAGE / name).glob('*.py')) or [PACKAGE / name])]
    wrong, used = [], set()
    for path in files:
        name = path.relative_to(PACKAGE).as_posix()
        for function, tree in functions_of(path):
            uses = processor_dependent(tree)
            if uses and (name, function) in NOT_OF_A_BLOCK:
                used.add((name, function))
                continue
            wrong += [f'{name}:{line}: {what}, in {function or "the module"}' for line, what in uses]
    assert wrong == []
    assert set(NOT_OF_A_BLOCK) == used
