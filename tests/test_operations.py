"""Operation counts: the cost of each PyTorch operation, and what the count of a solver depends on."""

import json
import math

import pytest
import torch
from kornia.core.exceptions import ShapeError, ValueCheckError
from operations import (
    OPERATION_COSTS,
    OperationCounter,
    cholesky,
    complexity_results,
    count_per_problem,
    matmul,
    operation_count,
    solve,
)

from kornia_pnpnet import PnPNet, RobustWeightedLM, create_solver
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.propose.mlp import MLPInit


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
        (lambda x: 3 - x, flops(add=12)),
        (lambda x: torch.add(x, x, alpha=3), flops(add=12, multiply=12)),
        (lambda x: x[:, None] * x[None], flops(multiply=3 * 3 * 4)),
        (lambda x: x.rsqrt(), flops(sqrt=12, divide=12)),
        (lambda x: x.exp_(), flops(exp=12)),
        (lambda x: x.sin() + x.log(), flops(log=24, add=12)),
        (lambda x: x.abs() > 1, flops(compare=36)),
        (lambda x: x.clamp(min=0, max=1), flops(compare=24)),
        (lambda x: torch.where(x > 1, x, 0.0), flops(compare=12, logic=12)),
        (lambda x: torch.addcmul(x, x, x, value=2), flops(add=12, multiply=24)),
        (lambda x: x**5, flops(multiply=36)),  # x² twice, times x
        (lambda x: x**-2, flops(multiply=12, divide=12)),
        (lambda x: x**1.5, flops(sqrt=12, multiply=12)),
        (lambda x: x**0.3, flops(exp=12, log=12, multiply=12)),
        (lambda x: x.mean(-1), flops(add=9, divide=3)),
        (lambda x: x.cumsum(-1), flops(add=9)),
        (lambda x: x.min(-1), flops(compare=9)),
        (lambda x: torch.linalg.vector_norm(x, dim=(0, 1)), flops(add=11, multiply=12, sqrt=1)),
        (lambda x: x.softmax(-1), flops(add=12 + 9, divide=12, exp=12, compare=9)),
        (
            lambda x: torch.nn.functional.layer_norm(x, (4,), x[0], x[1]),  # sums, differences, squares
            3 * flops(add=3 + 4 + 3 + 1 + 4, multiply=4 + 4 + 4, divide=3, sqrt=1),
        ),
        (lambda x: (x > 0).all(-1), flops(compare=12, logic=9)),
        (lambda x: x.sort(0), flops(compare=4 * 3 * math.log2(3))),
        (lambda x: x.topk(2), flops(compare=3 * (6 + 2))),
        (lambda x: x.topk(2, sorted=False), flops(compare=3 * 6)),
        (lambda x: x.kthvalue(3), flops(compare=3 * 5)),
        (lambda x: x.nanmedian(-1), flops(compare=3 * (4 + 6))),
        (lambda x: (-x).T.reshape(2, 6).flip(0).clone()[:, [0, 1]], 0),
    ],
)
def test_cost_of_an_operation(function, expected):
    assert count(function, (3, 4)) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("function", "shapes", "expected"),
    [
        (lambda a, b: a @ b, [(5, 6, 2, 3), (6, 3, 4)], 30 * matmul(2, 3, 4)),
        (torch.nn.functional.linear, [(5, 3), (4, 3), (4,)], 5 * flops(multiply=12, add=12)),
        (torch.cdist, [(5, 2, 3), (5, 4, 3)], 40 * flops(add=3 + 2, multiply=3, sqrt=1)),
        (torch.linalg.inv_ex, [(5, 4, 4)], 5 * solve(4, 4)),
        (torch.linalg.cholesky_ex, [(5, 4, 4)], 5 * cholesky(4)),
    ],
)
def test_cost_of_linear_algebra(function, shapes, expected):
    assert count(function, *shapes) == expected


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_costs_of_factorisations_are_those_of_the_loops_of_the_textbook(n):
    eliminate = sum((n - k - 1) ** 2 for k in range(n))
    pairs = n * (n - 1) // 2
    triangular = flops(add=2 * pairs, multiply=2 * pairs, divide=n)
    assert solve(n, 1) == flops(add=eliminate, multiply=eliminate, divide=pairs, compare=pairs) + triangular
    inner = sum(j for j in range(n) for _ in range(j, n))  # Cholesky by columns
    assert cholesky(n) == pytest.approx(flops(add=inner, multiply=inner, divide=pairs, sqrt=n))


def test_an_operation_without_a_known_cost_is_an_error():
    with pytest.raises(NotImplementedError, match=r"aten\.erfc"):
        count(lambda x: x.erfc(), (3,))


@pytest.mark.parametrize("batch", [2, 5])
def test_operations_shared_by_the_batch_are_not_counted(batch):
    table = torch.rand(5, 5)
    cost = count_per_problem(lambda size: torch.rand(size, 5) @ (table @ table).exp() + table.sum(), batch)
    assert cost == pytest.approx(flops(add=5 * 4 + 5, multiply=5 * 5))


# -- solvers -----------------------------------------------------------------------------------------------------------


def test_a_network_costs_a_product_and_a_sum_for_each_weight():
    network = MLPInit(20)
    weights = sum(p.numel() for name, p in network.named_parameters() if name.endswith("weight"))
    alone = operation_count(PnPNet(network, RobustWeightedLM(0)), 20) - operation_count("identity-lm:m=0", 20)
    # Beside its layers' products and sums: scales of the input, ReLU, and one rotation.
    assert 2 * weights < alone < 2 * weights + 150 * 20


@pytest.mark.parametrize(
    "name", [f"{name}:effort=fixed" for name in ("epnp-lm", "reppnp-lm", "pnpnet-set", "pnpnet-n9")]
)
def test_counts_do_not_depend_on_the_data(name, make_problems):
    solver = load_solver(name)
    for outliers in (0, 3):
        # In batches as large as those of `operation_count`: small ones are solved by LAPACK.
        inputs = make_problems(n=9, batch=128, outliers=outliers, noise=outliers > 0, seed=outliers)[:3]
        counted = count_per_problem(lambda batch, inputs=inputs: solver(*(part[:batch] for part in inputs)), 64)
        assert counted == operation_count(name, 9)


def test_an_iteration_costs_the_same_each_time():
    counts = [operation_count(f"identity-lm:m={m}", 9) for m in (1, 2, 30)]
    assert counts[2] - counts[1] == pytest.approx(28 * (counts[1] - counts[0]))


def test_ransac_draws_more_samples_with_more_outliers_and_more_confidence():
    solver = create_solver("p3p-ransac")
    counts = [operation_count(solver, 30, outliers=k) for k in (12, 15, 18)]  # with fewer the smallest number suffices
    assert counts == sorted(counts)
    assert counts[0] < 0.5 * counts[-1]
    assert operation_count("p3p-ransac:confidence=0.9", 30, outliers=18) < 0.8 * counts[-1]


def test_results_are_plain_data_with_a_count_for_each_n():
    sizes, names = [6, 9, 12], ["net", "epnp", "p3p-ransac", "ransac-epnp-lm"]
    results = complexity_results(names, sizes)
    assert json.loads(json.dumps(results, allow_nan=False)) == results
    assert (results["n"], results["outliers"], results["ransac"]) == (sizes, [2, 3, 4], names[2:])
    counts = results["counts"]
    assert [name for name in names if None in counts[name]] == ["ransac-epnp-lm"]  # its samples have 7 pairs
    assert counts["net"][1] == operation_count("net-n9", 9) == operation_count("net", 9)
    assert counts["p3p-ransac"][1] == operation_count("p3p-ransac", 9, outliers=3)


def test_what_cannot_be_counted_is_an_error():
    with pytest.raises(ValueCheckError, match="known-inliers"):
        operation_count("known-inliers", 9)
    with pytest.raises(ShapeError):
        operation_count("net-n9", 10)
