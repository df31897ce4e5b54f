"""EPnP, EPPnP and REPPnP: exact, differentiable, as successful as their papers and OpenCV; the algebra of solvers."""

import pytest
import torch
from helpers import finite, rate

from kornia_pnpnet import Pose, create_solver, pose_errors, success
from kornia_pnpnet.core.linalg import align, nearest_rotation, solve_leading, solve_positive
from kornia_pnpnet.core.symmetric import are_semi_definite, equivalent_sigma, symmetric
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.refine.residual import rotation_angle

SOLVERS = {
    "EPnP": lambda **options: create_solver("epnp", **options),
    "EPPnP": lambda **options: create_solver("reppnp", reject_outliers=False, **options),
    "REPPnP": lambda **options: create_solver("reppnp", **options),
}
THIN = [(5, None, 1e-3, 1.0), (4, 0.0, 1e-3, 0.99), (4, None, 1e-3, 0.85)]
THIN += [(9, thickness, 1.0, 0.98) for thickness in (1e-1, 1e-3, 1e-8)]
MIX = OutlierMix()  # at most 3, 6 and 16 outliers


def flattened(p, thickness=0.0):
    """The same pixels of points that lie on a slanted plane, apart from bumps of this fraction of their distances."""
    normal = torch.tensor([0.2, -0.3, 1.0], dtype=torch.float64)
    rays = torch.nn.functional.pad(p.img_points / p.intrinsics[:, :1, :1], (0, 1), value=1.0)
    bumps = torch.randn(p.img_points.shape[:2], generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    cam_points = rays * (20.0 / (rays @ normal) * (1.0 + thickness * bumps))[..., None]
    return p._replace(world_points=(cam_points - p.pose.translation[:, None]) @ p.pose.rotation)


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize(("n", "planar"), [(6, False), (50, False), (5, True), (20, True)])
def test_exact_pairs_give_the_exact_pose(name, n, planar, make_problems):
    p = make_problems(n, 100, noise=False)
    p, solver = flattened(p) if planar else p, SOLVERS[name]()
    result = solver(*p[:3])
    assert result.ok.all()
    assert result.weights.all()
    assert pose_errors(result.pose, p.pose).rotation_error_deg.max() < 1e-4
    single = solver(*(x.float() for x in p[:3]))
    assert pose_errors(Pose(*(x.double() for x in single.pose)), p.pose).rotation_error_deg.max() < 0.2


@pytest.mark.parametrize(("n", "thickness", "limit", "share"), THIN)
def test_few_pairs_and_nearly_planar_points_are_solved(n, thickness, limit, share, make_problems):
    """Below a threshold the thickness is dropped and acts as noise of that size."""
    p = make_problems(n, 500, noise=False)
    p = p if thickness is None else flattened(p, thickness)
    errors = pose_errors(SOLVERS["EPnP"]()(*p[:3]).pose, p.pose)
    assert (errors.rotation_error_deg < limit).double().mean() >= share


@pytest.mark.parametrize("name", ["EPnP", "EPPnP"])
def test_weights_count_pairs(name, make_problems):
    """A pair of weight 3 counts as three pairs, and a common factor of the weights does not matter."""
    p, times = make_problems(9, 50), torch.tensor([1, 3, 1, 1, 2, 1, 1, 1, 1])
    solver = SOLVERS[name]()
    repeated = solver(*(x.repeat_interleave(times, 1) for x in p[:2]), p.intrinsics)
    for factor in (1.0, 1e-6):
        weighted = solver(*p[:3], factor * times.double().expand(50, 9))
        torch.testing.assert_close(weighted.matrix, repeated.matrix, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("n", "outliers"), [(9, 1), (50, 12)])
def test_gross_outliers_are_found_and_do_not_move_the_pose(n, outliers, make_problems):
    p = make_problems(n, 200, outliers=outliers, noise=False)
    cam = p.world_points @ p.pose.rotation.mT + p.pose.translation[:, None]
    off = (cam[..., :2] - p.img_points / p.intrinsics[:, :1, :1] * cam[..., 2:]).norm(dim=-1)
    gross = (p.inliers | (off > 3.0)).all(-1)  # some mismatches happen to be close to the true pixel
    assert gross.sum() > 100
    result = SOLVERS["REPPnP"]()(*p[:3])
    found = ((result.weights > 0) == p.inliers).all(-1)
    assert found[gross].double().mean() > 0.97
    assert pose_errors(result.pose, p.pose).rotation_error_deg[found].max() < 1e-4
    assert success(pose_errors(SOLVERS["EPPnP"]()(*p[:3]).pose, p.pose))[gross].double().mean() < 0.03


@pytest.mark.parametrize("thickness", [0.0, 1.0])
@pytest.mark.parametrize(("dtype", "max_error_deg"), [(torch.float64, 1e-4), (torch.float32, 0.5)])
def test_a_view_through_a_telephoto_lens(dtype, max_error_deg, thickness, random_rotations, generator):
    """From a distance of 100 radii there is hardly any depth, and off the axis all pixels nearly coincide."""
    world = torch.randn(100, 20, 3, generator=generator, dtype=torch.float64)
    world[..., 2] *= thickness
    truth = Pose(random_rotations(100), torch.tensor([50.0, -30.0, 100.0], dtype=torch.float64).expand(100, 3))
    cam_points = world @ truth.rotation.mT + truth.translation[:, None]
    pixels = 3400.0 * cam_points[..., :2] / cam_points[..., 2:]
    pixels[:, [2, 5, 11], 0] += 40.0  # more than a radius
    camera = torch.diag(torch.tensor([3400.0, 3400.0, 1.0])).to(dtype)
    result = SOLVERS["REPPnP"]()(world.to(dtype), pixels.to(dtype), camera)
    errors = pose_errors(Pose(*(x.double() for x in result.pose)), truth)
    assert (errors.rotation_error_deg < max_error_deg).double().mean() > 0.95


# Shares of success, about three standard deviations below those of 5000 problems.
@pytest.mark.parametrize(("n", "mix", "floor"), [(9, None, 0.88), (9, MIX, 0.715), (20, MIX, 0.975), (50, MIX, 0.995)])
def test_success_on_the_protocols_problems(n, mix, floor):
    p = SyntheticProblems(n=n, batch_size=1000, seed=7, outliers=mix).batch(0)
    assert rate(SOLVERS["REPPnP"]()(*p[:3]), p) > floor


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("name", SOLVERS)
def test_gradcheck(name, planar, make_problems, generator):
    p = make_problems(9, 1, seed=5)
    p = flattened(p)._replace(img_points=p.img_points + 1.0) if planar else p
    solver = SOLVERS[name](**({"iterations": 8} if name == "EPnP" else {"refine_iterations": 6}))
    assert solver(*p[:3]).ok.all()

    # All inputs near 1, so that one difference step suits all.
    def run(world, pixels, focal, weights):
        camera = torch.cat((1000.0 * focal, 1000.0 * focal, torch.ones(1).double())).diag()
        return tuple(solver(world, 1000.0 * pixels, camera, weights).pose)

    weights = 0.5 + torch.rand(1, 9, generator=generator, dtype=torch.float64)
    inputs = [p.world_points, p.img_points / 1000.0, p.intrinsics[0, :1, 0] / 1000.0, weights]
    inputs = [x.detach().clone().requires_grad_() for x in inputs]
    assert torch.autograd.gradcheck(run, inputs, eps=1e-6, atol=1e-4, rtol=1e-4, fast_mode=True)


SQUARE = torch.tensor([[[-1, -1], [1, -1], [-1, 1], [1, 1], [2, 0], [-2, 0]]], dtype=torch.float64)


@pytest.mark.parametrize("plane", [SQUARE, SQUARE[:, :4], SQUARE + 0.1 * SQUARE.square()], ids=["six", "four", "odd"])
def test_a_plane_parallel_to_the_image_has_a_gradient(plane):
    pixels = (plane / 4.0).requires_grad_()
    world = torch.nn.functional.pad(plane, (0, 1))
    result = SOLVERS["EPnP"](iterations=8, gradient="always")(world, pixels, torch.eye(3).double())
    torch.testing.assert_close(result.translation, torch.tensor([[0.0, 0.0, 4.0]]).double(), rtol=0, atol=1e-8)
    result.translation[0, 2].backward()
    # Pixels that grow together come from a camera that is closer: d(1/z) = dz / z.
    torch.testing.assert_close((pixels.grad * pixels.detach()).sum().item(), -4.0, rtol=1e-5, atol=0)


@pytest.fixture(params=[True, False], ids=["few", "many"])
def few(request, monkeypatch):
    """Whether functions that have a form for few problems and one for many use the first one."""
    monkeypatch.setattr("kornia_pnpnet.core.linalg.are_few", lambda _: request.param)


EASY = [(1, 1, 1), (3, 2, 1), (3, 2, 0), (3, 2, -1), (1, 1e-3, 1e-6)]
HARD = [(1, 1e-5, -1e-7), (1, 1e-10, 0)]
CASES = [(torch.float32, x, 3e-6) for x in EASY] + [(torch.float64, x, 1e-14) for x in EASY + HARD]


@pytest.mark.parametrize(("dtype", "values", "tolerance"), CASES)
@pytest.mark.usefixtures("few")
def test_nearest_rotation_is_known_from_its_singular_vectors(dtype, values, tolerance, random_rotations):
    left, right = random_rotations(50), random_rotations(50, seed=1)
    matrix = (left * torch.tensor(values, dtype=torch.float64)) @ right.mT
    rotation, unique = nearest_rotation(matrix.to(dtype).permute(1, 2, 0))
    assert unique.all()
    rotation = rotation.permute(2, 0, 1).double()
    eye = torch.eye(3, dtype=torch.float64).expand(50, 3, 3)
    torch.testing.assert_close(rotation @ rotation.mT, eye, rtol=0, atol=tolerance)
    # Rounding of the matrix alone turns the rotation by about its relative error over the smallest gap.
    gap = (values[1] + values[2]) / values[0]
    assert (rotation_angle(rotation, left @ right.mT) < tolerance / gap).all()


@pytest.mark.usefixtures("few")
def test_where_there_is_no_nearest_rotation_it_is_the_identity_without_gradient(random_rotations):
    left, right = random_rotations(5), random_rotations(5, seed=1)
    values = torch.tensor([[0, 0, 0], [1, 0, 0], [3, 1, -1], [3e-200, 2e-200, 1e-200], [2, 1, 1]], dtype=torch.float64)
    matrix = ((left * values[:, None]) @ right.mT).permute(1, 2, 0).requires_grad_()
    rotation, unique = nearest_rotation(matrix)
    assert unique.tolist() == [False, False, False, False, True]
    assert torch.equal(rotation[..., :4], torch.eye(3, dtype=torch.float64)[..., None].expand(3, 3, 4))
    loss = (rotation * torch.arange(9.0).view(3, 3, 1)).sum()
    (gradient,) = torch.autograd.grad(loss, matrix, create_graph=True)
    assert not gradient[..., :4].any()
    assert gradient[..., 4].any()
    (second,) = torch.autograd.grad(gradient.sum(), matrix)
    finite(gradient, second)


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")  # PyTorch's own use of it in forward mode
def test_gradcheck_of_the_nearest_rotation(generator):
    matrix = torch.randn(3, 3, 4, generator=generator, dtype=torch.float64)
    for x in (matrix, matrix * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)[:, None]):
        inputs = (x.clone().requires_grad_(),)
        assert torch.autograd.gradcheck(lambda m: nearest_rotation(m)[0], inputs, check_forward_ad=True)
        assert torch.autograd.gradgradcheck(lambda m: nearest_rotation(m)[0], inputs)


def test_align_finds_a_similarity(random_rotations, generator):
    source = torch.randn(7, 9, 3, generator=generator, dtype=torch.float64)
    rotation, shift = random_rotations(7), torch.randn(7, 1, 3, generator=generator, dtype=torch.float64)
    target = 2.5 * source @ rotation.mT + shift
    target[:, 0] += 100.0
    weights = torch.rand(7, 9, generator=generator, dtype=torch.float64)
    weights[:, 0] = 0.0
    found, translation, scale = align(source, target, weights)
    torch.testing.assert_close(found, rotation)
    torch.testing.assert_close(scale, torch.full((7,), 2.5, dtype=torch.float64))
    share = (weights / weights.sum(1, keepdim=True))[..., None]
    means = [(share * x).sum(1) for x in (source, target)]
    torch.testing.assert_close(translation, means[1] - (rotation @ means[0][..., None])[..., 0])


def test_a_singular_system_in_its_range_has_a_finite_solution():
    matrix = torch.zeros(3, 3, 1, dtype=torch.float64)
    matrix[:2, :2] = 1.0
    rhs = torch.tensor([2.0, 2.0, 0.0], dtype=torch.float64)[:, None]
    (solution,) = solve_leading(matrix, rhs, (3,))
    torch.testing.assert_close((matrix[..., 0] @ torch.stack(solution)[:, 0])[:, None], rhs)
    assert torch.stack(solution).isfinite().all()


@pytest.mark.usefixtures("few")
def test_damped_systems_are_solved(generator):
    root = torch.randn(20, 6, 8, generator=generator, dtype=torch.float64)
    matrix, rhs = root @ root.mT, torch.randn(20, 6, generator=generator, dtype=torch.float64)
    matrix[3], matrix[4], matrix[5, 2, 2] = torch.nan, torch.ones(6, 6), -1.0
    damping = torch.linspace(0.0, 2.0, 20, dtype=torch.float64)
    damping[3:6] = 0.0
    leaves = [x.clone().requires_grad_() for x in (matrix.permute(1, 2, 0), rhs.mT, damping)]
    solution, solved = solve_positive(*leaves)
    good = torch.arange(20) // 3 != 1
    assert torch.equal(solved, good)
    damped = matrix + damping[:, None, None] * torch.diag_embed(matrix.diagonal(dim1=1, dim2=2))
    torch.testing.assert_close(solution.mT[good], torch.linalg.solve(damped[good], rhs[good]), rtol=1e-9, atol=1e-9)
    assert not solution[:, ~good].any()
    (alone,) = torch.autograd.grad(solve_positive(leaves[0].detach(), leaves[1], damping)[0].sum(), leaves[1])
    gradients = torch.autograd.grad(solution.square().sum(), leaves)
    assert all(x[..., matrix.isfinite().all((1, 2))].isfinite().all() for x in (*gradients, alone))


@pytest.mark.parametrize("count", [1, 2000])
def test_gradients_are_finite_for_any_size_of_the_matrix(count):
    for size in (1e-38, 1e-30, 1e-20, 1e-15, 1.0, 1e15):
        matrix = (size * torch.eye(6)[..., None].repeat(1, 1, count)).requires_grad_()
        solution, _ = solve_positive(matrix, torch.full((6, count), size), torch.tensor(0.0))
        (0.0 * solution).sum().backward()
        assert matrix.grad.isfinite().all()


def matrices(size, eigenvalues=None):
    generator = torch.Generator().manual_seed(size)
    turn = torch.linalg.qr(torch.randn(200, size, size, generator=generator, dtype=torch.float64)).Q
    values = 10.0 ** (4.0 * torch.rand(200, size, generator=generator, dtype=torch.float64) - 2.0)
    values = values if eigenvalues is None else torch.tensor(eigenvalues, dtype=torch.float64).expand(200, size)
    return (turn * values[:, None]) @ turn.mT


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [2, 3])
def test_semi_definite_is_told_up_to_rounding(size, dtype):
    for smallest, expected in ((0.0, True), (1e-3, True), (-1e-3, False), (torch.nan, False), (torch.inf, False)):
        matrix = matrices(size, eigenvalues=[1.0, 1.0, smallest][-size:]).to(dtype)
        assert (are_semi_definite(symmetric(matrix)) == expected).all(), smallest
        assert not are_semi_definite(symmetric(-matrix)).any()
    assert are_semi_definite(symmetric(torch.zeros(1, size, size, dtype=dtype))).all()


@pytest.mark.parametrize("size", [2, 3])
def test_the_equivalent_sigma_has_the_same_trace(size):
    matrix = matrices(size)
    sigma = equivalent_sigma(symmetric(matrix))
    torch.testing.assert_close(size * sigma.square(), matrix.diagonal(dim1=1, dim2=2).sum(-1))
    zero = torch.zeros(1, size, size, requires_grad=True)
    equivalent_sigma(symmetric(zero)).sum().backward()
    assert (zero.grad == 0).all()
    assert equivalent_sigma(symmetric(torch.full((1, size, size), torch.nan))).isnan().all()
