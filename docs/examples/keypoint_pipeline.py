"""From images to poses, trained end to end: ``python docs/examples/keypoint_pipeline.py``.

A textured box is rendered in random poses, behind occluders, blurred and noisy. A small network finds its 14 keypoints
(Kornia's spatial softmax and expectation) and predicts a standard deviation for each; `pnpnet-set` makes a pose of
them. The network learns from labels of the visible keypoints, less than half of all. Copies of it then train as long
again in the ways of :data:`WAYS`: with the keypoint loss alone; with the likelihood of the labels, too, which teaches
the standard deviations without a pose; or with the loss of the pose, whose gradient comes through the solver. Two more
networks have labels of all keypoints, which only a known pose can give. All are tested with the same solver on new
images. Writes `keypoint_pipeline.json` and pictures to `--out`.

``--covariances`` runs another, shorter experiment without occluders: motion blurs each image along one direction, in
which keypoints are less exact. Copies of one network train end to end and by likelihood. They predict the noise of a
keypoint as a standard deviation, as a covariance, or as a factor of the covariance of the keypoint's heat map. Writes
`keypoint_covariances.json` to `--out`.
"""

import copy
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

import torch
from kornia.filters import gaussian_blur2d, motion_blur
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from kornia.geometry.subpix import spatial_softmax2d
from shared import command, pose_error, write
from torch import Tensor, nn
from torch.distributions import MultivariateNormal
from torch.nn import functional

from kornia_pnpnet import PnPResult, Pose, create_solver, heatmap_keypoints
from kornia_pnpnet.cameras import reproject
from kornia_pnpnet.evaluation.plots import BLUE, ORANGE, VERMILION, make_figure, save, themed

SIZE, FOCAL, BATCH = 64, 90.0, 32
CAMERA = torch.tensor([[FOCAL, 0.0, (SIZE - 1) / 2], [0.0, FOCAL, (SIZE - 1) / 2], [0.0, 0.0, 1.0]])
HALF = torch.tensor([0.5, 0.4, 0.3])
CORNERS = torch.tensor([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
CENTRES = torch.cat((torch.eye(3), -torch.eye(3)))
KEYPOINTS = torch.cat((CORNERS, CENTRES)) * HALF  # (14, 3)
EDGES = [(i, j) for i in range(8) for j in range(i) if (CORNERS[i] != CORNERS[j]).sum() == 1]
TEXTURES = 8
MOST = 0.3  # a mean distance of the keypoints from which on a pose is far off: a third of the box
POSE_WEIGHT = 50.0  # weight of the loss of the pose beside that of the keypoints, in pixels
MEAN_OF = 50  # updates in the mean that is a point of a curve
MOTION = 9  # pixels; length of the blur of a camera in motion
TEST_SEED = 999_983  # of images that no training uses

ALONE, END, WITHOUT_SIGMA = "keypoint loss alone", "end to end", "end to end, not told how far off"
FULL = "keypoint loss alone, hidden ones labelled"
LIKELY, FULL_LIKELY = f"{ALONE}, how far off by likelihood", f"{FULL}, how far off by likelihood"
#: Ways of :func:`train` by the name of a network.
WAYS: dict[str, tuple[str, ...]] = {
    ALONE: (),
    END: ("end to end",),
    LIKELY: ("likelihood",),
    FULL: ("hidden",),
    FULL_LIKELY: ("hidden", "likelihood"),
}
#: The noise of a keypoint, as a network predicts it.
SIGMA, COVARIANCE, HEAT_MAP = "standard deviation", "covariance", "covariance of the heat map times a factor"


class Images(NamedTuple):
    """Images (B, 3, SIZE, SIZE), the true pose, the true pixels of the keypoints (B, 14, 2) and which show (B, 14)."""

    images: Tensor
    pose: Pose
    pixels: Tensor
    visible: Tensor


def draw(seed: int, index: int, batch: int = BATCH, *, motion: bool = False) -> Images:
    """The images of a batch: the same for the same seed and index.

    With ``motion`` each is blurred along a random direction; a smaller turn and no occluders make these images easier.
    """
    generator = torch.Generator().manual_seed(1_000_003 * seed + index)

    def uniform(*shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator)

    axis = functional.normalize(torch.randn(batch, 3, generator=generator), dim=-1)
    rotation = axis_angle_to_rotation_matrix(axis * uniform(batch, 1, high=math.radians(30.0 if motion else 75.0)))
    translation = torch.cat((uniform(batch, 2, low=-0.35, high=0.35), uniform(batch, 1, low=2.2, high=3.4)), -1)
    pose = Pose(rotation, translation)
    images, hit = render(pose)
    background = functional.interpolate(uniform(batch, 3, 5, 5), (SIZE, SIZE), mode="bicubic", align_corners=True)
    images = torch.where(hit[:, None], images, background)
    pixels, visible = reproject(KEYPOINTS, CAMERA, pose), outside(pose)
    visible &= ((pixels > 0) & (pixels < SIZE - 1)).all(-1)
    row, column = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    for _ in range(0 if motion else 3):
        centre, half = uniform(batch, 2, low=8.0, high=SIZE - 8.0), uniform(batch, 2, low=2.0, high=12.0)
        inside = (row - centre[:, :1, None]).abs() < half[:, :1, None]
        inside &= (column - centre[:, 1:, None]).abs() < half[:, 1:, None]
        images = torch.where(inside[:, None], uniform(batch, 3, 1, 1), images)
        visible &= ((pixels.flip(-1) - centre[:, None]).abs() > half[:, None]).any(-1)
    images = gaussian_blur2d(images, (5, 5), uniform(batch, 1, low=0.4, high=1.2).expand(-1, 2))
    if motion:
        images = motion_blur(images, MOTION, uniform(batch, high=180.0), torch.zeros(batch))
    images = images + 0.04 * torch.randn(images.shape, generator=generator)
    return Images(images - 0.5, pose, pixels, visible)


def outside(pose: Pose) -> Tensor:
    """Whether the box itself does not hide a keypoint, (B, 14): a side that it lies on faces the camera."""
    eye = -(pose.translation[:, None] @ pose.rotation) / HALF  # (B, 1, 3)
    on = (KEYPOINTS / HALF).abs() > 1.0 - 1e-6
    return (on & (eye * (KEYPOINTS / HALF) > 1.0)).any(-1)


def render(pose: Pose) -> tuple[Tensor, Tensor]:
    """The box by the ray of each pixel: colours (B, 3, SIZE, SIZE), and where it is."""
    generator = torch.Generator().manual_seed(7)
    textures = torch.rand(6, 3, TEXTURES, TEXTURES, generator=generator) + torch.rand(6, 3, 1, 1, generator=generator)
    textures = 0.5 * textures  # each side with a colour of its own
    row, column = torch.meshgrid(torch.arange(float(SIZE)), torch.arange(float(SIZE)), indexing="ij")
    rays = torch.stack((column, row, torch.ones_like(row)), -1).view(-1, 3) @ torch.linalg.inv(CAMERA).mT
    direction = rays @ pose.rotation  # in the box's axes, (B, P, 3)
    origin = -(pose.translation[:, None] @ pose.rotation)  # (B, 1, 3)
    direction = torch.where(direction.abs() < 1e-6, 1e-6, direction)
    near = (-HALF * direction.sign() - origin) / direction
    far = (HALF * direction.sign() - origin) / direction
    enter, side = near.max(-1)
    hit = enter < far.amin(-1)
    point = (origin + enter[..., None] * direction) / HALF  # on the surface, one entry is -1 or 1
    face = side + 3 * (direction.gather(-1, side[..., None])[..., 0] > 0)
    across = torch.stack([point.gather(-1, ((side + k) % 3)[..., None]) for k in (1, 2)], -1)
    cell = (0.5 * (across[..., 0, :] + 1.0) * TEXTURES).long().clamp(0, TEXTURES - 1)
    colour = textures[face, :, cell[..., 0], cell[..., 1]]  # (B, P, 3)
    light = 0.6 + 0.4 * direction.gather(-1, side[..., None]).abs() / direction.norm(dim=-1, keepdim=True)
    shape = (-1, SIZE, SIZE)
    return (colour * light).mT.unflatten(-1, (SIZE, SIZE)), hit.view(shape)


class Keypoints(nn.Module):
    """Pixels (B, 14, 2) of the keypoints, and their noise: a standard deviation (B, 14) of 0.1 to 30 pixels.

    After :meth:`predict` the noise may be a covariance (B, 14, 2, 2).
    """

    def __init__(self) -> None:
        super().__init__()
        count = len(KEYPOINTS)

        def block(size_in: int, size_out: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
            layer = nn.Conv2d(size_in, size_out, kernel, stride, kernel // 2, bias=False)
            return nn.Sequential(layer, nn.GroupNorm(8, size_out), nn.ReLU())

        self.down = nn.ModuleList([block(3, 24, 5, 2), block(24, 48, 3, 2), block(48, 96, 3, 2), block(96, 96, 3, 2)])
        self.up = nn.ModuleList([block(96 + 96, 64), block(64 + 48, 48), block(48 + 24, 48)])
        self.heads = nn.Conv2d(48, 2 * count, 1)
        self.noise = SIGMA
        self.to(memory_format=torch.channels_last)  # faster on CPUs

    def predict(self, noise: str) -> Self:
        """Predict another kind of noise from now on; covariances begin as multiples of the identity."""
        self.noise = noise
        if noise == COVARIANCE:
            self.aspect = nn.Conv2d(48, 2 * len(KEYPOINTS), 1)
            nn.init.zeros_(self.aspect.weight)
            nn.init.zeros_(self.aspect.bias)
        return self

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        x = images.contiguous(memory_format=torch.channels_last)
        kept = []
        for layer in self.down:
            x = layer(x)
            kept.append(x)
        for layer, skip in zip(self.up, kept[-2::-1], strict=True):
            x = layer(torch.cat((functional.interpolate(x, scale_factor=2.0), skip), 1))
        heat, off = self.heads(x).chunk(2, 1)  # (B, 14, SIZE / 2, SIZE / 2) each
        pixels, spread = heatmap_keypoints(heat, stride=2)
        share = spatial_softmax2d(heat)
        sigma = torch.exp(0.5 + 3.0 * torch.tanh((share * off).sum((-2, -1)) / 3.0))
        if self.noise == SIGMA:
            return pixels, sigma
        variance = sigma.square()[..., None, None]
        if self.noise == HEAT_MAP:
            return pixels, variance * spread
        size, lean = (torch.cat((share, share), 1) * self.aspect(x)).sum((-2, -1)).tanh().chunk(2, 1)
        none = torch.zeros_like(size)
        factor = torch.stack((size.exp(), none, 3.0 * lean, (-size).exp()), -1).unflatten(-1, (2, 2))
        return pixels, variance * factor @ factor.mT  # the determinant is that of the variance alone


def solve(solver: nn.Module, pixels: Tensor, noise: Tensor | None) -> PnPResult:
    """Poses of the box from its keypoints."""
    known = {"img_sigma": noise} if noise is None or noise.ndim == 2 else {"img_cov": noise}
    result: PnPResult = solver(KEYPOINTS.expand(len(pixels), -1, -1), pixels, CAMERA, **known)
    return result


def distance(pose: Pose, truth: Pose) -> Tensor:
    """How far the keypoints are from where they should be, the mean over all of them, (B,)."""
    off = KEYPOINTS @ (pose.rotation - truth.rotation).mT + (pose.translation - truth.translation)[:, None]
    return (off.square().sum(-1) + 1e-12).sqrt().mean(-1)


def surprise(off: Tensor, noise: Tensor) -> Tensor:
    """Negative log-likelihood of normal noise, up to a constant, (B, 14)."""
    if noise.ndim == 2:
        return 0.5 * off.square().sum(-1) / noise.square() + 2.0 * noise.log()
    return -MultivariateNormal(torch.zeros(2), noise, validate_args=False).log_prob(off)


def train(
    network: Keypoints, solver: nn.Module, seed: int, updates: range, way: Sequence[str] = (), *, motion: bool = False
) -> dict[str, list[float]]:
    """Train a network on the batches ``updates`` of a seed, and return its curves.

    The loss is that of the keypoints; the way "end to end" adds that of the pose, and "likelihood" that of the noise,
    from which keypoints get no gradient. In the way "hidden" the hidden keypoints have labels, too.
    """
    log: list[float] = []
    optimizer = torch.optim.AdamW(network.parameters(), lr=2e-3, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-3, total_steps=len(updates), pct_start=0.1)
    for index in updates:
        problem = draw(seed, index, motion=motion)
        pixels, noise = network(problem.images)
        off = functional.smooth_l1_loss(pixels, problem.pixels, reduction="none").mean(-1)
        labelled = torch.ones_like(problem.visible) if "hidden" in way else problem.visible
        loss = (off * labelled).sum() / labelled.sum()
        log.append(loss.item())
        if "likelihood" in way:
            loss = loss + (surprise((pixels - problem.pixels).detach(), noise) * labelled).sum() / labelled.sum()
        if "end to end" in way:
            result = solve(solver, pixels, noise)
            error = distance(result.pose, problem.pose)
            counts = result.ok & (error.detach() < 10.0 * MOST)
            # Saturated, because a pose that is far off says little about pixels.
            loss = loss + POSE_WEIGHT * torch.where(counts, error / (1.0 + error / MOST), 0.0).mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        schedule.step()
    return {"keypoint_loss": [round(x.mean().item(), 5) for x in torch.tensor(log).split(MEAN_OF)]}


@torch.no_grad()
def test(network: Keypoints, solver: nn.Module, *, with_sigma: bool, batches: int, motion: bool) -> dict[str, float]:
    """Errors on images of a seed that no training uses."""
    rows = []
    for index in range(batches):
        problem = draw(TEST_SEED, index, motion=motion)
        pixels, sigma = network(problem.images)
        pose = solve(solver, pixels, sigma if with_sigma else None).pose
        off = (pixels - problem.pixels).norm(dim=-1).mean(-1)
        rows.append(torch.stack((distance(pose, problem.pose), pose_error(pose, problem.pose)[1], off)))
    away, angle, pixel = torch.cat(rows, 1)
    return {
        "mean_distance": away.clamp(max=1.0).mean().item(),
        "mean_rotation_deg": angle.mean().item(),
        "median_distance": away.median().item(),
        "mean_keypoint_px": pixel.mean().item(),
    }


def begin(seed: int, updates: int, *, motion: bool, **options: Any) -> tuple[nn.Module, Keypoints, Keypoints, Any]:
    """The solver, an untrained network, the same after training with the keypoint loss, and the first results."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    solver = create_solver("pnpnet-set", **options).requires_grad_(False)
    untrained = Keypoints()
    start = copy.deepcopy(untrained)
    curves = train(start, solver, seed, range(updates), motion=motion)
    return solver, untrained, start, {"keypoints first": {"curves": curves}}


def run(seed: int, updates: int, batches: int) -> tuple[dict[str, Any], dict[str, Keypoints]]:
    """Train networks in all :data:`WAYS`."""
    solver, untrained, start, found = begin(seed, updates, motion=False, effort="fixed")
    networks = {}
    for name, way in WAYS.items():
        networks[name] = network = copy.deepcopy(untrained if "hidden" in way else start)
        for first in (0, updates) if "hidden" in way else (updates,):
            curves = train(network, solver, seed, range(first, first + updates), way)
        with_sigma = name not in (ALONE, FULL)
        found[name] = {"curves": curves, **test(network, solver, with_sigma=with_sigma, batches=batches, motion=False)}
        distances = ", ".join(f"{key} {found[name][key]:.4f}" for key in ("mean_distance", "median_distance"))
        print(f"seed {seed}, {name}: {distances}", flush=True)
    found[WITHOUT_SIGMA] = test(networks[END], solver, with_sigma=False, batches=batches, motion=False)
    return found, {name: networks[name] for name in (ALONE, END)}


def run_covariances(seed: int, updates: int, batches: int) -> tuple[dict[str, Any], dict[str, Keypoints]]:
    """Train networks that predict each kind of noise from one start, on images with motion blur."""
    solver, _, start, found = begin(seed, updates, motion=True)
    more = range(updates, updates + updates // 2)
    for noise in (SIGMA, COVARIANCE, HEAT_MAP):
        network = copy.deepcopy(start).predict(noise)
        curves = train(network, solver, seed, more, ("end to end", "likelihood"), motion=True)
        found[noise] = {"curves": curves, **test(network, solver, with_sigma=True, batches=batches, motion=True)}
        print(f"seed {seed}, {noise}: mean_distance {found[noise]['mean_distance']:.4f}", flush=True)
    return found, {}


@themed
def plot_errors(results: dict[str, Any], path: Path) -> None:
    """The errors of each seed, and their means."""
    figure = make_figure(8.0, 3.4)
    looks = {
        ALONE: ("labels of visible keypoints", ORANGE),
        LIKELY: ("... and sigmas, by likelihood", ORANGE),
        FULL: ("labels of hidden ones, too", VERMILION),
        FULL_LIKELY: ("... and sigmas, by likelihood", VERMILION),
        WITHOUT_SIGMA: ("end to end, without sigmas", BLUE),
        END: ("end to end", BLUE),
    }
    parts = (("mean_distance", "mean distance of keypoints"), ("mean_rotation_deg", "mean rotation error (°)"))
    for axes, (key, label) in zip(figure.subplots(1, 2, sharey=True), parts, strict=True):
        best = results["times_lower"]
        for y, (name, (_, colour)) in enumerate(looks.items()):
            values = [found[name][key] for found in results["seeds"].values()]
            axes.barh(y, sum(values) / len(values), color=colour, alpha=0.4, height=0.6)
            axes.plot(values, [y] * len(values), "o", color=colour, markersize=4.0)
            if name in best:
                axes.annotate(f"× {best[name][key]:.2f}", (0.02, y), xycoords=("axes fraction", "data"), va="center")
        axes.set_xlabel(label)
        axes.grid(visible=False, axis="y")
    axes.set_yticks(range(len(looks)), [text for text, _ in looks.values()])
    axes.invert_yaxis()
    save(figure, path)


@torch.no_grad()
def plot_overlays(networks: dict[str, Keypoints], path: Path) -> None:
    """The box as it is and as it is found, over test images."""
    solver = create_solver("pnpnet-set")
    problem = draw(TEST_SEED, 0)
    figure = make_figure(9.0, 3.2)
    for row, (name, network) in zip(figure.subplots(2, 6), networks.items(), strict=True):
        pixels, sigma = network(problem.images)
        result = solve(solver, pixels, sigma if name == END else None)
        found, truth = (reproject(KEYPOINTS, CAMERA, pose) for pose in (result.pose, problem.pose))
        for i, axes in enumerate(row):
            axes.imshow((problem.images[i] + 0.5).clamp(0, 1).permute(1, 2, 0))
            for corners, colour in ((truth, "white"), (found, BLUE if name == END else ORANGE)):
                for a, b in EDGES:
                    axes.plot(*corners[i, [a, b]].mT, color=colour, linewidth=1.0)
            axes.scatter(*pixels[i].mT, s=24.0 / (1.0 + sigma[i]) if name == END else 8.0, color="black")
            axes.set_xlim(0, SIZE - 1)
            axes.set_ylim(SIZE - 1, 0)
            axes.set_axis_off()
        row[0].set_title(name, loc="left", fontsize=8)
    save(figure, path)


def main() -> None:
    parser = command(__doc__, seeds=2)
    parser.add_argument("--updates", type=int, default=2000, help="of each half of the training")
    parser.add_argument("--batches", type=int, default=32, help="of test images")
    parser.add_argument("--covariances", action="store_true", help="compare kinds of noise; end to end half as long")
    options = parser.parse_args()
    train_all = run_covariances if options.covariances else run
    runs = [train_all(seed, options.updates, options.batches) for seed in range(options.seeds)]
    seeds = {str(seed): found for seed, (found, _) in enumerate(runs)}
    results: dict[str, Any] = {"updates": options.updates, "batches": options.batches, "seeds": seeds}
    if options.covariances:
        write(options.out / "keypoint_covariances.json", **results)
        return
    keys = seeds["0"][WITHOUT_SIGMA]
    totals = {name: {key: sum(found[name][key] for found in seeds.values()) for key in keys} for name in WAYS}
    end_to_end = totals.pop(END)
    results["times_lower"] = {name: {key: x[key] / end_to_end[key] for key in keys} for name, x in totals.items()}
    write(options.out / "keypoint_pipeline.json", **results)
    plot_errors(results, options.out / "keypoint_pipeline.png")
    plot_overlays(runs[-1][1], options.out / "keypoint_pipeline_overlays.png")


if __name__ == "__main__":
    main()
