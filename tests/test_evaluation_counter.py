"""The operation counter: the cost of each PyTorch operation, and that no operation is missed."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from strategies import SOLVERS, batches, many

from kornia_pnpnet.core.trees import iter_tensors
from kornia_pnpnet.evaluation.operations.costs import (
    OPERATION_COSTS,
    cholesky,
    lu,
    matmul,
    smallest,
    solve,
    solve_triangular,
    sort,
)
from kornia_pnpnet.evaluation.operations.counter import OperationCounter, count_per_problem


def count(function, *shapes):
    """Operations of a function of random tensors of these shapes, which are made outside of the count."""
    tensors = [torch.rand(shape, dtype=torch.float64) + 0.5 for shape in shapes]
    with OperationCounter() as counter:
        function(*tensors)
    return counter.total


def flops(**counts):
    return sum(OPERATION_COSTS[kind] * count for kind, count in counts.items())


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (lambda x: x + 1, flops(add=12)),
        (lambda x: 3 - x, flops(add=12)),
        (lambda x: x[:, None] * x[None], flops(multiply=3 * 3 * 4)),
        (lambda x: x / 3, flops(divide=12)),
        (lambda x: x.rsqrt(), flops(sqrt=12, divide=12)),
        (lambda x: x.exp_(), flops(exp=12)),
        (lambda x: x.sin() + x.log(), flops(log=24, add=12)),
        (lambda x: x.abs() > 1, flops(compare=36)),
        (lambda x: x.clamp(min=0, max=1), flops(compare=24)),
        (lambda x: torch.where(x > 1, x, 0.0), flops(compare=12, logic=12)),
        (lambda x: torch.addcmul(x, x, x), flops(add=12, multiply=12)),
        (lambda x: x.square(), flops(multiply=12)),
        (lambda x: x**5, flops(multiply=36)),  # x² twice, times x
        (lambda x: x**-2, flops(multiply=12, divide=12)),
        (lambda x: x**1.5, flops(sqrt=12, multiply=12)),
        (lambda x: x**0.3, flops(exp=12, log=12, multiply=12)),
        (lambda x: x.sum(-1), flops(add=9)),
        (lambda x: x.cumsum(-1), flops(add=9)),
        (lambda x: x.amax(-1), flops(compare=9)),
        (lambda x: x.min(-1), flops(compare=9)),
        (lambda x: torch.linalg.cross(x.mT, x.mT), flops(add=12, multiply=24)),
        (lambda x: torch.linalg.vector_norm(x, dim=(0, 1)), flops(add=11, multiply=12, sqrt=1)),
        (lambda x: x.softmax(-1), flops(add=12 + 9, divide=12, exp=12, compare=9)),
        (
            lambda x: torch.nn.functional.layer_norm(x, (4,), x[0], x[1]),  # sums, differences, squares
            3 * flops(add=3 + 4 + 3 + 1 + 4, multiply=4 + 4 + 4, divide=3, sqrt=1),
        ),
        (lambda x: (x > 0).all(-1), flops(compare=12, logic=9)),
        (lambda x: x.sort(-1), flops(compare=3 * 4 * 2)),
        (lambda x: x.sort(0), flops(compare=4 * 3 * math.log2(3))),
        (lambda x: x.topk(2), flops(compare=3 * (6 + 2))),
        (lambda x: x.topk(2, sorted=False), flops(compare=3 * 6)),
        (lambda x: torch.lerp(x, x, x), flops(add=24, multiply=12)),
        (lambda x: torch.addcmul(x, x, x, value=2), flops(add=12, multiply=24)),
        (lambda x: torch.add(x, x, alpha=3), flops(add=12, multiply=12)),
        (lambda x: (-x).T.reshape(2, 6).flip(0).clone()[:, [0, 1]], 0),
    ],
)
def test_cost_of_an_operation(function, expected):
    assert count(function, (3, 4)) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("function", "shapes", "expected"),
    [
        (lambda a, b: a @ b, [(2, 3), (3, 4)], matmul(2, 3, 4)),
        (lambda a, b: a @ b, [(5, 2, 3), (3, 4)], 5 * matmul(2, 3, 4)),
        (lambda a, b: a @ b, [(5, 6, 2, 3), (6, 3, 4)], 30 * matmul(2, 3, 4)),
        (torch.nn.functional.linear, [(5, 3), (4, 3), (4,)], 5 * flops(multiply=12, add=12)),
        (torch.linalg.inv_ex, [(5, 4, 4)], 5 * solve(4, 4)),
        (torch.linalg.cholesky_ex, [(5, 4, 4)], 5 * cholesky(4)),
    ],
)
def test_cost_of_linear_algebra(function, shapes, expected):
    assert count(function, *shapes) == expected


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_counts_of_linear_algebra_agree_with_the_loops_of_the_textbook(n):
    add = divide = 0
    for k in range(n):  # Gaussian elimination
        for _ in range(k + 1, n):
            divide += 1
            add += n - k - 1
    assert lu(n) == pytest.approx(flops(add=add, multiply=add, divide=divide, compare=divide))
    add = divide = 0
    for j in range(n):  # Cholesky by columns
        for i in range(j, n):
            add += j
            divide += i > j
    assert cholesky(n) == pytest.approx(flops(add=add, multiply=add, divide=divide, sqrt=n))
    assert solve_triangular(n, 1, unit=True) == 2 * sum(range(n))
    assert matmul(n, n, 1) == flops(add=n * (n - 1), multiply=n * n)


def test_an_operation_without_a_known_cost_is_an_error():
    with pytest.raises(NotImplementedError, match=r"aten\.erf"):
        count(lambda x: x.erf(), (3,))


@pytest.mark.parametrize("batch", [2, 5])
def test_operations_shared_by_the_batch_are_not_counted(batch):
    table = torch.rand(5, 5)
    cost = count_per_problem(lambda size: torch.rand(size, 5) @ (table @ table).exp() + table.sum(), batch)
    assert cost == pytest.approx(flops(add=5 * 4 + 5, multiply=5 * 5))


def test_cost_of_sorting():
    assert sort(0) == sort(1) == 0
    assert sort(8) == flops(compare=24)
    assert smallest(8, 1) == smallest(8, 7) == flops(compare=9)


@pytest.mark.slow
@many(40)
@given(st.sampled_from([name for name in SOLVERS if not name.endswith("-n9")]), batches())
def test_counting_changes_no_result(name, case):
    inputs, mask, weights, _ = case
    plain = SOLVERS[name](*inputs, weights=weights, mask=mask)
    with OperationCounter() as counter:
        counted = SOLVERS[name](*inputs, weights=weights, mask=mask)
    assert (len(inputs[0]) > 0) <= counter.total < math.inf
    assert all(map(torch.equal, iter_tensors(counted), iter_tensors(plain)))
