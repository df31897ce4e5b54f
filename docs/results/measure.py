"""Measure the results files of the page, put trained weights into the package. ``make.py`` is the command."""

import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import torch
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from operations import complexity_results
from torch import nn

from kornia_pnpnet import PnPNet, RobustWeightedLM, pose_covariance
from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.core.files import write_json
from kornia_pnpnet.core.schema import to_json
from kornia_pnpnet.evaluation import EvaluationData, evaluate
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.evaluation.problem_sets import evaluation_sets
from kornia_pnpnet.evaluation.results import format_table, load_results, save_results
from kornia_pnpnet.metrics import reliability, success_rate
from kornia_pnpnet.pretrained import WEIGHTS_FOLDER, shipped_weights
from kornia_pnpnet.result import PnPResult, Problems
from kornia_pnpnet.training.card import write_model_card
from kornia_pnpnet.training.checkpoint import HISTORY_NAME
from kornia_pnpnet.training.results import RESULTS_NAME, load_run

HERE = Path(__file__).resolve().parent
OUTPUTS = HERE.parents[1] / "outputs" / "results"

#: The results files of evaluations, by name without ``.json``.
RESULTS = (
    *("paper", "gaussian_pose", "real", "mismatches", "crowd", "against_n", "against_m", "views", "distribution"),
    *("set", "set_given", "set_real", "set_real_given"),
)
#: Other files that ``make.py measure`` writes.
OTHERS = ("honesty", "probability", "judge", "complexity")
#: The paper's network as published, the same with our changes, and the network for any number of pairs.
PAPER, OURS, ANY = "pnpnet-n9-paper", "pnpnet-n9", "pnpnet-set"
METRIC_SCENES = ("strecha/fountain-P11", "strecha/Herz-Jesus-P25", "eth3d/courtyard")
OTHER_SCENES = ("colmap/lund_door", "colmap/sceaux_castle")  # reconstructions of arbitrary unit
# Seeds of the problems that the page reports, and of those that thresholds are tuned on. No training used them.
SEED_REPORT, SEED_TUNE = 20_261_131, 20_261_132

UNTUNED = (
    *(PAPER, OURS, "net-n9", "identity-lm", "epnp", "epnp-lm", "reppnp", "reppnp-lm"),
    *("opencv-epnp", "opencv-sqpnp"),
)
_PIXELS: dict[str, Sequence[float]] = {"threshold": (1.0, 2.0, 5.0, 10.0, 20.0, 35.0, 50.0, 80.0, 120.0)}
_TWO_THRESHOLDS = {"threshold": (1.0, 2.0, 3.0, 5.0, 10.0), "world_threshold": (0.05, 0.1, 0.15, 0.2, 0.3, 0.4)}
#: Threshold methods by the name on the page: the solver, and the values of its options that tuning tries.
#: ``p3p-ransac`` has one threshold in pixels like the peers, ``p3p-ransac-noise`` also one for noise of the world
#: points. OpenCV's RANSAC once with its usual options (AP3P, refined) and once with the best options that we found.
TUNED: dict[str, tuple[str, dict[str, Sequence[float]]]] = {
    **{name: (name, _PIXELS) for name in ("ransac-epnp-lm", "p3p-ransac")},
    "p3p-ransac-noise": ("p3p-ransac", _TWO_THRESHOLDS),
    "opencv-ransac": ("opencv-ransac", _PIXELS),
    "opencv-ransac-sqpnp": ("opencv-ransac:method=SQPNP,refine=false", _PIXELS),
    **{name: (name, _PIXELS) for name in ("opencv-usac", "poselib", "pycolmap")},
}
PEERS = ("opencv-ransac", "opencv-ransac-sqpnp", "opencv-usac", "poselib", "pycolmap")
ROBUST = ("p3p-ransac", "p3p-ransac-noise", *PEERS)
BOUNDS = ("known-inliers", "known-inliers-and-noise")
VIEWS = (1, 2, 3, 4, 8)
DEPTHS = (0, 1, 2, 3, 5, 7, 10, 15, 20, 30)  # iterations of the classical refinement
SIGMAS = (0.25, 0.5, 1.0, 2.0)  # pixels; standard deviations that tuning tries for the scenes
_MOST_ROWS = 100  # rows of the learning curves of a run that are shipped
CHI_SQUARE_95 = 12.592  # 95 % quantile of the chi-square distribution with 6 degrees of freedom
SCALES = (("cauchy", 10.0), ("geman_mcclure", 20.0))  # kernels and their scales in pixels


class Counts(NamedTuple):
    """Where the scenes are, and the numbers of problems of a synthetic set and of a scene."""

    scenes: Path
    synthetic: int
    real: int

    def draw(self, sources: Iterable[str], outliers: str, **changed: Any) -> dict[str, EvaluationData]:
        """Sets of the seed for the report, 9 pairs unless ``changed`` says otherwise."""
        options: dict[str, Any] = {"dtype": torch.float64, "seed": SEED_REPORT, "n": 9, "count": self.synthetic}
        return evaluation_sets(list(sources), outliers, **{**options, **changed})

    def tuning(self, outliers: str, **changed: Any) -> dict[str, EvaluationData]:
        """Smaller synthetic sets, of the seed for tuning."""
        return self.draw(["synthetic"], outliers, **{"seed": SEED_TUNE, "count": self.synthetic // 10, **changed})

    def draw_scenes(self, outliers: str, *, others: bool = True, **changed: Any) -> dict[str, EvaluationData]:
        """Problems of the scenes in metres and, with ``others``, of the scenes of arbitrary unit."""
        sets: dict[str, EvaluationData] = {}
        for metric, names in ((True, METRIC_SCENES), (False, OTHER_SCENES if others else ())):
            paths = [str(self.scenes / name) for name in names]
            sets |= self.draw(paths, outliers, **{"metric": metric, "count": self.real, **changed})
        return sets

    def tuning_scenes(self) -> dict[str, EvaluationData]:
        """Fewer problems of the scenes in metres, of the seed for tuning."""
        return self.draw_scenes("none,2", seed=SEED_TUNE, others=False, count=self.real // 5)


class FromTheTruth(nn.Module):
    """The refinement of a solver from the true pose: its success if the first guess were perfect."""

    def __init__(self, solver: PnPNet) -> None:
        super().__init__()
        self.config, self.solver = solver.config(), PnPNet(None, solver.refine, solver.normalize)

    def solve_with_truth(self, problems: Problems) -> PnPResult:
        return self.solver(*problems[:3], init=problems.pose)


def named(names: Iterable[str], found: Mapping[str, str] | None = None) -> dict[str, nn.Module]:
    """Solvers by their names on the page; ``found`` has the options of tuned solvers."""
    return {name: load_solver((found or {}).get(name, name)) for name in names}


def tune(data: Mapping[str, EvaluationData], label: str, names: Iterable[str] = tuple(TUNED)) -> dict[str, str]:
    """For each threshold method the options with the highest success, summed over all sets."""
    best = {}
    for name in names:
        base, grid = TUNED[name]
        choices = product(*([f"{key}={x:g}" for x in values] for key, values in grid.items()))
        specs = [f"{base}{',' if ':' in base else ':'}{','.join(choice)}" for choice in choices]
        rows = evaluate(named(specs), data, path=OUTPUTS / "tuning" / f"{label}, {name}.json", repeats=1)["rows"]
        best[name] = max(specs, key=lambda x: sum(row["success"]["rate"] for row in rows if row["solver"] == x))
    return best


def run(name: str, solvers: Mapping[str, nn.Module], data: Mapping[str, EvaluationData], **more: Any) -> None:
    """Evaluate into ``outputs/results`` and write the file here without the errors of single problems."""
    results = evaluate(solvers, data, path=OUTPUTS / f"{name}.json")
    rows = [{key: value for key, value in row.items() if key != "per_problem"} for row in results["rows"]]
    save_results({**results, "rows": rows, **more}, HERE / f"{name}.json")
    print(f"\n{name}\n{format_table(results)}", flush=True)


def measure_protocol(counts: Counts, wanted: set[str]) -> None:
    """The protocol's data, Gaussian translations, and several numbers of pairs."""
    found = tune(counts.tuning("none,uniform,3"), "paper")
    for name, source in (("paper", "synthetic"), ("gaussian_pose", "gaussian_pose")):
        if name in wanted:
            run(name, named((*UNTUNED, *TUNED, *BOUNDS), found), counts.draw([source], "none,uniform,3"), tuned=found)
    if "against_n" in wanted:
        fast = (*UNTUNED, "p3p-ransac", "p3p-ransac-noise", "opencv-ransac", "poselib", *BOUNDS)
        sets = counts.draw(["synthetic"], "none,uniform", n=[6, 9, 12, 20, 50])
        run("against_n", named(dict.fromkeys((*shipped_weights(), *fast)), found), sets, tuned=found)


def measure_crowd(counts: Counts, _: set[str]) -> None:
    """A hundred pairs with many outliers."""
    crowd: dict[str, Any] = {"n": 100, "outliers": "50%,70%"}
    found = tune(counts.tuning(**crowd, count=counts.real // 5), "crowd", ROBUST)
    run("crowd", named((*ROBUST, *BOUNDS), found), counts.draw(["synthetic"], **crowd, count=counts.real), tuned=found)


def measure_scenes(counts: Counts, wanted: set[str]) -> None:
    """The scenes, and the scenes in metres against the number of mismatches."""
    # Without the solver that allows for noise of the world points: the scenes' points are as exact as their pixels.
    sharp = tuple(name for name in TUNED if "noise" not in name)
    found = tune(counts.tuning_scenes(), "real", sharp)
    if "real" in wanted:
        solvers = named((*UNTUNED, *sharp, "known-inliers"), found)
        run("real", solvers, counts.draw_scenes("none,2"), tuned=found)
    if "mismatches" in wanted:
        names = (PAPER, OURS, "reppnp-lm", "epnp-lm", "p3p-ransac", "opencv-ransac", "poselib", "known-inliers")
        sets = counts.draw_scenes("none,1,2,3,4,5", seed=SEED_REPORT + 10, others=False, mismatches_only=True)
        run("mismatches", named(names, found), sets, tuned=found)


def measure_depths(counts: Counts, _: set[str]) -> None:
    """Several numbers of iterations."""
    specs = [f"{name}:m={m}" for name in ("identity-lm", "epnp-lm", "reppnp-lm") for m in DEPTHS]
    specs += [f"{OURS}:m={m}" for m in range(PnPNet.from_pretrained(OURS).refine.m + 1)]
    run("against_m", named(specs), counts.draw(["synthetic"], "none,uniform"))


def measure_views(counts: Counts, _: set[str]) -> None:
    """Several guesses for each problem, and refinements from the true pose."""
    solvers = named([f"{OURS}:views={count}" for count in VIEWS])
    solvers[f"{OURS} from the truth"] = FromTheTruth(PnPNet.from_pretrained(OURS))
    kernels = {f"alpha = {alpha:g}": ("power", alpha) for alpha in (1.0, 1.5, 2.0)}
    kernels |= {f"{kernel}, {scale:g} px": (kernel, scale) for kernel, scale in SCALES}
    for name, (kernel, shape) in kernels.items():
        classical = PnPNet(None, RobustWeightedLM(30, kernel=kernel, robustness=shape, reject_worse=False))
        solvers[f"{name} from the truth"] = FromTheTruth(classical)
    run("views", solvers, counts.draw_scenes("2") | counts.draw(["synthetic"], "none,uniform,3"))


def set_data(counts: Counts) -> tuple[dict[str, EvaluationData], dict[str, EvaluationData]]:
    """Synthetic sets of many numbers of pairs, outliers and rotations, and sets of scenes and raw matches."""
    seed, count = SEED_REPORT + 20, 2 * counts.synthetic
    made = counts.draw(["synthetic", "any_rotation"], "none,uniform,3", seed=seed, count=count)
    for n in (6, 12, 20, 50, 200):
        outliers = "uniform,50%" if n >= 20 else "uniform"
        fewer = count if n < 100 else count // 5
        made |= counts.draw(["synthetic"], outliers, n=n, seed=seed, count=fewer)
    real: dict[str, EvaluationData] = {}
    for n, outliers in ((9, "2"), (12, "3")):
        real |= counts.draw_scenes(outliers, n=n, seed=seed)
    files = sorted(str(path) for path in (counts.scenes / "matches").glob("*.npz"))
    matches = counts.draw(files, "none", n=50, seed=seed, count=counts.real)
    return made, real | {f"{name} (raw matches)": entry for name, entry in matches.items()}


def measure_set(counts: Counts, wanted: set[str]) -> None:
    """The network for any number of pairs, with the thresholds that ``paper`` and ``real`` found for the others."""
    tuned = {name: load_results(HERE / f"{name}.json")["tuned"] for name in ("paper", "real")}
    made, real = set_data(counts)
    if "set" in wanted:
        every = (ANY, *(name for name in ROBUST if name != "pycolmap"), *BOUNDS)
        run("set", named(every, tuned["paper"]), made, tuned=tuned["paper"])
    if "set_real" in wanted:
        few = (ANY, OURS, "p3p-ransac", "opencv-ransac", "poselib", "known-inliers")
        run("set_real", named(few, tuned["real"]), real, tuned=tuned["real"])
    if "set_real_given" in wanted:
        sigma = tune_sigma(counts.tuning_scenes())
        run("set_real_given", named((ANY,)), with_known_noise(real, sigma), img_sigma=sigma)


def tune_sigma(data: Mapping[str, EvaluationData]) -> float:
    """The standard deviation of the pixels with the highest success: to this solver what a threshold is to others."""

    def solved(sigma: float) -> float:
        path = OUTPUTS / "tuning" / f"set, {sigma:g}.json"
        rows = evaluate(named((ANY,)), with_known_noise(data, sigma), path=path, repeats=1)["rows"]
        return sum(float(row["success"]["rate"]) for row in rows)

    return max(SIGMAS, key=solved)


def with_known_noise(sets: Mapping[str, EvaluationData], img_sigma: float) -> dict[str, EvaluationData]:
    """Scenes with a known standard deviation of the pixels, and exact points."""
    found = {}
    for name, entry in sets.items():
        sigma = torch.full_like(entry.problems.world_points[:, 0, 0], img_sigma)
        problems = entry.problems._replace(img_sigma=sigma, world_sigma=torch.zeros_like(sigma))
        description = {**entry.description, "img_sigma": img_sigma, "world_sigma": 0.0}
        found[f"{name}, noise given"] = entry._replace(problems=problems, description=description)
    return found


def measure_set_given(counts: Counts, _: set[str]) -> None:
    """The network for any number of pairs with known noise."""
    options: dict[str, Any] = {"count": 2 * counts.synthetic, "seed": SEED_REPORT + 20, "known_noise": True}
    sets = counts.draw(["synthetic", "any_rotation"], "none,uniform,3", **options)
    run("set_given", named((ANY, "known-inliers-and-noise")), sets)


@torch.no_grad()
def measure_honesty(counts: Counts, _: set[str]) -> None:
    """Weights as probabilities, ``ok`` on problems without an answer, and covariances."""
    tuned = load_results(HERE / "paper.json")["tuned"]
    count = counts.synthetic // 2
    common: dict[str, Any] = {"count": count, "seed": SEED_REPORT + 30}

    def drawn(n: int, outliers: str, **more: Any) -> Problems:
        (entry,) = evaluation_sets(["synthetic"], outliers, n=n, **common, **more).values()
        return entry.problems

    solver = PnPNet.from_pretrained(ANY)
    sets = evaluation_sets(["synthetic"], "uniform", n=(6, 9, 20, 50), **common)
    sets |= evaluation_sets(["any_rotation"], "uniform", n=9, **common)
    sets |= evaluation_sets(["synthetic"], "50%", n=50, **common)
    diagrams = {}
    for name, entry in sets.items():
        problems = entry.problems
        found = reliability(solver.with_starts(*problems[:3], first_stage_only=True)[1].weights, problems.inliers)
        lists = {key: x.nan_to_num(0.0).tolist() for key, x in found._asdict().items()}
        diagrams[name] = {**lists, "error": found.expected_error}

    oks: dict[str, dict[str, Any]] = {}
    for n in (9, 20):
        sound, noise = drawn(n, "none"), drawn(n, f"{n}")
        others = sound._replace(img_points=sound.img_points.roll(1, 0))
        kinds = {"no outliers": sound, "pixels of other problems": others, "all pairs random": noise}
        names = (ANY, *((OURS,) if n == 9 else ()), "p3p-ransac", "opencv-ransac", "poselib")
        for name, other in named(names, tuned).items():
            for kind, problems in kinds.items():
                oks.setdefault(f"n = {n}, {kind}", {})[name] = success_rate(other(*problems[:3]).ok)._asdict()

    covariances = {}
    solver = solver.double()
    for n, wrong in ((12, 0), (12, 3), (20, 0), (20, 5), (50, 0), (50, 12)):
        problems = drawn(n, f"{wrong}" if wrong else "none", dtype=torch.float64, known_noise=True)
        covariances[f"n = {n}, {wrong} outliers"] = covariance_check(solver, problems)
    made = {"environment": environment(), "problems": count, "tuned": dict(tuned)}
    write_json(HERE / "honesty.json", {**made, "reliability": diagrams, "ok": oks, "covariance": covariances})


def covariance_check(solver: PnPNet, problems: Problems) -> dict[str, Any]:
    """Squared pose errors relative to the covariance: their mean, and the share below the 95 % quantile."""
    sigmas: dict[str, Any] = problems.sigmas
    result = solver(*problems[:3], **sigmas)
    covariance = pose_covariance(result.pose, *problems[:3], **sigmas, weights=result.weights)
    turn = rotation_matrix_to_axis_angle(result.rotation @ problems.pose.rotation.mT)
    error = torch.cat((turn, result.translation - problems.pose.translation), -1)  # (B, 6)
    squares = (error * torch.linalg.solve(covariance, error)).sum(-1)
    return {"mean": squares.mean().item(), "inside": success_rate(squares < CHI_SQUARE_95)._asdict()}


#: What measures which files.
STEPS: tuple[tuple[set[str], Callable[[Counts, set[str]], None]], ...] = (
    ({"paper", "gaussian_pose", "against_n"}, measure_protocol),
    ({"crowd"}, measure_crowd),
    ({"real", "mismatches"}, measure_scenes),
    ({"against_m"}, measure_depths),
    ({"views"}, measure_views),
    ({"set", "set_real", "set_real_given"}, measure_set),
    ({"set_given"}, measure_set_given),
    ({"honesty"}, measure_honesty),
)


def measure(scenes: Path, synthetic_count: int, real_count: int, only: Sequence[str]) -> None:
    """Solve everything, or the files in ``only``, and write the results files."""
    import cv2

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    wanted = set(only or (*RESULTS, *OTHERS))
    for names, step in STEPS:
        if wanted & names:
            step(Counts(scenes, synthetic_count, real_count), wanted & names)
    if wanted & {"probability", "judge"}:
        import measure_judge  # needs hydra
    if "probability" in wanted:
        write_json(HERE / "probability.json", measure_judge.measure_probability(SEED_TUNE, SEED_REPORT + 60))
    if "judge" in wanted:
        write_json(HERE / "judge.json", measure_judge.measure_judge(scenes, SEED_REPORT + 70))
    if "complexity" in wanted:
        write_json(HERE / "complexity.json", complexity_results())


def compare(scenes: Path, count: int, runs: Sequence[Path]) -> None:
    """Solve the scenes with two runs of ``train.py`` on different data, named by their folders."""
    solvers = {f"data={folder.name}": PnPNet.from_pretrained(folder / "weights") for folder in runs}
    folders = dict(zip(solvers, runs, strict=True))
    updates = {name: load_run(folder / "results.json").run.update for name, folder in folders.items()}
    run("distribution", solvers, Counts(scenes, 0, count).draw_scenes("none,2"), updates=updates)


def ship(runs: Sequence[Path]) -> None:
    """Put the weights of the last run into the package, with the learning curves of all runs."""
    results = load_run(runs[-1] / RESULTS_NAME)
    kind = "set" if results.initializer == "SetInit" else f"n{results.config['model']['n']}"
    kind += "-paper" if results.config["name"].endswith("-paper") else ""
    collect_weights(runs, WEIGHTS_FOLDER / f"pnpnet-{kind}")


def collect_weights(runs: Sequence[Path], folder: Path) -> None:
    """Gather weights, results, model card and learning curves of successive runs of ``train.py`` in one folder.

    Each run after the first began with the weights of the run before. The folder gets at most 100 rows of each run's
    learning curves, all with a validation, and gives the weights their name. After an error nothing is written.
    """
    curves: list[pd.DataFrame] = []
    for path in (run / HISTORY_NAME for run in runs):
        rows = pd.read_csv(path)
        rows = rows.dropna(subset=[name for name in rows if name.startswith("val/")], how="all")
        if rows.empty:
            raise ValueError(f"'{path}' has no row with a validation.")
        rows = rows[:: -max(1, -(-len(rows) // _MOST_ROWS))][::-1]  # evenly spaced, the last one included
        before = curves[-1]["update"].iloc[-1] if curves else 0  # updates count from the first run on
        curves.append(rows.assign(update=rows["update"] + before))
    results = load_run(runs[-1] / RESULTS_NAME)
    PnPNet.from_pretrained(runs[-1] / "weights")  # raises when they are damaged
    shutil.copytree(runs[-1] / "weights", folder, dirs_exist_ok=True)
    write_json(folder / RESULTS_NAME, to_json(results))
    write_model_card(folder, results, name=folder.name)
    pd.concat(curves).to_csv(folder / HISTORY_NAME, index=False)
