"""Our solvers on a GPU: ``python benchmarks/gpu.py`` writes ``gpu.json``; README.md describes the measurements."""

import gc
import itertools
import json
import os
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import contenders
import torch
from contenders import OURS, CannotBeTimedError, Contender, N, Task, draw
from harness import BACKWARD, FORWARD, HERE, in_turns, parser, say, seconds, share, summary, threads
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.benchmark import timer
from torch.utils.flop_counter import flop_registry

from kornia_pnpnet import PnPNet, create_solver, list_solvers, pose_errors, success, success_rate
from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.core.trees import iter_tensors, take
from kornia_pnpnet.evaluation.results import save_results
from kornia_pnpnet.refine.residual import rotation_angle
from kornia_pnpnet.result import Pose, Problems

#: Largest difference of a pose that counts as the same, in radians, and of a gradient, relative to its length.
LIMITS = {torch.float32: 1e-3, torch.float64: 1e-6}
_DRAWN = 10_000  # problems; larger batches repeat them
# Rotations (B, 3, 3), translations (B, 3), ``ok`` (B,), and gradients (B, 5 N).
_Found = tuple[Tensor, Tensor, Tensor, Tensor]


class Amount(NamedTuple):
    """How much is measured. The first mode is what the others are compared with."""

    parity: int = 1000  # problems of each solver that both devices solve
    # CUDA graphs: solvers, modes and batch sizes; then contenders, batch sizes and numbers of pairs.
    graphs: tuple[str, ...] = ("pnpnet-n9", "pnpnet-set")
    modes: tuple[str, ...] = ("eager", "compiled", "reduce-overhead", "captured")
    calls: tuple[int, ...] = (1, 100, 1000)
    # Solvers and efforts whose waits for the GPU are counted.
    waits: tuple[tuple[str, str | None], ...] = (
        *(("pnpnet-n9", "fixed"), ("pnpnet-n9", None)),
        *(("pnpnet-set", "fixed"), ("pnpnet-set", None), ("p3p-ransac", None)),
    )
    contenders: tuple[str, ...] = (
        *("pnpnet-n9", "pnpnet-n9 compiled", "pnpnet-set", "pnpnet-set compiled"),
        *("epnp-lm", "p3p-ransac", "poselib"),
    )
    batches: tuple[int, ...] = (1000, 10_000, 100_000, 1_000_000)
    pairs: tuple[int, ...] = (9, 50)
    rounds: int = 5  # calls that are timed
    call_s: float = 10.0  # larger batches are left out where a call may take longer
    copied: int = 2**28  # float32 entries of the copy that measures the bandwidth
    side: int = 8192  # rows of the matrices that measure the rate of arithmetic


FULL = Amount()
#: A few small problems without compiling, which show that everything runs.
QUICK = FULL._replace(parity=4, graphs=("pnpnet-n9",), modes=("eager",), calls=(1, 4), waits=(), copied=2**16, side=64)
QUICK = QUICK._replace(contenders=("pnpnet-n9", "epnp-lm"), batches=(4, 8), pairs=(9, 12), rounds=3)


def parity(device: str, amount: Amount) -> Iterator[dict[str, Any]]:
    """Solve the same problems on the CPU and on the device, with gradients, by every solver of ours."""
    for name in list_solvers():
        try:
            solver = create_solver(name)
        except ImportError:  # a solver of another library
            continue
        if not isinstance(solver, PnPNet):
            continue
        say(f"parity: {name}")
        problems = draw(getattr(solver.init, "n", N), amount.parity)
        for dtype, limit in LIMITS.items():
            case = {"solver": name, "dtype": str(dtype).removeprefix("torch."), "limit": limit, "count": amount.parity}
            found = []
            try:
                for place in ("cpu", device):
                    call = call_of(solver.to(place, dtype), problems, place, BACKWARD, dtype)
                    found.append([x.cpu() for x in call()])
            except RuntimeError as error:
                yield {**case, "why": reason(error)}
                continue
            (rotation, _, ok, slope), (other_rotation, _, other_ok, other_slope) = found
            both = ok & other_ok
            turned = rotation_angle(rotation, other_rotation)
            length = torch.maximum(slope.norm(dim=1), other_slope.norm(dim=1)).clamp(min=torch.finfo(dtype).tiny)
            change = (slope - other_slope).norm(dim=1) / length
            poses = [Pose(*(x.double() for x in one[:2])) for one in found]
            yield {
                **case,
                "success": [success_rate(success(pose_errors(x, problems.pose))).rate for x in poses],
                "both_ok": int(both.sum()),
                "same_ok": share(ok == other_ok),
                "same_pose": share(turned[both] <= limit),
                "same_gradient": share(change[both] <= limit),
            }


def reason(error: BaseException) -> str:
    """The start of the message of the error that caused an error, in one line."""
    while error.__context__ is not None:
        error = error.__context__
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]


#: Options of ``solver.compile`` by mode. The modes "eager" and "captured" do not compile.
COMPILED: dict[str, dict[str, str]] = {"compiled": {}, "reduce-overhead": {"mode": "reduce-overhead"}}


def captured(call: Callable[[], _Found]) -> Callable[[], _Found]:
    """The call as one CUDA graph, which is captured now and replayed by each call into the same result."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(3):  # allocations and handles of libraries must not come into the graph
            call()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with ExitStack() as stack:
        gc.disable()  # garbage can contain another graph, and to free a graph ends the capture
        stack.callback(gc.enable)
        stack.enter_context(torch.cuda.graph(graph))
        result = call()

    def replay() -> _Found:
        graph.replay()
        return result

    return replay


def graphs(device: str, amount: Amount) -> Iterator[dict[str, Any]]:
    """Time a call of each mode, of solvers with a fixed effort, forward and with gradients to points and pixels."""
    for name, direction in itertools.product(amount.graphs, (FORWARD, BACKWARD)):
        torch.compiler.reset()
        solvers = {mode: create_solver(name, effort="fixed").to(device, torch.float32) for mode in amount.modes}
        for mode, solver in solvers.items():
            if mode in COMPILED:
                contenders.compile_or_raise(solver, **COMPILED[mode])
        for batch in amount.calls:
            say(f"graphs: {name}, B = {batch}, {direction}")
            modes = _modes(solvers, batch, device, amount.rounds, direction)
            yield {"solver": name, "batch": batch, "mode": direction, "modes": modes}
            for mode in [mode for mode, found in modes.items() if "why" in found]:
                del solvers[mode]  # a solver that has failed to compile runs uncompiled from now on


def _modes(
    solvers: Mapping[str, nn.Module], batch: int, device: str, rounds: int, direction: str
) -> dict[str, dict[str, Any]]:
    """Time a call of each mode in turns, and compare its poses and gradients with those of the first mode."""
    problems = draw(N, batch)
    tasks: dict[str, Task] = {}
    modes: dict[str, dict[str, Any]] = {}
    expected: tuple[Tensor, ...] = ()
    for mode, solver in solvers.items():
        call = call_of(solver, problems, device, direction)
        try:
            task = Task(captured(call) if mode == "captured" else call, lambda: problems.pose, problems, device)
            start = time.perf_counter()
            task.warm()
            rotation, _, ok, slope = (x.clone() for x in task.call())  # the next replay overwrites its result
        except (CannotBeTimedError, RuntimeError) as error:
            modes[mode] = {"why": reason(error)}
            continue
        modes[mode] = {"warm_s": time.perf_counter() - start}
        tasks[mode] = task
        expected = expected or (rotation, ok, slope)
        modes[mode] |= {
            "rotation_difference": float(rotation_angle(rotation, expected[0]).max()),
            "same_ok": share(ok == expected[1]),
            "same_gradient": share((slope - expected[2]).norm(dim=1) <= 1e-2 * expected[2].norm(dim=1)),
        }
    timers = {mode: partial(task.seconds, 10) for mode, task in tasks.items()}
    for mode, times in in_turns(timers, rounds).items():
        modes[mode] |= summary([1e6 * x for x in times])
    return modes


def call_of(
    solver: nn.Module, problems: Problems, device: str, direction: str, dtype: torch.dtype = torch.float32
) -> Callable[[], _Found]:
    """A call that returns poses, ``ok``, and gradients to points and pixels, which are empty forward."""
    *pairs, intrinsics = (x.to(device, dtype) for x in problems[:3])
    backward = direction == BACKWARD
    leaves = [x.detach().requires_grad_(backward) for x in pairs]

    def call() -> _Found:
        with torch.set_grad_enabled(backward):
            result = solver(*leaves, intrinsics)
        slopes = contenders.gradient(result.pose, leaves) if backward else [pairs[0].new_zeros(len(result.ok), 0)]
        rotation, translation = (x.detach() for x in result.pose)
        return rotation, translation, result.ok, torch.cat([x.flatten(1) for x in slopes], 1)

    return call


def waits(device: str, amount: Amount) -> Iterator[dict[str, Any]]:
    """Count how often a call waits for the GPU, because the next operations depend on values or copy from the CPU."""
    problems = draw(N, 100)
    for (name, effort), direction in itertools.product(amount.waits, (FORWARD, BACKWARD)):
        solver = create_solver(name, effort=effort).to(device, torch.float32)
        call = call_of(solver, problems, device, direction)
        call()
        places: Counter[str] = Counter()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            torch.cuda.set_sync_debug_mode("warn")
            call()
            torch.cuda.set_sync_debug_mode("default")
        for warning in caught:
            if "called a synchronizing" in str(warning.message):
                path = Path(warning.filename)
                places[f"{path.parent.name}/{path.name}:{warning.lineno}"] += 1
        yield {"solver": name, "effort": effort, "mode": direction, "waits": places.total(), "places": dict(places)}


class Work(TorchDispatchMode):
    """Count the bytes that operations read and write, and floating point operations.

    Views are free. Each operation reads its arguments and writes its results, as without a compiler. Products of
    matrices count as in PyTorch's own counter, every other operation once for each entry of its results.
    """

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.bytes = self.flops = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        with self:  # in inference mode, operations that consist of others arrive whole
            result = func.decompose(*args, **kwargs)
        if result is not NotImplemented:
            return result
        result = func(*args, **kwargs)
        if not func.is_view:
            written = list(iter_tensors(result))
            product = flop_registry.get(func.overloadpacket)
            self.flops += product(*args, **kwargs, out_val=result) if product else sum(x.numel() for x in written)
            self.bytes += sum(x.nbytes for x in iter_tensors((args, *kwargs.values(), written)))
        return result


def machine_rates(device: str, amount: Amount) -> dict[str, float]:
    """Bytes per second of a copy, read and written, and operations per second of a product of float32 matrices."""
    source = torch.zeros(amount.copied, device=device)
    target, matrix = torch.empty_like(source), torch.ones(amount.side, amount.side, device=device)

    def quickest(call: Callable[[], object]) -> float:
        return min(seconds(call, clock=timer) for _ in range(10))

    copy, product = quickest(lambda: target.copy_(source)), quickest(lambda: matrix @ matrix)
    return {"bytes_per_s": 2 * source.nbytes / copy, "flops_per_s": 2 * amount.side**3 / product}


def work(contender: Contender, problems: Problems, *, backward: bool) -> dict[str, float]:
    """Count what a call that is not compiled does for a problem, see :class:`Work`."""
    task = contender.task(problems, backward=backward)
    with Work() as counted:
        task.call()
    moved = [*(2 if backward else 1) * problems[:2], problems.intrinsics, *problems.pose]
    least = sum(4 * x.numel() for x in moved)  # float32
    total = {"least_bytes": least, "bytes": counted.bytes, "flops": counted.flops}
    return {key: value / task.size for key, value in total.items()}


def measure_throughput(device: str, amount: Amount) -> Iterator[dict[str, Any]]:
    """Time per problem, peak memory, and how far from the floors of the machine, after the rates of the machine."""
    rates = machine_rates(device, amount)
    yield {"rates": rates}
    for name, n in itertools.product(amount.contenders, amount.pairs):
        torch.compiler.reset()
        if name not in OURS:  # on the CPU, one problem after the other
            say(f"throughput: {name}, n = {n}")
            with threads():
                task = contenders.CONTENDERS[name]().task(draw(n, amount.batches[0]))
            task.warm()
            place: dict[str, Any] = {"contender": name, "mode": FORWARD, "n": n, "batch": task.size}
            yield {**place, "success": task.success().rate, **summary([task.us() for _ in range(amount.rounds)])}
            continue
        contender, plain = (OURS[x](device=device) for x in (name, name.removesuffix(" compiled")))
        if not contender.takes(n):
            continue
        drawn = draw(n, min(_DRAWN, max(amount.batches)))
        known: dict[str, list[tuple[int, float]]] = {FORWARD: [], BACKWARD: []}  # batches and seconds of a call
        for mode, batch in itertools.product((FORWARD, BACKWARD), amount.batches):
            say(f"throughput: {name}, n = {n}, B = {batch}, {mode}")
            place = {"contender": name, "mode": mode, "n": n, "batch": batch}
            if (expected_s := _expected_s(known[mode], batch)) > amount.call_s:
                yield {**place, "why": f"a call would take about {expected_s:.0f} s"}
                continue
            problems = take(drawn, torch.arange(batch) % len(drawn.world_points))
            start = time.perf_counter()
            try:
                task = contender.task(problems, backward=mode == BACKWARD)
                task.warm()
            except (CannotBeTimedError, RuntimeError) as error:
                yield {**place, "why": reason(error)}
                if isinstance(error, RuntimeError):
                    continue
                break  # it has failed to compile, and runs uncompiled from now on
            place["warm_s"] = time.perf_counter() - start
            each = work(plain, take(problems, slice(1000)), backward=mode == BACKWARD)
            if device != "cpu":
                torch.cuda.reset_peak_memory_stats(device)
                before = torch.cuda.memory_allocated(device)
                task.seconds()
                place["peak_bytes"] = torch.cuda.max_memory_allocated(device) - before
            found = summary([task.us() for _ in range(amount.rounds)])
            known[mode].append((batch, found["median_us"] * batch / 1e6))
            floor_s = max(each["least_bytes"] / rates["bytes_per_s"], each["flops"] / rates["flops_per_s"])
            traffic_s = each["bytes"] / rates["bytes_per_s"]
            shares = {key: 1e6 * x / found["median_us"] for key, x in (("floor", floor_s), ("traffic", traffic_s))}
            if batch == amount.batches[0]:
                place["success"] = task.success().rate
            yield {**place, "work": each, "shares": shares, **found}


def _expected_s(known: list[tuple[int, float]], batch: int) -> float:
    """Seconds of a call, on the line through the last two: small batches wait for the launches of kernels."""
    if len(known) < 2:
        return known[0][1] if known else 0.0
    (small, one), (large, other) = known[-2:]
    return other + max(other - one, 0.0) * (batch - large) / (large - small)


Part = Callable[[str, Amount], Iterator[dict[str, Any]]]
PARTS: dict[str, Part] = {"parity": parity, "waits": waits, "graphs": graphs, "throughput": measure_throughput}


def main(arguments: Sequence[str] | None = None, amount: Amount | None = None) -> None:
    """Measure, and write each row into the file as soon as it is known."""
    command = parser(__doc__, HERE / "gpu.json")
    command.add_argument("--device", default="cuda", help="cuda, or cpu to try the script")
    command.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), help="the others stay in the file")
    command.add_argument("--quick", action="store_true", help="a few small problems: does everything run?")
    options = command.parse_args(arguments)
    amount = amount or (QUICK if options.quick else FULL)
    results = json.loads(options.out.read_text()) if options.out.exists() else {}
    for part in options.parts:
        settings = {"device": options.device, **amount._asdict()}
        made = {"environment": environment(), "settings": settings, "load_average": os.getloadavg()[0]}
        results[part] = {**made, "rows": []}
        for row in PARTS[part](options.device, amount):
            if "rates" in row:
                results[part] |= row
            else:
                results[part]["rows"].append(row)
            save_results(results, options.out)


if __name__ == "__main__":
    main()
