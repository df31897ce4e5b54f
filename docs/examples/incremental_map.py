"""A small incremental mapping program with two ways to register an image: ``python docs/examples/incremental_map.py``.

Cameras circle over a scene and match what they see with the map so far. A share of the matches is wrong, and points
triangulated from wrong matches lie anywhere, some of them far away. The program registers one image after the other
and triangulates new points, with `cv2.solvePnPRansac` or with `pnpnet-set`; both stand in :data:`REGISTER`. In
the end all images are registered again to the whole map. Writes `incremental_map.json` to `--out`.
"""

from typing import Any

import cv2
import torch
from kornia.geometry.epipolar import triangulate_points
from shared import command, opencv, write
from torch import Tensor, nn

from kornia_pnpnet import Pose, create_solver, pose_errors
from kornia_pnpnet.data.draws import batch_generator

IMAGES, POINTS = 12, 300
CAMERA = torch.tensor([[1000.0, 0.0, 640.0], [0.0, 1000.0, 480.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
PIXEL_NOISE, THRESHOLD = 1.0, 6.0  # px
SEED = 20_261_123

#: What registers images, from world points (B, N, 3), pixels (B, N, 2), the camera and a mask of the matches.
REGISTER: dict[str, nn.Module] = {"cv2.solvePnPRansac": opencv(THRESHOLD), "pnpnet-set": create_solver("pnpnet-set")}


def draw_scene(wrong: float, index: int) -> tuple[Pose, Tensor]:
    """True poses, and the pixel of every point in every image, (IMAGES, POINTS, 2)."""
    generator = batch_generator(SEED, index)
    points = torch.randn(POINTS, 3, generator=generator, dtype=torch.float64) * torch.tensor([3.0, 3.0, 1.0])
    angle = torch.linspace(0.0, 1.5, IMAGES, dtype=torch.float64)
    tilt = torch.tensor([2.2, 0.0, 0.0], dtype=torch.float64)  # looks down on the scene
    turn = torch.stack((0 * angle, 0 * angle, angle), -1)
    none = torch.zeros(IMAGES, 3, dtype=torch.float64)
    rotation = Pose.from_rvec(tilt.expand(IMAGES, 3), none).rotation @ Pose.from_rvec(turn, none).rotation
    poses = Pose(rotation, torch.tensor([0.0, 0.0, 15.0], dtype=torch.float64).expand(IMAGES, 3))
    pixels = poses.camera(CAMERA).project(points.expand(IMAGES, -1, -1))
    pixels = pixels + PIXEL_NOISE * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    other = torch.rand(IMAGES, POINTS, generator=generator).argsort(-1)
    mismatch = torch.rand(IMAGES, POINTS, generator=generator) < wrong
    return poses, torch.where(mismatch[..., None], pixels.gather(1, other[..., None].expand(-1, -1, 2)), pixels)


@torch.no_grad()
def run(solver: nn.Module, truth: Pose, pixels: Tensor) -> Pose:
    """Map and register: the last poses of all images."""
    rotation, translation = truth.rotation.clone(), truth.translation.clone()  # the first two images are given
    points = torch.zeros(POINTS, 3, dtype=torch.float64)
    mapped = torch.zeros(POINTS, dtype=torch.bool)
    for image in range(1, IMAGES):
        if image > 1:
            one = slice(image, image + 1)
            found = solver(points[None], pixels[one], CAMERA, mask=mapped[None]).pose
            rotation[image], translation[image] = found.rotation[0], found.translation[0]
        pair = [image - 1, image]
        cameras = CAMERA @ torch.cat((rotation[pair], translation[pair][..., None]), -1)
        new = triangulate_points(cameras[:1], cameras[1:], pixels[pair[:1]], pixels[pair[1:]])[0]
        fresh = ~mapped & new.isfinite().all(-1) & (torch.arange(POINTS) % IMAGES <= image)
        points[fresh], mapped = new[fresh], mapped | fresh
    last: Pose = solver(points.expand(IMAGES, -1, -1), pixels, CAMERA, mask=mapped.expand(IMAGES, -1)).pose
    return last


def main() -> None:
    options = command(__doc__, scenes=20).parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    runs: dict[str, Any] = {name: {} for name in REGISTER}
    for wrong in (0.05, 0.1, 0.2):
        for name, solver in REGISTER.items():
            errors = []
            for index in range(options.scenes):
                truth, pixels = draw_scene(wrong, index)
                errors.append(pose_errors(run(solver, truth, pixels), truth).rotation_error_deg[2:])
            error = torch.cat(errors)
            right = (error < 1.0).double().mean().item()
            runs[name][f"{wrong:.0%}"] = {"within_1_deg": right, "median_deg": error.median().item()}
            print(f"{name}, {wrong:.0%} wrong: {right:.1%} of images")
    write(options.out / "incremental_map.json", scenes=options.scenes, images=IMAGES, runs=runs)


if __name__ == "__main__":
    main()
