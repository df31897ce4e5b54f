"""A compiled solver is the same solver; where it cannot be compiled it runs as it is, and says so once."""

import copy
import multiprocessing
import os
import pickle
import threading
from unittest.mock import Mock

import pytest
import torch
from helpers import assert_same
from torch import nn
from torch._dynamo.testing import CompileCounter
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.torch_version import TorchVersion

from kornia_pnpnet import PnPNet, Pose, RobustWeightedLM, create_solver, pose_covariance
from kornia_pnpnet.cameras import bearings
from kornia_pnpnet.core.performance import INLINE, Runner, ascending_order, in_order, in_turn, ranked
from kornia_pnpnet.data import CameraProblems, OutlierMix, SyntheticProblems
from kornia_pnpnet.measurements import heatmap_keypoints

# torch.compile makes an instance of an autograd function while it looks into it.
pytestmark = pytest.mark.filterwarnings("ignore:.*should not be instantiated:DeprecationWarning")


@pytest.fixture
def backend(monkeypatch):
    """Dynamo captures and guards, its graphs run as they are: what needs no C++ compiler. Counts the graphs."""
    torch.compiler.reset()
    counter, compile_ = CompileCounter(), torch.compile
    monkeypatch.setattr(torch, "compile", lambda function, options, **x: compile_(function, backend=counter, **x))
    yield counter
    torch.compiler.reset()


def problems(count, n=9, dtype=torch.float64):
    return SyntheticProblems(n=n, batch_size=count, seed=5, outliers=OutlierMix(), dtype=dtype).batch(0)


def assert_compiled_is_eager(solver, compiled, batch, rtol=1e-6, atol=1e-6, gradients=False):
    def solve(net):
        inputs = [x.clone().requires_grad_(gradients) for x in batch[:3]]
        with torch.set_grad_enabled(gradients):
            result = net(*inputs, cam_from_rig=batch.cam_from_rig)
        if not gradients:
            return result, ()
        total = sum(x.sum() for x in (result.rotation, result.weights, result.cost, result.init.translation))
        return result, torch.autograd.grad(total, [*inputs, *net.parameters()], materialize_grads=True)

    (expected, derivatives), (found, compiled_derivatives) = solve(solver), solve(compiled)
    assert not gradients or derivatives[0].any()
    assert_same(found, expected, rtol=rtol, atol=atol)
    assert_same(compiled_derivatives, derivatives, rtol=1e-4, atol=atol)


CASES = [("pnpnet-n9", 2, False, 1, False), ("pnpnet-n9", 2, True, 1, True)]
SLOW = [("pnpnet-n9", 3, True, 1, False), ("pnpnet-n9", 1, False, 1, True)]
SLOW += [(name, 1, False, 1, False) for name in ("pnpnet-n9", "epnp-lm", "reppnp-lm", "pnpnet-set")]
SLOW += [("pnpnet-set", 1, whole, 3, False) for whole in (False, True)]
CASES += [pytest.param(*case, marks=pytest.mark.slow) for case in SLOW]


@pytest.mark.parametrize(("name", "views", "whole", "cameras", "gradients"), CASES)
def test_each_part_is_one_graph_and_the_batch_may_change(name, views, whole, cameras, gradients, backend):
    # The set's softmax and the search for rigs round otherwise in a graph, and some of their parts run on demand.
    is_set = name == "pnpnet-set"
    solver = create_solver(name, m=12 if is_set else 2, views=views, effort="fixed" if is_set else None)
    solver.double().requires_grad_(gradients)
    compiled = copy.deepcopy(solver)
    compiled.compile(whole=whole)
    tolerance = 1e-6 if not is_set else 1e-4 if cameras == 1 else 1e-3
    graphs = 1 if whole else 0
    for count in (1000 if cameras == 1 else 150, 7, 5, 1):  # of 1000 rigs, one or another is chaotic
        p = problems(count)
        if cameras > 1:
            options = {"outlier_share": 0.25, "cameras": cameras, "dtype": torch.float64}
            p = CameraProblems(n=12, batch_size=count, seed=5, **options).batch(0)
        assert_compiled_is_eager(solver, compiled, p, tolerance, tolerance, gradients)
        graphs = graphs or backend.frame_count
    assert backend.frame_count == graphs


@pytest.mark.parametrize("whole", [pytest.param(False, marks=pytest.mark.slow), True])
def test_what_cannot_be_captured_runs_as_it_is_with_one_warning(whole, backend):
    eager, compiled = create_solver("p3p-ransac", seed=1), create_solver("p3p-ransac", seed=1)
    compiled.compile(whole=whole)
    inputs = problems(3)[:3]
    with torch.no_grad():
        with pytest.warns(RuntimeWarning, match="Not compiled, running uncompiled") as caught:
            first = compiled(*inputs)
        assert len(caught) == 1
        for result in (first, compiled(*inputs)):
            assert_same(result, eager(*inputs), rtol=1e-9, atol=1e-9)


def test_starts_of_a_solver_that_is_compiled_as_a_whole_are_of_fixed_effort(make_problems):
    inputs = make_problems(40, 10, outliers=30)[:3]
    expected = create_solver("pnpnet-set", effort="fixed")(*inputs)
    solver = create_solver("pnpnet-set")
    solver.compile(whole=True)
    assert_same(solver.with_starts(*inputs)[0], expected)


@pytest.mark.parametrize("when", ["compile", "call"])
def test_without_a_compiler_it_runs_as_it_is(when, monkeypatch):
    failing = Mock(side_effect=RuntimeError("no compiler"))
    monkeypatch.setattr(torch, "compile", failing if when == "compile" else lambda function, **options: failing)
    run = Runner(True)
    with pytest.warns(RuntimeWarning, match=r"Not compiled, running uncompiled.*no compiler") as caught:
        assert run(torch.neg, torch.ones(1)) == -1
    assert len(caught) == 1
    assert run(torch.neg, torch.ones(1)) == -1


def test_an_older_pytorch_runs_it_as_it_is(monkeypatch):
    solver = create_solver("pnpnet-n9")
    monkeypatch.setattr(torch, "__version__", TorchVersion("2.11.0+cu130"))
    with pytest.warns(RuntimeWarning, match=r"running uncompiled.*2\.13, got 2\.11\.0") as caught:
        solver.compile()
    assert len(caught) == 1
    assert solver(*problems(3)[:3]).ok.shape == (3,)


def test_too_little_memory_is_no_failure_of_the_compiler(monkeypatch):
    full, run = Mock(side_effect=torch.cuda.OutOfMemoryError("too large")), Runner(True)
    monkeypatch.setattr(torch, "compile", lambda function, **options: full)
    with pytest.raises(torch.cuda.OutOfMemoryError):
        run(torch.neg, torch.ones(3))
    assert not run.failed


def test_errors_of_the_caller_are_the_callers(backend):
    solver = create_solver("pnpnet-n9", m=0)
    solver.compile()
    world, img, intrinsics = problems(3)[:3]
    with pytest.raises(Exception, match=r"img_points must have the shape"):
        solver(world, img[:, :8], intrinsics)
    with pytest.raises(Exception, match=r"built for n = 9"):
        solver(world[:, :8], img[:, :8], intrinsics)
    run, x = Runner(True), torch.rand(2, 3, 4)
    with pytest.raises(IndexError):
        run(in_order, x[0, 0])
    assert torch.equal(run(in_order, x), in_order(x))
    assert not run.failed


class Scaled(nn.Module):
    """Compiled as a solver is: a method of its own, which reads its own weights."""

    def __init__(self):
        super().__init__()
        self.scale = nn.Parameter(torch.ones(1))
        self.run = Runner(True)

    def forward(self, x, part=None):
        return self.run((part or self).scaled, x)

    def scaled(self, x):
        return self.scale * x


def test_copies_use_their_own_weights(backend):
    module, x = Scaled(), torch.ones(3)
    assert torch.equal(module(x), x)
    for other in (copy.deepcopy(module), pickle.loads(pickle.dumps(module))):
        other.load_state_dict({"scale": torch.full((1,), 0.5)})
        assert torch.equal(other(x), 0.5 * x)
        assert torch.equal(module(x), x)
        assert torch.equal(module(x, other), 0.5 * x)  # as if it replaced a part of the module
    assert backend.frame_count == 5


@pytest.mark.parametrize("name", ["pnpnet-n9", "epnp-lm", "reppnp-lm"])
def test_nothing_reads_a_value_back(name):
    """So a solve can be captured as one CUDA graph: fake tensors have no values to branch on."""
    solver = create_solver(name, effort="fixed").double()
    with FakeTensorMode(allow_non_fake_inputs=True) as mode, torch.no_grad():
        result = solver(*(mode.from_tensor(x) for x in problems(3)[:3]))
    assert result.rotation.shape == (3, 3, 3)


@pytest.mark.slow
@pytest.mark.parametrize("whole", [False, True])
def test_inductor_computes_the_same(whole):
    """With buffers in place, the compiler of PyTorch 2.13 gave wrong gradients by the world points."""
    torch.compiler.reset()
    solver = create_solver("pnpnet-n6", m=3, views=2, effort="fixed" if whole else None).double().requires_grad_()
    compiled = copy.deepcopy(solver)
    compiled.compile(whole=whole)
    for count in (50, 31, 1):
        assert_compiled_is_eager(solver, compiled, problems(count, n=6), atol=1e-8)
    assert_compiled_is_eager(solver, compiled, problems(50, n=6), gradients=True)


@pytest.mark.slow
def test_gradients_of_another_batch_size_are_not_compiled_for_again():
    """PyTorch 2.13 chooses the code of a sum by the number of its addends, 4096 of them or more."""
    torch.compiler.reset()
    refine = RobustWeightedLM(1)
    solver = PnPNet(None, refine).float()
    solver.compile()
    for count in (7, 1000, 1):
        with torch._dynamo.config.patch(error_on_recompile=count != 7):
            solver(*problems(count, dtype=torch.float32)[:3]).rotation.sum().backward()
    assert refine.damping.raw.grad.isfinite().all()


@pytest.mark.slow
def test_inductor_computes_the_same_with_more_pairs_than_problems():
    """In float32 and with loops in an order of its own the compiler of PyTorch 2.13 gave 18 of these 20 wrong poses."""
    torch.compiler.reset()
    solver = PnPNet(None, RobustWeightedLM(2)).float()
    compiled = copy.deepcopy(solver)
    compiled.compile()
    for count in (20, 50):
        batch = problems(count, n=40, dtype=torch.float32)
        with torch.no_grad():
            ours, eager = (net(*batch[:3], init=batch.pose) for net in (compiled, solver))
        torch.testing.assert_close(ours.matrix, eager.matrix, rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(ours.weights, eager.weights, rtol=1e-2, atol=1e-3)
        assert (ours.inliers == eager.inliers).double().mean() > 0.99


def several(values, *shape):
    return torch.randint(values, shape, generator=torch.Generator().manual_seed(1)).to(torch.float32) - values // 2


@pytest.mark.parametrize("batch", [1, 300])
@pytest.mark.parametrize("count", [3, 9, 16, 33])
def test_ranks_are_those_of_a_sort(batch, count, backend):
    values = several(50, 3, count, batch)
    ordered = values.sort(1).values
    ranks = torch.arange(batch) % (count + 1) - 1  # a negative rank means 0
    expected = ordered.gather(1, ranks.clamp(min=0).expand(3, 1, -1))[:, 0]
    for run in (Runner(), Runner(True)):
        assert torch.equal(run(in_order, values), ordered)
        assert torch.equal(run(ranked, values, count // 2), ordered[:, count // 2])
        assert torch.equal(run(ranked, values, ranks), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [1, 300])
@pytest.mark.parametrize("count", [3, 9, 33])
def test_ties_of_the_first_key_are_ordered_by_the_second_and_equal_pairs_stay(count, batch, dtype, backend):
    keys = torch.stack((several(5, count, batch), several(3, count, batch))).to(dtype)
    keys[:, 0] *= -1.0  # -0 equals 0
    keys[:, -1] = torch.inf
    expected = [sorted(range(count), key=lambda i, pairs=pairs: pairs[i]) for pairs in keys.permute(2, 1, 0).tolist()]
    for run in (Runner(), Runner(True)):
        assert run(ascending_order, keys).tolist() == expected


of_the_exporter = pytest.mark.filterwarnings("ignore::FutureWarning")  # about its own code


def kernels(program):
    return {node.target for node in program.graph.nodes if node.op == "call_function"} & set(INLINE)


def export(function, *inputs, **options):
    module = nn.Module()
    module.forward = lambda *x: function(*x)  # noqa: PLW0108 - built-in functions have no signature
    return torch.export.export(module, inputs, **options)


A, B = torch.linspace(-1.0, 2.0, 24).sin().view(2, 3, 4), torch.linspace(-3.0, 1.0, 40).cos().view(2, 4, 5)
TIES = torch.tensor([[3.0, 1.0, 1.0, -2.0, 3.0, 0.0], [0.0, -0.0, torch.inf, -torch.inf, 5.0, 5.0]])
INLINED = [(torch.matmul, (A, B[0])), (torch.mm, (A[0], B[0])), (torch.bmm, (A, B))]
INLINED += [(lambda bias, a, b: torch.addmm(bias, a, b, beta=0.5, alpha=2.0), (B[0, :1], A[0], B[0]))]
INLINED += [(nn.functional.linear, (A, *more)) for more in ((B[0].T, B[0, 0]), (B[0].T,))]
INLINED += [(lambda x: (x > 0).cumsum(-1), (A,)), (lambda x: x.cumsum(0, dtype=torch.float64), (A,))]
INLINED += [(lambda x: x.sort(stable=True), (TIES,)), (lambda x: x.sort(dim=0, descending=True, stable=True), (TIES,))]
INLINED += [(lambda x: x.topk(3, 1), (A.mT,)), (lambda x: x.topk(2, 1, largest=False), (A,))]


@of_the_exporter
@pytest.mark.parametrize(("function", "inputs"), INLINED)
def test_operations_that_are_inlined_give_the_same_results(function, inputs):
    program = export(function, *inputs)
    inlined = program.run_decompositions(INLINE)
    assert not kernels(inlined)
    expected, found = program.module()(*inputs), inlined.module()(*inputs)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6)


@of_the_exporter
def test_functions_are_exported_for_any_batch():
    (w, x, k, pose), dist = problems(4)[:4], torch.full((4, 5), 0.01, dtype=torch.float64)
    calls = [(lambda *x: pose_covariance(Pose(*x[:2]), *x[2:], img_sigma=1.0), (*pose, w, x, k))]
    calls += [(lambda x, k, d: bearings(x, k, dist=d), (x, k, dist)), (heatmap_keypoints, (x[:, None],))]
    for function, inputs in calls:
        sizes = (({0: torch.export.Dim("batch", min=2)},) * len(inputs),)
        program, twice = export(function, *inputs, dynamic_shapes=sizes).module(), [torch.cat((x, x)) for x in inputs]
        torch.testing.assert_close(program(*twice), function(*twice))


@of_the_exporter
def test_long_sorts_stay_calls():
    program = export(lambda x: x.sort(stable=True).indices, torch.randn(2, 1000))
    assert kernels(program.run_decompositions(INLINE)) == kernels(program) != set()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
@pytest.mark.filterwarnings("ignore:.*use of fork:DeprecationWarning")
def test_a_forked_process_does_not_wait_for_a_thread_of_its_parent():
    held, done = threading.Event(), threading.Event()

    @in_turn
    def hold(_: torch.Tensor) -> None:
        held.set()
        done.wait()

    thread = threading.Thread(target=hold, args=(torch.ones(1),))
    thread.start()
    held.wait()
    process = multiprocessing.get_context("fork").Process(target=in_turn(torch.relu), args=(torch.ones(1),))
    process.start()
    process.join(30)
    done.set()
    thread.join()
    assert process.exitcode == 0
