"""Whatever comes in, for what is around solvers: bounds, counts, export, and what runs of trainings leave behind."""

import itertools
import json
import math
import shutil
import warnings
from collections import Counter
from functools import cache, partial

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.core.exceptions import BaseError
from test_hardening import SOLVERS, WORDS, batches, check, damage, many, run_main, same
from test_hardening_parts import ANY, ERRORS, WORD, Seen, finite, names_the_file, options, places_in, poses, spoiled

from kornia_pnpnet import MLPInit, PnPNet, RobustWeightedLM, create_solver
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation.bounds import KnownInliers, KnownInliersAndNoise
from kornia_pnpnet.evaluation.comparison import SeesTruth
from kornia_pnpnet.evaluation.figures import (
    plot_against_m,
    plot_against_n,
    plot_mismatches,
    plot_reliability,
    plot_scenes,
)
from kornia_pnpnet.evaluation.operations import OperationCounter, count_per_problem
from kornia_pnpnet.export import export_onnx, export_program
from kornia_pnpnet.pretrained import WEIGHTS_FOLDER
from kornia_pnpnet.training.loop import FitReport, train_briefly
from kornia_pnpnet.training.results import (
    collect_weights,
    find_results,
    load_run,
    run_results,
    summarize_runs,
    write_json,
    write_model_card,
)
from kornia_pnpnet.types import Problems

# It would hide what failed.
pytestmark = pytest.mark.filterwarnings("ignore:Generating overly large repr")


# -- bounds and counts ------------------------------------------------------------------------------------------------


@many(60)
@given(
    batches(), st.data(), st.sampled_from([KnownInliers(), KnownInliersAndNoise(), KnownInliersAndNoise(img_sigma=0)])
)
def test_bounds_take_anything(tally, case, data, bound):
    inputs, _, _, kinds = case
    tally("parts", "`KnownInliers`, `KnownInliersAndNoise` of any problems and true poses: as solvers")
    assert isinstance(bound, SeesTruth)
    assert not isinstance(SOLVERS["epnp"], SeesTruth)
    batch, count = inputs[0].shape[:2]
    inliers = torch.rand(batch, count, generator=torch.Generator().manual_seed(batch)) > 0.3
    problems = Problems(*inputs, data.draw(poses(batch, inputs[0].dtype)), inliers)
    inliers[:, 0] = True  # the one that is spoiled
    if isinstance(bound, KnownInliersAndNoise):  # whose noise is infinite, too: such a pair weighs nothing
        kinds = ["nothing" if kind == "infinite point" else kind for kind in kinds]
    check(bound.solve_with_truth(problems), inputs, kinds, lambda *_: None)


def test_bounds_of_any_options(tally):
    made = Seen(tally, "`KnownInliersAndNoise` with any options")
    problems = SyntheticProblems(n=9, batch_size=3, seed=0).batch(0)

    @many(60)
    @given(options(img_sigma=ANY, world_sigma=ANY))
    def run(values):
        bound = made(lambda: KnownInliersAndNoise(**values))
        if bound is not None:
            finite(*bound.solve_with_truth(problems)[:4])

    run()
    made.both()


@many(40)
@given(st.sampled_from([name for name in SOLVERS if not name.endswith("-n9")]), batches())
def test_counted_solvers_are_the_same_solvers(tally, name, case):
    tally("parts", "`OperationCounter` around any solver and batch: the same result, no operation of unknown cost")
    inputs, mask, weights, _ = case
    with OperationCounter() as counter:
        result = SOLVERS[name](*inputs, weights=weights, mask=mask)
    assert (len(inputs[0]) > 0) <= counter.operations.flops < math.inf
    for ours, plain in zip(result[:5], SOLVERS[name](*inputs, weights=weights, mask=mask)[:5], strict=True):
        assert ours.equal(plain)


SIZES = st.integers(1, 6)


@many(60)
@given(SIZES, SIZES, SIZES, st.sampled_from([torch.float32, torch.float64]))
def test_counts_of_any_size_are_those_of_the_formula(tally, rows, inner, columns, dtype):
    tally("parts", "`count_per_problem` of products of any size: what a count by hand gives")

    def run(batch):
        constant = torch.ones(inner, columns, dtype=dtype)
        return (torch.ones(batch, rows, inner, dtype=dtype) @ (constant / 2.0)).exp()

    counts = count_per_problem(run)
    cells = rows * columns
    assert (counts.multiply, counts.add, counts.exp) == (cells * inner, cells * (inner - 1), cells)
    assert counts.divide == 0  # of what is the same for the whole batch


@many(10)
@given(st.sampled_from([torch.fft.fft, torch.special.bessel_j0, torch.erfinv, torch.linalg.svd]), SIZES)
def test_operations_of_unknown_cost_are_an_error(tally, function, size):
    tally("parts", "`OperationCounter` around operations whose cost it does not know: an error that names them")
    with pytest.raises(NotImplementedError, match=r"aten\.\w+"), OperationCounter():
        function(torch.rand(size, size))


# -- export -----------------------------------------------------------------------------------------------------------

SMALL = {
    "network": PnPNet(MLPInit(6), RobustWeightedLM(1)),
    "from the identity": PnPNet(None, RobustWeightedLM(1)),
    "RANSAC": create_solver("p3p-ransac"),
}
#: Mostly none that a graph can have: each that is made takes seconds.
PAIRS = st.sampled_from([None, 6, 6.0, 12, 0, 1, 2, -1, True, 0.5, math.nan, "6"])


def test_programs_of_any_number_of_pairs(tally):
    made = Seen(tally, "`export_program` of small solvers for any n; what works gives the solver's results")
    export = cache(lambda name, kind, n: export_program(SMALL[name], n))  # True is 1, and 6.0 is 6, but for the kind

    @many(40)
    @given(st.sampled_from(sorted(SMALL)), PAIRS, st.data())
    def run(name, n, data):
        program = made(lambda: export(name, type(n), n))
        if program is None:
            return
        (world, img, camera), *_ = data.draw(batches(6 if name == "network" else n).filter(lambda case: case[3]))
        inputs = [x.detach().float().contiguous() for x in (world, img, camera, torch.ones_like(world[..., 0]))]
        with torch.no_grad():
            same(program.module()(*inputs), SMALL[name](*inputs)[:5])

    run()
    made.both()


def test_models_of_any_number_of_pairs(tally, tmp_path):
    pytest.importorskip("onnxscript", reason="needs onnxscript")
    made = Seen(tally, "`export_onnx` of small solvers for any n; what is refused leaves the old file as it was")
    path = tmp_path / "solver.onnx"

    @many(12, times=1)
    @given(st.sampled_from(sorted(SMALL)), PAIRS)
    def run(name, n):
        path.write_bytes(b"old")
        if made(lambda: export_onnx(SMALL[name], path, n)) is None:
            assert path.read_bytes() == b"old"
        else:
            assert path.stat().st_size > 1000
        assert [*tmp_path.iterdir()] == [path]

    run()
    made.both(1)


# -- runs -------------------------------------------------------------------------------------------------------------


def made_run(folder):
    """The folder of a run, as ``train.py`` leaves it: that of shipped weights."""
    shipped = WEIGHTS_FOLDER / "pnpnet-n6"
    (folder / "weights").mkdir(parents=True)
    for name in ("results.json", "history.csv"):
        shutil.copy(shipped / name, folder / name)
    for name in ("config.json", "model.safetensors"):
        shutil.copy(shipped / name, folder / "weights" / name)
    return folder


def test_spoiled_results_of_runs_are_an_error_of_ours(tally, tmp_path):
    run_folder = made_run(tmp_path / "run")
    path = run_folder / "results.json"
    content = json.loads(path.read_text())
    places, outcomes = list(places_in(content)), Counter()

    @many(150)
    @given(spoiled(content, places))
    def run(results):
        tally("files", "`find_results`, `write_model_card`, `summarize_runs` of spoiled results of a run: or one error")
        path.write_text(json.dumps(results))
        card = tmp_path / "README.md"
        card.unlink(missing_ok=True)
        try:
            assert find_results(run_folder / "weights") == load_run(path) == results
        except ValueError as error:
            outcomes["refused"] += 1
            names_the_file(error, path)
            with pytest.raises(ValueError, match="No results of a run"):
                write_model_card(tmp_path, results)
            assert not card.exists()
            with pytest.warns(UserWarning, match="Left out of the summary"):
                assert summarize_runs(tmp_path) is None
        else:
            outcomes["works"] += 1
            write_model_card(tmp_path, results)
            assert card.stat().st_size > 1000
            assert summarize_runs(tmp_path).read_text().count("\n") >= 2
            (tmp_path / "summary.csv").unlink()

    run()
    assert min(outcomes["refused"], outcomes["works"]) >= 5


def test_damaged_runs_are_an_error_of_ours(tally, tmp_path):
    sound, spoilt = (made_run(tmp_path / name) for name in ("sound", "spoilt"))
    files = {path.relative_to(spoilt): path.read_bytes() for path in spoilt.rglob("*.*")}
    outcomes = Counter()

    @many(100)
    @given(st.sampled_from(sorted(files)), st.data(), st.booleans(), st.sampled_from([100, 3, 2, 1]))
    def run(name, data, last, most_rows):
        tally("files", "`collect_weights` of damaged runs: all of it, or one error and nothing")
        (spoilt / name).write_bytes(data.draw(damage(files[name])))
        folder = tmp_path / "collected"
        shutil.rmtree(folder, ignore_errors=True)
        try:
            collect_weights([sound, spoilt] if last else [spoilt, sound], folder, most_rows=most_rows)
        except ERRORS:
            outcomes["refused"] += 1
            assert not folder.exists()
        else:
            outcomes["works"] += 1
            PnPNet.from_pretrained(folder)
            assert len([*folder.iterdir()]) == 5
        (spoilt / name).write_bytes(files[name])

    run()
    assert min(outcomes["refused"], outcomes["works"]) >= 5
    for most_rows in (0, -1, 0.5, math.nan):
        with pytest.raises(BaseError):
            collect_weights([sound], tmp_path / "none", most_rows=most_rows)
    with pytest.raises(ValueError, match="at least one run"):
        collect_weights([], tmp_path / "none")
    (spoilt / "history.csv").unlink()
    with pytest.raises(FileNotFoundError):
        collect_weights([spoilt], tmp_path / "none")
    assert not (tmp_path / "none").exists()


REPORT = FitReport(0, 100, 0, False, 10.0, 10.0, {"data": 0.5, "forward": 0.5}, 300.0)


@many(12)
@given(
    st.integers(0, 3), st.sampled_from([0, 1, 4]), st.booleans(), st.booleans(), st.lists(WORD, max_size=3), st.data()
)
def test_results_of_any_run_make_a_card_and_a_summary(tally, tmp_path_factory, sets, m, network, told, words, data):
    tally(
        "files",
        "`run_results` of some solvers and any sets, its card and its row in a summary: as they were written",
    )
    folder = tmp_path_factory.mktemp("run")
    model = PnPNet(MLPInit(9) if network else None, RobustWeightedLM(m))
    source = {"_target_": data.draw(st.sampled_from(["kornia_pnpnet.data.SyntheticProblems", "mine.Source"]))}
    source |= data.draw(options(n=st.just([6, 9]), outliers=st.just({"_target_": "mine.Mix", "x": 1}), points=WORD))
    validation = {}
    for i in range(sets):
        size, noise = data.draw(st.integers(1, 3)), (0.01, 0.05) if told else 0.05
        problems = SyntheticProblems(n=9, batch_size=size, seed=i, outliers=OutlierMix(), world_sigma=noise).batch(0)
        validation[f"set {i}"] = problems
    config = {"batch_size": 8, "model": {"n": 9}, "name": data.draw(st.sampled_from([None, "drone"]))}
    config["data"] = {"train": source, "validation": dict.fromkeys(validation, source)}
    make = partial(run_results, model, validation, REPORT, config, [*words, "~x", "+a.b=1", "c=d=e"])
    if not sets:
        with pytest.raises(ValueError, match="at least one validation set"):
            make()
        return
    results = make()
    write_json(folder / "results.json", results)
    assert load_run(folder / "results.json") == json.loads(json.dumps(results))
    write_model_card(folder, results)
    card = (folder / "README.md").read_text()
    assert card.startswith(f"# {config['name'] or ('MLPInit' if network else 'PnPNet')}\n")
    assert all(name in card for name in validation)
    own = "mine.Source" in str(source) or "mine.Mix" in str(source)
    assert ("from mine." in card) == own
    assert ("synthetic problems" in card) == (not own)
    summary = summarize_runs(folder).read_text()
    assert "d=e" in summary


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.builds(object),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)


@many(80)
@given(JSON)
def test_any_content_is_written_whole_or_not_at_all(tally, tmp_path_factory, content):
    tally("files", "`write_json` of any content: read as it was written, or an error and the old file")
    path = tmp_path_factory.getbasetemp() / "json" / "content.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text("old")
    try:
        text = json.dumps(content, allow_nan=False)
    except (TypeError, ValueError):
        with pytest.raises((TypeError, ValueError)):
            write_json(path, content)
        assert path.read_text() == "old"
    else:
        write_json(path, content)
        assert json.loads(path.read_text()) == json.loads(text)
    assert [*path.parent.iterdir()] == [path]


def test_trainings_of_any_length(tally, tmp_path):
    made = Seen(tally, "`train_briefly` for seconds that are none; the old run stays as it was")
    history, checkpoint = tmp_path / "history.csv", tmp_path / "last.ckpt"
    checkpoint.write_bytes(b"old")

    @many(20)
    @given(st.sampled_from([0.0, -1.0, math.nan, math.inf, -math.inf, None, "1", True, [1.0]]))
    def run(seconds):
        history.write_text("old")
        made(lambda: train_briefly(seconds, tmp_path, progress=False))
        assert history.read_text() == "old"
        assert checkpoint.read_bytes() == b"old"

    run()
    made(lambda: train_briefly(1e-6, tmp_path, progress=False))
    assert made.counts["works"] == 1
    assert history.read_text().startswith("update,")


# -- pictures of results ----------------------------------------------------------------------------------------------

SOURCES = "paper", "gaussian_pose", "fox", "the $b_a^r$n"
NAMES = "epnp-lm", "epnp-lm:m=3", "pnpnet-n6", "pnpnet-n9", "known-inliers"
SHARE = st.floats(0.0, 1.0)
NUMBER = st.one_of(st.floats(0.0, 200.0), st.sampled_from([-1.0, 0.0, 1e-300, 1e300]))


@st.composite
def evaluations(draw, full=False):
    """Results of any solvers on any sets, each on most of them; ``full``: of all there are here."""

    def some(*values):
        return values if full else draw(st.lists(st.sampled_from(values), min_size=1, max_size=3, unique=True))

    def few(values):  # one for each set and solver would be more than can be drawn
        return itertools.cycle(draw(st.lists(values, min_size=1, max_size=3)))

    names, outliers, numbers = some(*NAMES, draw(WORD)), some("none", "uniform", 1, 2, "many"), some(6, 9, 0)
    limits, units, shares = few(NUMBER), few(WORD), few(st.sampled_from([0.5, 1]))
    sets = {
        f"{source} {wrong} {n}": {
            "description": {"source": source, "outliers": wrong, "mismatch_share": next(shares)},
            "n": n,
            "max_rotation_deg": next(limits),
            "max_translation": next(limits),
            "unit": next(units),
        }
        for source, wrong, n in itertools.product(some(*SOURCES), outliers, numbers)
    }
    rates = few(st.fixed_dictionaries({"rate": SHARE, "low": SHARE, "high": SHARE, "total": st.integers(1, 300)}))
    times, lost = few(st.floats(1e-9, 1e12)), few(st.sampled_from([False, False, False, True]))
    rows = [
        {"data": data, "solver": solver, "success": next(rates), "us_per_problem": next(times)}
        for data, solver in itertools.product(sets, names)
        if not next(lost)
    ]
    depths = few(st.sampled_from([None, {"refine": 1}, *({"refine": {"m": m}} for m in (0, 3, 5))]))
    if full:
        depths = itertools.cycle([{"refine": {"m": 10}}, {"refine": {"m": 3}}])
    return {"data": sets, "solvers": {name: {"config": next(depths)} for name in names}, "rows": rows}


def drawn(tally, tmp_path, what, plot, strategy, examples=16):
    """Draw pictures: there is one, or an error and none."""
    made = Seen(tally, f"{what}: a picture, or an error and none")
    path = tmp_path / "picture.png"

    @many(examples)
    @given(strategy)
    def run(values):
        path.unlink(missing_ok=True)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Glyph", UserWarning)  # that the font does not have
            assert (made(lambda: plot(path, values)) is not None) == path.exists()

    run()
    made.both(1)


@pytest.mark.parametrize("plot", [plot_against_m, plot_against_n, plot_mismatches, plot_scenes])
def test_pictures_of_any_results(plot, tally, tmp_path):
    strategy = st.lists(evaluations(), max_size=2) | st.lists(evaluations(full=True), min_size=1, max_size=1)
    drawn(tally, tmp_path, f"`{plot.__name__}` of any results", plot, strategy)


def test_reliability_pictures_of_any_numbers(tally, tmp_path):
    keys = "number", "predicted", "observed"
    equal = st.lists(st.tuples(st.integers(0, 9), ANY, ANY), min_size=1, max_size=4)
    equal = equal.map(lambda rows: dict(zip(keys, zip(*rows, strict=True), strict=True)))
    curve = equal | st.fixed_dictionaries(dict.fromkeys(keys, st.lists(ANY, max_size=3)))
    drawn(
        tally, tmp_path, "`plot_reliability` of any numbers", plot_reliability, st.dictionaries(WORD, curve, max_size=3)
    )


# -- the other commands -----------------------------------------------------------------------------------------------

#: What each needs to be quick, and what it can be given.
COMMANDS = {
    "evaluate": (("--solver", "epnp", "--problems", 3), "--solver --data --n --outliers --seed --dtype --plot"),
    "figures": ((), "--out"),
    "export": (("--solver", "p3p-ransac"), "--n"),
    "list": ((), "--x"),
    "demo": (("--problems", 3, "--train-seconds", 0), "--data --problems"),
}
SAID = WORDS | st.sampled_from(
    ["9", "6,9", "none,2", "50%", "uniform", "float64", "gaussian_pose", "p3p-ransac", "1e9"]
)


def test_any_arguments_of_other_commands_are_a_line_and_no_traceback(tally, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    codes = Counter()

    @many(80)
    @given(st.sampled_from(sorted(COMMANDS)), st.data())
    def run(name, data):
        tally(
            "files",
            "`pnpnet evaluate`, `figures`, `export`, `list`, `demo` with any arguments: at most one line of error",
        )
        quick, may = COMMANDS[name]
        pairs = data.draw(st.lists(st.tuples(st.sampled_from(may.split()), SAID), max_size=2))
        files = data.draw(st.lists(SAID, max_size=1))
        code, out, err = run_main(name, *quick, *(x for pair in pairs for x in pair), *files)
        codes[name, code] += 1
        assert code in (0, 2)
        if code == 2:
            assert err.startswith("pnpnet: ")
            assert err.count("\n") == 1
        else:
            assert out

    run()
    assert all(codes[name, 2] for name in COMMANDS)
    assert all(codes[name, 0] for name in ("evaluate", "list", "demo"))  # what others need is not among the words


# -- poses and cameras of Kornia ---------------------------------------------------------------------------------------


@many(60)
@given(batches(), st.data(), st.sampled_from(["pnpnet-set", "epnp-lm", "p3p-ransac"]))
def test_cameras_of_kornia_take_anything(tally, case, data, name):
    tally("parts", "`Pose.matrix`, `Pose.se3`, `Pose.camera` of any pose, and a `PinholeCamera` for any intrinsics")
    (world, img, matrices), mask, weights, _ = case
    batch = len(world)
    pose = data.draw(poses(batch, world.dtype))
    camera = pose.camera(matrices, 480, 640)
    assert pose.matrix.shape == (batch, 4, 4)
    assert pose.matrix[:, :3, 3].equal(pose.translation)
    assert camera.extrinsics.equal(pose.matrix)
    if batch:  # Kornia's quaternions have at least one
        torch.testing.assert_close(pose.se3.matrix(), pose.matrix, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(camera.intrinsics[:, :3, :3], matrices, rtol=0, atol=0, equal_nan=True)
    ours, plain = (SOLVERS[name](world, img, x, weights=weights, mask=mask) for x in (camera, matrices))
    for one, other in zip(ours[:5], plain[:5], strict=True):
        assert one.equal(other)
