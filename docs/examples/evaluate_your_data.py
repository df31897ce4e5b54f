"""Compare solvers on your correspondences: ``python docs/examples/evaluate_your_data.py pairs.npz``.

The file holds P problems of N pairs: `world_points` (P, N, 3), `img_points` (P, N, 2) in pixels, `intrinsics`
(P, 3, 3), and the true poses x_cam = R x_world + t as `rotation` (P, 3, 3) and `translation` (P, 3). If problems have
different numbers of pairs, pad them and add `mask` (P, N), false for the padding. Without a file, the program makes an
example.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch

from kornia_pnpnet import Pose, create_solver, pose_errors, success
from kornia_pnpnet.data import OutlierMix, SyntheticProblems


def write_example(path: Path) -> Path:
    """Write 500 synthetic problems of 50 pairs, of which up to 90 % are outliers."""
    problems = SyntheticProblems(n=50, batch_size=500, outliers=OutlierMix(max_ratio=0.9), world_sigma=0.0).batch(0)
    names = "world_points", "img_points", "intrinsics", "rotation", "translation"
    arrays = zip(names, (*problems[:3], *problems.pose), strict=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **{name: x.numpy() for name, x in arrays})
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", nargs="?", type=Path, help="your problems (.npz)")
    parser.add_argument("--threshold", type=float, default=8.0, help="of p3p-ransac and PoseLib, in pixels")
    parser.add_argument("--limits", type=float, nargs=2, default=(1.0, 0.2), help="of a solved problem: degrees, units")
    options = parser.parse_args()
    with np.load(options.file or write_example(Path("outputs/examples/pairs.npz"))) as file:
        arrays = {name: torch.from_numpy(file[name]) for name in file.files}
    truth = Pose(arrays.pop("rotation"), arrays.pop("translation"))
    arrays.setdefault("mask", torch.ones(arrays["img_points"].shape[:2], dtype=torch.bool))
    torch.set_num_threads(1)  # as PoseLib
    print(f"{len(arrays['mask'])} problems with {arrays['mask'].sum(1).double().mean():.0f} pairs on average")
    print("solver        solved      ok  rotation error  translation error  ms per problem")
    for name in ("pnpnet-set", "p3p-ransac", "poselib"):
        try:
            solver = create_solver(name, **({} if name == "pnpnet-set" else {"threshold": options.threshold}))
        except ImportError as error:
            print(f"{name:<12}  left out: {error}")
            continue
        with torch.no_grad():
            solver(**{key: x[:8] for key, x in arrays.items()})  # the first call takes longer
            start = time.perf_counter()
            result = solver(**arrays)
            # The time of PoseLib's own calls, without our adapter.
            seconds = getattr(solver, "library_s", time.perf_counter() - start)
            ms = 1e3 * seconds / len(result.ok)
        errors = pose_errors(result.pose, Pose(*(x.to(result.rotation) for x in truth)))
        solved, ok = (100 * x.double().mean() for x in (success(errors, *options.limits), result.ok))
        angle, shift = (x.median() for x in errors)
        print(f"{name:<12}  {solved:4.1f} %  {ok:4.1f} %  {angle:13.3f}°  {shift:17.4f}  {ms:14.2f}")


if __name__ == "__main__":
    main()
