"""Measure and write the results page: ``python docs/results/make.py measure`` and ``... render``.

``measure`` solves fresh problems with every solver and writes the results files here, without the errors of single
problems; with them they are in ``outputs/results``, from where a run that was stopped continues. It needs the scenes
(``--scenes``, default ``../shared/data``). ``compare`` (two folders of ``train.py`` with ``--runs``) writes
``distribution.json`` in the same way, and ``ship`` (with ``--runs`` the folders of one solver's runs, one after the
other) puts its weights into the package. ``render`` reads the files and
writes ``README.md`` and the pictures; every number of the page comes from the files. ``ablation.csv`` and ``sweep.csv``
are copies of ``summary.csv`` in the folders of these, which take less than an hour on one core and go on where they
were stopped::

    SHORT="train.updates=4000 validation_size=5000 threads=1 hydra.sweep.dir=outputs/ablation resume=true"
    python train.py -m experiment=recipe $SHORT
    python train.py -m experiment=net_loss_only,identity_start,shared,additive,uncentred $SHORT
    python train.py -m experiment=kernels $SHORT
    python train.py -m experiment=sweep threads=1 hydra.sweep.dir=outputs/sweep resume=true
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise, product, takewhile
from pathlib import Path
from typing import Any

import torch
from kornia.geometry.conversions import rotation_matrix_to_axis_angle
from torch import nn

from kornia_pnpnet import PnPNet, RobustWeightedLM, pose_covariance
from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.core.files import write_json
from kornia_pnpnet.evaluation import EvaluationData, evaluate
from kornia_pnpnet.evaluation.figures import paper_figures, plot_reliability, plot_sweep, plot_training
from kornia_pnpnet.evaluation.figures.sweep import mix_in_words
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.evaluation.operations import complexity_results
from kornia_pnpnet.evaluation.problem_sets import evaluation_sets
from kornia_pnpnet.evaluation.results import format_table, load_results, save_results
from kornia_pnpnet.metrics import SuccessRate, reliability, success_rate
from kornia_pnpnet.pretrained import WEIGHTS_FOLDER, shipped_weights
from kornia_pnpnet.training.collect import collect_weights
from kornia_pnpnet.training.results import load_run
from kornia_pnpnet.types import PnPResult, Problems

HERE = Path(__file__).resolve().parent
OUTPUTS = HERE.parents[1] / "outputs" / "results"
EXPERIMENTS = HERE.parents[1] / "conf" / "experiment"
OURS = "pnpnet-n9"
ANY = "pnpnet-set"
METRIC_SCENES = ("strecha/fountain-P11", "strecha/Herz-Jesus-P25", "eth3d/courtyard")
OTHER_SCENES = ("colmap/lund_door", "colmap/sceaux_castle")
# Nothing was trained, tuned or looked at with these before.
SEED_REPORT, SEED_TUNE = 20_261_131, 20_261_132

UNTUNED = (OURS, "net-n9", "identity-lm", "epnp", "epnp-lm", "reppnp", "reppnp-lm", "opencv-epnp", "opencv-sqpnp")
THRESHOLDS = (1.0, 2.0, 5.0, 10.0, 20.0, 35.0, 50.0, 80.0, 120.0)
# Threshold methods: what they are made from, and what is tried. `p3p-ransac` has the one knob that all have;
# `p3p-ransac-noise` also allows for noise of the world points. OpenCV's RANSAC as people call it (AP3P, refined),
# and the strongest way we found of calling it.
TUNED: dict[str, tuple[str, dict[str, Sequence[float]]]] = {
    "ransac-epnp-lm": ("ransac-epnp-lm", {"threshold": THRESHOLDS}),
    "p3p-ransac": ("p3p-ransac", {"threshold": THRESHOLDS}),
    "p3p-ransac-noise": (
        "p3p-ransac",
        {"threshold": (1.0, 2.0, 3.0, 5.0, 10.0), "world_threshold": (0.05, 0.1, 0.15, 0.2, 0.3, 0.4)},
    ),
    "opencv-ransac": ("opencv-ransac", {"threshold": THRESHOLDS}),
    "opencv-ransac-sqpnp": ("opencv-ransac:method=SQPNP,refine=false", {"threshold": THRESHOLDS}),
    "opencv-usac": ("opencv-usac", {"threshold": THRESHOLDS}),
    "poselib": ("poselib", {"threshold": THRESHOLDS}),
    "pycolmap": ("pycolmap", {"threshold": THRESHOLDS}),
}
PEERS = ("opencv-ransac", "opencv-ransac-sqpnp", "opencv-usac", "poselib", "pycolmap")
ROBUST = ("p3p-ransac", "p3p-ransac-noise", *PEERS)
BOUNDS = ("known-inliers", "known-inliers-and-noise")
VIEWS = (1, 2, 3, 4, 8)
SYNTHETIC = ("paper", "any_rotation")
# Noise of a scene's pixels that is tried, as thresholds are.
SIGMAS = (0.25, 0.5, 1.0, 2.0)
# Below this a chi-square number of six degrees of freedom is in 95 of 100 cases.
CHI_SQUARE_95 = 12.592
SCALES = (("cauchy", 10.0), ("geman_mcclure", 20.0))


# -- measuring -------------------------------------------------------------------------------------------------------


def named(names: Iterable[str], found: Mapping[str, str]) -> dict[str, nn.Module]:
    """Solvers by what the page calls them; ``found`` has the options that tuning found."""
    return {name: load_solver(found.get(name, name)) for name in names}


def tune(data: Mapping[str, EvaluationData], label: str, names: Iterable[str] = tuple(TUNED)) -> dict[str, str]:
    """For each threshold method the options with which it succeeds most often over all sets."""
    best = {}
    for name in names:
        base, grid = TUNED[name]
        start = base + ("," if ":" in base else ":")
        specs = [
            start + ",".join(f"{key}={value:g}" for key, value in zip(grid, values, strict=True))
            for values in product(*grid.values())
        ]
        candidates = {spec: load_solver(spec) for spec in specs}
        results = evaluate(candidates, data, path=OUTPUTS / "tuning" / f"{label}, {name}.json", repeats=1)
        total = dict.fromkeys(specs, 0.0)
        for row in results["rows"]:
            total[row["solver"]] += row["success"]["rate"]
        best[name] = max(specs, key=lambda spec: total[spec])
    return best


def real_sets(
    scenes: Path, outliers: str, *, count: int, seed: int, others: bool, mismatches_only: bool = False
) -> dict[str, EvaluationData]:
    """Problems of the scenes in metres and, with ``others``, of those of another unit."""
    common: dict[str, Any] = {"n": 9, "count": count, "seed": seed, "dtype": torch.float64}
    common["mismatches_only"] = mismatches_only
    sets = evaluation_sets([str(scenes / name) for name in METRIC_SCENES], outliers, **common)
    if others:
        sets |= evaluation_sets([str(scenes / name) for name in OTHER_SCENES], outliers, metric=False, **common)
    return sets


class FromTheTruth(nn.Module):
    """The refinement of a solver from the true pose: what it would reach if its first guess were perfect."""

    def __init__(self, solver: PnPNet) -> None:
        super().__init__()
        self.config = solver.config()
        self.solver = solver

    def solve_with_truth(self, problems: Problems) -> PnPResult:
        """Start from the answers."""
        return self.solver(*problems[:3], init=problems.pose)


def classical(kernel: str, shape: float) -> PnPNet:
    """The refinement with classical step and damping and one shape of a kernel, run to the end."""
    return PnPNet(None, RobustWeightedLM(30, kernel=kernel, robustness=shape, learnable=False))


def run(name: str, solvers: Mapping[str, nn.Module], data: Mapping[str, EvaluationData], **more: Any) -> None:
    """Evaluate into ``outputs/results`` and write what the page needs of it here."""
    results = evaluate(solvers, data, path=OUTPUTS / f"{name}.json")
    rows = [{key: value for key, value in row.items() if key != "per_problem"} for row in results["rows"]]
    save_results({**results, "rows": rows, **more}, HERE / f"{name}.json")
    print(f"\n{name}\n{format_table(results)}", flush=True)


def set_data(scenes: Path, count: int, real_count: int) -> dict[str, EvaluationData]:
    """What a solver for any number of pairs must stand: numbers of pairs, rotations, shares of wrong ones, scenes."""
    common: dict[str, Any] = {"dtype": torch.float64, "seed": SEED_REPORT + 20}
    sets = evaluation_sets(["synthetic", "any_rotation"], "none,uniform,3", n=9, count=count, **common)
    for n, wrong in ((6, "uniform"), (12, "uniform"), (20, "uniform,50%"), (50, "uniform,50%"), (200, "uniform,50%")):
        sets |= evaluation_sets(["synthetic"], wrong, n=n, count=count if n < 100 else count // 5, **common)
    common["count"] = real_count
    for n, wrong in ((9, "2"), (12, "3")):
        sets |= evaluation_sets([str(scenes / name) for name in METRIC_SCENES], wrong, n=n, **common)
        sets |= evaluation_sets([str(scenes / name) for name in OTHER_SCENES], wrong, n=n, metric=False, **common)
    matches = sorted(str(path) for path in (scenes / "matches").glob("*.npz"))
    return sets | {
        f"{name} (raw matches)": entry for name, entry in evaluation_sets(matches, "none", n=50, **common).items()
    }


def with_noise_told(sets: Mapping[str, EvaluationData], img_sigma: float) -> dict[str, EvaluationData]:
    """Scenes of which a solver is told that pixels are off by so much, and points are not."""
    found = {}
    for name, entry in sets.items():
        sigma = torch.full_like(entry.problems.world_points[:, 0, 0], img_sigma)
        problems = entry.problems._replace(img_sigma=sigma, world_sigma=torch.zeros_like(sigma))
        description = {**entry.description, "img_sigma": img_sigma, "world_sigma": 0.0}
        found[f"{name}, noise told"] = entry._replace(problems=problems, description=description)
    return found


def honesty(tuned: Mapping[str, str], count: int) -> dict[str, Any]:
    """What solvers say of their own answers: weights as chances, ``ok`` on garbage, covariances."""
    solver = PnPNet.from_pretrained(ANY)
    common: dict[str, Any] = {"count": count, "seed": SEED_REPORT + 30}

    def drawn(n: int, outliers: str, **more: Any) -> Problems:
        (entry,) = evaluation_sets(["synthetic"], outliers, n=n, **common, **more).values()
        return entry.problems

    sets = evaluation_sets(["synthetic"], "uniform", n=(6, 9, 20, 50), **common)
    sets |= evaluation_sets(["any_rotation"], "uniform", n=9, **common)
    sets |= evaluation_sets(["synthetic"], "50%", n=50, **common)
    diagrams = {}
    for name, entry in sets.items():
        _, guess = solver.with_guess(*entry.problems[:3])
        found = reliability(guess.weights, entry.problems.inliers)
        lists = {key: x.nan_to_num(0.0).tolist() for key, x in found._asdict().items()}
        diagrams[name] = {**lists, "error": found.expected_error}

    oks: dict[str, dict[str, Any]] = {}
    for n in (9, 20):
        sound, noise = drawn(n, "none"), drawn(n, f"{n}")
        others = sound._replace(img_points=sound.img_points.roll(1, 0))
        kinds = {"no pair wrong": sound, "pixels of other problems": others, "all pairs random": noise}
        names = (ANY, *((OURS,) if n == 9 else ()), "p3p-ransac", "opencv-ransac", "poselib")
        for name, other in named(names, tuned).items():
            for kind, problems in kinds.items():
                rate = success_rate(other(*problems[:3]).ok)._asdict()
                oks.setdefault(f"n = {n}, {kind}", {})[name] = rate

    covariances = {}
    for n, wrong in ((12, 0), (12, 3), (20, 0), (20, 5), (50, 0), (50, 12)):
        problems = drawn(n, f"{wrong}" if wrong else "none", dtype=torch.float64, known_noise=True)
        result = PnPNet.from_pretrained(ANY).double()(*problems[:3], **problems.sigmas)
        covariance = pose_covariance(result.pose, *problems[:3], **problems.sigmas, weights=result.weights)
        turn = rotation_matrix_to_axis_angle(result.rotation @ problems.pose.rotation.mT)
        error = torch.cat((turn, result.translation - problems.pose.translation), -1)
        squares = (error * torch.linalg.solve(covariance, error)).sum(-1)
        inside = success_rate(squares < CHI_SQUARE_95)._asdict()
        covariances[f"n = {n}, {wrong} wrong"] = {"mean": squares.mean().item(), "inside": inside}
    made = {"environment": environment(), "problems": count, "tuned": dict(tuned)}
    return {**made, "reliability": diagrams, "ok": oks, "covariance": covariances}


def measure(scenes: Path, synthetic_count: int, real_count: int, only: Sequence[str]) -> None:
    """Solve everything and write the results files."""
    import cv2

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    synthetic: dict[str, Any] = {"dtype": torch.float64, "seed": SEED_REPORT, "n": 9, "count": synthetic_count}
    tuning: dict[str, Any] = {**synthetic, "seed": SEED_TUNE, "count": synthetic_count // 10}
    crowd: dict[str, Any] = {"n": 100, "outliers": "50%,70%"}
    sharp = tuple(name for name in TUNED if "noise" not in name)  # the scenes' points are as exact as their pixels
    fast = (*UNTUNED, "p3p-ransac", "p3p-ransac-noise", "opencv-ransac", "poselib", *BOUNDS)
    depths = [
        f"{name}:m={m}" for name in ("identity-lm", "epnp-lm", "reppnp-lm") for m in (0, 1, 2, 3, 5, 7, 10, 15, 20, 30)
    ]
    shipped = PnPNet.from_pretrained(OURS)
    depths += [f"{OURS}:m={m}" for m in range(shipped.refine.m + 1)]

    def wanted(name: str) -> bool:
        return not only or name in only

    if any(wanted(name) for name in ("paper", "gaussian_pose", "against_n")):
        found = tune(evaluation_sets(["synthetic"], "none,uniform,3", **tuning), "paper")
        everything = named((*UNTUNED, *TUNED, *BOUNDS), found)
        if wanted("paper"):
            run("paper", everything, evaluation_sets(["synthetic"], "none,uniform,3", **synthetic), tuned=found)
        if wanted("gaussian_pose"):
            run(
                "gaussian_pose",
                everything,
                evaluation_sets(["gaussian_pose"], "none,uniform,3", **synthetic),
                tuned=found,
            )
        if wanted("against_n"):
            sets = evaluation_sets(["synthetic"], "none,uniform", **{**synthetic, "n": [6, 9, 12, 20, 50]})
            run("against_n", named(dict.fromkeys((*shipped_weights(), *fast)), found), sets, tuned=found)
    if wanted("crowd"):
        found = tune(evaluation_sets(["synthetic"], **{**tuning, **crowd, "count": real_count // 5}), "crowd", ROBUST)
        sets = evaluation_sets(["synthetic"], **{**synthetic, **crowd, "count": real_count})
        run("crowd", named((*ROBUST, *BOUNDS), found), sets, tuned=found)
    if wanted("real") or wanted("mismatches"):
        found = tune(real_sets(scenes, "none,2", count=real_count // 5, seed=SEED_TUNE, others=False), "real", sharp)
        if wanted("real"):
            sets = real_sets(scenes, "none,2", count=real_count, seed=SEED_REPORT, others=True)
            run("real", named((*UNTUNED, *sharp, "known-inliers"), found), sets, tuned=found)
        if wanted("mismatches"):
            options: dict[str, Any] = {
                "count": real_count,
                "seed": SEED_REPORT + 10,
                "others": False,
                "mismatches_only": True,
            }
            names = (OURS, "reppnp-lm", "epnp-lm", "p3p-ransac", "opencv-ransac", "poselib", "known-inliers")
            run("mismatches", named(names, found), real_sets(scenes, "none,1,2,3,4,5", **options), tuned=found)
    if wanted("against_m"):
        run("against_m", named(depths, {}), evaluation_sets(["synthetic"], "none,uniform", **synthetic))
    if wanted("views"):
        sets = real_sets(scenes, "2", count=real_count, seed=SEED_REPORT, others=True)
        sets |= evaluation_sets(["synthetic"], "none,uniform,3", **synthetic)
        guesses: dict[str, nn.Module] = {
            f"{OURS}:views={count}": load_solver(f"{OURS}:views={count}") for count in VIEWS
        }
        guesses |= {f"{OURS} from the truth": FromTheTruth(shipped)}
        kernels = {f"alpha = {alpha:g}": classical("power", alpha) for alpha in (1.0, 1.5, 2.0)}
        kernels |= {f"{name}, {scale:g} px": classical(name, scale) for name, scale in SCALES}
        guesses |= {f"{name} from the truth": FromTheTruth(solver) for name, solver in kernels.items()}
        run("views", guesses, sets)
    if any(wanted(name) for name in ("set", "set_real", "set_real_told")):
        # Tuned by `paper` and `real`, where these are not measured along with this.
        tuned = {name: load_results(HERE / f"{name}.json")["tuned"] for name in ("paper", "real")}
        sets = set_data(scenes, 2 * synthetic_count, real_count)
        synthetic_sets = {name: entry for name, entry in sets.items() if entry.description["source"] in SYNTHETIC}
        real = {name: entry for name, entry in sets.items() if name not in synthetic_sets}
        if wanted("set"):
            every = (ANY, *(name for name in ROBUST if name != "pycolmap"), *BOUNDS)
            run("set", named(every, tuned["paper"]), synthetic_sets, tuned=tuned["paper"])
        if wanted("set_real"):
            few = (ANY, OURS, "p3p-ransac", "opencv-ransac", "poselib", "known-inliers")
            run("set_real", named(few, tuned["real"]), real, tuned=tuned["real"])
        if wanted("set_real_told"):
            # What the threshold is to the others is the pixels' noise to this one.
            sharpest = real_sets(scenes, "none,2", count=real_count // 5, seed=SEED_TUNE, others=False)
            solved = dict.fromkeys(SIGMAS, 0.0)
            for sigma in SIGMAS:
                told = with_noise_told(sharpest, sigma)
                path = OUTPUTS / "tuning" / f"set, {sigma:g}.json"
                rows = evaluate(named((ANY,), {}), told, path=path, repeats=1)["rows"]
                solved[sigma] = sum(row["success"]["rate"] for row in rows)
            sigma = max(solved, key=lambda sigma: solved[sigma])
            run("set_real_told", named((ANY,), {}), with_noise_told(real, sigma), img_sigma=sigma)
    if wanted("set_told"):
        common = {**synthetic, "count": 2 * synthetic_count, "seed": SEED_REPORT + 20, "known_noise": True}
        sets = evaluation_sets(["synthetic", "any_rotation"], "none,uniform,3", **common)
        run("set_told", named((ANY, "known-inliers-and-noise"), {}), sets)
    if wanted("honesty"):
        with torch.no_grad():
            found = honesty(load_results(HERE / "paper.json")["tuned"], synthetic_count // 2)
        write_json(HERE / "honesty.json", found)
    if wanted("complexity"):
        write_json(HERE / "complexity.json", complexity_results())


# -- the page --------------------------------------------------------------------------------------------------------


class Rates:
    """Success rates and times of a results file by data set and solver."""

    def __init__(self, results: Mapping[str, Any]) -> None:
        self.results = results
        self.rows = {(row["data"], row["solver"]): row for row in results["rows"]}
        self.sets = list(results["data"])
        self.solvers = [name for name in results["solvers"] if any((data, name) in self.rows for data in self.sets)]

    def rate(self, data: str, solver: str) -> float:
        """Success in per cent."""
        return 100 * float(self.rows[data, solver]["success"]["rate"])

    def versus(self, data: str, one: str, other: str) -> str:
        """How far one solver is from another, in points, and whether the intervals are apart."""
        a, b = (self.rows[data, name]["success"] for name in (one, other))
        apart = a["low"] > b["high"] or b["low"] > a["high"]
        difference = 100 * (a["rate"] - b["rate"])
        return (
            f"{difference:+.1f} points ({('ahead' if difference > 0 else 'behind') if apart else 'intervals overlap'})"
        )

    def best(self, data: str, solvers: Iterable[str]) -> str:
        """Who succeeds most often."""
        return max((name for name in solvers if (data, name) in self.rows), key=lambda name: self.rate(data, name))

    def cost(self, data: str, one: str, other: str) -> float:
        """How many times as long as the first solver the second takes."""
        return float(self.rows[data, other]["us_per_problem"] / self.rows[data, one]["us_per_problem"])

    def table(self, sets: Sequence[str] | None = None, *, times: bool = True) -> str:
        """A line for each solver: success with its interval and, with ``times``, microseconds for each set."""
        sets = self.sets if sets is None else sets
        start = f"{sets[0].rpartition(', ')[0]}, "
        common = all(data.startswith(start) for data in sets)
        heads = [data.removeprefix(start) if common else data for data in sets]
        lines = ["| Solver | " + " | ".join(f"{head} (%) | µs" if times else f"{head} (%)" for head in heads) + " |"]
        lines.append("|---" + "|---:" * (len(heads) * (1 + times)) + "|")
        for solver in self.solvers:
            there = [self.rows.get((data, solver)) for data in sets]
            cells = [self._cells(row, times) for row in there]
            if any(there):
                lines.append(f"| `{solver}` | " + " | ".join(cells) + " |")
        return "\n".join(lines)

    @staticmethod
    def _cells(row: Mapping[str, Any] | None, times: bool) -> str:
        if row is None:
            return "– | –" if times else "–"
        rate, low, high = (100 * row["success"][key] for key in ("rate", "low", "high"))
        return f"{rate:.1f} [{low:.1f}, {high:.1f}]" + (f" | {row['us_per_problem']:.0f}" if times else "")


CLAIMS = """\
1. *The cost is low and fixed.* On problems without and with exactly 3 wrong pairs `{ours}` takes {us_none:.0f} and
   {us_three:.0f} µs, the paper's RANSAC `{ransac}` {ransac_none:.0f} and {ransac_three:.0f}, a ratio of
   {cost_ransac:.0f}. In operations at n = 9 it is {flops_ours} against {flops_ransac}, a ratio of
   {flops_ratio:.0f}; the classical `epnp-lm` has {flops_epnp_lm}. In µs `epnp` takes {cost_epnp:.1f} and
   `reppnp`, which also stands wrong pairs, {cost_reppnp:.1f} times as long as `{ours}`; `p3p-ransac`
   {cost_p3p:.1f} times.
2. *Direct methods are not accurate when pairs are wrong.* With k uniform `epnp-lm` solves {epnp_lm:.1f} %, `{ours}`
   {pnpnet:.1f} %: {against_epnp_lm}. REPPnP as published is far behind too (the authors' implementation: 56 % without
   wrong pairs at n = 9, PROTOCOL's measurement, not ours); `reppnp` as it is built here departs from it (see its
   documentation) and solves {reppnp:.1f} % with k uniform ({against_reppnp} for `{ours}`) and {reppnp_three:.1f} % with
   exactly 3 ({against_reppnp_three}).
3. *The success is that of RANSAC.* `{ours}` against the paper's own RANSAC: {against_ransac_none} without wrong pairs,
   {against_ransac} with k uniform, {against_ransac_three} with exactly 3. Against `p3p-ransac`, whose samples of 3 are
   free of outliers when samples of 7 of 9 never are: {against_p3p_none}, {against_p3p}, {against_p3p_three}.
4. *It carries over to real data.* Over the scenes with 2 of 9 pairs wrong `{ours}` solves {real:.1f} %, `reppnp-lm`
   {real_reppnp:.1f} %, `p3p-ransac` {real_p3p:.1f} %; without wrong pairs {real_none:.1f}, {real_none_reppnp:.1f} and
   {real_none_p3p:.1f} %.
"""


PAGE = """\
# Results

Written by `docs/results/make.py` from the results files beside it; no number here is typed. Success: rotation error
below 1° and translation error below 0.2 m, or 0.5 % of the median depth where a scene has no unit. Brackets: 95 %
intervals. Every solver has the same problems of seeds that nothing was trained or tuned on, in float64. Time: calls of
1000 problems, one thread, {cpu}, commit {commit}; the machine was shared, so compare
within a column, and see [benchmarks](../../benchmarks/solvers.md) for times taken in turns. The thresholds of all
threshold methods were tuned by success on another seed:

{tuned}

`{ours}` is the paper's PnP-Net, with a robust kernel whose scale is learned in place of the paper's power and the best
of {shipped_views} guesses; `net-n9` its first stage alone, `-lm` the classical robust LM (α = 1) after a method,
`ransac-epnp-lm` the paper's RANSAC on samples of 7. `p3p-ransac` has the threshold in pixels that every peer has;
`p3p-ransac-noise` also allows for noise of the world points. `opencv-ransac` is OpenCV {opencv}'s RANSAC with AP3P
and a final refinement, as it is usually called; `opencv-ransac-sqpnp` the same with SQPnP and no refinement, the
strongest call we found. The bounds know which pairs are wrong, and how large the noise is. Which solver for what:
[solvers](../solvers.md).

## What the paper claims, and what we find

{claims}
## The protocol's data, n = 9

{paper}

![Success on the protocol's data](figure2_paper.png)

Against the best of the other libraries:

{paper_peers}

## Normal translations, n = 9

{gaussian_pose}

![Success with normal translations](figure3_gaussian_pose.png)

## Operations

Counted by the protocol of Minka's Lightspeed toolbox from formulas that a test holds against an instrumented run
(`kornia_pnpnet.evaluation.operations`).

![Operations against n](figure1_operations.png)

## Real scenes

9 random observed points of a random image; 2 of them spoilt, or none. fountain-P11 and Herz-Jesus-P25: Strecha et al.,
CVPR 2008; courtyard: ETH3D, Schöps et al., CVPR 2017, its observations simulated from the official reconstruction;
lund_door and sceaux_castle: COLMAP models of arbitrary unit.

{real}

![Success on real scenes](figure4_scenes.png)

Against the best of the other libraries:

{real_peers}

![Success against the number of mismatches](figure5_mismatches.png)

Each mismatch shows a point of its own.

## Many pairs, most of them wrong

n = 100 with 50 and with 70 wrong pairs.

{crowd}

## One network for any number of pairs

`{any}` on other problems than above: the protocol's, the same with rotations by any angle, other numbers of pairs and
shares of wrong ones, and scenes, also the raw matches of two of them, whose mismatches are real. The weights are the
same everywhere; thresholds are those tuned for the protocol's data and for scenes.

{set}

With the noise of pixels and points told (`img_sigma=1.0, world_sigma=0.05`):

{set_told}

Scenes:

{set_real}

The same with `img_sigma={img_sigma:g}, world_sigma=0`, tuned as the others' thresholds are: points of a reconstruction
are nearly exact, which the network, untold, cannot know.

{set_real_told}

Against the best of the threshold methods, ours and others:

{set_peers}

## What a solver says of its own answer

The weights that the network of `{any}` gives the pairs before the refinement, against the share of them that are right:
below the dotted line they are too high. The lower panel says how many pairs have such a weight. The expected
calibration error: {calibration}.

![Weights against the share of pairs that are right](reliability.png)

How many answers are called `ok`, in per cent. Pixels of other problems, and pairs that are all random, have no answer:

{oks}

The error of the pose, squared and relative to what `pose_covariance` says from the weights of `{any}`, which is told
the noise: of six degrees of freedom its mean should be 6, and 95 % of it below {chi_square:.1f}.

{covariances}

## Against the number of pairs

{against_n}

![Success against n](success_against_n.png)

## Against the number of iterations

`{ours}:m=2` are the first two of the trained iterations; the classical LM has as many as it is given.

![Success against m](success_against_m.png)

## Why half of the training is tilted slabs

Two short runs ({distribution_runs}): `data=paper` on the protocol's box alone, `data=mixed` as shipped. The box is
longer along the optical axis than across, which no façade is: what the network learns of it does not carry over.

{distribution}

## More guesses for each problem, and a perfect one

The network guesses from `views` mirror images of each problem ({shipped_views} as `{ours}` is shipped), seven tenths of
the iterations refine all of them, and the best goes on: most of what it loses on scenes with wrong pairs, it loses to a
first guess that is too far off. On the protocol's data that is a smaller part. `{ours} from the truth` starts its
few iterations at the true pose; `alpha = ...`, the paper's weight, and kernels with a scale `from the truth` are 30
classical iterations from there, which is where the minima are: wrong pairs and noise move them. On the scenes these
minima are hardly ever wrong. On the protocol's data, whose points have noise of their own, they are about as good as
RANSAC (first table), and the learned iterations, which need not end in a minimum, are compared with them.

{views}

## Ablations

{ablation}

## Sweep over n, m and the mix of wrong pairs

{sweep}

## Training

{trainings}
"""
RESULTS = (
    *("paper", "gaussian_pose", "real", "mismatches", "crowd", "against_n", "against_m", "views", "distribution"),
    *("set", "set_told", "set_real", "set_real_told"),
)


def claims(paper: Rates, real: Rates, complexity: Mapping[str, Any]) -> str:
    """The paper's claims beside what the files say."""
    none, uniform, three = paper.sets
    ransac = "ransac-epnp-lm"
    at_nine = complexity["n"].index(9)
    flops = {name: counts[at_nine] for name, counts in complexity["counts"].items()}

    def versus(other: str, data: str) -> str:
        return paper.versus(data, OURS, other)

    def pooled(solver: str, wrong: str) -> float:
        rates = [real.rate(data, solver) for data in real.sets if data.endswith(wrong)]
        return sum(rates) / len(rates)

    return CLAIMS.format(
        ours=OURS,
        ransac=ransac,
        us_none=paper.rows[none, OURS]["us_per_problem"],
        us_three=paper.rows[three, OURS]["us_per_problem"],
        ransac_none=paper.rows[none, ransac]["us_per_problem"],
        ransac_three=paper.rows[three, ransac]["us_per_problem"],
        cost_ransac=paper.cost(three, OURS, ransac),
        cost_epnp=paper.cost(three, OURS, "epnp"),
        cost_reppnp=paper.cost(three, OURS, "reppnp"),
        cost_p3p=paper.cost(three, OURS, "p3p-ransac"),
        flops_ours=f"{flops['pnpnet']:,.0f}",
        flops_ransac=f"{flops[ransac]:,.0f}",
        flops_epnp_lm=f"{flops['epnp-lm']:,.0f}",
        flops_ratio=flops[ransac] / flops["pnpnet"],
        pnpnet=paper.rate(uniform, OURS),
        epnp_lm=paper.rate(uniform, "epnp-lm"),
        against_epnp_lm=versus("epnp-lm", uniform),
        reppnp=paper.rate(uniform, "reppnp"),
        reppnp_three=paper.rate(three, "reppnp"),
        against_reppnp=versus("reppnp", uniform),
        against_reppnp_three=versus("reppnp", three),
        against_ransac_none=versus(ransac, none),
        against_ransac=versus(ransac, uniform),
        against_ransac_three=versus(ransac, three),
        against_p3p_none=versus("p3p-ransac", none),
        against_p3p=versus("p3p-ransac", uniform),
        against_p3p_three=versus("p3p-ransac", three),
        real=pooled(OURS, "2 outliers"),
        real_reppnp=pooled("reppnp-lm", "2 outliers"),
        real_p3p=pooled("p3p-ransac", "2 outliers"),
        real_none=pooled(OURS, " 0 outliers"),
        real_none_reppnp=pooled("reppnp-lm", " 0 outliers"),
        real_none_p3p=pooled("p3p-ransac", " 0 outliers"),
    )


def beside_peers(rates: Rates, solvers: Iterable[str]) -> str:
    """One line for each data set: how far our solvers are from the best peer."""
    lines = []
    for data in rates.sets:
        peer = rates.best(data, (*PEERS, "opencv-epnp", "opencv-sqpnp"))
        parts = ", ".join(f"`{name}` {rates.versus(data, name, peer)}" for name in solvers)
        lines.append(f"- {data}, best is `{peer}` with {rates.rate(data, peer):.1f} %: {parts}.")
    return "\n".join(lines)


def honesty_parts(found: Mapping[str, Any]) -> dict[str, str]:
    """The section's texts."""
    errors = ", ".join(f"{entry['error']:.3f} ({name})" for name, entry in found["reliability"].items())
    names = list(dict.fromkeys(name for rates in found["ok"].values() for name in rates))
    head = "| | " + " | ".join(f"`{name}`" for name in names) + " |\n|---|" + "---:|" * len(names)
    lines = [
        f"| {kind} | " + " | ".join(str(SuccessRate(**rates[name])) if name in rates else "–" for name in names) + " |"
        for kind, rates in found["ok"].items()
    ]
    covariances = ["| | mean | below the limit |", "|---|---:|---:|"] + [
        f"| {name} | {entry['mean']:.2f} | {SuccessRate(**entry['inside'])} |"
        for name, entry in found["covariance"].items()
    ]
    return {"calibration": errors, "oks": "\n".join([head, *lines]), "covariances": "\n".join(covariances)}


def beside_best(rates: Rates, solver: str, others: Iterable[str]) -> str:
    """One line for each data set: how far a solver is from the best of others."""
    lines = []
    for data in rates.sets:
        best = rates.best(data, others)
        lines.append(
            f"- {data}, best is `{best}` with {rates.rate(data, best):.1f} %: {rates.versus(data, solver, best)}."
        )
    return "\n".join(lines)


ABLATION = """\
Short runs ({updates} updates) of the shipped recipe with one thing changed, each by the file of its name in
[conf/experiment](../../conf/experiment), which opens with its command; success on the training's validation sets, and
µs per problem (the shortest call of 1000 problems at the end of the run, one thread). `recipe` changes nothing: its
{seeds} seeds differ by up to {spread:.1f} points, which the intervals do not cover, since they are about the problems
alone. So a run counts as above or below only if its interval is above or below those of all seeds of `recipe`; the
difference is from their mean.

{table}

{findings}"""

SWEEP = """\
`python train.py -m experiment=sweep`: {updates} updates for each n, m and mix of wrong pairs, which is also the mix
that is tested. So short, the runs compare with each other, not with the shipped weights, and another seed changes them
too (see the ablations). µs as above, the least over the mixes, on which it does not depend.

{table}

{findings}

![Success against m](sweep_against_m.png)

![Success against n](sweep_against_n.png)"""

Row = Mapping[str, str]
KERNEL = "model.solver.refine.kernel"


def read_summary(path: Path) -> list[Row]:
    """The rows of the summary of a multirun, none when it was not run."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def percent(row: Row, data: str) -> tuple[float, float, float]:
    """Success of a run on a validation set and its interval."""
    rate, low, high = (100 * float(row[f"{data}/{key}"]) for key in ("rate", "low", "high"))
    return rate, low, high


def compared(runs: Sequence[Row], others: Sequence[Row], data: str) -> str:
    """How far the mean of some runs is from that of others, in points, and whether all intervals are apart."""
    (rates, lows, highs), (other_rates, other_lows, other_highs) = (
        zip(*(percent(row, data) for row in rows), strict=True) for rows in (runs, others)
    )
    difference = sum(rates) / len(rates) - sum(other_rates) / len(other_rates)
    above, below = min(lows) > max(other_highs), max(highs) < min(other_lows)
    return f"{difference:+.1f} points ({'above' if above else 'below' if below else 'not told apart'})"


def updates_of(rows: Sequence[Row]) -> str:
    """How long runs were, which is the same for all or said as it is."""
    return " or ".join(dict.fromkeys(row["update"] for row in rows))


def claim(experiment: str) -> str:
    """What an experiment's file says that it tests."""
    lines = (EXPERIMENTS / f"{experiment}.yaml").read_text(encoding="utf-8").splitlines()
    comment = " ".join(line.removeprefix("# ") for line in takewhile(lambda line: line.startswith("#"), lines))
    return comment.partition("Claim: ")[2]


def ablation_text(rows: Sequence[Row]) -> str:
    """Short runs beside the recipe's: a table, and for each experiment its claim and what the intervals say of it."""
    sets = [key.removesuffix("/rate") for key in rows[0] if key.endswith("/rate")]
    recipe = [row for row in rows if row["experiment"] == "recipe"]
    lines = [
        "| Run | " + " | ".join(f"{data} (%)" for data in sets) + " |",
        "|---" + "|---:" * len(sets) + "|",
    ]
    for row in [*recipe, *(row for row in rows if row not in recipe)]:
        seed = f"seed={row['seed']}" if row.get("seed") else ""
        name = " ".join(filter(None, (row["experiment"], row.get(KERNEL), seed)))
        cells = ["{:.1f} [{:.1f}, {:.1f}]".format(*percent(row, data)) for data in sets]
        lines.append(f"| `{name}` | " + " | ".join(cells) + " |")
    findings = []
    for experiment in dict.fromkeys(row["experiment"] for row in rows if row not in recipe):
        findings.append(f"- `{experiment}`. *Claim:* {claim(experiment)}")
        by_kind: dict[str, list[Row]] = {}
        for row in rows:
            if row["experiment"] == experiment:
                by_kind.setdefault(row.get(KERNEL, ""), []).append(row)
        for kind, runs in by_kind.items():
            found = ", ".join(f"{data} {compared(runs, recipe, data)}" for data in sets)
            findings.append(f"    - *Found{f', {kind}' if kind else ''}:* {found}.")
    rates = {data: [percent(row, data)[0] for row in recipe] for data in sets}
    return ABLATION.format(
        updates=updates_of(rows),
        seeds=len(recipe),
        spread=max(max(values) - min(values) for values in rates.values()),
        table="\n".join(lines),
        findings="\n".join(findings),
    )


def sweep_text(rows: Sequence[Row]) -> str:
    """The sweep as a table of n and mix against m, and what its steps in m and in n give at the middle of the other."""
    if not rows:
        return "Not run yet: `python train.py -m experiment=sweep`."
    runs = {(int(row["model.n"]), int(row["model.m"]), float(row["data.outliers.max_ratio"])): row for row in rows}
    all_n, all_m, mixes = (sorted(set(values)) for values in zip(*runs, strict=True))
    lines = ["| n | trained and tested on | " + " | ".join(f"m = {m} (%)" for m in all_m) + " |"]
    lines.append("|---:|---" + "|---:" * len(all_m) + "|")
    for n in all_n:
        for mix in mixes:
            cells = ["{:.1f} [{:.1f}, {:.1f}]".format(*percent(runs[n, m, mix], "uniform")) for m in all_m]
            lines.append(f"| {n} | {mix_in_words(mix)} | " + " | ".join(cells) + " |")
        times = [min(float(runs[n, m, mix]["us_per_problem"]) for mix in mixes) for m in all_m]
        lines.append(f"| {n} | µs | " + " | ".join(f"{time:.0f}" for time in times) + " |")
    findings = []
    middle_n, middle_m = all_n[len(all_n) // 2], all_m[len(all_m) // 2]
    for mix in mixes:
        deeper_steps = ", ".join(
            f"{low} → {high} {compared([runs[middle_n, high, mix]], [runs[middle_n, low, mix]], 'uniform')}"
            for low, high in pairwise(all_m)
        )
        wider_steps = ", ".join(
            f"{low} → {high} {compared([runs[high, middle_m, mix]], [runs[low, middle_m, mix]], 'uniform')}"
            for low, high in pairwise(all_n)
        )
        findings.append(
            f"- {mix_in_words(mix)}: m at n = {middle_n}, {deeper_steps}; n at m = {middle_m}, {wider_steps}."
        )
    return SWEEP.format(updates=updates_of(rows), table="\n".join(lines), findings="\n".join(findings))


def page(
    results: Mapping[str, Mapping[str, Any]],
    complexity: Mapping[str, Any],
    honest: Mapping[str, Any],
    ablation: Sequence[Row],
    sweep: Sequence[Row],
) -> str:
    """The results page as Markdown, from the results files by their names and the summaries of short runs."""
    rates = {name: Rates(entry) for name, entry in results.items()}
    environment = results["paper"]["environment"]
    tuned = [
        f"- {label}: " + ", ".join(f"`{spec}`" for spec in dict.fromkeys(results[name]["tuned"].values()))
        for label, name in (("protocol", "paper"), ("n = 100", "crowd"), ("scenes", "real"))
    ]
    runs = results["distribution"]["updates"].items()
    return PAGE.format(
        ours=OURS,
        cpu=environment["cpu"],
        commit=" and ".join(dict.fromkeys(f"{entry['environment']['commit']:.9}" for entry in results.values())),
        opencv=environment["versions"]["opencv"],
        tuned="\n".join(tuned),
        claims=claims(rates["paper"], rates["real"], complexity),
        paper=rates["paper"].table(),
        paper_peers=beside_peers(rates["paper"], ("p3p-ransac", "p3p-ransac-noise", "reppnp", OURS)),
        gaussian_pose=rates["gaussian_pose"].table(),
        real="\n\n".join(
            rates["real"].table(sets, times=False) for sets in (rates["real"].sets[:6], rates["real"].sets[6:])
        ),
        real_peers=beside_peers(rates["real"], ("p3p-ransac", "reppnp", OURS)),
        crowd=rates["crowd"].table(),
        against_n="\n\n".join(rates["against_n"].table(rates["against_n"].sets[i::2]) for i in (0, 1)),
        any=ANY,
        set="\n\n".join(
            rates["set"].table(sets, times=False) for sets in (rates["set"].sets[:6], rates["set"].sets[6:])
        ),
        set_told=rates["set_told"].table(times=False),
        set_real="\n\n".join(rates["set_real"].table(rates["set_real"].sets[i : i + 6], times=False) for i in (0, 6)),
        chi_square=CHI_SQUARE_95,
        **honesty_parts(honest),
        img_sigma=results["set_real_told"]["img_sigma"],
        set_real_told="\n\n".join(
            rates["set_real_told"].table(rates["set_real_told"].sets[i : i + 6], times=False) for i in (0, 6)
        ),
        set_peers="\n".join(beside_best(rates[name], ANY, ROBUST) for name in ("set", "set_real")),
        shipped_views=PnPNet.from_pretrained(OURS).views,
        views="\n\n".join(
            rates["views"].table(sets, times=False) for sets in (rates["views"].sets[:5], rates["views"].sets[5:])
        ),
        distribution_runs=", ".join(f"{name}: {n} updates" for name, n in runs),
        distribution=format_table(results["distribution"]),
        ablation=ablation_text(ablation),
        sweep=sweep_text(sweep),
        trainings="\n\n".join(
            f"`{name}`: [model card](../../kornia_pnpnet/weights/{name}/README.md).\n\n"
            f"![Learning curves of {name}](training-{name}.png)"
            for name in shipped_weights()
        ),
    )


def render() -> None:
    """Write the page and its pictures from the results files."""
    results = {name: load_results(HERE / f"{name}.json") for name in RESULTS}
    complexity = json.loads((HERE / "complexity.json").read_text())
    paper_figures([*(results[name] for name in RESULTS[:7]), complexity], HERE)
    for name in shipped_weights():
        plot_training(HERE / f"training-{name}.png", WEIGHTS_FOLDER / name / "history.csv")
    short_runs = [read_summary(HERE / f"{name}.csv") for name in ("ablation", "sweep")]
    if short_runs[1]:
        for against in ("n", "m"):
            plot_sweep(HERE / f"sweep_against_{against}.png", HERE / "sweep.csv", against=against)
    honest = json.loads((HERE / "honesty.json").read_text())
    plot_reliability(HERE / "reliability.png", honest["reliability"])
    (HERE / "README.md").write_text(page(results, complexity, honest, *short_runs), encoding="utf-8")


def compare(scenes: Path, count: int, runs: Sequence[Path]) -> None:
    """What two training distributions give on the scenes: runs of ``train.py``, named by their folders."""
    solvers = {f"data={folder.name}": PnPNet.from_pretrained(folder / "weights") for folder in runs}
    files = {
        name: json.loads((folder / "results.json").read_text()) for name, folder in zip(solvers, runs, strict=True)
    }
    updates = {name: file["run"]["update"] for name, file in files.items()}
    sets = real_sets(scenes, "none,2", count=count, seed=SEED_REPORT, others=True)
    run("distribution", solvers, sets, updates=updates)


def ship(runs: Sequence[Path]) -> None:
    """Put the weights of the last run into the package, with the curves of all."""
    results = load_run(runs[-1] / "results.json")
    kind = "set" if results.initializer == "SetInit" else f"n{results.config['model']['n']}"
    collect_weights(runs, WEIGHTS_FOLDER / f"pnpnet-{kind}")


def main() -> None:
    """Run one of the steps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", choices=("measure", "compare", "ship", "render"))
    parser.add_argument(
        "--only", nargs="+", default=(), choices=(*RESULTS, "honesty", "complexity"), help="for measure: these files"
    )
    parser.add_argument("--scenes", type=Path, default=HERE.parents[2] / "shared" / "data")
    parser.add_argument("--synthetic-count", type=int, default=5000)
    parser.add_argument("--real-count", type=int, default=1000)
    parser.add_argument(
        "--runs",
        type=Path,
        nargs="+",
        help="for compare: folders of two runs, `mixed` and `paper`; for ship: one or more",
    )
    arguments = parser.parse_args()
    if arguments.step == "measure":
        measure(arguments.scenes, arguments.synthetic_count, arguments.real_count, arguments.only)
    elif arguments.step == "compare":
        compare(arguments.scenes, arguments.real_count, arguments.runs)
    elif arguments.step == "ship":
        ship(arguments.runs)
    else:
        render()


if __name__ == "__main__":
    main()
