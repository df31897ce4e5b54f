"""What is known besides the pairs: Jacobians, exact least squares, no harm by a wrong prior, any unit and heading."""

import math
from itertools import product

import pytest
import torch
from helpers import derivative, rate, verified_derivative, verify_jacobian
from torch import nn

from kornia_pnpnet import PnPNet, Pose, PosePrior, RobustWeightedLM, Status, create_solver, gravity_prior
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.problem import Problem, State
from kornia_pnpnet.refine.residual import project, retract
from kornia_pnpnet.refine.terms import CameraTerm, PoseTerm

SIGMA = math.radians(1.0)
SIGMAS = {"img_sigma": 1.0, "world_sigma": 0.05}


def drawn(problems, generator, wrong=0.0):
    """The pose of the frame before: 1 degree and 2 % of the distance off, and ``wrong`` sigmas more."""
    distance = problems.pose.translation.norm(dim=-1, keepdim=True).expand(-1, 3)
    sigmas = torch.cat((torch.full_like(distance, SIGMA), 0.02 * distance), -1)
    noise, direction = torch.randn(2, *sigmas.shape, generator=generator, dtype=sigmas.dtype)
    error = sigmas * (noise + wrong * nn.functional.normalize(direction, dim=-1))
    return PosePrior(retract(problems.pose, error), torch.diag_embed(sigmas**-2))


def gravity(problems, generator, wrong=0.0):
    """Of an accelerometer that is half a degree off, and ``wrong`` sigmas more."""
    down, noise, side = torch.randn(3, *problems.pose.translation.shape, generator=generator, dtype=torch.float64)
    truth = nn.functional.normalize((problems.pose.rotation @ down[..., None])[..., 0], dim=-1)
    across = nn.functional.normalize(torch.linalg.cross(truth, side), dim=-1)
    turn = 0.5 * SIGMA * (noise + wrong * across)
    return gravity_prior(down, truth + torch.linalg.cross(turn, truth), 0.5 * SIGMA)


def informative(problems, generator):
    """An information with correlations between turns and shifts."""
    root = torch.randn(len(problems.world_points), 6, 6, generator=generator, dtype=torch.float64)
    return PosePrior(retract(problems.pose, 0.01 * root[:, 0]), 400.0 * root @ root.mT)


@pytest.fixture
def state(request, random_rotations, generator):
    """Poses, and the number of unknown parameters of the camera that the test's ``unknown`` says."""
    unknown = request.getfixturevalue("unknown")
    pose = Pose(random_rotations(5), 3.0 * torch.randn(5, 3, generator=generator, dtype=torch.float64))
    return State(pose, 0.1 * torch.randn(5, unknown, generator=generator, dtype=torch.float64))


def pose_term(expected, information, generator, scale=None):
    """A term of an information (5, 6, 6) and an expected pose, in a frame off the caller's."""
    centroid, size = torch.randn(5, 3, generator=generator).double(), torch.linspace(0.5, 2.0, 5).double()
    term, usable = PoseTerm.of(PosePrior(expected, information, scale), centroid, size)
    assert usable.all()
    turned = (expected.rotation * term.offset[:, None]).sum(-1)
    torch.testing.assert_close(term.pose.translation, expected.translation / size[:, None] + turned)
    return term


def assert_gradient(term, state):
    """Half of the robust loss has the gradient of the normal equations."""
    linear = term.linearise(state)
    pulled = linear.weight[:, None, None] * linear.information @ linear.jacobian
    gradient = (linear.residual[:, None] @ pulled)[:, 0]
    expected = verified_derivative(lambda x: 0.5 * term.loss(x)[:, None], state)[:, 0]
    torch.testing.assert_close(gradient, expected, rtol=1e-9, atol=1e-9 * expected.abs().max().item())


@pytest.mark.parametrize("unknown", range(4))
@pytest.mark.parametrize("scale", [3.0, math.inf])
def test_a_pose_term_is_linearised(unknown, scale, state, generator):
    root = torch.randn(5, 6, 6, generator=generator, dtype=torch.float64)
    expected = retract(state.pose, 0.5 * torch.randn(5, 6, generator=generator, dtype=torch.float64))
    term = pose_term(expected, root @ root.mT, generator, torch.full((5,), scale, dtype=torch.float64))
    verify_jacobian(lambda x: term.errors(x.pose)[0], state, term.linearise(state).jacobian)
    assert_gradient(term, state)


@pytest.mark.parametrize("unknown", range(4))
@pytest.mark.parametrize("isotropic", [True, False])
def test_a_term_with_an_open_axis_is_linearised(isotropic, unknown, state, generator):
    """Turns about the axis change nothing; there the error is that of the nearest pose that the term allows."""
    axis = nn.functional.normalize(torch.randn(5, 3, generator=generator, dtype=torch.float64), dim=-1)
    known = torch.block_diag(torch.eye(3), torch.eye(3)).double().repeat(5, 1, 1)
    known[:, :3, :3] -= axis[:, :, None] * axis[:, None]
    root = torch.randn(5, 6, 6, generator=generator, dtype=torch.float64)
    information = known if isotropic else known @ root @ root.mT @ known
    about, off = torch.zeros(5, 6, dtype=torch.float64), torch.randn(5, 6, generator=generator, dtype=torch.float64)
    about[:, :3] = 1.5 * axis
    term = pose_term(retract(state.pose, about), information, generator)
    linear = term.linearise(state)
    assert linear.residual[:, :3].abs().max() < 1e-12
    verify_jacobian(lambda x: (known @ term.errors(x.pose)[0][..., None])[..., 0], state, known @ linear.jacobian)
    assert_gradient(pose_term(retract(retract(state.pose, about), 0.3 * off), information, generator), state)


@pytest.mark.parametrize("unknown", [1, 2, 3])
def test_a_camera_term_is_linearised(unknown, state):
    focal = torch.linspace(500.0, 900.0, 5, dtype=torch.float64)
    term = CameraTerm(1.2 * focal, torch.linspace(1.0, 9.0, 5).double(), torch.ones(5).double(), focal)
    linear = term.linearise(state)
    verify_jacobian(lambda x: term.linearise(x).residual, state, linear.jacobian)
    assert_gradient(term, state)
    torch.testing.assert_close(linear.residual[:, 0], (focal * state.camera[:, 0].exp() / term.expected).log())


@pytest.mark.parametrize("kind", [informative, gravity, drawn])
def test_pose_is_a_minimum_of_the_whole_cost(kind, make_problems, generator):
    p = make_problems(n=8, batch=20)
    prior = kind(p, generator)._replace(scale=torch.full((20,), torch.inf, dtype=torch.float64))
    solver = PnPNet(None, RobustWeightedLM(40, kernel="huber", robustness=1e4, learnable=False))
    state = State.of(solver(*p[:3], prior=prior, init=p.pose, img_sigma=2.0).pose)
    problem = Problem.of(p.world_points, p.img_points, p.intrinsics[0, 0, 0])
    term, _ = PoseTerm.of(prior, torch.zeros(20, 3).double(), torch.ones(20).double())

    def of_pairs(state):
        return project(state, problem).sq_residual.sum(1, keepdim=True) / 4.0

    alone = derivative(of_pairs, state)[:, 0]
    whole = derivative(lambda x: of_pairs(x) + term.errors(x.pose)[1][:, None], state)[:, 0]
    assert (whole.norm(dim=-1) < 1e-5 * alone.norm(dim=-1)).all()


@pytest.mark.parametrize("name", ["pnpnet-set", "epnp-lm", "p3p-ransac"])
def test_a_prior_without_information_is_a_start_alone(name, make_problems):
    problems = make_problems(n=9, batch=10, outliers=2)
    nothing = PosePrior(problems.pose, torch.zeros(10, 6, 6, dtype=torch.float64))
    solver = create_solver(name)
    found, expected = solver(*problems[:3], prior=nothing), solver(*problems[:3], init=problems.pose)
    torch.testing.assert_close(found.matrix, expected.matrix)


@pytest.mark.parametrize("size", [1e-20, 1.0, 1e20])
def test_information_beside_a_zero_of_the_diagonal_is_refused_in_every_unit(size, make_problems):
    problems = make_problems(n=9, batch=2, outliers=0)
    information = torch.diag(torch.tensor([100.0, 0.0, 100.0, 0.0, 0.0, 0.0], dtype=torch.float64)).repeat(2, 1, 1)
    information[0, 4, 3] = 1e-5 / size**2
    prior = PosePrior((problems.pose.rotation, size * problems.pose.translation), information)  # a plain tuple
    result = create_solver("epnp-lm")(size * problems.world_points, *problems[1:3], prior=prior)
    assert result.status.tolist() == [Status.NOT_FINITE, Status.SOLVED]


def test_what_is_known_helps_and_what_is_wrong_hardly_harms(make_problems, generator):
    solver = create_solver("pnpnet-set")
    three, nine = make_problems(n=3, batch=500, outliers=0), make_problems(n=9, batch=500, outliers=3)

    def found(problems, prior=None):
        return rate(solver(*problems[:3], prior=prior, **SIGMAS), problems)

    assert found(three, drawn(three, generator)) > found(three) + 0.15
    alone = found(nine)
    assert found(nine, drawn(nine, generator)) > alone + 0.04
    for kind, wrong in product((drawn, gravity), (10.0, 100.0)):
        assert found(nine, kind(nine, generator, wrong)) > alone - 0.03


@pytest.mark.parametrize("name", ["pnpnet-set:effort=fixed", "pnpnet-set:effort=adaptive", "p3p-ransac:threshold=10.0"])
def test_gravity_chooses_among_poses(name, make_problems, generator):
    problems, solver = make_problems(n=4, batch=500, outliers=1), load_solver(name)
    found = [solver(*problems[:3], prior=x, **SIGMAS) for x in (None, gravity(problems, generator))]
    assert rate(found[1], problems) > rate(found[0], problems) + 0.02


@pytest.mark.parametrize("size", [1e-200, 1.0, 1e200])
def test_opposite_directions_of_any_length(size, generator):
    down = torch.randn(4, 3, generator=generator, dtype=torch.float64)
    prior = gravity_prior(size * down, -size * down, torch.tensor(0.1, dtype=torch.float64))
    torch.testing.assert_close((prior.pose.rotation @ down[..., None])[..., 0], -down)
    torch.testing.assert_close(torch.linalg.det(prior.pose.rotation), torch.ones(4, dtype=torch.float64))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_almost_level_camera_has_a_valid_prior_of_gravity(dtype):
    down = torch.tensor([[x, 1.0, y * x] for x in (1e-4, 1e-3, 0.01) for y in (0.0, 0.3, 1.0)], dtype=dtype)
    assert PoseTerm.of(gravity_prior(down, down, 0.02), *(torch.ones_like(down), torch.ones_like(down[:, 0])))[1].all()


def test_a_prior_a_third_of_a_turn_away_has_a_gradient():
    turn = torch.tensor([[[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]], requires_grad=True)
    here = Pose(torch.eye(3)[None], torch.zeros(1, 3))
    term, _ = PoseTerm.of(PosePrior(here._replace(rotation=turn), torch.eye(6)[None]), torch.zeros(1, 3), torch.ones(1))
    assert torch.autograd.grad(term.errors(here)[1], turn)[0].isfinite().all()


def test_gradients_of_gravity(generator):
    down = torch.randn(3, 1, 3, generator=generator, dtype=torch.float64)
    sigma = torch.full((1,), 0.02, dtype=torch.float64)
    leaves = [x.requires_grad_() for x in (down[0], down[0] + 0.1 * down[1], sigma)]
    relative = lambda *x: (gravity_prior(*x).pose.rotation, 1e-3 * gravity_prior(*x).information)  # noqa: E731
    assert torch.autograd.gradcheck(relative, leaves)
