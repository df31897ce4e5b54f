"""Learn where a detector is wrong, from poses alone: ``python docs/examples/keypoint_offsets.py``.

A detector finds the 12 keypoints of an object. Each keypoint has an unknown bias in pixels, and in every image 30 % of
the keypoints are at random pixels. The program learns an offset for each keypoint from the true camera pose alone,
through a differentiable solver: this package's `pnpnet-set`, its EPnP without weights, or Kornia's DLT. It records the
error of the offsets after every step. Writes `keypoint_offsets.json` and a picture of it to `--out`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from kornia.geometry import solve_pnp_dlt
from shared import command, write
from torch import Tensor

from kornia_pnpnet import create_solver
from kornia_pnpnet.data.draws import batch_generator, random_poses
from kornia_pnpnet.evaluation.plots import BLUE, GREEN, ORANGE, log_scale, make_figure, save, themed
from kornia_pnpnet.losses import pose_distances
from kornia_pnpnet.result import Pose

KEYPOINTS, BATCH, WRONG = 12, 64, 0.3
FOCAL, CENTRE, PIXEL_NOISE, BIAS = 800.0, 320.0, 1.0, 12.0
SEED = 20_261_150

#: Poses of problems, and which of them count, (B,).
Solve = Callable[[Tensor, Tensor, Tensor], tuple[Pose, Tensor]]


def ours(name: str) -> Solve:
    """A solver of ours; problems count where it says ok."""
    solver = create_solver(name)

    def solve(*inputs: Tensor) -> tuple[Pose, Tensor]:
        result = solver(*inputs)
        return result.pose, result.ok

    return solve


def kornias_dlt(*inputs: Tensor) -> tuple[Pose, Tensor]:
    """Kornia's; what is not finite does not count."""
    found = solve_pnp_dlt(*inputs)
    return Pose(found[..., :3], found[..., 3]), found.detach().isfinite().all(-1).all(-1)


SOLVERS: dict[str, Solve] = {"pnpnet-set": ours("pnpnet-set"), "epnp": ours("epnp"), "kornia-dlt": kornias_dlt}


def draw(index: int, keypoints: Tensor, bias: Tensor) -> tuple[Tensor, Tensor, Tensor, Pose]:
    """A batch of images: world points, what the detector says, intrinsics and the true pose."""
    generator = batch_generator(SEED, index + 1)
    rotation = random_poses(BATCH, generator).rotation.float()
    away = torch.rand(BATCH, 3, generator=generator) * torch.tensor([1.0, 1.0, 3.0]) + torch.tensor([-0.5, -0.5, 4.0])
    pose = Pose(rotation, away)
    intrinsics = torch.tensor([[FOCAL, 0.0, CENTRE], [0.0, FOCAL, CENTRE], [0.0, 0.0, 1.0]]).expand(BATCH, 3, 3)
    world_points = keypoints.expand(BATCH, -1, -1)
    img_points = pose.camera(intrinsics).project(world_points)
    img_points = img_points + bias + PIXEL_NOISE * torch.randn(img_points.shape, generator=generator)
    anywhere = 2.0 * CENTRE * torch.rand(img_points.shape, generator=generator)
    wrong = torch.rand(BATCH, KEYPOINTS, generator=generator) < WRONG
    return world_points, torch.where(wrong[..., None], anywhere, img_points), intrinsics, pose


def learn(solve: Solve, steps: int) -> dict[str, Any]:
    """The errors of the offsets after every step, and the number of gradients that were not finite."""
    generator = batch_generator(SEED, 0)
    keypoints = torch.randn(KEYPOINTS, 3, generator=generator) * 0.5
    bias = BIAS * torch.randn(KEYPOINTS, 2, generator=generator)
    offsets = torch.zeros(KEYPOINTS, 2, requires_grad=True)
    optimizer = torch.optim.Adam([offsets], lr=0.5)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, eta_min=0.01)
    errors, lost = [], 0
    for step in range(steps):
        with torch.no_grad():
            errors.append(round((offsets + bias).square().sum(-1).mean().sqrt().item(), 4))
        world_points, img_points, intrinsics, truth = draw(step, keypoints, bias)
        pose, counts = solve(world_points, img_points + offsets, intrinsics)
        rotation, translation = pose_distances(pose, truth)
        # A pose that is far off contains no information about pixels, so the loss of a sample is bounded.
        loss = rotation + translation
        loss = torch.where(counts, loss / (1.0 + 5.0 * loss), 0.0).sum() / counts.sum().clamp(min=1)
        optimizer.zero_grad()
        loss.backward()
        if not offsets.grad.isfinite().all():
            lost += 1
            continue
        torch.nn.utils.clip_grad_norm_([offsets], 1.0)
        optimizer.step()
        schedule.step()
    return {"error_px": errors, "steps_without_finite_gradient": lost}


@themed
def plot(runs: dict[str, Any], path: Path) -> None:
    """The errors against steps."""
    figure = make_figure(7.0, 3.6)
    axes = figure.subplots()
    for (name, run), colour in zip(runs.items(), (BLUE, ORANGE, GREEN), strict=True):
        axes.plot(run["error_px"], color=colour, linewidth=1.7, label=name)
    axes.set(xlabel="step", ylabel="error of the learned offsets (px)")
    log_scale(axes, "y")
    axes.set_title(f"{WRONG:.0%} of the keypoints anywhere", loc="left")
    axes.legend(frameon=False)
    save(figure, path)


def main() -> None:
    options = command(__doc__, steps=600).parse_args()
    torch.set_num_threads(1)
    runs = {name: learn(solve, options.steps) for name, solve in SOLVERS.items()}
    write(options.out / "keypoint_offsets.json", steps=options.steps, runs=runs)
    plot(runs, options.out / "keypoint_offsets.png")
    for name, run in runs.items():
        first, last = run["error_px"][0], run["error_px"][-1]
        print(f"{name}: {first:.2f} px at first, {last:.2f} px after {options.steps} steps")


if __name__ == "__main__":
    main()
