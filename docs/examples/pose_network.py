"""Train a convolutional network from nothing, with poses as the only labels: ``python docs/examples/pose_network.py``.

The network finds the pixels of an object's twelve keypoints in an image. Before training its keypoints fit no pose, and
a loss on the pose of a solver has no useful gradient. The program therefore starts with `monte_carlo_pose_loss`. It
adds the loss on the pose when most poses are `ok`. Writes `pose_network.json` to `--out`.
"""

from typing import Any

import torch
from shared import command, write
from torch import Tensor, nn

from kornia_pnpnet import Pose, create_solver, monte_carlo_pose_loss, pose_errors
from kornia_pnpnet.cameras import reproject
from kornia_pnpnet.data.draws import batch_generator, random_poses
from kornia_pnpnet.losses import pose_distances

KEYPOINTS, BATCH, TEST, SEED = 12, 32, 256, 20_261_123
SIZE, CENTRE, FOCAL = 64, 31.5, 240.0  # of the images, pixels
CAMERA = torch.tensor([[FOCAL, 0.0, CENTRE], [0.0, FOCAL, CENTRE], [0.0, 0.0, 1.0]])
SHAPE = torch.rand(KEYPOINTS, 3, generator=batch_generator(SEED, 0)) * 2.0 - 1.0
# Twelve colours that differ as much as possible: the corners of an icosahedron, around grey.
CORNERS = [(0.0, a, b) for a in (-0.53, 0.53) for b in (-0.85, 0.85)]
COLOURS = torch.tensor([corner[k:] + corner[:k] for corner in CORNERS for k in range(3)])
BLOB, NOISE = 1.5, 0.05  # radius of a keypoint's blob in pixels, and standard deviation of the noise of the image


def draw(index: int, count: int) -> tuple[Tensor, Pose]:
    """Images (B, 3, 64, 64) of coloured blobs, in any rotation, and their poses."""
    generator = batch_generator(SEED, 1 + index)
    rotation = random_poses(count, generator, max_angle=torch.pi).rotation.float()
    shift = 0.2 * torch.randn(count, 3, generator=generator) + torch.tensor([0.0, 0.0, 15.0])
    u, v = reproject(SHAPE, CAMERA, Pose(rotation, shift))[..., None].unbind(2)  # (B, N, 1)
    cells = torch.arange(SIZE)
    rows, columns = (torch.exp(-0.5 * ((cells - x) / BLOB).square()) for x in (v, u))  # (B, N, 64)
    images = (rows.mT[:, None] * COLOURS.T[:, None]) @ columns[:, None]
    return images + NOISE * torch.randn(images.shape, generator=generator), Pose(rotation, shift)


class Network(nn.Module):
    """Finds the pixels of the keypoints as means of heat maps, and learns how exact they are."""

    def __init__(self) -> None:
        super().__init__()
        layers = [nn.Conv2d(3, 32, 5, 2, 2), nn.ReLU(), nn.Conv2d(32, 32, 3, 1, 1), nn.ReLU()]
        self.heat = nn.Sequential(*layers, nn.Conv2d(32, KEYPOINTS, 1))
        self.log_sigma = nn.Parameter(torch.tensor(3.0))  # of the pixels' error: at first a third of the image

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (B, N, 2) and the standard deviation of their error."""
        heat = (5.0 * self.heat(images)).flatten(2).softmax(-1).unflatten(-1, (SIZE // 2, SIZE // 2))
        cells = 2.0 * torch.arange(SIZE // 2) + 0.5
        return torch.stack((heat.sum(2) @ cells, heat.sum(3) @ cells), -1), self.log_sigma.exp()


def train(steps: int, seed: int) -> list[dict[str, Any]]:
    """Train a network. Returns its errors on test images before, during and after the training."""
    torch.manual_seed(seed)
    network, curve = Network(), []
    weights = {"params": network.heat.parameters()}, {"params": [network.log_sigma], "lr": 2e-2}
    optimizer = torch.optim.Adam(weights, 6e-3)
    solver = create_solver("pnpnet-set", effort="fixed")
    test_images, test_poses = draw(steps, TEST)
    for step in range(steps + 1):
        if step % max(1, steps // 10) == 0:
            with torch.no_grad():
                pixels, sigma = network(test_images)
                found = solver(SHAPE.expand(TEST, -1, -1), pixels, CAMERA, img_sigma=sigma)
            errors = [error.median().item() for error in pose_errors(found.pose, test_poses)]
            off = (pixels - reproject(SHAPE, CAMERA, test_poses)).norm(dim=-1).median().item()
            ok = found.ok.float().mean().item()
            curve.append({"step": step, "ok": ok, "rotation_deg": errors[0], "translation": errors[1], "pixels": off})
            print(", ".join(f"{name} {value:.3g}" for name, value in curve[-1].items()), flush=True)

        images, pose = draw(step, BATCH)
        pixels, sigma = network(images)
        pairs = SHAPE.expand(BATCH, -1, -1), pixels, CAMERA
        loss = monte_carlo_pose_loss(pose, [], *pairs, img_sigma=sigma).mean()
        if ok > 0.5:  # the likelihood keeps the pixels near their keypoints, which a pose alone does not determine
            found = solver(*pairs, img_sigma=sigma.detach())
            distance = sum(pose_distances(found.pose, pose))
            loss = loss + (distance.clamp(max=1.0) * found.ok).mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimizer.step()
    return curve


def main() -> None:
    options = command(__doc__, steps=300, seeds=1).parse_args()
    torch.set_num_threads(1)
    curves = [train(options.steps, seed) for seed in range(options.seeds)]
    write(options.out / "pose_network.json", steps=options.steps, curves=curves)


if __name__ == "__main__":
    main()
