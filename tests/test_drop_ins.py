"""Code of the documentation that replaces a call of another package, run against that package where it is installed."""

import itertools
import re
import warnings
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch

from kornia_pnpnet import Pose, pose_errors
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.refine.residual import rotation_angle

DOCS = Path(__file__).resolve().parents[1] / "docs"
INSTALL = {
    "h5py": "pip install h5py",
    "hloc": "pip install git+https://github.com/cvg/Hierarchical-Localization",
    "dust3r": "clone https://github.com/naver/dust3r and put it on PYTHONPATH with its requirements",
    "epropnp": "clone https://github.com/tjiiv-cprg/EPro-PnP and put it on PYTHONPATH; pip install pyro-ppl",
    "pytorch3d": "pip install git+https://github.com/facebookresearch/pytorch3d",
}


def real(name):
    """A module of another package, or a skip that says how to install it."""
    package, _, _ = name.partition(".")
    return pytest.importorskip(name, reason=INSTALL.get(package), exc_type=ImportError)


def snippet(page, heading=""):
    """The Python of a page, or of one of its sections, run as it is; returns its names."""
    text = (DOCS / page).read_text()
    if heading:
        text = next(x for x in re.split(r"^## ", text, flags=re.M) if x.startswith(heading))
    names = {}
    for block in re.findall(r"```python\n(.*?)```", text, flags=re.S):
        exec(block, names)
    return names


def write_hloc_scene(folder, points=300):
    """A COLMAP model, features and matches in hloc's files; four in ten matches are wrong. Returns the true poses."""
    h5py, rng = real("h5py"), np.random.default_rng(0)
    world = rng.uniform([-4, -3, 6], [4, 3, 12], (points, 3))
    poses = {}
    for i in range(8):
        turn = Pose.from_rvec(torch.from_numpy(rng.normal(0, 0.05, (1, 3))), torch.zeros(1, 3)).rotation[0].numpy()
        poses[f"{i}.png"] = np.column_stack((turn, rng.normal(0, 0.3, 3)))
    references, queries, images = list(poses)[:4], list(poses)[4:], []
    with h5py.File(folder / "features.h5", "w") as features:
        for i, (name, pose) in enumerate(poses.items(), start=1):
            cam = world @ pose[:, :3].T + pose[:, 3]
            pixels = 500.0 * cam[:, :2] / cam[:, 2:] + [320.0, 240.0] + rng.normal(0, 0.5, (points, 2))
            features.create_group(name)["keypoints"] = pixels - 0.5  # hloc counts from the centre of the first pixel
            if name in references:
                numbers = " ".join(map(str, [*pycolmap.Rigid3d(pose).rotation.quat[[3, 0, 1, 2]], *pose[:, 3]]))
                seen = " ".join(f"{u} {v} {j}" for j, (u, v) in enumerate(pixels, start=1))
                images.append(f"{i} {numbers} 1 {name}\n{seen}\n")
    model = folder / "model"
    model.mkdir()
    (model / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
    (model / "images.txt").write_text("".join(images))
    rows = [f"{j + 1} {x} {y} {z} 0 0 0 0 1 {j} 2 {j} 3 {j} 4 {j}\n" for j, (x, y, z) in enumerate(world)]
    (model / "points3D.txt").write_text("".join(rows))
    with h5py.File(folder / "matches.h5", "w") as matches:
        for query, reference in itertools.product(queries, references):
            found, wrong = np.arange(points), rng.random(points) < 0.4
            found[wrong] = rng.integers(points, size=wrong.sum())
            group = matches.create_group(f"{query}/{reference}")
            group["matches0"], group["matching_scores0"] = found, np.ones(points)
    (folder / "queries.txt").write_text("".join(f"{query} PINHOLE 640 480 500 500 320 240\n" for query in queries))
    (folder / "retrieval.txt").write_text("".join(f"{q} {r}\n" for q in queries for r in references))
    return {query: poses[query] for query in queries}


def hloc_errors(localize_sfm, folder, truth):
    """Largest rotation error in degrees and distance of the cameras of a run of hloc."""
    names = ("queries.txt", "retrieval.txt", "features.h5", "matches.h5", "poses.txt")
    localize_sfm.main(folder / "model", *(folder / name for name in names))
    rows = [line.split() for line in (folder / "poses.txt").read_text().splitlines()]
    assert len(rows) == len(truth)
    numbers = torch.tensor([list(map(float, row[1:])) for row in rows], dtype=torch.float64)
    true = torch.from_numpy(np.stack([truth[row[0]] for row in rows]))
    errors = pose_errors(Pose.from_quaternion(numbers[:, :4], numbers[:, 4:]), Pose(true[..., :3], true[..., 3]))
    return torch.stack([*errors]).amax(1).numpy()


@pytest.mark.slow
def test_hloc_localises_its_queries_with_the_localizer_of_the_page(tmp_path, monkeypatch):
    localize_sfm, truth = real("hloc.localize_sfm"), write_hloc_scene(tmp_path)
    theirs = hloc_errors(localize_sfm, tmp_path, truth)
    monkeypatch.setattr(localize_sfm, "QueryLocalizer", localize_sfm.QueryLocalizer)  # undone at the end
    snippet("examples/clients.md", "hloc")
    ours = hloc_errors(localize_sfm, tmp_path, truth)
    assert theirs.max() < 0.1
    assert (ours < 1.5 * theirs + 0.002).all()


@pytest.mark.slow
def test_dust3r_gets_focal_length_and_pose_from_the_function_of_the_page(monkeypatch):
    init_im_poses = real("dust3r.cloud_opt.init_im_poses")
    focal, height, width = 210.0, 120, 160
    generator = torch.Generator().manual_seed(0)
    columns, rows = torch.meshgrid(torch.arange(width), torch.arange(height), indexing="xy")
    depth = 3.0 + torch.sin(columns / 17.0) + torch.cos(rows / 13.0)
    rays = torch.stack(((columns - width / 2) / focal, (rows - height / 2) / focal, torch.ones(height, width)), -1)
    pose = Pose.from_rvec(torch.tensor([[0.3, -0.5, 0.2]]), torch.tensor([[0.4, -0.2, 0.6]]))
    pts3d = (rays * depth[..., None] - pose.translation) @ pose.rotation[0]
    pts3d += 0.01 * torch.randn(pts3d.shape, generator=generator)
    pts3d[torch.rand(height, width, generator=generator) < 0.2] += 0.5  # wrong pixels that are said to be right
    msk = torch.rand(height, width, generator=generator) < 0.7

    def errors(fast_pnp, known):
        found, cam_to_world = fast_pnp(pts3d, known, msk, "cpu")
        world_to_cam = cam_to_world.inverse()
        angle = rotation_angle(world_to_cam[:3, :3], pose.rotation[0]).rad2deg().item()
        return abs(found / focal - 1.0), angle, (world_to_cam[:3, 3] - pose.translation[0]).norm().item()

    theirs = {known: errors(init_im_poses.fast_pnp, known) for known in (None, focal)}
    monkeypatch.setattr(init_im_poses, "fast_pnp", init_im_poses.fast_pnp)  # undone at the end
    snippet("examples/clients.md", "DUSt3R")
    for known, (focal_error, angle, distance) in theirs.items():
        ours = errors(init_im_poses.fast_pnp, known)
        assert ours[0] < 0.01
        assert ours[0] <= focal_error
        assert ours[1] < max(0.2, angle)
        assert ours[2] < max(0.02, distance)


def median_errors(poses, truth):
    """Median angle in radians and distance of poses (B, 7)."""
    cosine = (poses[:, 3:] * truth[:, 3:]).sum(-1).abs().clamp(max=1.0)
    return 2.0 * cosine.acos().median().item(), (poses - truth)[:, :3].norm(dim=-1).median().item()


@pytest.mark.slow
def test_epro_pnps_layer_and_loss_are_two_calls(generator):
    epropnp, lm = real("epropnp.epropnp"), real("epropnp.levenberg_marquardt")
    camera, cost = real("epropnp.camera").PerspectiveCamera(), real("epropnp.cost_fun").AdaptiveHuberPnPCost()
    start = lm.RSLMSolver(dof=6, num_points=8, num_proposals=128, num_iter=5)
    layer = epropnp.EProPnP6DoF(mc_samples=512, num_iter=4, solver=lm.LMSolver(dof=6, num_iter=10, init_solver=start))
    ours = snippet("examples/clients.md", "EPro-PnP")
    # Problems in normalised coordinates, and the true poses (B, 7).
    x3d, cam_mats = torch.randn(64, 24, 3, generator=generator), torch.eye(3).expand(64, 3, 3)
    pose = Pose.from_rvec(torch.randn(64, 3, generator=generator), torch.tensor([0.0, 0.0, 6.0]).expand(64, 3))
    cam = x3d @ pose.rotation.mT + pose.translation[:, None]
    x2d = cam[..., :2] / cam[..., 2:] + 0.01 * torch.randn(64, 24, 2, generator=generator)
    w2d, truth = torch.full_like(x2d, 100.0), torch.cat((pose.translation, pose.quaternion), -1)
    camera.set_param(cam_mats)
    cost.set_param(x2d, w2d)
    theirs = layer(x3d, x2d, w2d, camera, cost)[0]
    found = [median_errors(poses, truth) for poses in (ours["forward_test"](x3d, x2d, w2d, cam_mats), theirs)]
    assert max(found[0]) < 0.1
    assert all(a < 1.2 * b for a, b in zip(*found, strict=True))

    # Both losses are lower for the true poses than for others, and teach the weights.
    wrong = truth + torch.tensor([0.3, 0, 0, 0, 0, 0, 0])
    w2d = w2d.index_fill(1, torch.arange(2), 0.0).requires_grad_()  # a keypoint out of sight
    for out_pose in (truth, wrong):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            *_, weights, target = layer.monte_carlo_forward(x3d, x2d, w2d, camera, cost, pose_init=out_pose)
        losses = (target + weights.logsumexp(0)).mean(), ours["loss"](x3d, x2d, w2d, cam_mats, out_pose).mean()
        for loss in losses:
            assert torch.autograd.grad(loss, w2d, retain_graph=True)[0].isfinite().all()
        if out_pose is truth:
            right = losses
    assert all(a < b for a, b in zip(right, losses, strict=True))


@pytest.mark.slow
def test_pytorch3ds_solution_has_the_axes_of_the_page():
    ops = real("pytorch3d.ops")

    def efficient_pnp(x, y):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of candidates with points behind the camera
            return ops.efficient_pnp(x, y)

    page = snippet("howto/pytorch3d.md")
    clean = SyntheticProblems(n=12, batch_size=8, seed=5, outliers=OutlierMix(count=0)).batch(0)
    focal, centre = clean.intrinsics[:, None, [0, 1], [0, 1]], clean.intrinsics[:, None, :2, 2]
    solution = efficient_pnp(clean.world_points, (clean.img_points - centre) / focal)
    theirs = pose_errors(Pose(solution.R.mT, solution.T), clean.pose)
    assert theirs.rotation_error_deg.median() < 1.0
    # With outliers theirs is far off and ours is not.
    spoilt = efficient_pnp(page["x"], page["y"])
    found = [Pose(spoilt.R.mT, spoilt.T), Pose(page["row_rotation"].mT, page["translation"])]
    theirs, ours = (pose_errors(x, page["problems"].pose).rotation_error_deg.median() for x in found)
    assert theirs > 5.0
    assert ours < 1.0
