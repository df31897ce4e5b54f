"""Measure and write the results page: ``python docs/results/make.py measure``, ``... compare`` and ``... render``.

``compare`` (two folders of ``train.py`` with ``--runs``) writes ``distribution.json`` in the same way.
``measure`` solves fresh problems with every solver and writes ``synthetic.json`` and ``real.json`` here; it needs the
scenes (``--scenes``, default ``../shared/data``). ``render`` reads those files and ``ablation.csv``, the summary of
short runs, and writes ``README.md`` and the pictures; every number of the page comes from the files.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from kornia_pnpnet import PnPNet, RobustWeightedLM, create_solver
from kornia_pnpnet.data import OutlierMix, SceneProblems, SyntheticProblems, load_scene
from kornia_pnpnet.evaluation import EvaluationData, draw_problems, evaluate, format_table, load_results, save_results
from kornia_pnpnet.figures import plot_errors, plot_success, plot_training
from kornia_pnpnet.model import WEIGHTS_FOLDER

HERE = Path(__file__).resolve().parent
SCENES = {
    "fountain-P11": ("strecha/fountain-P11", True),
    "Herz-Jesus-P25": ("strecha/Herz-Jesus-P25", True),
    "courtyard": ("eth3d/courtyard", True),
    "lund_door": ("colmap/lund_door", False),
    "sceaux_castle": ("colmap/sceaux_castle", False),
}
# Nothing was trained, tuned or looked at with these before.
SEED_REPORT, SEED_TUNE = 20_261_121, 20_261_122
THRESHOLDS = (2.0, 5.0, 10.0, 20.0, 35.0, 50.0, 80.0)
RESULTS = ("synthetic", "real", "depth", "distribution")
OURS, PEER = "pnpnet-n9", "opencv-ransac"
# OpenCV's RANSAC as people call it (AP3P, refined), and the strongest way we found of calling it.
PEERS = {PEER: {}, "opencv-ransac-sqpnp": {"method": "SQPNP", "refine": False}}


def synthetic_data(seed: int, count: int) -> dict[str, EvaluationData]:
    """The protocol without outliers, with k uniform in 0 ... 3, and with exactly 3."""
    mixes = {"none": OutlierMix(count=0), "k uniform": OutlierMix(), "exactly 3": OutlierMix(count=3)}
    data = {}
    for i, (name, mix) in enumerate(mixes.items()):
        source = SyntheticProblems(n=9, batch_size=1000, seed=seed + 10 * i, outliers=mix)
        description = {"distribution": "paper", "outliers": name, "seed": source.seed}
        data[name] = EvaluationData(draw_problems(source, count), description=description)
    return data


def real_data(folder: Path, seed: int, count: int) -> dict[str, EvaluationData]:
    """Every scene with 0 and with 2 of 9 pairs wrong."""
    data = {}
    for name, (path, metric) in SCENES.items():
        scene = load_scene(folder / path, metric=metric)
        for k in (0, 2):
            source = SceneProblems(scene, n=9, seed=seed, outliers=OutlierMix(count=k), dtype=torch.float32)
            data[f"{name}, {k} wrong"] = EvaluationData(
                draw_problems(source, count),
                max_translation=source.max_translation,
                unit="m" if metric else "units",
                description={"scene": path, "outliers": k, "seed": seed},
            )
    return data


def tuned(options: Mapping[str, Any], data: Mapping[str, EvaluationData]) -> tuple[torch.nn.Module, dict[str, float]]:
    """OpenCV's RANSAC with the threshold that succeeds most often over all sets, and what each threshold reached."""
    reached = {}
    for threshold in THRESHOLDS:
        results = evaluate({PEER: create_solver(PEER, threshold=threshold, **options)}, data, repeats=1)
        reached[f"{threshold:g}"] = sum(row["success"]["rate"] for row in results["rows"]) / len(results["rows"])
    best = max(reached, key=lambda key: reached[key])
    return create_solver(PEER, threshold=float(best), **options), reached


def deeper(solver: PnPNet, order: Sequence[int]) -> PnPNet:
    """The same weights with some iterations of the refinement done again: ``order`` names them, from 0."""
    refine = RobustWeightedLM(len(order))
    for name in ("step", "damping", "robustness"):
        getattr(refine, name).raw.data = getattr(solver.refine, name).raw.data[list(order)]
    return PnPNet(solver.init, refine, solver.normalize)


def measure_depth(scenes: Path, count: int) -> None:
    """What more iterations of the shipped weights do, without training them."""
    shipped = PnPNet.from_pretrained(OURS)
    orders = {5: (0, 1, 2, 3, 4), 7: (0, 1, 1, 2, 2, 3, 4), 10: (0, 1, 1, 1, 2, 2, 2, 3, 4, 4)}
    solvers = {f"m = {depth}": deeper(shipped, order) for depth, order in orders.items()}
    data = {name: entry for name, entry in real_data(scenes, SEED_REPORT, count).items() if "2 wrong" in name}
    data["protocol, k uniform"] = synthetic_data(SEED_REPORT, count)["k uniform"]
    save_results(evaluate(solvers, data), HERE / "depth.json")


def compare(scenes: Path, count: int, runs: Sequence[Path]) -> None:
    """What two training distributions give on the scenes: runs of ``train.py``, named by their folders."""
    solvers = {f"data={run.name}": PnPNet.from_pretrained(run / "weights") for run in runs}
    results = evaluate(solvers, real_data(scenes, SEED_REPORT, count))
    files = {name: json.loads((run / "results.json").read_text()) for name, run in zip(solvers, runs, strict=True)}
    results["updates"] = {name: file["run"]["update"] for name, file in files.items()}
    save_results(results, HERE / "distribution.json")


def measure(scenes: Path, synthetic_count: int, real_count: int) -> None:
    """Solve everything and write the two results files."""
    torch.set_num_threads(1)
    ours = {name: create_solver(name) for name in (OURS, "net-n9", "identity-lm")}
    for name, tuning, reported in (
        ("synthetic", synthetic_data(SEED_TUNE, 1000), synthetic_data(SEED_REPORT, synthetic_count)),
        ("real", real_data(scenes, SEED_TUNE, 300), real_data(scenes, SEED_REPORT, real_count)),
    ):
        peers = {peer: tuned(options, tuning) for peer, options in PEERS.items()}
        results = evaluate({**ours, **{peer: solver for peer, (solver, _) in peers.items()}}, reported)
        reached = {peer: by_threshold for peer, (_, by_threshold) in peers.items()}
        results["peer_threshold_tuning"] = {"seed": SEED_TUNE, "mean_success": reached}
        save_results(results, HERE / f"{name}.json")
        print(format_table(results))
    measure_depth(scenes, real_count)


def comparison(results: Mapping[str, Any]) -> list[str]:
    """One line for each data set: how far our success is from OpenCV's, and whether the intervals overlap."""
    rows = {(row["data"], row["solver"]): row["success"] for row in results["rows"]}
    lines = []
    for name in results["data"]:
        parts = []
        for peer in PEERS:
            mine, other = rows[name, OURS], rows[name, peer]
            difference = 100 * (mine["rate"] - other["rate"])
            apart = mine["low"] > other["high"] or other["low"] > mine["high"]
            verdict = ("ahead" if difference > 0 else "behind") if apart else "intervals overlap"
            parts.append(f"{difference:+.1f} points against `{peer}` ({verdict})")
        lines.append(f"- {name}: {', '.join(parts)}.")
    return lines


PAGE = """\
# Results

Written by `docs/results/make.py` from [synthetic.json](synthetic.json), [real.json](real.json),
[depth.json](depth.json) and [distribution.json](distribution.json), which hold the errors of every problem, and
[ablation.csv](ablation.csv); no number here is typed. Success: rotation error below 1° and translation error below
0.2 m, or 0.5 % of the median depth where a scene has no unit. Brackets: 95 % intervals. Every solver has the same
problems, n = 9, of seeds used for nothing else. Time: calls of 1000 problems, one thread, {cpu}.

`{ours}` is the paper's PnP-Net, `net-n9` its first stage alone, `identity-lm` the classical robust LM started from the
identity, `{peer}` OpenCV {opencv}'s RANSAC with AP3P and a final refinement as it is usually called, `{strong}` the
same with SQPnP for samples and inliers and without refinement, the strongest call we found. Their thresholds were tuned
by success on other seeds ({thresholds}).

## The protocol's data

{synthetic_table}

![Success on the protocol's data](synthetic_success.png)

![Errors on the protocol's data](synthetic_errors.png)

`{ours}` against OpenCV:

{synthetic_comparison}

## Real scenes

9 random observed points of a random image; 2 of them spoilt, or none. fountain-P11 and Herz-Jesus-P25: Strecha et al.,
CVPR 2008; courtyard: ETH3D, Schöps et al., CVPR 2017, its observations simulated from the official reconstruction;
lund_door and sceaux_castle: COLMAP models of arbitrary unit.

{real_table}

![Success on real scenes](real_success.png)

`{ours}` against OpenCV:

{real_comparison}

## Why half of the training is tilted slabs

Two short runs ({distribution_runs}): `data=paper` on the protocol's box alone, `data=mixed` as shipped. The box is
longer along the optical axis than across, which no façade is: what the network learns of it does not carry over.

{distribution_table}

## Why real scenes with wrong pairs are behind

The first guess is coarser there than on the protocol's data (`net-n9` above), and five iterations do not always bring
it home. The table has the same weights with the middle iterations done again, untrained for it: success on the scenes
rises, success on the protocol, for whose noise the last iterations were tuned, falls. Training deeper unrolls is the
next thing to try; the scale of the scene is not the cause, since the world is centred and scaled.

{depth_table}

## Ablation

Short runs of the shipped recipe with one thing changed; success on the training's validation sets.

{ablation_table}

## Training of {ours}

![Learning curves](training.png)

[Model card](../../kornia_pnpnet/weights/{ours}/README.md)
"""


def ablation_table(path: Path) -> str:
    """The summary of the short runs as a Markdown table of success rates."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = [key.removesuffix("/rate") for key in rows[0] if key.endswith("/rate")]
    lines = ["| Run | Updates | " + " | ".join(names) + " |", "|---" * (2 + len(names)) + "|"]
    for row in rows:
        shares = [[100 * float(row[f"{name}/{key}"]) for key in ("rate", "low", "high")] for name in names]
        rates = [f"{rate:.1f} % [{low:.1f}, {high:.1f}]" for rate, low, high in shares]
        lines.append(f"| {row['run']} | {row['update']} | " + " | ".join(rates) + " |")
    return "\n".join(lines)


def page(results: Mapping[str, Mapping[str, Any]], ablation: Path) -> str:
    """The results page as Markdown, from the results by their names in ``RESULTS`` and the ablation's table."""
    synthetic, real = results["synthetic"], results["real"]
    return PAGE.format(
        ours=OURS,
        peer=PEER,
        cpu=synthetic["environment"]["cpu"],
        opencv=synthetic["environment"]["versions"]["opencv"],
        strong=next(reversed(PEERS)),
        thresholds=", ".join(
            f"`{peer}`: {synthetic['solvers'][peer]['config']['threshold']:g} px on the protocol, "
            f"{real['solvers'][peer]['config']['threshold']:g} px on the scenes"
            for peer in PEERS
        ),
        synthetic_table=format_table(synthetic),
        real_table=format_table(real),
        synthetic_comparison="\n".join(comparison(synthetic)),
        real_comparison="\n".join(comparison(real)),
        depth_table=format_table(results["depth"]),
        distribution_runs=", ".join(f"{name}: {n} updates" for name, n in results["distribution"]["updates"].items()),
        distribution_table=format_table(results["distribution"]),
        ablation_table=ablation_table(ablation),
    )


def render() -> None:
    """Write the page and its pictures from the results files."""
    results = {name: load_results(HERE / f"{name}.json") for name in RESULTS}
    plot_success(HERE / "synthetic_success.png", results["synthetic"])
    plot_errors(HERE / "synthetic_errors.png", results["synthetic"])
    plot_success(HERE / "real_success.png", results["real"])
    plot_training(HERE / "training.png", WEIGHTS_FOLDER / OURS / "history.csv")
    (HERE / "README.md").write_text(page(results, HERE / "ablation.csv"), encoding="utf-8")


def main() -> None:
    """Run one of the two steps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", choices=("measure", "compare", "render"))
    parser.add_argument("--scenes", type=Path, default=HERE.parents[2] / "shared" / "data")
    parser.add_argument("--synthetic-count", type=int, default=10_000)
    parser.add_argument("--real-count", type=int, default=1000)
    parser.add_argument("--runs", type=Path, nargs="+", help="for compare: folders of two runs, `mixed` and `paper`")
    arguments = parser.parse_args()
    if arguments.step == "measure":
        measure(arguments.scenes, arguments.synthetic_count, arguments.real_count)
    elif arguments.step == "compare":
        compare(arguments.scenes, arguments.real_count, arguments.runs)
    else:
        render()


if __name__ == "__main__":
    main()
