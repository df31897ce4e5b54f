"""Operation counts: the cost of each operation, that none is left out, and the counts of solvers."""

from __future__ import annotations

import json
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import ValueCheckError
from strategies import SOLVERS, batches, many

from kornia_pnpnet import MLPInit, Normalize
from kornia_pnpnet.data import SyntheticProblems
from kornia_pnpnet.evaluation.operations import OperationCounter, complexity_results, operation_count
from kornia_pnpnet.evaluation.operations.costs import (
    OPERATION_COSTS,
    Operations,
    cholesky,
    lu,
    matmul,
    smallest,
    solve,
    solve_triangular,
    sort,
)
from kornia_pnpnet.evaluation.operations.counter import count_per_problem


def count(function, *shapes):
    """Operations of a function of random tensors of these shapes, made beforehand."""
    tensors = [torch.rand(shape, dtype=torch.float64) + 0.5 for shape in shapes]
    with OperationCounter() as counter:
        function(*tensors)
    return counter.total


def test_every_kind_has_a_cost():
    assert Operations(*range(1, 9)).flops == sum(i * cost for i, cost in enumerate(OPERATION_COSTS.values(), 1))
    assert list(OPERATION_COSTS) == list(Operations.__dataclass_fields__)


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (lambda x: x + 1, Operations(add=12)),
        (lambda x: 3 - x, Operations(add=12)),
        (lambda x: x * x, Operations(multiply=12)),
        (lambda x: x[:, None] * x[None], Operations(multiply=3 * 3 * 4)),
        (lambda x: x / 3, Operations(divide=12)),
        (lambda x: x.rsqrt(), Operations(sqrt=12, divide=12)),
        (lambda x: x.exp_(), Operations(exp=12)),
        (lambda x: x.sin() + x.log(), Operations(log=24, add=12)),
        (lambda x: x.abs() > 1, Operations(compare=36)),
        (lambda x: x.clamp(min=0), Operations(compare=12)),
        (lambda x: x.clamp(min=0, max=1), Operations(compare=24)),
        (lambda x: torch.where(x > 1, x, 0.0), Operations(compare=12, logic=12)),
        (lambda x: torch.addcmul(x, x, x), Operations(add=12, multiply=12)),
        (lambda x: x.square(), Operations(multiply=12)),
        (lambda x: x**5, Operations(multiply=36)),  # x² twice, times x
        (lambda x: x**8, Operations(multiply=36)),
        (lambda x: x**-2, Operations(multiply=12, divide=12)),
        (lambda x: x**0.5, Operations(sqrt=12)),
        (lambda x: x**1.5, Operations(sqrt=12, multiply=12)),
        (lambda x: x**0.3, Operations(exp=12, log=12, multiply=12)),
        (lambda x: x**x, Operations(exp=12, log=12, multiply=12)),
        (lambda x: x.sum(-1), Operations(add=9)),
        (lambda x: x.sum(), Operations(add=11)),
        (lambda x: x.cumsum(-1), Operations(add=9)),
        (lambda x: x.amax(-1), Operations(compare=9)),
        (lambda x: x.argmin(-1), Operations(compare=9)),
        (lambda x: x.min(-1), Operations(compare=9)),
        (lambda x: torch.minimum(x, x), Operations(compare=12)),
        (lambda x: x.tanh(), Operations(log=12)),
        (lambda x: torch.linalg.cross(x.mT, x.mT), Operations(add=12, multiply=24)),
        (lambda x: torch.linalg.vector_norm(x, dim=0), Operations(add=8, multiply=12, sqrt=4)),
        (lambda x: torch.linalg.vector_norm(x, dim=(0, 1)), Operations(add=11, multiply=12, sqrt=1)),
        (lambda x: x.softmax(-1), Operations(add=12 + 9, divide=12, exp=12, compare=9)),
        (
            lambda x: torch.nn.functional.layer_norm(x, (4,), x[0], x[1]),  # sums, differences, squares
            3 * Operations(add=3 + 4 + 3 + 1 + 4, multiply=4 + 4 + 4, divide=3, sqrt=1),
        ),
        (lambda x: (x > 0).all(-1), Operations(compare=12, logic=9)),
        (lambda x: x.sort(-1), Operations(compare=3 * 4 * 2)),
        (lambda x: x.argsort(dim=-1, stable=True), Operations(compare=3 * 4 * 2)),
        (lambda x: x.sort(0), Operations(compare=4 * 3 * math.log2(3))),
        (lambda x: x.topk(1), Operations(compare=3 * 5)),
        (lambda x: x.topk(2), Operations(compare=3 * (6 + 2))),
        (lambda x: x.topk(2, sorted=False), Operations(compare=3 * 6)),
        (lambda x: torch.lerp(x, x, x), Operations(add=24, multiply=12)),
        (lambda x: torch.addcmul(x, x, x, value=-1), Operations(add=12, multiply=12)),
        (lambda x: torch.addcmul(x, x, x, value=2), Operations(add=12, multiply=24)),
        (lambda x: torch.add(x, x, alpha=3), Operations(add=12, multiply=12)),
        (lambda x: (-x).T.reshape(2, 6).flip(0).clone()[:, [0, 1]], Operations()),
    ],
)
def test_cost_of_an_operation(function, expected):
    assert count(function, (3, 4)) == expected


@pytest.mark.parametrize(
    ("function", "shapes", "expected"),
    [
        (lambda a, b: a @ b, [(2, 3), (3, 4)], matmul(2, 3, 4)),
        (lambda a, b: a @ b, [(5, 2, 3), (5, 3, 4)], 5 * matmul(2, 3, 4)),
        (lambda a, b: a @ b, [(5, 2, 3), (3, 4)], 5 * matmul(2, 3, 4)),
        (lambda a, b: a @ b, [(5, 6, 2, 3), (6, 3, 4)], 30 * matmul(2, 3, 4)),
        (torch.nn.functional.linear, [(5, 3), (4, 3), (4,)], 5 * Operations(multiply=12, add=12)),
        (torch.linalg.inv_ex, [(5, 4, 4)], 5 * solve(4, 4)),
        (torch.linalg.cholesky_ex, [(5, 4, 4)], 5 * cholesky(4)),
    ],
)
def test_cost_of_linear_algebra(function, shapes, expected):
    assert count(function, *shapes) == expected


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_formulas_agree_with_the_algorithms_written_out(n):
    """The loops of the textbook, counted one by one."""
    add = divide = 0
    for k in range(n):  # Gaussian elimination
        for _ in range(k + 1, n):
            divide += 1
            add += n - k - 1
    assert (lu(n).add, lu(n).multiply, lu(n).divide) == (pytest.approx(add), pytest.approx(add), divide)
    add = divide = 0
    for j in range(n):  # Cholesky by columns
        for i in range(j, n):
            add += j
            divide += i > j
    assert (cholesky(n).add, cholesky(n).multiply) == (pytest.approx(add), pytest.approx(add))
    assert (cholesky(n).divide, cholesky(n).sqrt) == (divide, n)
    assert solve_triangular(n, 1).add == sum(range(n))
    assert matmul(n, n, 1).add == n * (n - 1)


def test_an_unknown_operation_is_not_lost():
    with pytest.raises(NotImplementedError, match=r"aten\.erf"):
        count(lambda x: x.erf(), (3,))


def test_what_the_batch_shares_is_not_counted():
    table = torch.rand(5, 5)
    counts = count_per_problem(lambda batch: torch.rand(batch, 5) @ (table @ table).exp() + table.sum())
    assert counts == Operations(add=5 * 4 + 5, multiply=5 * 5)


def test_cost_of_sorting():
    assert sort(0) == sort(1) == Operations()
    assert sort(8) == Operations(compare=24)
    assert smallest(8, 1) == smallest(8, 7) == Operations(compare=9)


# -- counts of solvers -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [6, 20])
def test_a_network_multiplies_once_for_each_weight(n):
    network = MLPInit(n)
    weights = sum(p.numel() for name, p in network.named_parameters() if name.endswith("weight"))
    p = SyntheticProblems(n=n, batch_size=4).batch(0)
    corr, _ = Normalize()(p.world_points, p.img_points, p.intrinsics)
    counts = count_per_problem(lambda batch: network(corr.map(lambda x: x[:batch] if x.ndim else x)))
    assert 0 < counts.multiply - weights < 60


def test_an_iteration_costs_the_same_each_time():
    counts = [operation_count(f"identity-lm:m={m}", 9) for m in (1, 2, 3, 30)]
    iteration = counts[1] - counts[0]
    assert counts[2] - counts[1] == pytest.approx(iteration)
    assert counts[3] - counts[2] == pytest.approx(27 * iteration)


@pytest.mark.slow
def test_ransac_costs_more_with_more_outliers_and_at_most_all_samples():
    few = [operation_count("p3p-ransac", 50, outliers=k) for k in (0, 15, 30, 45)]
    assert few == sorted(few)
    assert few[0] < 0.5 * few[-1] <= 0.5 * 1.05 * operation_count("p3p-ransac:threshold=1e-9", 50)


@pytest.mark.slow
def test_results_are_plain_data_with_a_count_for_each_n():
    names = ["pnpnet", "epnp-lm", "p3p-ransac", "ransac-epnp-lm"]
    results = complexity_results(names, n=(6, 9, 30))
    assert json.loads(json.dumps(results, allow_nan=False)) == results
    assert results["outliers"] == [2, 3, 10]
    assert list(results["counts"]) == names
    assert results["ransac"] == ["p3p-ransac", "ransac-epnp-lm"] == list(results["all_samples"])
    assert results["counts"]["ransac-epnp-lm"][0] is None  # samples of 7 of 6 pairs
    for name in ("pnpnet", "epnp-lm"):
        assert results["counts"][name] == sorted(results["counts"][name])


@pytest.mark.parametrize("name", ["opencv-sqpnp", "known-inliers"])
def test_only_solvers_of_the_package_are_counted(name):
    if name == "opencv-sqpnp":
        pytest.importorskip("cv2")
    with pytest.raises(ValueCheckError, match=name):
        operation_count(name, 9)


# -- whatever comes in -------------------------------------------------------------------------------------------------


@pytest.mark.slow
@many(40)
@given(st.sampled_from([name for name in SOLVERS if not name.endswith("-n9")]), batches())
def test_counted_solvers_are_the_same_solvers(name, case):
    inputs, mask, weights, _ = case
    with OperationCounter() as counter:
        result = SOLVERS[name](*inputs, weights=weights, mask=mask)
    assert (0 < counter.total.flops < math.inf) or not len(inputs[0])
    for ours, plain in zip(result[:5], SOLVERS[name](*inputs, weights=weights, mask=mask)[:5], strict=True):
        assert ours.equal(plain)


SIZES = st.integers(1, 6)


@many(10)
@given(st.sampled_from([torch.fft.fft, torch.special.bessel_j0, torch.erfinv, torch.linalg.svd]), SIZES)
def test_operations_of_unknown_cost_are_an_error(function, size):
    with pytest.raises(NotImplementedError, match=r"The cost of aten\.\w+ is unknown"), OperationCounter():
        function(torch.rand(size, size))
