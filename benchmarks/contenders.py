"""The contenders by name: solvers of this package and of other libraries; the problems that they solve.

A contender makes a task of a batch of problems. A task can be timed, forward or forward and backward, and counts how
many problems its poses solve.
"""

import time
import warnings
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from harness import HERE, say, seconds
from kornia.geometry import solve_pnp_dlt
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor, nn
from torch.utils.benchmark import timer

from kornia_pnpnet import Normalize, PnPNet, RobustWeightedLM, Starts, pose_errors, success, success_rate
from kornia_pnpnet.core.files import digest
from kornia_pnpnet.core.trees import take
from kornia_pnpnet.data import CameraProblems, OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation import draw_problems
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.evaluation.results import source_digest
from kornia_pnpnet.metrics import SuccessRate
from kornia_pnpnet.peers import PeerSolver
from kornia_pnpnet.result import Pose, Problems

#: The paper's solver as it is shipped, and the solver for any number of pairs.
TRAINED, ANY = "pnpnet-n9", "pnpnet-set"
#: The network of ``TRAINED`` with one guess, ``ITERATIONS`` and classical hyperparameters: the trained ones belong to
#: more iterations.
PLAIN = "net-n9+lm"
WHOLE = f"{PLAIN} compiled whole"
#: Iterations of every refinement with classical hyperparameters.
ITERATIONS = 5
# Errors of the pose that the refinement alone starts from, about those of the network's guess: the angle, and the
# distance relative to the distance of the points.
COARSE_ANGLE_DEG, COARSE_SHIFT = 5.0, 0.05
#: Number of pairs unless a row says otherwise.
N = 9
# Seed of the problems. No training or tuning used it.
_SEED = 20_270_400


class CannotBeTimedError(Exception):
    """Why a contender cannot be timed."""


class Task(NamedTuple):
    """A call on given problems."""

    call: Callable[[], Any]  # solves all problems once, forward, or forward and backward
    poses: Callable[[], Pose]  # of all problems, in their frame; not timed
    problems: Problems
    device: str = "cpu"  # PyTorch's timer waits until a GPU has finished

    @property
    def size(self) -> int:
        """Number of problems."""
        return len(self.problems.world_points)

    def seconds(self, times: int = 1) -> float:
        """Seconds of a call, the mean over ``times`` calls."""
        return seconds(self.call, times, time.perf_counter if self.device == "cpu" else timer)

    def us(self, times: int = 1) -> float:
        """Microseconds per problem, the mean over ``times`` calls."""
        return 1e6 * self.seconds(times) / self.size

    def warm(self) -> float:
        """Return the seconds of a second call. Raise ``CannotBeTimedError`` if the call does not compile."""
        _compiled(self.seconds)
        return float(_compiled(self.seconds))

    def success(self) -> SuccessRate:
        """Share of the problems that are solved."""
        with torch.no_grad():
            pose = Pose(*(x.double().cpu() for x in self.poses()))
        return success_rate(success(pose_errors(pose, self.problems.pose)))


def _compiled(call: Callable[[], Any]) -> Any:
    """Call a function, and raise CannotBeTimedError when it warns that it does not compile."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = call()
    for warning in caught:
        if "compil" in str(warning.message) and not issubclass(warning.category, DeprecationWarning):
            raise CannotBeTimedError(str(warning.message))
    return found


def compile_or_raise(module: nn.Module, **options: bool | str) -> None:
    """Call the module's ``compile``; CannotBeTimedError when it warns that it does not compile."""
    _compiled(partial(module.compile, **options))


def gradient(pose: Pose, leaves: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Gradients of the sum of all entries of the poses."""
    return torch.autograd.grad(pose.rotation.sum() + pose.translation.sum(), leaves, materialize_grads=True)


def float_inputs(problems: Problems, device: str = "cpu") -> list[Tensor]:
    """Points, pixels and intrinsics in float32 on a device."""
    return [x.to(device, torch.float32) for x in problems[:3]]


class Contender:
    """A solver to be timed. A subclass defines ``call``, and the other methods where they differ."""

    loops = False  # whether problems are solved one after the other: a part of a batch shows the time per problem
    differentiable = True  # whether there are gradients
    n: int | None = None  # the only number of pairs that the solver takes, if there is one
    device = "cpu"
    solver: Any = nn.Module()  # whose parameters get gradients

    def takes(self, n: int) -> bool:
        """Whether the contender gets problems of ``n`` pairs."""
        return self.n in (None, n)

    def inputs(self, problems: Problems) -> Any:
        """Prepare the arguments of ``call``; this is not timed. With gradients, points and pixels come first."""
        return float_inputs(problems, self.device)

    def call(self, inputs: Any) -> Any:
        """Solve the problems; this is timed."""
        raise NotImplementedError

    def pose(self, result: Any) -> Pose:
        """The pose of a result of ``call``."""
        return Pose(*result.pose)

    def poses(self, problems: Problems, inputs: Any) -> Pose:
        """Solve the problems once more, for their poses in the frame of the problems."""
        return self.pose(self.call(inputs))

    def task(self, problems: Problems, *, backward: bool = False) -> Task:
        """Prepare a batch; this is not timed."""
        inputs = self.inputs(problems)
        call: Callable[[], Any] = torch.no_grad()(lambda: self.call(inputs))
        if backward:
            # A clone would change the layout in memory in which the solver hands pairs over.
            leaves = [x.detach().requires_grad_() for x in inputs[:2]]
            learned = [x for x in self.solver.parameters() if x.requires_grad]
            call = lambda: gradient(self.pose(self.call([*leaves, *inputs[2:]])), [*leaves, *learned])  # noqa: E731
        return Task(call, lambda: self.poses(problems, inputs), problems, self.device)


class Ours(Contender):
    """A solver of this package: the whole call, in float32. Gradients go to points, pixels and parameters."""

    def __init__(
        self, spec: str, *, classical: bool = False, compiled: bool = False, device: str = "cpu", **options: bool
    ) -> None:
        solver: Any = load_solver(spec)
        if classical:
            solver = PnPNet(solver.init, RobustWeightedLM(ITERATIONS, reject_worse=False), solver.normalize).eval()
        self.solver = solver.float().to(device)
        self.device = device
        self.n = getattr(solver.init, "n", None)
        self.solver.requires_grad_(spec.startswith("pnpnet-"))
        if compiled:
            compile_or_raise(self.solver, **options)

    def call(self, inputs: Any) -> Any:
        """Call the solver with the whole batch."""
        return self.solver(*inputs)


class Refinement(Ours):
    """A refinement alone, on normalised pairs and from the coarse pose."""

    def __init__(self, *, compiled: bool = False, device: str = "cpu") -> None:
        self.solver = RobustWeightedLM(ITERATIONS, reject_worse=False).to(device)
        self.device = device
        if compiled:
            compile_or_raise(self.solver)

    def inputs(self, problems: Problems) -> Any:
        """Normalised points and pixels, the normalised problem, its start, and its frame."""
        with torch.no_grad():
            problem, frame = Normalize(order=False)(*float_inputs(problems, self.device))
            start = frame.apply(Pose(*(x.to(problem.world_points) for x in coarse_pose(problems))))
        starts = Starts(start, torch.ones_like(problem.weights))
        return problem.world_points, problem.img_points, problem, starts, frame

    def call(self, inputs: Any) -> Any:
        """Call the refinement."""
        world, img, problem, starts, _ = inputs
        return self.solver(problem._replace(world_points=world, img_points=img), starts)

    def poses(self, problems: Problems, inputs: Any) -> Pose:
        """Refine once more and undo the normalisation."""
        return Pose(*inputs[-1].undo(self.call(inputs).pose))


def coarse_pose(problems: Problems) -> Pose:
    """The true poses, turned about the centre of the points and moved."""
    rotation, translation = problems.pose
    generator = torch.Generator().manual_seed(0)
    turn, shift = torch.randn(2, len(rotation), 3, generator=generator, dtype=torch.float64)
    turn, shift = (x / x.norm(dim=-1, keepdim=True) for x in (turn, shift))
    centre = problems.world_points.mean(1)[..., None]  # (B, 3, 1)
    cam_centre = rotation @ centre + translation[..., None]
    turned = axis_angle_to_rotation_matrix(torch.deg2rad(torch.tensor(COARSE_ANGLE_DEG)) * turn).to(rotation) @ rotation
    shift = COARSE_SHIFT * cam_centre.norm(dim=1) * shift.to(translation)
    return Pose(turned, (cam_centre - turned @ centre)[..., 0] + shift)


def exported(spec: str, suffix: str, export: Callable[..., object]) -> Path:
    """Export a solver for N pairs in minutes, unless ``outputs/exported`` has it from the present code and weights."""
    solver = load_solver(spec)
    made_of = digest(source_digest(), torch.__version__, *solver.state_dict().values())
    path = HERE.parent / "outputs" / "exported" / f"{spec}-{made_of[:16]}{suffix}"
    if not path.exists():
        export(solver, path, N)
    return path


class Packaged(Contender):
    """A solver of this package for N pairs, compiled ahead of time for one problem per call, in float32."""

    loops, differentiable, n = True, False, N

    def __init__(self, spec: str) -> None:
        from kornia_pnpnet.export import export_package, load_package

        self.solver = load_package(exported(spec, ".pt2", partial(export_package, batch=1)))

    def inputs(self, problems: Problems) -> Any:
        """The inputs of each problem."""
        return list(zip(*(x.split(1) for x in float_inputs(problems)), strict=True))

    def call(self, inputs: Any) -> Any:
        """Call the package for each problem."""
        return [self.solver(*one) for one in inputs]

    def pose(self, result: Any) -> Pose:
        """The poses of all calls."""
        return Pose(*(torch.cat(x) for x in list(zip(*result, strict=True))[:2]))


class Onnx(Contender):
    """A solver of this package as an ONNX model for N pairs, under ONNX Runtime, in float32."""

    differentiable, n = False, N

    def __init__(self, spec: str) -> None:
        import onnxruntime

        from kornia_pnpnet.export import INPUTS, export_onnx

        self.names = INPUTS
        path = exported(spec, ".onnx", export_onnx)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = torch.get_num_threads()
        options.log_severity_level = 3
        self.session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])

    def inputs(self, problems: Problems) -> Any:
        """Arrays by the names of the model's inputs."""
        tensors = *float_inputs(problems), torch.ones(problems.world_points.shape[:2])
        return {name: x.numpy() for name, x in zip(self.names, tensors, strict=True)}

    def call(self, inputs: Any) -> Any:
        """Run the session with the whole batch."""
        return self.session.run(None, inputs)

    def pose(self, result: Any) -> Pose:
        """The first two outputs of the model."""
        return Pose(*map(torch.from_numpy, result[:2]))


def bare_call(solver: nn.Module, problems: Problems) -> Callable[[], object]:
    """One call with the whole batch for a solver of ours; the calls of the library alone for a peer."""
    if isinstance(solver, PeerSolver):
        single = list(zip(*(x.numpy() for x in problems[:3]), strict=True))
        return lambda: [solver.solve_one(*one) for one in single]
    return lambda: solver(*problems[:3])


class Peer(Contender):
    """The calls of another library, on arrays in float64 that are prepared, in as many threads as PyTorch uses.

    A thread solves its share of the problems, one after the other. kornia-rs keeps Python's lock: it gets one thread.
    """

    loops, differentiable = True, False

    def __init__(self, spec: str) -> None:
        self.solver = load_solver(spec)
        self.threads = 1 if spec == "kornia-rs" else torch.get_num_threads()
        self.pool = ThreadPoolExecutor(self.threads)

    def task(self, problems: Problems, *, backward: bool = False) -> Task:
        """Call the library for each problem. The poses are those of the adapter of this package."""
        count = min(self.threads, len(problems.world_points))
        calls = [bare_call(self.solver, take(problems, slice(i, None, count))) for i in range(count)]
        run = calls[0] if count == 1 else lambda: list(self.pool.map(lambda call: call(), calls))
        return Task(run, lambda: Pose(*self.solver(*problems[:3]).pose), problems)


class KorniaDLT(Contender):
    """Kornia's direct linear transform, batched, in float32. Float64 has the same success."""

    def takes(self, n: int) -> bool:
        """At least six pairs. Above 200 the singular value decomposition of all pairs takes too long."""
        return 6 <= n <= 200

    def call(self, inputs: Any) -> Any:
        """Call the function with the whole batch."""
        return solve_pnp_dlt(*inputs)

    def pose(self, result: Any) -> Pose:
        """The parts of the matrices (B, 3, 4)."""
        return Pose(result[:, :, :3], result[:, :, 3])


#: Our solvers. The threshold of the RANSAC is tuned for the protocol's data (docs/results).
OURS: dict[str, Callable[..., Contender]] = {
    TRAINED: partial(Ours, TRAINED),
    f"{TRAINED} compiled": partial(Ours, TRAINED, compiled=True),
    PLAIN: partial(Ours, TRAINED, classical=True),
    WHOLE: partial(Ours, TRAINED, classical=True, compiled=True, whole=True),
    ANY: partial(Ours, ANY),
    f"{ANY} compiled": partial(Ours, ANY, compiled=True),
    "refinement": Refinement,
    "refinement compiled": partial(Refinement, compiled=True),
    "epnp-lm": partial(Ours, "epnp-lm"),
    "p3p-ransac": partial(Ours, "p3p-ransac:threshold=50"),
}
#: All contenders.
CONTENDERS: dict[str, Callable[..., Contender]] = {
    **OURS,
    **{f"{name} packaged": partial(Packaged, name) for name in (TRAINED, ANY)},
    **{f"{name} ONNX": partial(Onnx, name) for name in (TRAINED, ANY)},
    **{name: partial(Peer, name) for name in ("opencv-ransac", "kornia-rs", "poselib", "pycolmap")},
    "kornia-dlt": KorniaDLT,
}


def make_contenders(names: Collection[str] | None) -> tuple[dict[str, Contender], list[dict[str, Any]]]:
    """Contenders by name (``None``: all), and for each that cannot be made its name and the reason."""
    made: dict[str, Contender] = {}
    skipped: list[dict[str, Any]] = []
    for name, make in CONTENDERS.items():
        if names and name not in names:
            continue
        try:
            made[name] = make()
        except (ImportError, CannotBeTimedError) as error:
            skipped.append({"contender": name, "why": str(error)})
            say(f"skipped: {name}: {error}")
    return made, skipped


def draw(n: int, count: int, outliers: OutlierMix | None = None) -> Problems:
    """Problems of the protocol's data in float64; a third of the pairs are mismatches unless ``outliers`` is given."""
    mix = OutlierMix(count=n // 3, mismatch_share=1.0) if outliers is None else outliers
    # A constant batch size: a smaller count gives the first problems of a larger one.
    source = SyntheticProblems(n=n, batch_size=1000, seed=_SEED + n, outliers=mix, dtype=torch.float64)
    return draw_problems(source, count)


def random_cameras(n: int, count: int, seed: int, share: float, **options: Any) -> Problems:
    """Problems of random cameras in float64; ``share`` is the share of outliers."""
    options |= {"batch_size": count, "seed": seed, "outlier_share": share, "dtype": torch.float64}
    return CameraProblems(n=n, **options).batch(0)


def relative_errors(pose: Pose, problems: Problems) -> tuple[Tensor, Tensor]:
    """Rotation errors in degrees, and distances of the camera centres by the median distance of the points, (B,)."""
    centres = [(x.rotation.mT @ x.translation[..., None])[..., 0] for x in (pose, problems.pose)]
    cam_points = problems.world_points @ problems.pose.rotation.mT + problems.pose.translation[:, None]
    shift = (centres[0] - centres[1]).norm(dim=-1) / cam_points.norm(dim=-1).median(1).values
    return pose_errors(pose, problems.pose).rotation_error_deg, shift
