"""Ways to use the confidences of a network's keypoints: ``keypoints.py A.npz B.npz --sources S.json --out O.json``.

Each file holds the problems of one source: ``world`` (P, N, 3), ``img`` (P, N, 2) in undistorted pixels, ``mask``
(P, N), ``confidence`` (P, N), ``K`` (P, 3, 3), the reference pose ``R`` (P, 3, 3) and ``t`` (P, 3), ``seen`` (P,) for
problems that may be used for choosing, ``cluster`` (P,), equal for problems that depend on each other, such as those of
neighbouring frames, and ``inlier_px`` (), the largest reprojection error of an inlier under the reference pose.

Seen problems fit an isotonic regression of the confidence, and the noise, constant and as a power of the confidence;
the others are measured. PoseLib's threshold is ``inlier_px``; masked, it gets pairs with a fitted confidence above 0.5.
The error is the rotation error in radians plus the translation error relative to the distance of the points' centre.
"""

import json
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from harness import SAMPLES, interval, parser, recorded
from sklearn.isotonic import IsotonicRegression
from torch import Tensor, nn

from kornia_pnpnet import create_solver, pose_errors
from kornia_pnpnet.cameras import reproject
from kornia_pnpnet.core.files import read_npz
from kornia_pnpnet.core.tables import markdown_table
from kornia_pnpnet.evaluation.results import save_results
from kornia_pnpnet.result import Pose

FIELDS = ("world", "img", "mask", "confidence", "K", "R", "t", "seen", "cluster")
# Upper limits of the rotation error in degrees and of the relative translation error for a pose to be right. The mean
# "capped" error has no term above CAP.
RIGHT, CAP = (5.0, 0.05), 0.5
FEWEST = 6  # pairs that PoseLib gets at least, the most confident ones
# Median and mean logarithm of the length of a two-dimensional residual, relative to its standard deviation.
MEDIAN, MEAN_LOG = math.sqrt(2 * math.log(2)), 0.5 * (math.log(2) - 0.5772156649)
# Noise is fitted on errors between these, relative to the largest of an inlier; confidences count as LEAST at least.
FITTED, LEAST = (0.02, 3.0), 0.05
BATCH = 500
BASES = ("weights=c**6", "weights=c**2", "nothing")  # ways that all others are compared to
EXACT = {"world_sigma": torch.tensor(0.0)}

Problems = dict[str, Tensor]
Way = tuple[nn.Module, Callable[[Problems], dict[str, Tensor]]]


def read(path: Path) -> tuple[Problems, float]:
    """The problems of a file, with the centre of the points as the origin of the world, and the limit of an inlier."""
    arrays = read_npz(path, (*FIELDS, "inlier_px"))
    p = {name: torch.from_numpy(arrays[name]) for name in FIELDS}
    p["confidence"] = p["confidence"].clamp(0, 1)
    origin = (p["world"] * p["mask"][..., None]).sum(1) / p["mask"].sum(1, keepdim=True)
    p["world"], p["t"] = p["world"] - origin[:, None], p["t"] + (p["R"] @ origin[..., None])[..., 0]
    return p, float(arrays["inlier_px"])


def reprojection(p: Problems) -> Tensor:
    """Reprojection errors under the reference pose, in pixels, (P, N); NaN behind the camera."""
    return (reproject(p["world"], p["K"], Pose(p["R"], p["t"])) - p["img"]).norm(dim=-1)


@torch.no_grad()
def solve(p: Problems, way: Way) -> dict[str, Tensor]:
    """Solve all problems; their errors, also capped, whether the poses are right, and the solver's ``ok``."""
    parts = []
    for start in range(0, len(p["world"]), BATCH):
        q = {name: value[start : start + BATCH] for name, value in p.items()}
        result = way[0](q["world"], q["img"], q["K"], **{"mask": q["mask"], **way[1](q)})
        angle, distance = pose_errors(result.pose, Pose(q["R"], q["t"]))
        shift = distance / q["t"].norm(dim=1)
        parts.append((angle.deg2rad() + shift, (angle < RIGHT[0]) & (shift < RIGHT[1]), result.ok))
    error, right, ok = (torch.cat(x).double() for x in zip(*parts, strict=True))
    return {"error": error, "capped": error.clamp(max=CAP), "right": right, "ok": ok}


def ways(seen: Problems, inlier_px: float) -> tuple[dict[str, Way], dict[str, float]]:
    """Ways to use the confidence, and the numbers that were fitted on the seen problems."""
    error, used, c = reprojection(seen), seen["mask"], seen["confidence"]
    isotonic = IsotonicRegression(y_min=0.01, y_max=0.99, increasing="auto", out_of_bounds="clip")
    isotonic.fit(c[used].numpy(), (error < inlier_px)[used].numpy())

    def calibration(confidence: Tensor) -> Tensor:
        return torch.from_numpy(isotonic.predict(confidence.flatten().numpy())).reshape_as(confidence).to(confidence)

    fitted = used & (error < FITTED[1] * inlier_px) & (error > FITTED[0] * inlier_px)
    sigma = error[fitted].median() / MEDIAN
    logs = c[fitted].clamp(min=LEAST).log().numpy(), error[fitted].log().numpy() - MEAN_LOG
    slope, offset = (float(x) for x in np.polyfit(*logs, 1))
    scale = math.exp(offset)

    def masked(q: Problems) -> dict[str, Tensor]:
        best = q["confidence"].where(q["mask"], -1.0).topk(FEWEST).values[:, -1:]
        return {"mask": q["mask"] & ((calibration(q["confidence"]) > 0.5) | (q["confidence"] >= best))}

    ours, poselib = create_solver("pnpnet-set"), create_solver("poselib", threshold=inlier_px)
    return {
        "nothing": (ours, lambda _: {}),
        "weights=c**6": (ours, lambda q: {"weights": q["confidence"] ** 6}),
        "weights=c**2": (ours, lambda q: {"weights": q["confidence"] ** 2}),
        "confidence=c": (ours, lambda q: {"confidence": q["confidence"]}),
        "confidence=fitted": (ours, lambda q: {"confidence": calibration(q["confidence"])}),
        "img_sigma=constant": (ours, lambda _: {"img_sigma": sigma, **EXACT}),
        "img_sigma=power of c": (ours, lambda q: {"img_sigma": scale * q["confidence"].clamp(LEAST) ** slope, **EXACT}),
        "PoseLib": (poselib, lambda _: {}),
        "PoseLib, masked": (poselib, masked),
    }, {"sigma_px": float(sigma), "power": slope, "inlier_px": inlier_px}


def measure(path: Path) -> dict[str, Any]:
    """Measure all ways on the problems of a file that were not seen."""
    p, inlier_px = read(path)
    seen, new = ({name: value[at] for name, value in p.items()} for at in (p["seen"], ~p["seen"]))
    found, chosen = ways(seen, inlier_px)
    scores, rows = {name: solve(new, way) for name, way in found.items()}, []
    cluster = new["cluster"].unique(return_inverse=True)[1].numpy()
    sums, sizes = partial(np.bincount, cluster), np.bincount(cluster)
    for name, one in scores.items():
        row = {key: float(value.mean()) for key, value in one.items()} | {"median": float(one["error"].median())}
        less = {b: {k: interval(sums((v - scores[b][k]).numpy()), sizes) for k, v in one.items()} for b in BASES}
        rows.append({"way": name, **row, "less": less})
    inliers = (reprojection(new) < inlier_px)[new["mask"]].double()
    counts = {"seen": len(seen["t"]), "measured": len(new["t"]), "clusters": len(sizes)}
    share = {"pairs": len(inliers) / len(new["t"]), "inliers": float(inliers.mean())}
    return {"source": path.stem, **counts, **share, "fitted": chosen, "rows": rows}


def main() -> None:
    """Measure, print the tables and write the results."""
    command = parser(__doc__)
    command.add_argument("problems", type=Path, nargs="+")
    command.add_argument("--sources", type=Path, required=True, help="JSON: a description of each source, by its file")
    options = command.parse_args()
    sources = json.loads(options.sources.read_text())
    settings = {"right": RIGHT, "cap": CAP, "samples": SAMPLES, "dtype": "float64"}
    made = recorded(lambda: {"results": [measure(path) for path in options.problems]}, **settings)
    columns = ("error", "capped", "median", "right", "ok")
    for one in made["results"]:
        print({key: value for key, value in one.items() if key != "rows"})
        rows = [[row["way"], *(f"{row[x]:.3f}" for x in columns)] for row in one["rows"]]
        print(markdown_table(["way", *columns], rows))
    save_results({**made, "sources": sources}, options.out)


if __name__ == "__main__":
    main()
