"""The two numbers of the refinement: operations, and bytes that move, for each problem and iteration."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import torch
from contenders import TRAINED
from settings import N, draw
from tasks import ITERATIONS, normalized
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from kornia_pnpnet import RobustWeightedLM, create_solver
from kornia_pnpnet.evaluation.operations import Operations, count_per_problem

__all__ = ["GPU", "measure_engine"]

_BATCH = 1000


@dataclass(frozen=True)
class Device:
    """What a GPU moves and computes at most."""

    name: str
    bytes_per_second: float
    flops_per_second: float


#: The project's planning figures: the bandwidth that is reached, and the data sheet's float32 without tensor cores.
GPU = Device("NVIDIA H200", bytes_per_second=4.3e12, flops_per_second=67e12)


class Traffic(TorchDispatchMode):
    """Counts kernels and the bytes that they read and write; views move none."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.kernels = 0
        self.bytes = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run an operation and count it."""
        result = func(*args, **(kwargs or {}))
        read, written = tensors((args, kwargs)), tensors(result)
        there = {tensor.untyped_storage().data_ptr() for tensor in read}
        view = written and all(tensor.untyped_storage().data_ptr() in there for tensor in written)
        if not (view and not func._schema.is_mutable):
            self.kernels += 1
            self.bytes += count_bytes((*read, *written))
        return result


def tensors(values: Any) -> list[Tensor]:
    """The tensors in any nest of containers."""
    return [leaf for leaf in tree_leaves(values) if isinstance(leaf, Tensor)]


def count_bytes(values: Iterable[Tensor]) -> int:
    """Bytes of all entries; one that is expanded is there once."""
    total = 0
    for tensor in values:
        sizes = [size for size, stride in zip(tensor.shape, tensor.stride(), strict=True) if stride]
        total += tensor.element_size() * math.prod(sizes)
    return total


def refinement_operations(m: int) -> Operations:
    """Operations of the refinement alone, with ``m`` iterations, for one problem."""
    refine = RobustWeightedLM(m)
    inputs = {batch: normalized(draw(N, batch), "cpu")[:2] for batch in (2, 4)}
    return count_per_problem(lambda batch: refine(*inputs[batch]))


@torch.no_grad()
def traffic(m: int) -> Traffic:
    """What a call of the refinement moves in eager mode, for the whole batch."""
    refine = RobustWeightedLM(m)
    corr, guess, _ = normalized(draw(N, _BATCH), "cpu")
    with Traffic() as counted:
        refine(corr, guess)
    return counted


@torch.no_grad()
def floor_bytes() -> dict[str, float]:
    """Bytes of a problem that have to be read and written once: for a whole call, and for one iteration by itself."""
    corr, guess, _ = normalized(draw(N, _BATCH), "cpu")
    pairs = count_bytes((corr.world_points, corr.img_points, corr.weights, guess.weights)) / _BATCH
    pose, results = (count_bytes(tensors(x)) / _BATCH for x in (guess.pose, RobustWeightedLM()(corr, guess)))
    return {"solve": pairs + pose + results, "iteration": pairs + 2 * pose}


def measure_engine() -> dict[str, Any]:
    """Count; nothing is timed.

    Returns:
        ``n``, ``m``; ``shipped``: iterations and views of the shipped solver; ``operations`` of one iteration by kind;
        ``iteration_flops`` and ``solve_flops``, weighted as figure 1 of the results; ``iteration_kernels`` and
        ``iteration_bytes`` of eager mode; ``floor_bytes`` of a whole call and of an iteration; ``gpu``: what the floor
        allows on one.
    """
    whole, without_last = (refinement_operations(m) for m in (ITERATIONS, ITERATIONS - 1))
    one = {kind: count - asdict(without_last)[kind] for kind, count in asdict(whole).items()}
    more, fewer = (traffic(m) for m in (ITERATIONS, ITERATIONS - 1))
    floor = floor_bytes()
    shipped: Any = create_solver(TRAINED)
    return {
        "n": N,
        "m": ITERATIONS,
        "shipped": {"m": shipped.refine.m, "views": shipped.views},
        "batch": _BATCH,
        "operations": one,
        "iteration_flops": Operations(**one).flops,
        "solve_flops": whole.flops,
        "iteration_kernels": more.kernels - fewer.kernels,
        "iteration_bytes": (more.bytes - fewer.bytes) / _BATCH,
        "floor_bytes": floor,
        "gpu": {
            **asdict(GPU),
            "solves_per_second_by_bytes": GPU.bytes_per_second / floor["solve"],
            "solves_per_second_by_operations": GPU.flops_per_second / whole.flops,
        },
    }
