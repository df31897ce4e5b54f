"""Laws of the set network: its invariances, its samples, its noise, and that a few training steps improve it."""

import math
import os
import platform
import subprocess
import sys
from itertools import combinations

import pytest
import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from kornia_pnpnet.init.set import _ENOUGH, _some_of
from kornia_pnpnet.init.view import _same

from kornia_pnpnet import Normalize, PnPNet, Pose, RobustWeightedLM, SetInit, SetLoss, pose_errors, success
from kornia_pnpnet.core.trees import iter_tensors, map_tensors
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.problem import Noise

NOISE = {"img_sigma": 1.0, "world_sigma": 0.05}


def solver(**options):
    torch.manual_seed(0)
    refine = RobustWeightedLM(4, kernel="geman_mcclure", robustness=6.0)
    return PnPNet(SetInit(**options), refine, Normalize(order=False), effort="fixed").double().eval()


def near(a, b, tolerance=1e-6):
    for mine, others in zip(a, b, strict=True):
        torch.testing.assert_close(mine, others, rtol=tolerance, atol=tolerance)


def test_any_number_of_pairs_and_any_precision(make_problems, tmp_path):
    net = solver(width=16, heads=2, starts=2)
    net.save_pretrained(tmp_path)
    single = PnPNet.from_pretrained(tmp_path)  # float32 weights take float64 pairs
    single.effort = "fixed"
    for n in (4, 5, 9, 50, 1000):
        p = make_problems(n=n, batch=3)
        result = net(*p[:3])
        assert result.weights.shape == (3, n)
        assert result.matrix.isfinite().all()
        assert ((result.weights >= 0) & (result.weights <= 1)).all()
        assert single(*p[:3]).rotation.dtype == torch.float64
        near(single(*p[:3]).init, result.init, 1e-4)


def test_poses_follow_similarity_transforms_of_the_world(make_problems):
    """Turned by any angle, moved, in another unit: the network alone, and with known noise all of the solver."""
    p = make_problems(n=9, batch=20, outliers=2)
    net = solver()
    generator = torch.Generator().manual_seed(1)
    axis = torch.nn.functional.normalize(torch.randn(20, 3, generator=generator, dtype=torch.float64), dim=-1)
    turn = axis_angle_to_rotation_matrix(axis * math.pi * torch.rand(20, 1, generator=generator, dtype=torch.float64))
    shift, unit = torch.randn(20, 3, generator=generator, dtype=torch.float64) * 100, 1000.0
    world = (unit * p.world_points) @ turn.mT + shift[:, None]

    def back(pose):
        """A pose of the other world, expressed for the first."""
        rotation = pose.rotation @ turn
        return Pose(rotation, (pose.translation + (pose.rotation @ shift[..., None])[..., 0]) / unit)

    for noise, other in (({}, {}), (NOISE, {"img_sigma": 1.0, "world_sigma": 0.05 * unit})):
        first, second = net(*p[:3], **noise), net(world, *p[1:3], **other)
        near(back(second.init), first.init, 1e-4)  # of translations of a hundred
        near(back(second.pose), first.pose, 1e-4)
        near([second.weights], [first.weights], 1e-4)
        assert torch.equal(first.ok, second.ok)


def test_the_poses_are_rigid_and_there_are_as_many_as_were_asked_for(make_problems):
    p = make_problems(n=9, batch=30, outliers=3)
    corr, _ = Normalize(order=False)(*p[:3])
    for starts, samples, others in ((1, 0, 0), (3, 0, 2), (1, 2, 1), (3, 8, 3)):
        guess = solver(starts=starts, samples=samples).init(corr)
        rotations = guess.pose.rotation[:, None]
        if others:
            assert guess.others.translation.shape == (30, others, 3)
            rotations = torch.cat((rotations, guess.others.rotation), 1)
        else:
            assert guess.others is None
        eye = torch.eye(3, dtype=torch.float64).expand_as(rotations)
        torch.testing.assert_close(rotations @ rotations.mT, eye)
        torch.testing.assert_close(torch.linalg.det(rotations), torch.ones_like(rotations[..., 0, 0]))


@pytest.mark.parametrize(("n", "outliers"), [(4, 0), (9, 0), (9, 4), (60, 0), (60, 50)])
def test_samples_of_inliers_have_the_true_pose(n, outliers):
    """Where outliers are masked and there is no noise. Points in line and the like may fail."""
    options = {"n": n, "batch_size": 50, "seed": 1, "max_angle": math.pi, "dtype": torch.float64}
    mix = OutlierMix(count=outliers)
    p = SyntheticProblems(img_sigma=0.0, world_sigma=0.0, outliers=mix, **options).batch(0)
    _, guess = solver().with_starts(*p[:3], mask=p.inliers, img_sigma=0.1, world_sigma=0.001)
    sampled = Pose(guess.others.rotation[:, -1], guess.others.translation[:, -1])
    assert success(pose_errors(sampled, p.pose), 0.01, 0.01).double().mean() > 0.95


@pytest.mark.parametrize(("n", "there"), [(9, 4), (9, 6), (24, 9), (32, 24)])
def test_padding_makes_and_judges_no_sample(make_problems, n, there):
    p = make_problems(n=n, batch=200, outliers=n // 3)
    mask = torch.arange(n).expand(200, n) < there
    net = solver()
    padded = net.with_starts(*p[:3], mask=mask, **NOISE)[1]
    alone = net.with_starts(p.world_points[:, :there], p.img_points[:, :there], p.intrinsics, **NOISE)[1]
    near(padded.others, alone.others)


@pytest.mark.parametrize(("count", "wrong"), [(5, 1), (6, 2)])
def test_some_sample_is_right_whichever_are_wrong(count, wrong):
    samples = solver().init.triples(count)[0]
    assert len(samples) <= 6
    for bad in combinations(range(count), wrong):
        assert any(not set(bad) & set(sample) for sample in samples)


def test_where_no_sample_has_a_pose_the_first_guess_stands_in():
    p = SyntheticProblems(n=6, batch_size=4, seed=3, dtype=torch.float64).batch(0)
    line = p.world_points[:, :1] + torch.arange(6, dtype=torch.float64)[:, None] * torch.ones(3, dtype=torch.float64)
    corr, _ = Normalize(order=False)(line, *p[1:3])
    guess = solver().init(corr)
    torch.testing.assert_close(guess.others.rotation[:, -1], guess.pose.rotation)
    torch.testing.assert_close(guess.others.translation[:, -1], guess.pose.translation)


def test_the_pose_of_samples_is_a_constant(make_problems):
    p = make_problems(n=9, batch=5)
    corr, _ = Normalize(order=False)(*p[:3])
    world = corr.world_points.detach().requires_grad_()
    net = solver().init
    others = net(corr._replace(world_points=world)).others
    for index, learns in ((-1, False), (0, True)):
        total = others.rotation[:, index, 0].sum() + others.translation[:, index].sum()
        (gradient,) = torch.autograd.grad(total, world, retain_graph=True)
        assert gradient.any().item() is learns


def test_known_noise_is_used_as_it_is_and_unknown_noise_is_estimated(make_problems):
    p = make_problems(n=9, batch=4)
    net = solver()
    sigma = torch.tensor([0.5, torch.nan, 2.0, torch.nan], dtype=torch.float64)
    noise = net.with_starts(*p[:3], img_sigma=sigma)[1].noise
    known = ~sigma.isnan()
    torch.testing.assert_close(noise.img[known], sigma[known, None].expand(-1, 9))
    estimated = net.with_starts(*p[:3])[1].noise
    assert noise.img.isfinite().all()
    assert ((noise.world > 0) & noise.world.isfinite()).all()
    torch.testing.assert_close(noise.img[~known], estimated.img[~known])
    of_pairs = torch.rand(4, 9, dtype=torch.float64) + 0.1
    torch.testing.assert_close(net.with_starts(*p[:3], world_sigma=of_pairs)[1].noise.world, of_pairs)


def test_it_learns():
    """In a hundred small steps: any rotation, with a third of the pairs wrong."""
    torch.manual_seed(0)
    refine = RobustWeightedLM(6, kernel="geman_mcclure", robustness=20.0)
    net = PnPNet(SetInit(width=16, layers=2, hidden=32, samples=0), refine, Normalize(order=False))
    data = SyntheticProblems(n=9, batch_size=200, seed=1, outliers=OutlierMix(), max_angle=math.pi, known_noise=0.5)
    fresh = SyntheticProblems(n=9, batch_size=1000, seed=2, outliers=OutlierMix(), max_angle=math.pi).batch(0)
    loss, optimizer = SetLoss(), torch.optim.Adam(net.parameters(), lr=4e-3)

    def rate():
        with torch.no_grad():
            return success(pose_errors(net(*fresh[:3], **NOISE).pose, fresh.pose)).double().mean().item()

    before = rate()
    for i in range(100):
        p = data.batch(i)
        optimizer.zero_grad()
        result, guess = net.with_starts(*p[:3], **p.sigmas)
        loss(result, p, 1.0, guess).total.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
    assert rate() > max(0.65, before + 0.2)


def test_pairs_with_the_same_point_are_counted(generator):
    places = torch.randint(0, 3, (5, 40, 2), generator=generator).double()
    there = (torch.rand(5, 40, generator=generator) < 0.7).double()
    expected = ((places[:, :, None] == places[:, None]).all(-1) * there[:, None]).sum(-1)
    torch.testing.assert_close(_same(places, there)[there > 0], expected[there > 0])


@pytest.mark.parametrize("given", [False, True])
def test_large_batches_are_solved_in_parts(given, make_problems, monkeypatch):
    """Without gradients only, and with what belongs to each problem: cameras, masks, poses and noise."""
    p = make_problems(n=10, batch=7, outliers=2)
    net = solver()
    generator = torch.Generator().manual_seed(0)
    mask = torch.rand(7, 10, generator=generator) > 0.1
    noise = torch.linspace(0.5, 2.0, 7, dtype=torch.float64)
    extra = {"mask": mask, "init": tuple(p.pose), "img_sigma": noise} if given else {}
    sizes = []
    net.init.register_forward_hook(lambda _module, inputs, _output: sizes.append(len(inputs[0].weights)))
    whole = net(*p[:3], **extra)
    monkeypatch.setattr(SetInit, "pairs_at_once", 20 // torch.get_num_threads())
    net(*p[:3], **extra)
    assert sizes == [7, 7]
    with torch.no_grad():
        parts = net(*p[:3], **extra)
    assert sizes[2:] == ([2, 2, 3] if given else [3, 2, 2])
    assert isinstance(parts.init, Pose)
    near(iter_tensors(parts), iter_tensors(whole), 1e-9)


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
    near(iter_tensors(parts), iter_tensors(whole), 1e-9)
    assert (parts.weights[~mask] == 0).all()


_FAULTS = """
import resource
import torch
from kornia_pnpnet import create_solver
from kornia_pnpnet.core.performance import keep_freed_memory
torch.set_num_threads(1)
keep_freed_memory()
solver = create_solver("pnpnet-set")
inputs = torch.randn(1000, 9, 3), torch.randn(1000, 9, 2), torch.eye(3)
with torch.no_grad():
    for _ in range(3):
        solver(*inputs)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        solver(*inputs)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.slow
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another allocator")
def test_memory_of_a_call_serves_the_next():
    """With `keep_freed_memory`, ten calls ask the system for hardly any pages; else each asks for thousands."""
    plain = {key: value for key, value in os.environ.items() if not key.startswith(("MALLOC_", "LD_PRELOAD", "GLIBC"))}
    done = subprocess.run([sys.executable, "-c", _FAULTS], capture_output=True, text=True, check=True, env=plain)
    assert int(done.stdout) < 2000


def test_where_a_search_follows_the_network_sees_some_pairs_and_the_others_get_weights(make_problems):
    """Starts and noise are those of a problem of these pairs alone; sigmas and confidences stay with their pairs."""
    n = 3 * _ENOUGH
    p = make_problems(n=n, batch=50, outliers=n // 3)
    generator = torch.Generator().manual_seed(2)
    mask = torch.rand(50, n, generator=generator) > 0.3
    sigma = 0.5 + torch.rand(50, n, generator=generator, dtype=torch.float64)
    pretrained = PnPNet.from_pretrained("pnpnet-set").double().eval()
    net, normalize = pretrained.init, Normalize(order=False)
    noise = Noise(sigma, torch.full_like(sigma, torch.nan))
    confidence = torch.rand(50, n, generator=generator, dtype=torch.float64)
    corr = normalize(*p[:3], mask=mask, noise=noise, confidence=confidence)[0]
    guess = net(corr, search_follows=True)
    index = _some_of(mask, _ENOUGH)
    assert mask.gather(1, index).all()
    assert (index.sort(1).values.diff(dim=1) > 0).all()
    fewer = corr._replace(
        **{name: getattr(corr, name).gather(1, index) for name in ("weights", "near", "confidence")},
        world_points=corr.world_points.gather(1, index[..., None].expand(-1, -1, 3)),
        img_points=corr.img_points.gather(1, index[..., None].expand(-1, -1, 2)),
        noise=map_tensors(lambda x: x.gather(1, index), corr.noise),
    )
    alone = net(fewer, search_follows=True)
    near(guess.pose, alone.pose)
    near(guess.others, alone.others)
    near([guess.weights.gather(1, index), guess.noise.img.gather(1, index)], [alone.weights, alone.noise.img])
    unseen = torch.ones_like(mask).scatter(1, index, False) & mask
    right = guess.weights[unseen & p.inliers] > 0.5
    wrong = guess.weights[unseen & ~p.inliers] > 0.5
    assert right.double().mean() > 0.75
    assert wrong.double().mean() < 0.2


def test_pairs_that_are_seen_are_spread_over_those_that_are_there():
    counts = torch.tensor([1000, 40, 500, *range(_ENOUGH, 3 * _ENOUGH)])
    there = torch.arange(1000) >= 1000 - counts[:, None]
    there[1] = there[1].flip(0)
    index = _some_of(there, _ENOUGH)
    assert (index.sort(1).values.diff(dim=1) > 0).all()
    for row, first, last in ((0, 0, 1000), (2, 500, 1000)):
        counts = torch.histc(index[row].double(), 4, first, last)
        assert counts.tolist() == [_ENOUGH / 4] * 4
        assert abs((index[row] % 2).double().mean() - 0.5) < 0.1  # no stride that meets only even positions
    assert set(range(40)) <= set(index[1].tolist())


def test_padding_changes_nothing_where_the_network_sees_some_pairs(make_problems):
    p = make_problems(n=100, batch=20, outliers=40)
    padded = [torch.nn.functional.pad(x, (0, 0, 0, 30)) for x in p[:2]]
    mask = torch.arange(130).expand(20, 130) < 100
    net = PnPNet.from_pretrained("pnpnet-set").double().eval()
    near(net(*padded, p.intrinsics, mask=mask).pose, net(*p[:3]).pose)
