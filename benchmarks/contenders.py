"""The contenders by name: solvers of ours and of other libraries; how much is measured, and on which problems."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from harness import HERE, say
from kornia.geometry import solve_pnp_dlt
from tasks import (
    ITERATIONS,
    CannotBeTimedError,
    Contender,
    Task,
    compile_or_raise,
    float_inputs,
    gradient,
    leaves_of,
    normalized,
    waiting,
    without_gradient,
)
from torch import nn

from kornia_pnpnet import PnPNet, RobustWeightedLM
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation import draw_problems
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.peers import PeerSolver
from kornia_pnpnet.result import Pose, Problems

#: The paper's solver as it is shipped, and the solver for any number of pairs.
TRAINED, ANY = "pnpnet-n9", "pnpnet-set"
#: The network of ``TRAINED``, one guess, and the number of iterations that the targets were set for, with classical
#: hyperparameters: the trained hyperparameters belong to more iterations.
PLAIN = "net-n9+lm"
WHOLE = f"{PLAIN} compiled whole"


class Ours(Contender):
    """A solver of this package: the whole call, in float32. Gradients go to points, pixels and parameters."""

    def __init__(
        self,
        spec: str,
        *,
        compiled: bool = False,
        whole: bool = False,
        classical: int | None = None,
        device: str = "cpu",
    ) -> None:
        solver: Any = load_solver(spec)
        if classical is not None:
            solver = PnPNet(solver.init, RobustWeightedLM(classical, reject_worse=False), solver.normalize).eval()
        solver = solver.float().to(device)
        self.solver: nn.Module = solver
        self.device = device
        self.n = int(found[1]) if (found := re.match(r"pnpnet-n(\d+)", spec)) else None
        if compiled:
            compile_or_raise(self.solver, **({"whole": True} if whole else {}))

    def task(self, problems: Problems, *, backward: bool = False) -> Task:
        """The call with the whole batch."""
        world, img, intrinsics = float_inputs(problems, self.device)

        def poses() -> Pose:
            return Pose(*self.solver(world, img, intrinsics).pose)

        call: Callable[[], object] = without_gradient(lambda: self.solver(world, img, intrinsics))
        if backward:
            leaves = leaves_of(world, img)
            learned = [x for x in self.solver.parameters() if x.requires_grad]
            call = lambda: gradient(self.solver(*leaves, intrinsics).pose, [*leaves, *learned])  # noqa: E731
        return Task(call, poses, problems, waiting(self.device))


class Refinement(Contender):
    """A refinement alone, on normalised pairs and from the coarse pose."""

    def __init__(self, *, compiled: bool = False, device: str = "cpu") -> None:
        self.refine: nn.Module = RobustWeightedLM(ITERATIONS, reject_worse=False).to(device)
        self.device = device
        if compiled:
            compile_or_raise(self.refine)

    def task(self, problems: Problems, *, backward: bool = False) -> Task:
        """The call of the refinement."""
        pairs, starts, undo = normalized(problems, self.device)
        call: Callable[[], object] = without_gradient(lambda: self.refine(pairs, starts))
        if backward:
            # Not cloned: a clone would change the layout in memory in which the solver hands pairs over.
            leaves = [x.detach().requires_grad_() for x in (pairs.world_points, pairs.img_points)]
            wanted = pairs._replace(world_points=leaves[0], img_points=leaves[1])
            learned = [x for x in self.refine.parameters() if x.requires_grad]
            call = lambda: gradient(self.refine(wanted, starts).pose, [*leaves, *learned])  # noqa: E731
        return Task(call, lambda: undo(self.refine(pairs, starts).pose), problems, waiting(self.device))


def exported(spec: str, suffix: str, export: Callable[[PnPNet, Path], object]) -> Path:
    """Export a solver, unless ``outputs/exported`` has it from the present code: exporting takes minutes."""
    from kornia_pnpnet.evaluation.results import source_digest

    path = HERE.parent / "outputs" / "exported" / f"{spec}-{source_digest()[:16]}{suffix}"
    if not path.exists():
        solver = load_solver(spec)
        assert isinstance(solver, PnPNet)
        export(solver, path)
    return path


class Packaged(Contender):
    """A solver of this package for nine pairs, compiled ahead of time for one problem per call, in float32."""

    loops, differentiable = True, False
    n: int = 9

    def __init__(self, spec: str) -> None:
        from kornia_pnpnet.export import export_package, load_package

        self.solver = load_package(
            exported(spec, ".pt2", lambda solver, path: export_package(solver, path, self.n, batch=1))
        )

    def task(self, problems: Problems, *, backward: bool = False) -> Task:
        """The calls one after the other."""
        tensors = float_inputs(problems, "cpu")
        single = list(zip(*(x.split(1) for x in tensors), strict=True))

        def poses() -> Pose:
            results = [self.solver(*one) for one in single]
            return Pose(*(torch.cat(x) for x in list(zip(*results, strict=True))[:2]))

        return Task(lambda: [self.solver(*one) for one in single], poses, problems)


class Onnx(Contender):
    """A solver of this package as an ONNX model for nine pairs, under ONNX Runtime, in float32."""

    differentiable = False
    n: int = 9

    def __init__(self, spec: str) -> None:
        import onnxruntime

        from kornia_pnpnet.export import INPUTS, export_onnx

        self.names = INPUTS
        path = exported(spec, ".onnx", lambda solver, path: export_onnx(solver, path, self.n))
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = torch.get_num_threads()
        options.log_severity_level = 3
        self.session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])

    def task(self, problems: Problems, *, backward: bool = False) -> Task:
        """The call of the session with the whole batch."""
        tensors = *float_inputs(problems, "cpu"), torch.ones(problems.world_points.shape[:2])
        inputs = {name: x.numpy() for name, x in zip(self.names, tensors, strict=True)}

        def poses() -> Pose:
            rotation, translation, *_ = self.session.run(None, inputs)
            return Pose(torch.from_numpy(rotation), torch.from_numpy(translation))

        return Task(lambda: self.session.run(None, inputs), poses, problems)


# -- other libraries, called as fast as a user of the library can call them --------------------------------------------


def bare_call(solver: nn.Module, problems: Problems) -> Callable[[], object]:
    """One call with the whole batch for a solver of ours; the calls of the library alone for a peer."""
    inputs = (problems.world_points, problems.img_points, problems.intrinsics)
    if isinstance(solver, PeerSolver):
        single = list(zip(*(x.numpy() for x in inputs), strict=True))
        return lambda: [solver.solve_one(*one) for one in single]
    return lambda: solver(*inputs)


class Peer(Contender):
    """The call of a library for each problem, on arrays in float64 that are prepared."""

    loops, differentiable = True, False

    def __init__(self, spec: str) -> None:
        self.solver = load_solver(spec)

    def task(self, problems: Problems, *, backward: bool = False) -> Task:
        """The calls one after the other."""

        def poses() -> Pose:
            return Pose(*self.solver(problems.world_points, problems.img_points, problems.intrinsics).pose)

        return Task(bare_call(self.solver, problems), poses, problems)


class KorniaDLT(Contender):
    """Kornia's direct linear transform, batched, in float32. Float64 has the same success."""

    def takes(self, n: int) -> bool:
        """At least six pairs. Above 200 the singular value decomposition of all pairs takes too long."""
        return 6 <= n <= 200

    def task(self, problems: Problems, *, backward: bool = False) -> Task:
        """One call with the whole batch."""
        world, img, intrinsics = float_inputs(problems, "cpu")
        leaves = leaves_of(world, img)
        call: Callable[[], object] = without_gradient(lambda: solve_pnp_dlt(world, img, intrinsics))
        if backward:
            call = lambda: gradient(solve_pnp_dlt(leaves[0], leaves[1], intrinsics), leaves)  # noqa: E731

        def poses() -> Pose:
            matrix = solve_pnp_dlt(world, img, intrinsics)
            return Pose(matrix[:, :, :3], matrix[:, :, 3])

        return Task(call, poses, problems)


#: Our solvers. The threshold of the RANSAC is tuned for the protocol's data (docs/results).
OURS: dict[str, Callable[..., Contender]] = {
    TRAINED: functools.partial(Ours, TRAINED),
    f"{TRAINED} compiled": functools.partial(Ours, TRAINED, compiled=True),
    PLAIN: functools.partial(Ours, TRAINED, classical=ITERATIONS),
    WHOLE: functools.partial(Ours, TRAINED, classical=ITERATIONS, compiled=True, whole=True),
    ANY: functools.partial(Ours, ANY),
    f"{ANY} compiled": functools.partial(Ours, ANY, compiled=True),
    "refinement": Refinement,
    "refinement compiled": functools.partial(Refinement, compiled=True),
    "epnp-lm": functools.partial(Ours, "epnp-lm"),
    "p3p-ransac": functools.partial(Ours, "p3p-ransac:threshold=50"),
}
#: All contenders.
CONTENDERS: dict[str, Callable[..., Contender]] = {
    **OURS,
    f"{TRAINED} packaged": functools.partial(Packaged, TRAINED),
    f"{ANY} packaged": functools.partial(Packaged, ANY),
    f"{TRAINED} ONNX": functools.partial(Onnx, TRAINED),
    f"{ANY} ONNX": functools.partial(Onnx, ANY),
    "opencv-ransac": functools.partial(Peer, "opencv-ransac"),
    "kornia-rs": functools.partial(Peer, "kornia-rs"),
    "poselib": functools.partial(Peer, "poselib"),
    "pycolmap": functools.partial(Peer, "pycolmap"),
    "kornia-dlt": KorniaDLT,
}


# -- how much, and on which problems -----------------------------------------------------------------------------------

#: Number of pairs unless a row says otherwise.
N = 9
# Seed of the problems. No training or tuning used it.
_SEED = 20_270_400


class Settings(NamedTuple):
    """How much is measured."""

    contenders: tuple[str, ...] | None = None  # names; None: all
    problems: int = 1000  # that success is counted on; batch size of the rows with other numbers of pairs than N
    batches: tuple[int, ...] = (1, 10, 100, 1000, 10_000, 100_000)  # at N pairs
    pairs: tuple[int, ...] = (6, 9, 20, 100, 1000)
    most_backward: int = 10_000  # largest batch size with gradients
    rounds: int = 5  # at most
    loop_s: float = 0.2  # for a contender in a round: a loop solves fewer problems, a shorter call is repeated
    call_s: float = 2.0  # batches whose call takes longer are left out
    point_s: float = 3.0  # for all rounds of one comparison, about
    latency_calls: int = 1000  # calls with a single problem
    latency_s: float = 2.5  # for these calls; slow contenders get fewer
    memory_batch: int = 10_000  # of the memory measurement


FULL = Settings()
#: A few small problems: does everything run?
QUICK = Settings(None, 20, (1, 20), (6, 9), 20, 3, 0.01, 600.0, 1.0, 20, 1.0, 100)


def draw(n: int, count: int, outliers: OutlierMix | None = None) -> Problems:
    """Problems of the protocol's data in float64; a third of the pairs are mismatches unless ``outliers`` is given."""
    mix = OutlierMix(count=n // 3, mismatch_share=1.0) if outliers is None else outliers
    # A constant batch size: a smaller count gives the first problems of a larger one.
    source = SyntheticProblems(n=n, batch_size=1000, seed=_SEED + n, outliers=mix, dtype=torch.float64)
    return draw_problems(source, count)


def make_contenders(settings: Settings) -> tuple[dict[str, Contender], list[dict[str, Any]]]:
    """The contenders that are asked for by name, and for each that cannot be made its name and the reason."""
    made: dict[str, Contender] = {}
    skipped: list[dict[str, Any]] = []
    for name, make in CONTENDERS.items():
        if settings.contenders is not None and name not in settings.contenders:
            continue
        try:
            made[name] = make()
        except (ImportError, CannotBeTimedError) as error:
            skipped.append({"contender": name, "why": str(error)})
            say(f"skipped: {name}: {error}")
    return made, skipped
