"""A pose network that has learned nothing, and three losses to train it: ``python docs/examples/pose_network.py``.

The network gets a noisy description of an object's pose and predicts the pixels of the object's twelve keypoints. Its
only label is the pose, through a solver; before training its keypoints fit no pose. The losses are the distance
of the pose of Kornia's DLT, the distance of the pose of `pnpnet-set` with `gradient="always"`, and this package's
`monte_carlo_pose_loss`; they stand in :data:`LOSSES`. Writes `pose_network.json` to `--out`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from shared import command, dlt, write
from torch import Tensor, nn

from kornia_pnpnet import Pose, create_solver, monte_carlo_pose_loss, pose_errors
from kornia_pnpnet.data.draws import batch_generator, random_poses
from kornia_pnpnet.losses import pose_distances

KEYPOINTS, BATCH, TEST = 12, 64, 512
FOCAL, CENTRE = 800.0, 320.0
CAMERA = torch.tensor([[FOCAL, 0.0, CENTRE], [0.0, FOCAL, CENTRE], [0.0, 0.0, 1.0]])
INPUT_NOISE = 0.01
SEED = 20_261_123

#: The loss of predicted pixels (B, N, 2) of the keypoints (B, N, 3) and of the network's sigma, by the true pose.
Loss = Callable[[Tensor, Tensor, Tensor, Pose], Tensor]


def distance_to(truth: Pose, found: Pose) -> Tensor:
    """The mean distance of poses, in which a pose that is far off, or not finite, counts little."""
    distance = sum(pose_distances(found, truth))
    distance = distance[distance.isfinite()]
    return (distance / (1.0 + distance)).sum() / BATCH


def distance_of_pnpnet() -> Loss:
    """The distance of the pose of this package's solver."""
    solver = create_solver("pnpnet-set", gradient="always", effort="fixed")
    return lambda keypoints, pixels, sigma, truth: distance_to(
        truth, solver(keypoints, pixels, CAMERA, img_sigma=sigma.detach()).pose
    )


def likelihood(keypoints: Tensor, pixels: Tensor, sigma: Tensor, truth: Pose) -> Tensor:
    """How likely the true pose is among all poses."""
    return monte_carlo_pose_loss(truth, [], keypoints, pixels, CAMERA, img_sigma=sigma).mean()


LOSSES: dict[str, Callable[[], Loss]] = {
    "distance, `solve_pnp_dlt`": lambda: lambda x, pixels, _, truth: distance_to(truth, dlt(x, pixels, CAMERA)),
    "distance, `pnpnet-set`": distance_of_pnpnet,
    "`monte_carlo_pose_loss`": lambda: likelihood,
}


class Network(nn.Module):
    """From twelve numbers of a pose to the pixels of the keypoints, and one sigma for all of them."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(12, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU())
        self.pixels = nn.Linear(256, 2 * KEYPOINTS)
        self.log_sigma = nn.Parameter(torch.tensor(5.0))

    def forward(self, pose: Pose) -> tuple[Tensor, Tensor]:
        """Pixels (B, N, 2) and the standard deviation of their noise."""
        numbers = torch.cat((pose.rotation.flatten(1), pose.translation), 1)
        numbers = numbers + INPUT_NOISE * torch.randn_like(numbers)
        pixels = CENTRE + CENTRE * self.pixels(self.layers(numbers))
        return pixels.unflatten(-1, (KEYPOINTS, 2)), self.log_sigma.exp()


def draw(index: int, count: int) -> Pose:
    """Poses in any rotation, about five units away."""
    generator = batch_generator(SEED, index)
    shift = torch.randn(count, 3, generator=generator) * 0.5
    rotation = random_poses(count, generator, max_angle=torch.pi).rotation.float()
    return Pose(rotation, shift + torch.tensor([0.0, 0.0, 5.0]))


def train(loss: Loss, steps: int, seed: int) -> dict[str, Any]:
    """Train a network; the median errors of its poses on a test set, and the time of a step."""
    torch.manual_seed(seed)
    keypoints = torch.randn(KEYPOINTS, 3, generator=batch_generator(SEED, 0)) * 0.5
    network, judge, truth = Network(), create_solver("epnp-lm"), draw(1, TEST)
    weights = [*network.layers.parameters(), *network.pixels.parameters()]
    optimizer = torch.optim.Adam([{"params": weights}, {"params": [network.log_sigma], "lr": 1e-2}], 1e-3)
    start = time.perf_counter()
    for step in range(steps):
        pose = draw(2 + step, BATCH)
        optimizer.zero_grad()
        loss(keypoints.expand(BATCH, -1, -1), *network(pose), pose).backward()
        gradients = [x.grad for x in network.parameters() if x.grad is not None]
        if all(x.isfinite().all() for x in gradients):
            nn.utils.clip_grad_norm_(network.parameters(), 10.0)
            optimizer.step()
    seconds = time.perf_counter() - start
    with torch.no_grad():
        found = judge(keypoints.expand(TEST, -1, -1), network(truth)[0], CAMERA)
    error = pose_errors(found.pose, truth)
    turn, shift = error.rotation_error_deg.median().item(), error.translation_error.median().item()
    return {"rotation_deg": turn, "translation": shift, "ms_per_step": 1e3 * seconds / steps}


def main() -> None:
    """Train with every loss and write what came out."""
    parser = command(__doc__)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    torch.set_num_threads(1)
    runs: dict[str, list[dict[str, Any]]] = {}
    for name, make in LOSSES.items():
        runs[name] = [train(make(), options.steps, seed) for seed in range(options.seeds)]
        for row in runs[name]:
            print(f"{name}: {row['rotation_deg']:.1f}°, {row['translation']:.2f}, {row['ms_per_step']:.1f} ms per step")
    write(options.out / "pose_network.json", steps=options.steps, runs=runs)


if __name__ == "__main__":
    main()
