"""Linear algebra of small matrices, beside LAPACK's."""

import pytest
import torch

from kornia_pnpnet.core import linalg
from kornia_pnpnet.core.linalg import align, nearest_rotation, solve_leading, solve_positive
from kornia_pnpnet.core.symmetric import Symmetric2, Symmetric3, are_semi_definite, equivalent_sigma
from kornia_pnpnet.refine.residual import rotation_angle


@pytest.fixture(params=[True, False], ids=["few", "many"])
def few(request, monkeypatch):
    """Whether functions that have a form for few problems and one for many use the first one."""
    monkeypatch.setattr(linalg, "are_few", lambda _: request.param)


# --- the nearest rotation -------------------------------------------------------------------------------------------


EASY = [(1, 1, 1), (3, 2, 1), (3, 2, 0), (3, 2, -1), (1, 1e-3, 1e-6)]
HARD = [(1, 1e-5, -1e-7), (1, 1e-10, 0)]


@pytest.mark.parametrize(
    ("dtype", "values", "tolerance"),
    [(torch.float32, values, 3e-6) for values in EASY] + [(torch.float64, values, 1e-14) for values in EASY + HARD],
)
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
    values = [[0, 0, 0], [1, 0, 0], [3, 1, -1], [3e-200, 2e-200, 1e-200], [2, 1, 1]]
    values = torch.tensor(values, dtype=torch.float64)
    matrix = ((left * values[:, None]) @ right.mT).permute(1, 2, 0).requires_grad_()
    rotation, unique = nearest_rotation(matrix)
    assert unique.tolist() == [False, False, False, False, True]
    eye = torch.eye(3, dtype=torch.float64)[..., None].expand(3, 3, 4)
    assert torch.equal(rotation[..., :4], eye)
    loss = (rotation * torch.arange(9.0).view(3, 3, 1)).sum()
    (gradient,) = torch.autograd.grad(loss, matrix, create_graph=True)
    assert not gradient[..., :4].any()
    assert gradient[..., 4].any()
    (second,) = torch.autograd.grad(gradient.sum(), matrix)
    assert gradient.isfinite().all()
    assert second.isfinite().all()


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")  # PyTorch's own use of it in forward mode
def test_gradcheck_of_the_nearest_rotation(generator):
    matrix = torch.randn(3, 3, 4, generator=generator, dtype=torch.float64)
    flat = matrix * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)[:, None]
    for x in (matrix, flat):
        inputs = (x.clone().requires_grad_(),)
        assert torch.autograd.gradcheck(lambda m: nearest_rotation(m)[0], inputs, check_forward_ad=True)
        assert torch.autograd.gradgradcheck(lambda m: nearest_rotation(m)[0], inputs)


def test_align_finds_a_similarity(random_rotations, generator):
    """With weights of 0 for outliers; without noise it is exact."""
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


# --- systems ------------------------------------------------------------------------------------------------------


def test_a_singular_system_in_its_range_has_a_finite_solution():
    matrix = torch.zeros(3, 3, 1, dtype=torch.float64)
    matrix[:2, :2] = 1.0
    rhs = torch.tensor([2.0, 2.0, 0.0], dtype=torch.float64)[:, None]
    (solution,) = solve_leading(matrix, rhs, (3,))
    reached = (matrix[..., 0] @ torch.stack(solution)[:, 0])[:, None]
    torch.testing.assert_close(reached, rhs)
    assert torch.stack(solution).isfinite().all()


@pytest.mark.usefixtures("few")
def test_damped_systems_are_solved(generator):
    """One that is singular and one that is no number have the solution 0, with finite gradients, and harm no other."""
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


# --- symmetric matrices by their entries ------------------------------------------------------------------------------

KINDS = {2: Symmetric2, 3: Symmetric3}


def matrices(size, eigenvalues=None):
    count = 200
    generator = torch.Generator().manual_seed(size)
    turn = torch.linalg.qr(torch.randn(count, size, size, generator=generator, dtype=torch.float64)).Q
    values = 10.0 ** (4.0 * torch.rand(count, size, generator=generator, dtype=torch.float64) - 2.0)
    values = values if eigenvalues is None else torch.tensor(eigenvalues, dtype=torch.float64).expand(count, size)
    return (turn * values[:, None]) @ turn.mT


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [2, 3])
def test_semi_definite_is_told_up_to_rounding(size, dtype):
    for smallest, expected in ((0.0, True), (1e-3, True), (-1e-3, False), (torch.nan, False), (torch.inf, False)):
        matrix = matrices(size, eigenvalues=[1.0, 1.0, smallest][-size:]).to(dtype)
        assert (are_semi_definite(KINDS[size].of(matrix)) == expected).all(), smallest
        assert not are_semi_definite(KINDS[size].of(-matrix)).any()
    assert are_semi_definite(KINDS[size].of(torch.zeros(1, size, size, dtype=dtype))).all()


@pytest.mark.parametrize("size", [2, 3])
def test_the_equivalent_sigma_has_the_same_trace(size):
    matrix = matrices(size)
    sigma = equivalent_sigma(KINDS[size].of(matrix))
    torch.testing.assert_close(size * sigma.square(), matrix.diagonal(dim1=1, dim2=2).sum(-1))
    zero = torch.zeros(1, size, size, requires_grad=True)
    equivalent_sigma(KINDS[size].of(zero)).sum().backward()
    assert (zero.grad == 0).all()
    assert equivalent_sigma(KINDS[size].of(torch.full((1, size, size), torch.nan))).isnan().all()
