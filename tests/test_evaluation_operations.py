"""Operation counts of solvers: what a count depends on, and the results file of figure 1."""

from __future__ import annotations

import json

import pytest
import torch
from kornia.core.exceptions import ShapeError, ValueCheckError

from kornia_pnpnet import PnPNet, RobustWeightedLM, create_solver
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.evaluation.operations import (
    OPERATION_COSTS,
    complexity_results,
    count_per_problem,
    operation_count,
)
from kornia_pnpnet.propose.mlp import MLPInit


@pytest.mark.parametrize("n", [6, 20])
def test_a_network_costs_a_product_and_a_sum_for_each_weight(n):
    network = MLPInit(n)
    weights = sum(p.numel() for name, p in network.named_parameters() if name.endswith("weight"))
    alone = operation_count(PnPNet(network, RobustWeightedLM(0)), n) - operation_count("identity-lm:m=0", n)
    # Beside its layers' products and sums: scales of the input, ReLU, and one rotation.
    assert 2 * weights < alone < 2 * weights + 150 * n


@pytest.mark.parametrize("name", ["identity-lm", "epnp-lm", "reppnp-lm", "pnpnet-set:effort=fixed", "pnpnet-n9"])
def test_counts_do_not_depend_on_the_data(name, make_problems):
    solver = load_solver(name)

    def count(problems):
        inputs = problems.world_points, problems.img_points, problems.intrinsics
        return count_per_problem(lambda batch: solver(*(part[:batch] for part in inputs)))

    counts = [count(make_problems(n=9, batch=4, outliers=k, noise=k > 0, seed=k)) for k in (0, 3)]
    assert counts[0] == counts[1]
    assert counts[0] == operation_count(name, 9)


def test_an_iteration_costs_the_same_each_time():
    counts = [operation_count(f"identity-lm:m={m}", 9) for m in (1, 2, 3, 30)]
    iteration = counts[1] - counts[0]
    assert counts[2] - counts[1] == pytest.approx(iteration)
    assert counts[3] - counts[2] == pytest.approx(27 * iteration)


def test_ransac_draws_more_samples_with_more_outliers_and_more_confidence():
    solver = create_solver("p3p-ransac")
    counts = [operation_count(solver, 30, outliers=k) for k in (12, 15, 18)]  # with fewer the smallest number suffices
    assert counts == sorted(counts)
    assert counts[0] < 0.5 * counts[-1]
    assert operation_count("p3p-ransac:confidence=0.9", 30, outliers=18) < 0.8 * counts[-1]


def test_results_are_plain_data_with_a_count_for_each_n():
    sizes, names = [6, 9], ["net", "epnp", "p3p-ransac", "ransac-epnp-lm"]
    results = complexity_results(names, sizes)
    assert json.loads(json.dumps(results, allow_nan=False)) == results
    assert (results["kind"], results["format"]) == ("complexity", 1)
    assert (results["n"], results["outliers"], results["costs"]) == (sizes, [2, 3], OPERATION_COSTS)
    assert list(results["counts"]) == names
    assert results["ransac"] == names[2:]
    for name, counts in results["counts"].items():
        assert len(counts) == len(sizes)
        missing = [n for n, count in zip(sizes, counts, strict=True) if count is None]
        assert missing == ([6] if name == "ransac-epnp-lm" else [])  # its samples have 7 pairs
        assert name in results["ransac"] or counts == sorted(counts)
    assert results["counts"]["net"][1] == operation_count("net-n9", 9) == operation_count("net", 9)
    assert results["counts"]["p3p-ransac"][-1] == operation_count("p3p-ransac", 9, outliers=3)


def test_other_shares_of_outliers_and_other_solvers():
    name = "p3p-ransac:confidence=0.99"
    results = complexity_results([name], [9, 12], outlier_share=0.6)
    assert results["outliers"] == [5, 7]
    assert results["counts"] == {name: [operation_count(name, 9, outliers=5), operation_count(name, 12, outliers=7)]}


@pytest.mark.parametrize("name", ["opencv-sqpnp", "known-inliers"])
def test_solvers_outside_of_pytorch_have_no_count(name):
    if name == "opencv-sqpnp":
        pytest.importorskip("cv2")
    with pytest.raises(ValueCheckError, match=name):
        operation_count(name, 9)


def test_a_number_of_pairs_that_the_solver_does_not_take_is_an_error():
    with pytest.raises(ShapeError):
        operation_count("net-n9", 10)
    with pytest.raises(ShapeError):
        operation_count(PnPNet(torch.nn.Identity()), 2)
