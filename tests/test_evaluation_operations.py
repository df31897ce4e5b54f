"""The formulas of the operation counts against instrumented runs, part by part."""

from __future__ import annotations

import json
from dataclasses import asdict

import pytest
import torch
from kornia.core.exceptions import ValueCheckError

from kornia_pnpnet import Normalize, PnPNet, RobustWeightedLM, create_solver
from kornia_pnpnet.evaluation.operations import (
    OPERATION_COSTS,
    PARTS,
    SOLVERS,
    Operations,
    complexity_results,
    count_per_problem,
    operation_count,
    operations_by_part,
    part_calls,
)
from kornia_pnpnet.init import P3P, RANSAC, EPnP, MLPInit, SetInit, SubsetSolver
from kornia_pnpnet.init.ransac.search import Search

SIZES = (6, 9, 20, 50)
#: No pair is ever within the threshold: RANSAC draws all its samples.
ENDLESS = {"threshold": 1e-9}
JUDGE = {"m": 0, "robustness": 0.0, "learnable": False}


@pytest.fixture
def measure(make_problems, monkeypatch):
    """Operations of a solver by parts in a run on copies of one problem, and how many rounds of RANSAC were better."""
    improved = []
    improve = Search._improve

    def counted(search, problems, *arguments):
        improved.append(len(problems) > 0)
        return improve(search, problems, *arguments)

    monkeypatch.setattr(Search, "_improve", counted)
    monkeypatch.setattr("kornia_pnpnet.init.ransac.search._VECTOR", 1)

    def run(solver, n, **options):
        problems = make_problems(n, 1, **options)
        improved.clear()
        counts = count_per_problem(
            lambda batch: solver(*(x.expand(batch, *x.shape[1:]) for x in problems[:3])), list(PARTS)
        )
        return counts, sum(improved) // 2  # two batches

    return run


def differences(solver, measure, sizes=SIZES, outliers=None):
    """What the formulas say otherwise, in words: one line for each part and kind, with all n beside each other."""
    wrong = {}
    for n in sizes:
        options = {} if outliers is None else {"outliers": outliers(n), "noise": False}
        measured, better = measure(solver, n, **options)
        calls = [call for call in part_calls(solver, n, outliers=options.get("outliers"), better=better) if call[1]]
        formula = operations_by_part(solver, n, outliers=options.get("outliers"), better=better)
        for part in sorted(measured.keys() | formula.keys()):
            ran, said = (asdict(counts.get(part, Operations())) for counts in (measured, formula))
            alike = {call[2] for call in calls if call[0] == part}
            times = sum(call[1] for call in calls if call[0] == part) if len(alike) == 1 else 1
            where = f"{part or 'outside of all parts'}, {'each of its calls' if len(alike) == 1 else 'all its calls'}"
            for kind in ran:
                wrong.setdefault((where, kind), []).append((n, ran[kind] / times, said[kind] / times))
    return "\n".join(
        f"{where}, {kind}: " + "; ".join(f"n = {n}: runs {ran:g}, formula says {said:g}" for n, ran, said in places)
        for (where, kind), places in wrong.items()
        if any(ran != pytest.approx(said, rel=1e-9, abs=1e-6) for _, ran, said in places)
    )


@pytest.mark.parametrize("kernel", ["power", "geman_mcclure"])
@pytest.mark.parametrize(("m", "views"), [(0, 1), (1, 1), (5, 1), (0, 3), (1, 2), (4, 2), (5, 8)])
def test_networks_cost_what_the_formulas_say(m, views, kernel, measure):
    for n in SIZES:
        refine = RobustWeightedLM(m, kernel=kernel)
        wrong = differences(PnPNet(MLPInit(n), refine, views=views), measure, sizes=[n])
        assert not wrong, wrong


@pytest.mark.parametrize(
    ("init", "refine"),
    [
        ({}, {"by_residual": 2}),
        ({}, {"by_residual": 9, "m": 1}),
        ({"samples": 0}, {}),
        ({"samples": 8}, {"m": 0}),
        ({"samples": 0, "starts": 1}, {"kernel": "power", "by_residual": 1}),
        ({"width": 12, "layers": 2, "heads": 3, "hidden": 20, "starts": 2, "samples": 3}, {"m": 2}),
    ],
)
def test_set_networks_cost_what_the_formulas_say(init, refine, measure):
    solver = PnPNet(SetInit(**init), RobustWeightedLM(**{"m": 5, "kernel": "geman_mcclure", **refine}), Normalize())
    wrong = differences(solver, measure, sizes=(4, 9, 17, 18, 40))
    assert not wrong, wrong


def test_iterations_by_residual_cost_what_the_formulas_say(measure):
    wrong = differences(PnPNet(EPnP(), RobustWeightedLM(by_residual=2)), measure)
    assert not wrong, wrong


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("identity-lm", {}),
        ("epnp", {}),
        ("epnp", {"iterations": 2}),
        ("epnp-lm", {}),
        ("epnp-lm", {"m": 3}),
        ("reppnp", {}),
        ("reppnp", {"reject_outliers": False}),
        ("reppnp", {"null_iterations": 1, "rigid_iterations": 2, "refine_iterations": 1}),
        ("reppnp-lm", {}),
        ("p3p-ransac", ENDLESS),
        ("p3p-ransac", {**ENDLESS, "scorer": "inliers", "max_samples": 40}),
        ("p3p-ransac", {**ENDLESS, "local_candidates": 1, "local_iterations": 3, "max_samples": 70}),
        ("p3p-ransac", {"threshold": 1.0, "confidence": 1 - 1e-15, "max_samples": 300}),
    ],
)
def test_solvers_cost_what_the_formulas_say(name, options, measure):
    wrong = differences(create_solver(name, **options), measure)
    assert not wrong, wrong


@pytest.mark.parametrize(("options", "sizes"), [({}, (7, 9)), ({"max_samples": 33}, (11, 20))])
def test_ransac_on_subsets_costs_what_the_formulas_say(options, sizes, measure):
    wrong = differences(create_solver("ransac-epnp-lm", **ENDLESS, **options), measure, sizes)
    assert not wrong, wrong


def test_subsets_may_be_solved_by_a_network(measure):
    ransac = RANSAC(SubsetSolver(MLPInit(7), size=7), **ENDLESS, max_samples=40)
    wrong = differences(PnPNet(ransac, RobustWeightedLM(**JUDGE)), measure, sizes=(9, 20))
    assert not wrong, wrong


def test_ransac_stops_where_the_formula_says(measure):
    """Without noise the first round finds the inliers, and the rule is the formula's."""
    solver = create_solver("p3p-ransac", confidence=0.999999)
    wrong = differences(solver, measure, outliers=lambda n: n // 2)
    assert not wrong, wrong
    assert operation_count(solver, 50, outliers=25) < 0.3 * operation_count(solver, 50)
    few = [operation_count(solver, 50, outliers=k) for k in range(0, 50, 5)]
    assert few == sorted(few)
    assert few[0] < few[5] < few[-1] == operation_count(solver, 50)


def test_the_check_can_fail(measure, monkeypatch):
    monkeypatch.setitem(PARTS, "geometry.project", lambda n: n * Operations(14, 25, 1, compare=3, logic=1))
    wrong = differences(create_solver("identity-lm", m=1), measure, sizes=(6, 9)).splitlines()
    assert wrong == [
        "geometry.project, each of its calls, multiply: "
        "n = 6: runs 144, formula says 150; n = 9: runs 216, formula says 225"
    ]


@pytest.mark.parametrize("n", SIZES)
def test_a_network_multiplies_once_for_each_weight(n):
    network = MLPInit(n)
    weights = sum(p.numel() for name, p in network.named_parameters() if name.endswith("weight"))
    operations = PARTS["mlp.MLPInit.forward"](n)
    rest = operations.multiply - weights
    assert 0 < rest < 60
    assert rest == PARTS["mlp.MLPInit.forward"](3).multiply - sum(
        p.numel() for name, p in MLPInit(3).named_parameters() if name.endswith("weight")
    )


def test_an_iteration_costs_the_same_each_time():
    counts = [operation_count(f"identity-lm:m={m}", 9) for m in (1, 2, 3, 30)]
    iteration = counts[1] - counts[0]
    assert counts[2] - counts[1] == pytest.approx(iteration)
    assert counts[3] - counts[2] == pytest.approx(27 * iteration)


def test_results_are_plain_data_with_a_count_for_each_n():
    results = complexity_results(n=range(6, 51, 4))
    assert json.loads(json.dumps(results, allow_nan=False)) == results
    assert (results["kind"], results["format"]) == ("complexity", 1)
    assert results["n"] == list(range(6, 51, 4))
    assert results["outliers"] == [n // 3 for n in results["n"]]
    assert results["costs"] == OPERATION_COSTS
    assert list(results["counts"]) == list(SOLVERS)
    assert results["ransac"] == ["p3p-ransac", "ransac-epnp-lm"] == list(results["all_samples"])
    for name, counts in results["counts"].items():
        assert len(counts) == len(results["n"])
        missing = [n for n, count in zip(results["n"], counts, strict=True) if count is None]
        assert missing == ([6] if name == "ransac-epnp-lm" else [])
        if name in results["ransac"]:
            pairs = zip(counts, results["all_samples"][name], strict=True)
            assert all(count <= most for count, most in pairs if count is not None)
        else:
            assert counts == sorted(counts)
    assert results["counts"]["net"][1] == operation_count("net", 10)
    assert results["counts"]["p3p-ransac"][-1] == operation_count("p3p-ransac", 50, outliers=16)


def test_other_shares_of_outliers_and_other_solvers():
    results = complexity_results(["p3p-ransac:confidence=0.99"], [9, 30], outlier_share=0.6)
    assert results["outliers"] == [5, 18]
    solver = create_solver("p3p-ransac", confidence=0.99)
    assert results["counts"] == {
        "p3p-ransac:confidence=0.99": [operation_count(solver, 9, outliers=5), operation_count(solver, 30, outliers=18)]
    }


@pytest.mark.parametrize(
    ("solver", "message"),
    [
        (PnPNet(None, RobustWeightedLM(update="additive")), "retraction"),
        (PnPNet(None, RobustWeightedLM(reject_worse=True)), "rejection"),
        (PnPNet(None, RobustWeightedLM(kernel="huber")), "another kernel"),
        (PnPNet(torch.nn.Identity(), RobustWeightedLM()), "Identity"),
        (PnPNet(RANSAC(P3P()), RobustWeightedLM()), "Samples of 3"),
        (PnPNet(RANSAC(P3P(), scorer=torch.sqrt), RobustWeightedLM()), "sqrt"),
        (PnPNet(RANSAC(SubsetSolver(torch.nn.Identity(), size=3)), RobustWeightedLM()), "Samples of 3"),
        (PnPNet(None, RobustWeightedLM(), Normalize(scale=False)), "scale=False"),
        ("opencv-sqpnp", "opencv-sqpnp"),
        ("known-inliers", "known-inliers"),
    ],
)
def test_without_a_formula_there_is_no_count(solver, message):
    if solver == "opencv-sqpnp":
        pytest.importorskip("cv2")
    with pytest.raises(ValueCheckError, match=message):
        operation_count(solver, 2)
