"""The networks: samples, noise and training of the network of a set; layers and rotations of the paper's network."""

import math
import os
import platform
import subprocess
import sys

import pytest
import torch
from helpers import assert_same, rate
from kornia.geometry.conversions import axis_angle_to_rotation_matrix

from kornia_pnpnet import Normalize, PnPNet, Pose, RobustWeightedLM, SetInit, SetLoss, pose_errors, success
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.problem import Noise
from kornia_pnpnet.propose.mlp import rotation_about

NOISE = {"img_sigma": 1.0, "world_sigma": 0.05}


def solver():
    refine = RobustWeightedLM(4, kernel="geman_mcclure", robustness=6.0)
    return PnPNet(SetInit(), refine, Normalize(order=False), effort="fixed").double().eval()


@pytest.mark.parametrize(("n", "outliers"), [(4, 0), (9, 0), (9, 4), (60, 0), (60, 50)])
def test_samples_of_inliers_have_the_true_pose(n, outliers):
    """Where outliers are masked and there is no noise. Points in line and the like may fail."""
    options = {"max_angle": math.pi, "outliers": OutlierMix(count=outliers), "dtype": torch.float64}
    p = SyntheticProblems(n=n, batch_size=50, seed=1, img_sigma=0.0, world_sigma=0.0, **options).batch(0)
    _, guess = solver().with_starts(*p[:3], mask=p.inliers, img_sigma=0.1, world_sigma=0.001)
    sampled = Pose(guess.others.rotation[:, -1], guess.others.translation[:, -1])
    assert success(pose_errors(sampled, p.pose), 0.01, 0.01).double().mean() > 0.95


def test_known_noise_is_used_as_it_is_and_unknown_noise_is_estimated(make_problems):
    p = make_problems(n=9, batch=4)
    net = solver()
    sigma = torch.tensor([0.5, torch.nan, 2.0, torch.nan], dtype=torch.float64)
    noise = net.with_starts(*p[:3], img_sigma=sigma)[1].noise
    known = ~sigma.isnan()
    torch.testing.assert_close(noise.img[known], sigma[known, None].expand(-1, 9))
    assert noise.img.isfinite().all()
    assert ((noise.world > 0) & noise.world.isfinite()).all()
    torch.testing.assert_close(noise.img[~known], net.with_starts(*p[:3])[1].noise.img[~known])
    of_pairs = torch.rand(4, 9, dtype=torch.float64) + 0.1
    torch.testing.assert_close(net.with_starts(*p[:3], world_sigma=of_pairs)[1].noise.world, of_pairs)
    problem, given = net.normalize(*p[:3])[0], Noise(of_pairs, torch.full_like(of_pairs, torch.nan))
    starts = net.init(problem)
    assert_same(net.refine.begin(problem._replace(noise=given), starts).problem.noise[:2], (of_pairs, starts.noise[1]))


def test_it_learns():
    """In a hundred small steps: any rotation, up to a third of the pairs are outliers."""
    refine = RobustWeightedLM(6, kernel="geman_mcclure", robustness=20.0)
    net = PnPNet(SetInit(width=16, layers=2, hidden=32, samples=0), refine, Normalize(order=False))
    data = SyntheticProblems(n=9, batch_size=200, seed=1, outliers=OutlierMix(), max_angle=math.pi, known_noise=0.5)
    fresh = SyntheticProblems(n=9, batch_size=1000, seed=2, outliers=OutlierMix(), max_angle=math.pi).batch(0)
    loss, optimizer = SetLoss(), torch.optim.Adam(net.parameters(), lr=4e-3)
    before = rate(net(*fresh[:3], **NOISE), fresh)
    for i in range(100):
        p = data.batch(i)
        optimizer.zero_grad()
        result, guess = net.with_starts(*p[:3], **p.sigmas)
        loss(result, p, 1.0, guess).total.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
    assert rate(net(*fresh[:3], **NOISE), fresh) > max(0.65, before + 0.2)


def test_padding_costs_nothing(make_problems):
    """Problems of about the same size are solved together, without the padding of larger ones."""
    p = make_problems(n=60, batch=30, outliers=20)
    counts = torch.tensor([20, 33, 57]).repeat(10)
    mask = torch.rand(30, 60, generator=torch.Generator().manual_seed(0)).argsort(1) < counts[:, None]
    net, shapes = solver(), []
    net.init.register_forward_hook(lambda _module, inputs, _output: shapes.append(inputs[0].weights.shape))
    with torch.no_grad():
        whole = net(*p[:3], mask=mask)
        net.init.pairs_at_once = 400 // torch.get_num_threads()
        parts = net(*p[:3], mask=mask, weights=mask.double(), confidence=mask.double())
    assert shapes[0] == (30, 57)
    assert all(b * n <= 400 for b, n in shapes[1:])
    assert {n for _, n in shapes[1:]} == {20, 33, 57}
    assert_same(parts, whole, 1e-9, 1e-9)
    assert (parts.weights[~mask] == 0).all()


_FAULTS = """
import resource
import torch
from kornia_pnpnet import create_solver
from kornia_pnpnet.core.performance import keep_freed_memory
torch.set_num_threads(1)
keep_freed_memory()
solver, faults = create_solver("pnpnet-set"), []
inputs = torch.randn(1000, 9, 3), torch.randn(1000, 9, 2), torch.eye(3)
with torch.no_grad():
    for _ in range(14):
        faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
        solver(*inputs)
print(faults[13] - faults[3])
"""


@pytest.mark.slow
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another allocator")
def test_memory_of_a_call_serves_the_next():
    """With `keep_freed_memory`, ten calls ask the system for hardly any pages; else each asks for thousands."""
    plain = {key: value for key, value in os.environ.items() if not key.startswith(("MALLOC_", "LD_PRELOAD", "GLIBC"))}
    done = subprocess.run([sys.executable, "-c", _FAULTS], capture_output=True, text=True, check=True, env=plain)
    assert int(done.stdout) < 2000


def test_padding_changes_nothing_where_the_network_sees_some_pairs(make_problems):
    p = make_problems(n=100, batch=20, outliers=40)
    padded = [torch.nn.functional.pad(x, (0, 0, 0, 30)) for x in p[:2]]
    mask = torch.arange(130).expand(20, 130) < 100
    net = PnPNet.from_pretrained("pnpnet-set").double().eval()
    assert_same(net(*padded, p.intrinsics, mask=mask).pose, net(*p[:3]).pose, 1e-6, 1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_axis_and_angle_turn_as_kornias_rotation_vectors(dtype, generator):
    """Large and tiny angles, long and short axes; values and gradients."""
    axis = torch.randn(3, 400, generator=generator, dtype=torch.float64)
    axis *= 10.0 ** torch.linspace(-1, 3, 20, dtype=torch.float64).repeat(20)
    angle = 10.0 * torch.randn(400, generator=generator, dtype=torch.float64)
    angle[:200] *= 10.0 ** torch.linspace(-12, 0, 200, dtype=torch.float64)
    upstream = torch.randn(400, 3, 3, generator=generator, dtype=torch.float64).to(dtype)

    def kornias(axis, angle):
        length = (axis.square().sum(0) + torch.finfo(dtype).eps).sqrt()
        return axis_angle_to_rotation_matrix((axis / length * angle).mT)

    outcomes = []
    for function, at in ((rotation_about, dtype), (kornias, torch.float64)):
        leaves = [x.to(dtype).to(at).requires_grad_() for x in (axis, angle)]
        rotation = function(*leaves)
        by_axis, by_angle = torch.autograd.grad(rotation, leaves, upstream.to(at))
        size = leaves[0].detach().norm(dim=0)  # the gradient by the axis is inverse to it
        outcomes.append([x.to(torch.float64) for x in (rotation, by_axis * size, by_angle)])
    tolerance = 2e-5 if dtype == torch.float32 else 1e-12
    for mine, expected in zip(*outcomes, strict=True):
        torch.testing.assert_close(mine, expected, rtol=tolerance, atol=20 * tolerance)
