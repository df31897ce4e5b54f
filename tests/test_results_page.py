"""Pictures show the data of their arguments; the results page follows from its files; operations are counted."""

import itertools
import json
import math

import numpy as np
import operations
import pytest
import torch
from kornia.core.exceptions import ShapeError, ValueCheckError
from operations import OPERATION_COSTS, OperationCounter, complexity_results, count_per_problem, operation_count

pytest.importorskip("matplotlib")
pytest.importorskip("pandas")

import figures
import matches
import matplotlib as mpl
import pandas as pd
from matplotlib import pyplot
from rates import Rates, compare_all, compared

from kornia_pnpnet import MLPInit, PnPNet, RobustWeightedLM, create_solver, success_rate
from kornia_pnpnet.core.environment import BEHAVIOUR
from kornia_pnpnet.data import SyntheticProblems
from kornia_pnpnet.evaluation import EvaluationData, evaluate, plots


@pytest.fixture(scope="module")
def results():
    sets = {f"set {i}": EvaluationData(SyntheticProblems(batch_size=20, seed=i).batch(0)) for i in range(5)}
    return evaluate({name: create_solver(name) for name in ("epnp", "reppnp", "epnp-lm")}, sets, repeats=1)


@pytest.mark.parametrize("plot", [plots.plot_success, plots.plot_errors])
def test_a_file_is_written_and_global_state_stays(tmp_path, results, plot):
    before = dict(mpl.rcParams)
    assert plot(tmp_path / "new" / "a.png", results).read_bytes().startswith(b"\x89PNG")
    assert dict(mpl.rcParams) == before
    assert not pyplot.get_fignums()
    with pytest.raises(ValueError, match="no rows"):
        plot(tmp_path / "b.png", {**results, "rows": []})


def test_every_set_has_a_panel_with_a_dot_for_each_of_its_solvers(tmp_path, results, drawn):
    rows = results["rows"][:-1]
    plots.plot_success(tmp_path / "a.png", {**results, "rows": rows})
    assert len(drawn["a.png"].axes) == 5
    for axes, name in zip(drawn["a.png"].axes, results["data"], strict=True):
        dots = {dot.get_label(): dot.lines[0].get_xdata()[0] for dot in axes.containers}
        rates = {row["solver"]: 100 * row["success"]["rate"] for row in rows if row["data"] == name}
        assert dots == pytest.approx(rates)


def test_error_curves_are_the_shares_of_the_errors(tmp_path, results, drawn):
    plots.plot_errors(tmp_path / "a.png", results)
    (curve,) = (line for line in drawn["a.png"].axes[0].lines if line.get_label() == "reppnp")
    errors = np.array(results["rows"][1]["per_problem"]["rotation_error_deg"])
    at, share = (np.asarray(values, dtype=float) for values in curve.get_data())
    for limit in np.quantile(errors, (0.1, 0.5, 0.9)):
        assert share[at <= limit].max(initial=0.0) == pytest.approx((errors <= limit).mean())


def test_pose_picture_marks_rejected_pairs_and_takes_points_behind_the_camera(tmp_path, drawn):
    img = torch.from_numpy(np.random.default_rng(1).uniform((0, 0), (640, 480), (9, 2)))
    projected, rejected = img + 1.0, torch.arange(9) == 2
    projected[4], projected[5], img[6] = torch.nan, 1e12, torch.nan
    plots.plot_pose(tmp_path / "a.png", img, projected, rejected, "$\\frac{")
    (axes,) = drawn["a.png"].axes
    assert [len(line.get_xdata()) for line in axes.lines] == [7, 1, 7]  # kept, rejected, projected
    assert abs(np.diff(axes.get_xlim())[0]) < 1100
    with pytest.raises(ValueError, match="no pixel"):
        plots.plot_pose(tmp_path / "c.png", img * torch.nan, projected, rejected, "")


def test_training_picture_reads_the_history(tmp_path, drawn):
    header = "update,total,init_rotation,init_translation,refined_rotation,refined_translation"
    rows = [f"{i},{2 / i},{1 / i},{9 / i},nan,{4 / i},{'' if i % 2 else 0.1 * i}" for i in range(1, 9)]
    history = tmp_path / "a.csv"
    history.write_text("\n".join([f"{header},val/none/success", *rows]) + "\n")
    plots.plot_training(tmp_path / "a.png", history)
    loss, success, *_ = drawn["a.png"].axes
    assert loss.lines[0].get_ydata() == pytest.approx([2 / i for i in range(1, 9)])
    assert pytest.approx(np.array([[i, 0.1 * i] for i in (2, 4, 6, 8)])) == np.array(success.lines[0].get_data()).T
    for text, message in (("", "header"), (header, "no rows"), ("update\n1", "total")):
        history.write_text(text)
        with pytest.raises(ValueError, match=message):
            plots.plot_training(tmp_path / "a.png", history)


def results_of(rows):
    """A results file from (source, outliers, n, solver, solved of 100) and optionally m and the mismatch share."""
    file = {"solvers": {}, "data": {}, "rows": []}
    for source, outliers, n, solver, solved, *more in rows:
        m, share = (*more, *(None, 0.5)[len(more) :])
        data = f"{source} {outliers} {n} {share}"
        description = {"source": source, "outliers": outliers, "mismatch_share": share}
        file["data"][data] = {"description": description, "n": n, "unit": ""}
        file["data"][data] |= {"max_rotation_deg": 1.0, "max_translation": 0.2}
        file["solvers"][solver] = {"class": "PnPNet", "config": {"init": None, "refine": m and {"m": m}}}
        success = success_rate(torch.arange(100) < solved)._asdict()
        file["rows"].append({"data": data, "solver": solver, "success": success, "us_per_problem": 5.0 + (m or 0)})
    return file


@pytest.fixture
def draw(tmp_path, drawn):
    """The panels of the figure whose name begins so: places and values by solver."""

    def panels(start, *rows):
        drawn.clear()
        figures.paper_figures([results_of(file) for file in rows], tmp_path)
        (figure,) = (figure for name, figure in drawn.items() if name.startswith(start))
        return [
            {b.get_label(): np.array(b.lines[0].get_data(), dtype=float).T.round(6).tolist() for b in axes.containers}
            for axes in figure.axes
        ]

    return panels


def test_dots_stand_in_their_rows_at_their_rates(draw, drawn):
    solved = {"none": {"pnpnet-n9": 84, "reppnp": 56, "known-inliers": 85}, "uniform": {"pnpnet-n9": 100, "epnp": 0}}
    rows = [("paper", k, 9, name, count) for k in solved for name, count in solved[k].items()]
    rows.append(("paper", "none", 9, "reppnp:m=2", 1, 2))  # a point of a curve against m
    panels = draw("figure2", rows)
    axes = drawn["figure2_paper.png"].axes
    names = [label.get_text() for label in axes[0].get_yticklabels()]
    assert names == ["pnpnet-n9", "epnp", "reppnp", "known-inliers"]
    assert [{names[int(y)]: x for [(x, y)] in panel.values()} for panel in panels] == list(solved.values())
    low, high = axes[0].containers[0].lines[2][0].get_segments()[0][:, 0]
    rate = success_rate(torch.arange(100) < 84)
    assert [low, high] == pytest.approx([100 * rate.low, 100 * rate.high])


def test_scenes_are_pooled_over_all_their_problems(draw):
    rows = [("a", "none", 9, "epnp", 30), ("b", "none", 9, "epnp", 10), ("a", "none", 9, "mine", 1)]
    rows += [("a", 2, 9, "epnp", 5), ("a", 3, 9, "epnp", 7)]
    panels = draw("figure4", rows)
    pooled, first, _, spoilt = ({name: [round(x) for x, _ in dots] for name, dots in panel.items()} for panel in panels)
    assert pooled == {"epnp": [20]}  # the other solver solved one scene only
    assert first == {"epnp": [30], "mine": [1]}
    assert spoilt == {"epnp": [5]}


def test_mismatches_against_their_number(draw):
    mixed = [("a", k or "none", 9, "epnp", 50 - k) for k in range(3)]
    alone = [(scene, k or "none", 9, "epnp", 80 - k, None, 1.0) for k in range(3) for scene in ("a", "b")]
    alone += [("c", 2, 9, "epnp", 100, None, 1.0), ("a", 2, 20, "epnp", 50, None, 1.0), ("a", 1, 9, "p", 1, None, 1.0)]
    for files in ((mixed, alone), (alone, mixed)):
        (panel,) = draw("figure5", *files)
        assert panel.keys() == {"epnp"}
        assert panel["epnp"][1:] == [[1, 79], [2, 78]]
    draw("figure5", mixed)  # without sets of mismatches only


def test_solvers_for_one_n_each_share_a_curve(draw):
    rows = [("paper", "none", n, f"pnpnet-n{n}", n) for n in (6, 9, 20)]
    rows += [("paper", outliers, n, "epnp", 2 * n) for outliers in ("none", "uniform") for n in (6, 9, 20)]
    rows += [("paper", "uniform", 9, "pnpnet-n9", 7), ("paper", 3, 9, "epnp", 1)]
    none, uniform = draw("success_against_n", rows)
    assert none["pnpnet-n*"] == [[n, n] for n in (6, 9, 20)]
    assert none["epnp"] == uniform["epnp"] == [[n, 2 * n] for n in (6, 9, 20)]
    assert uniform["pnpnet-n*"] == [[9, 7]]


def test_m_is_read_from_the_configuration(draw):
    names = (("epnp-lm:m=3,x=1", 3), ("epnp-lm:x=1", 9), ("epnp-lm:x=1,m=1", 1), ("identity-lm", 8))
    rows = [("paper", k, 9, name, 10 * m, m) for k in ("none", "uniform") for name, m in names]
    *panels, time = draw("success_against_m", [*rows, ("paper", 3, 9, "epnp-lm", 1, 9)])
    assert panels == 2 * [{"epnp-lm:x=1": [[m, 10 * m] for m in (1, 3, 9)]}]
    assert time == {"epnp-lm:x=1": [[1, 6], [3, 8], [9, 14]]}


def test_more_problems_count_then_the_last_file(tmp_path, drawn):
    one, more, last = (results_of([("paper", "none", 9, "epnp", solved)]) for solved in (90, 50, 25))
    more["rows"][0]["success"]["total"] = last["rows"][0]["success"]["total"] = 200
    for files, rate in (((one, more), 50), ((more, one), 50), ((more, last), 25)):
        figures.paper_figures(files, tmp_path)
        (dot,) = drawn["figure2_paper.png"].axes[0].containers
        assert dot.lines[0].get_xdata() == pytest.approx([rate])


def test_figures_without_data_are_left_out(tmp_path, drawn):
    def names(*results):
        return [path.name.partition("_")[0] for path in figures.paper_figures(results, tmp_path)]

    counted = {"epnp": [10, 20, None], "p3p-ransac": [1, 2, 3]}
    counts = {"kind": "complexity", "n": [6, 9, 50], "counts": counted, "ransac": ["p3p-ransac"]}
    one = results_of([("paper", "none", 9, "epnp", 5)])
    assert names(one, counts) == ["figure1", "figure2"]
    assert names(results_of([("gaussian_pose", "uniform", 20, "epnp", 5)])) == ["figure3"]
    assert names(one, results_of([("paper", "none", 6, "epnp", 5)])) == ["figure2", "success"]
    unnamed = results_of([("paper", None, 9, "epnp", 5)])
    for nothing in ([], [results_of([])], [unnamed], [counts] * 2):
        with pytest.raises(ValueError, match=r"results|counts"):
            figures.paper_figures(nothing, tmp_path)


def test_texts_stay_on_the_page_and_odd_names_are_written(tmp_path, drawn):
    names = ("pnpnet-n9", r"$\frac{a$", "_hidden", "x" * 60, "with space", "ünïcode", "a:b=$1,m2=3", "known-inliers")
    rows = [("paper", k, n, name, 50) for k in ("none", "uniform", 3) for n in (6, 9) for name in names]
    rows += [(scene, k or "none", 9, name, 50) for scene in (r"$\frac{$", "a/b") for k in range(4) for name in names]
    counts = {"n": [6, 9], "counts": {name: [1, 2] for name in names}, "ransac": [], "kind": "complexity"}
    figures.paper_figures([results_of(rows), counts], tmp_path)
    for figure in drawn.values():
        box = figure.get_tightbbox()
        assert (box.min >= 0).all()
        assert (box.max <= figure.get_size_inches()).all()


def test_reliability_picture_leaves_empty_ranges_out(tmp_path, drawn):
    curve = {"number": [3.0, 0.0, 5.0], "predicted": [0.1, 0.5, 0.9], "observed": [0.2, 1.0, 0.7]}
    figures.plot_reliability(tmp_path / "a.png", {f"curve {i}": curve for i in range(11)})
    chance, share = drawn["a.png"].axes
    assert np.array(chance.lines[-1].get_data()).tolist() == [[0.1, 0.9], [0.2, 0.7]]
    assert share.lines[-1].get_ydata().tolist() == pytest.approx([37.5, 62.5])


@pytest.mark.parametrize("against", ["model.n", "model.m", "optim.lr"])
def test_sweep_picture_shows_success_and_time(tmp_path, drawn, against):
    values = {"optim.lr": (0.33, 0.001), "model.n": (9, 6), "model.m": (10, 2)}
    runs = pd.DataFrame(itertools.product(*values.values()), columns=list(values))
    rate = runs["model.n"] / 100 + runs["model.m"] / 1000 + runs["optim.lr"] / 10  # identifies the run
    runs = runs.assign(progress=[True, False] * 4, loss="pose", update=2000, us_per_problem=10_000 * rate)
    runs = runs.assign(**{"any/rate": rate, "any/low": rate - 0.01, "any/high": rate + 0.01})
    runs.to_csv(tmp_path / "a.csv", index=False)
    figures.plot_sweep(tmp_path / "a.png", tmp_path / "a.csv", against=against, data="any")
    panel, line = (name for name in values if name != against)
    for i, in_panel in enumerate(sorted(values[panel])):
        part = runs[runs[panel] == in_panel].sort_values([line, against])
        rates, times = drawn["a.png"].axes[i], drawn["a.png"].axes[2 + i]
        for bars, (_, expected) in zip(rates.containers, part.groupby(line), strict=True):
            points = expected[against].tolist(), (100 * expected["any/rate"]).tolist()
            assert np.array(bars.lines[0].get_data()) == pytest.approx(np.array(points))
        (time,) = times.containers
        assert list(time.lines[0].get_ydata()) == pytest.approx(part.groupby(against).us_per_problem.min().tolist())
    for wrong in ({"against": "loss"}, {"against": "progress"}, {"data": "uniform"}):
        with pytest.raises(ValueError, match="to draw"):
            figures.plot_sweep(tmp_path / "a.png", tmp_path / "a.csv", **{"against": against, "data": "any", **wrong})
    runs.assign(**{"model.m": 2}).to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(ValueError, match="several runs"):
        figures.plot_sweep(tmp_path / "a.png", tmp_path / "a.csv", against="model.n", data="any")


def test_the_pages_are_rendered_from_their_files():
    for path, text in pytest.importorskip("render").pages().items():
        assert text == path.read_text(encoding="utf-8")


def test_a_file_that_another_step_writes_is_refused(monkeypatch):
    monkeypatch.setattr("sys.argv", ["make.py", "measure", "--only", "distribution"])
    with pytest.raises(SystemExit, match="2"):
        pytest.importorskip("make").main()


def test_no_results_file_is_older_than_one_change_of_behaviour():
    render = pytest.importorskip("render")
    folders = render.HERE, render.REPOSITORY / "benchmarks", render.REPOSITORY / "docs" / "examples"
    found = {path.name: json.loads(path.read_bytes()) for folder in folders for path in folder.glob("*.json")}
    made = {name: (x if "environment" in x else x["throughput"])["environment"] for name, x in found.items()}
    assert {"solvers.json", "paper.json", "gpu.json"} <= made.keys()
    assert [name for name, x in found.items() if '": "/' in json.dumps(x)] == []  # no folder of a machine
    late = {"gpu.json": 7}  # no GPU was at hand after change 1
    assert [name for name, x in made.items() if BEHAVIOUR - x.get("behaviour", 0) > late.get(name, 1)] == []


def test_kinds_of_matches_are_summed_by_the_number_of_problems():
    solvers = {"pnpnet-set": (90, 80, 2.0), "poselib:threshold=6": (70, 70, 4.0)}
    solvers["poselib:threshold=6+ratio"] = (65, 71, 4.0)
    rows = [
        {"solver": name, "kind": kind, "group": group, "batch": size, "count": count, "success": rate / 100}
        | {"ms_per_problem": ms * count}
        for name, (*rates, ms) in solvers.items()
        for kind, count, rate in zip(("few", "many"), (100, 300), rates, strict=True)
        for group, size in (("all", 1), ("all", 500), ("hall", 500))
    ]
    file = matches.at_size({"rows": rows, "counts": [{"scene": "hall"}]})
    assert {(row["batch"], row["group"]) for row in file["rows"]} == {(500, "all"), (500, "hall")}
    found = matches.totals(file)
    ours = found["pnpnet-set"]
    assert [ours[kind].rate for kind in ("few", "many", "all")] == [0.9, 0.8, 0.825]
    assert (ours["few"].ms, ours["all"].ms, ours["all"].number) == (200.0, 500.0, 400)
    assert matches.by_success(found) == ["poselib:threshold=6", "poselib:threshold=6+ratio"]
    assert matches.points_ahead(file) == "+12.5 (+12.5 to +12.5)"  # one scene: any sample is the same


def test_a_solver_is_ahead_or_behind_only_when_intervals_are_apart():
    def entry(data, solver, rate):
        success = {"rate": rate, "low": rate - 0.01, "high": rate + 0.01}
        return {"data": data, "solver": solver, "success": success, "us_per_problem": 1.0}

    shares = {"won": (0.9, 0.8), "lost": (0.7, 0.8), "even": (0.8, 0.81)}
    rows = [entry(data, name, rate) for data, pair in shares.items() for name, rate in zip("ab", pair, strict=True)]
    rates = Rates({"rows": rows, "data": list(shares), "solvers": ["a", "b"]})
    standing = compare_all([rates], "a", ["b"])
    assert [list(sets) for sets in standing.values()] == [["won"], ["even"], ["lost"]]
    assert standing["behind"] == {"lost": ("b", pytest.approx(10.0))}
    assert rates.best("lost", ["a", "b"]) == "b"


def test_runs_are_apart_only_when_all_their_intervals_are():
    def row(rate):
        return {f"none/{key}": f"{(rate + half) / 100:.4f}" for key, half in (("rate", 0), ("low", -1), ("high", 1))}

    for rates, others, difference, verdict in (
        ([75.0], [70.0], "+5.0", "above"),
        ([65.0], [70.0], "-5.0", "below"),
        ([71.5], [70.0], "+1.5", "overlap"),
        ([75.0], [70.0, 74.0], "+3.0", "overlap"),  # one seed of the others comes near
        ([75.0, 71.0], [70.0], "+3.0", "overlap"),
    ):
        found = compared([row(rate) for rate in rates], [row(rate) for rate in others], "none")
        assert found.startswith(difference)
        assert verdict in found


def count(function, *shapes):
    """Operations of a function of random tensors of these shapes, which are made outside of the count."""
    tensors = [torch.rand(shape, dtype=torch.float64) + 0.5 for shape in shapes]
    with OperationCounter() as counter:
        function(*tensors)
    return counter.total


def flops(**counts):
    return sum(OPERATION_COSTS[kind] * count for kind, count in counts.items())


NORM = 3 * flops(add=3 + 4 + 3 + 1 + 4, multiply=4 + 4 + 4, divide=3, sqrt=1)  # sums, differences, squares
#: Functions of a matrix of 3 by 4, and what they cost; the fifth power is x² twice, times x.
COSTS = [(lambda x: 3 - x, flops(add=12)), (lambda x: torch.add(x, x, alpha=3), flops(add=12, multiply=12))]
COSTS += [(lambda x: x[:, None] * x[None], flops(multiply=3 * 3 * 4)), (lambda x: x.min(-1), flops(compare=9))]
COSTS += [(lambda x: x.rsqrt(), flops(sqrt=12, divide=12)), (lambda x: x.exp_(), flops(exp=12))]
COSTS += [(lambda x: x.sin() + x.log(), flops(log=24, add=12)), (lambda x: x.abs() > 1, flops(compare=36))]
COSTS += [(lambda x: x.clamp(min=0, max=1), flops(compare=24))]
COSTS += [(lambda x: torch.where(x > 1, x, 0.0), flops(compare=12, logic=12))]
COSTS += [(lambda x: torch.addcmul(x, x, x, value=2), flops(add=12, multiply=24)), (lambda x: x**5, flops(multiply=36))]
COSTS += [(lambda x: x**-2, flops(multiply=12, divide=12)), (lambda x: x**1.5, flops(sqrt=12, multiply=12))]
COSTS += [(lambda x: x**0.3, flops(exp=12, log=12, multiply=12))]
COSTS += [(lambda x: x.mean(-1), flops(add=9, divide=3)), (lambda x: x.cumsum(-1), flops(add=9))]
COSTS += [(lambda x: torch.linalg.vector_norm(x, dim=(0, 1)), flops(add=11, multiply=12, sqrt=1))]
COSTS += [(lambda x: x.softmax(-1), flops(add=12 + 9, divide=12, exp=12, compare=9))]
COSTS += [(lambda x: torch.nn.functional.layer_norm(x, (4,), x[0], x[1]), NORM)]
COSTS += [(lambda x: (x > 0).all(-1), flops(compare=12, logic=9))]
COSTS += [(lambda x: x.sort(0), flops(compare=4 * 3 * math.log2(3)))]
COSTS += [(lambda x: x.topk(2), flops(compare=3 * (6 + 2))), (lambda x: x.topk(2, sorted=False), flops(compare=3 * 6))]
COSTS += [(lambda x: x.kthvalue(3), flops(compare=3 * 5)), (lambda x: x.nanmedian(-1), flops(compare=3 * (4 + 6)))]
COSTS += [(lambda x: (-x).T.reshape(2, 6).flip(0).clone()[:, [0, 1]], 0)]
ALGEBRA = [(lambda a, b: a @ b, [(5, 6, 2, 3), (6, 3, 4)], 30 * operations.matmul(2, 3, 4))]
ALGEBRA += [(torch.nn.functional.linear, [(5, 3), (4, 3), (4,)], 5 * flops(multiply=12, add=12))]
ALGEBRA += [(torch.cdist, [(5, 2, 3), (5, 4, 3)], 40 * flops(add=3 + 2, multiply=3, sqrt=1))]
ALGEBRA += [(torch.linalg.inv_ex, [(5, 4, 4)], 5 * operations.solve(4, 4))]
ALGEBRA += [(torch.linalg.cholesky_ex, [(5, 4, 4)], 5 * operations.cholesky(4))]


@pytest.mark.parametrize(("function", "expected"), COSTS)
def test_cost_of_an_operation(function, expected):
    assert count(function, (3, 4)) == pytest.approx(expected)


@pytest.mark.parametrize(("function", "shapes", "expected"), ALGEBRA)
def test_cost_of_linear_algebra(function, shapes, expected):
    assert count(function, *shapes) == expected


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_costs_of_factorisations_are_those_of_the_loops_of_the_textbook(n):
    eliminate, pairs = sum((n - k - 1) ** 2 for k in range(n)), n * (n - 1) // 2
    triangular = flops(add=2 * pairs, multiply=2 * pairs, divide=n)
    assert operations.solve(n, 1) == flops(add=eliminate, multiply=eliminate, divide=pairs, compare=pairs) + triangular
    inner = sum(j for j in range(n) for _ in range(j, n))  # Cholesky by columns
    assert operations.cholesky(n) == pytest.approx(flops(add=inner, multiply=inner, divide=pairs, sqrt=n))


@pytest.mark.parametrize("batch", [2, 5])
def test_operations_shared_by_the_batch_are_not_counted(batch):
    table = torch.rand(5, 5)
    cost = count_per_problem(lambda size: torch.rand(size, 5) @ (table @ table).exp() + table.sum(), batch)
    assert cost == pytest.approx(flops(add=5 * 4 + 5, multiply=5 * 5))


def test_a_network_costs_a_product_and_a_sum_for_each_weight_and_iterations_cost_the_same():
    counts = [operation_count(f"identity-lm:m={m}", 9) for m in (1, 2, 30)]
    assert counts[2] - counts[1] == pytest.approx(28 * (counts[1] - counts[0]))
    network = MLPInit(20)
    weights = sum(p.numel() for name, p in network.named_parameters() if name.endswith("weight"))
    alone = operation_count(PnPNet(network, RobustWeightedLM(0)), 20) - operation_count("identity-lm:m=0", 20)
    # Beside its layers' products and sums: scales of the input, ReLU, and one rotation.
    assert 2 * weights < alone < 2 * weights + 150 * 20


@pytest.mark.parametrize("name", ["epnp-lm", "reppnp-lm", "pnpnet-set", "pnpnet-n9"])
def test_counts_do_not_depend_on_the_data(name, make_problems):
    solver = create_solver(name, effort="fixed")
    for outliers in (0, 3):
        # In batches as large as those of `operation_count`: small ones are solved by LAPACK.
        inputs = make_problems(n=9, batch=128, outliers=outliers, noise=outliers > 0, seed=outliers)[:3]
        counted = count_per_problem(lambda batch, inputs=inputs: solver(*(part[:batch] for part in inputs)), 64)
        assert counted == operation_count(name, 9)


def test_ransac_draws_more_samples_with_more_outliers_and_more_confidence():
    solver = create_solver("p3p-ransac")
    counts = [operation_count(solver, 30, outliers=k) for k in (12, 15, 18)]  # with fewer the smallest number suffices
    assert 2.0 * counts[0] < counts[2] > counts[1] > counts[0]
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
    with pytest.raises(NotImplementedError, match=r"aten\.erfc"):
        count(lambda x: x.erfc(), (3,))
    with pytest.raises(ValueCheckError, match="known-inliers"):
        operation_count("known-inliers", 9)
    with pytest.raises(ShapeError):
        operation_count("net-n9", 10)
