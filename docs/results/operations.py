r"""Operation counts: the scalar operations that a solver executes for one problem of n pairs (figure 1 of the paper).

Every count is measured: :class:`OperationCounter` runs the solver and adds up what each PyTorch operation costs by
:data:`OPERATION_COSTS`; moving data and changing signs cost nothing. All problems of n pairs cost the same, except for
RANSAC, whose count is the mean over 64 problems of the protocol without noise, where it stops as early as its rule
allows.

Source: R. Sheffer and A. Wiesel, "PnP-Net: A hybrid Perspective-n-Point Network", 2020, which counts by T. Minka's
Lightspeed toolbox.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from kornia.core.exceptions import ValueCheckError
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from kornia_pnpnet.core.environment import environment
from kornia_pnpnet.data import OutlierMix, SyntheticProblems
from kornia_pnpnet.evaluation.named_solvers import load_solver
from kornia_pnpnet.propose.mlp import MLPInit
from kornia_pnpnet.propose.ransac import RANSAC
from kornia_pnpnet.solver import PnPNet

#: The cost of one operation of each kind in "flops". Source: Lightspeed 2.8, ``flops.m`` and ``flops_div``, ``_sqrt``,
#: ``_exp``, ``_log`` (timed on a Pentium 4). There a sine or another special function costs as much as a logarithm, and
#: an absolute value (4) as much as two comparisons. The cost of logic, which Lightspeed does not list, is ours.
OPERATION_COSTS = {"add": 1, "multiply": 1, "divide": 8, "sqrt": 8, "exp": 40, "log": 20, "compare": 2, "logic": 1}
ADD, MULTIPLY, DIVIDE, SQRT, EXP, LOG, COMPARE, LOGIC = OPERATION_COSTS.values()

#: The solvers of figure 1. ``net``, ``pnpnet`` and ``pnpnet-paper`` are networks built for each number of pairs.
SOLVERS = (
    *("net", "pnpnet", "pnpnet-paper", "pnpnet-set", "epnp", "epnp-lm", "reppnp", "reppnp-lm", "p3p-ransac"),
    *("ransac-epnp-lm", "identity-lm"),
)
# Shipped solvers behind the names without n. Their networks are replaced by untrained ones for n pairs: a count depends
# on the architecture alone.
_ANY_N = {"net": "net-n9", "pnpnet": "pnpnet-n9", "pnpnet-paper": "pnpnet-n9-paper"}
# Problems in a run. RANSAC pads its samples to multiples of 64, so a batch of 64 needs next to no padding.
_BATCH = 64


def matmul(rows: int, inner: int, columns: int) -> float:
    """Matrix product (``flops_mul``)."""
    return rows * columns * ((inner - 1) * ADD + inner * MULTIPLY)


def cholesky(n: int) -> float:
    """Cholesky factorisation (``flops_chol``)."""
    return (n**3 - n) / 3 + n * (n - 1) / 2 * DIVIDE + n * SQRT


def solve(n: int, columns: int) -> float:
    """Gaussian elimination with partial pivoting, then two triangular systems for each right-hand side.

    Source: G. Golub and C. Van Loan, "Matrix Computations", 3rd edition, algorithm 3.4.1; ``flops_solve_tri``.
    """
    pairs = n * (n - 1) / 2
    return 2 * pairs * (2 * n - 1) / 3 + pairs * (DIVIDE + COMPARE) + columns * (2 * n * (n - 1) + n * DIVIDE)


def sort(n: int) -> float:
    """Sorting n numbers with n log2 n comparisons."""
    return n * math.log2(n) * COMPARE if n > 1 else 0


def smallest(n: int, k: int) -> float:
    """Selecting the k smallest of n numbers (R. Floyd and R. Rivest, CACM 18(3), 1975)."""
    return (n + min(k, n - k)) * COMPARE


# Names of PyTorch operations by their cost for each entry of the result. The first ones only create, move or view data,
# change signs or draw random numbers.
_ELEMENTWISE = {
    name: cost
    for names, cost in (
        ("_local_scalar_dense _to_copy _unsafe_view alias arange cat clone constant_pad_nd copy detach diag_embed", 0),
        ("diagonal empty empty_like expand eye fill flatten flip full full_like gather index index_copy index_put", 0),
        ("index_select lift_fresh masked_select neg new_empty new_full new_ones new_zeros nonzero ones ones_like", 0),
        ("permute promote_types rand randperm repeat roll scalar_tensor scatter select select_scatter slice split", 0),
        ("split_with_sizes squeeze stack t take_pairs transpose unbind unsqueeze view zero zeros zeros_like", 0),
        ("add rsub scatter_add sub", ADD),
        ("mul square", MULTIPLY),
        ("div floor_divide reciprocal remainder", DIVIDE),
        ("sqrt", SQRT),
        ("rsqrt", SQRT + DIVIDE),
        ("hypot", SQRT + ADD + 2 * MULTIPLY),
        ("logit", LOG + ADD + DIVIDE),
        ("exp exp2 expm1", EXP),
        ("acos atan2 cos erf lgamma log log1p sin tanh", LOG),
        ("sigmoid", EXP + ADD + DIVIDE),
        ("addcmul", MULTIPLY + ADD),
        ("addcdiv", DIVIDE + ADD),
        ("lerp", 2 * ADD + MULTIPLY),
        ("linalg_cross", ADD + 2 * MULTIPLY),
        ("ceil clamp_min eq ge gt isinf isnan le lt maximum minimum ne relu", COMPARE),
        ("abs copysign nan_to_num round sgn sign", 2 * COMPARE),
        ("bitwise_and bitwise_not bitwise_or logical_or masked_fill where", LOGIC),
    )
    for name in names.split()
}
# Cost for each input entry of a reduction, except for the first entry of each result.
_REDUCTIONS = {
    **dict.fromkeys(("cumsum", "sum"), ADD),
    "prod": MULTIPLY,
    **dict.fromkeys(("amax", "amin", "argmax", "argmin", "max", "min"), COMPARE),
    **dict.fromkeys(("all", "any"), LOGIC),
}
# Cost for one matrix of the batch, by the shapes of the input matrices.
_MATRIX: dict[str, Callable[..., float]] = {
    **dict.fromkeys(("mm", "bmm"), lambda a, b: matmul(a[0], a[1], b[1])),
    **dict.fromkeys(("addmm", "baddbmm"), lambda _, a, b: matmul(a[0], a[1], b[1]) + a[0] * b[1] * ADD),
    "mv": lambda a, _: matmul(a[0], a[1], 1),
    "linalg_cholesky_ex": lambda matrix: cholesky(matrix[0]),
    "linalg_inv_ex": lambda matrix: solve(matrix[0], matrix[0]),
    "_linalg_solve_ex": lambda matrix, right: solve(matrix[0], right[1]),
    "_linalg_det": lambda matrix: solve(matrix[0], 0) + (matrix[0] - 1) * MULTIPLY,
    "cholesky_solve": lambda right, factor: right[1] * 2 * factor[0] * (factor[0] - 1 + DIVIDE),
    # With both sets of vectors: about 21 n^3, half of them products. Source: as below, section 8.6.
    "_linalg_svd": lambda matrix: 10.5 * matrix[0] ** 3 * (ADD + MULTIPLY),
    # Tridiagonal form and QR iterations with eigenvectors: about 9 n^3, half of them products. Source: G. Golub and C.
    # Van Loan, "Matrix Computations", 4th edition, section 8.3.
    "_linalg_eigh": lambda matrix: 4.5 * matrix[0] ** 3 * (ADD + MULTIPLY),
}
# Cost for one row, by its length n and the arguments of the call.
_ROWS: dict[str, Callable[[int, dict[str, Any]], float]] = {
    "linalg_vector_norm": lambda n, _: (n - 1) * ADD + n * MULTIPLY + SQRT,
    # Subtract the maximum, divide the exponentials by their sum.
    "logsumexp": lambda n, _: 2 * (n - 1) * ADD + n * EXP + LOG + (n - 1) * COMPARE,
    "_softmax": lambda n, _: (2 * n - 1) * ADD + n * (DIVIDE + EXP) + (n - 1) * COMPARE,
    # Subtract the mean, divide by the root of variance plus epsilon, apply weight and bias.
    "native_layer_norm": lambda n, _: (4 * n - 1) * ADD + 3 * n * MULTIPLY + 3 * DIVIDE + SQRT,
    "kthvalue": lambda n, call: smallest(n, call["k"]),
    "nanmedian": lambda n, _: n * COMPARE + smallest(n, (n + 1) // 2),
    "sort": lambda n, _: sort(n),
    "topk": lambda n, call: smallest(n, call["k"]) + (sort(call["k"]) if call["sorted"] else 0),
    "_unique2": lambda n, _: sort(n),
}


def _power(exponent: Any) -> float:
    """Cost of a power (``flops_pow``): products and a root for a multiple of 1/2, else exponential and logarithm."""
    if isinstance(exponent, Tensor) or not float(2 * exponent).is_integer():
        return EXP + LOG + MULTIPLY
    whole, half = divmod(abs(exponent), 1)
    products = int(whole).bit_length() + int(whole).bit_count() - 2 if whole else 0
    root = (SQRT + min(whole, 1) * MULTIPLY) if half else 0
    return products * MULTIPLY + root + (DIVIDE if exponent < 0 else 0)


def _for_each_result(name: str, call: dict[str, Any]) -> float | None:
    """Cost for each entry of the result of an elementwise operation; ``None`` for other operations."""
    if name == "pow":
        return _power(call["exponent"])
    if name == "clamp":
        return sum(call[bound] is not None for bound in ("min", "max")) * COMPARE
    if name == "searchsorted":  # by bisection
        return int(call["sorted_sequence"].shape[-1] + 1).bit_length() * COMPARE
    scaled = name in ("add", "sub", "addcmul") and call.get("alpha", call.get("value", 1)) not in (1, -1)
    return _ELEMENTWISE[name] + (MULTIPLY if scaled else 0) if name in _ELEMENTWISE else None


def _operations(name: str, call: dict[str, Any], output: Any) -> float:
    """Cost of one call of the PyTorch operation ``aten.<name>`` with the given arguments and output."""
    each = _for_each_result(name, call)
    if each == 0:  # the output need not be a tensor
        return 0
    results = (output[0] if isinstance(output, tuple | list) else output).numel()
    if each is not None:
        return results * each
    tensors = [value for value in call.values() if isinstance(value, Tensor)]
    entries = tensors[0].numel() if tensors else 0
    if name == "mean":
        return (entries - results) * ADD + results * DIVIDE
    if name == "_cdist_forward":
        length = tensors[0].shape[-1]
        return results * ((2 * length - 1) * ADD + length * MULTIPLY + SQRT)
    if name in _MATRIX:
        return math.prod(tensors[0].shape[:-2]) * _MATRIX[name](*(tensor.shape[-2:] for tensor in tensors))
    if name in _REDUCTIONS:
        first = entries // tensors[0].shape[call["dim"]] if name == "cumsum" else results
        return (entries - first) * _REDUCTIONS[name]
    if name in _ROWS:
        shape, dims = call.get("normalized_shape", tensors[0].shape), call.get("dim")
        kept = range(len(shape)) if dims is None else [dims] if isinstance(dims, int) else dims
        length = math.prod(shape[dim] for dim in kept)
        return entries // max(length, 1) * _ROWS[name](length, call)
    raise NotImplementedError(f"The cost of aten.{name} is unknown. Add the cost to {__name__}.")


class OperationCounter(TorchDispatchMode):
    """Count the operations of the tensor code that runs inside a ``with`` block, in ``total``.

    ``NotImplementedError`` for a PyTorch operation whose cost is unknown, so that no operation is missed.
    """

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.total = 0.0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        with self:  # in inference mode, operations that consist of others arrive whole
            output = func.decompose(*args, **(kwargs or {}))
        if output is not NotImplemented:
            return output
        output = func(*args, **(kwargs or {}))
        names = [argument.name for argument in func._schema.arguments]
        call = {argument.name: argument.default_value for argument in func._schema.arguments}
        call |= dict(zip(names, args, strict=False)) | (kwargs or {})
        self.total += _operations(func.overloadpacket.__name__.rstrip("_"), call, output)
        return output


def count_per_problem(run: Callable[[int], object], batch: int = 2) -> float:
    """Measure the cost that each further problem of a batch adds, by runs of ``batch`` and of ``2 * batch`` problems.

    Operations that a batch executes once for all problems cancel out. ``run`` solves a batch of the given size.
    """
    counts = []
    for size in (batch, 2 * batch):
        with torch.no_grad(), OperationCounter() as counter:
            run(size)
        counts.append(counter.total)
    return (counts[1] - counts[0]) / batch


def operation_count(solver: str | PnPNet, n: int, *, outliers: int = 0) -> float:
    """Count the operations that a solver executes for one problem of ``n`` pairs, by running it.

    The names ``net``, ``pnpnet`` and ``pnpnet-paper`` stand for networks that are built for ``n`` pairs. A named solver
    has the fixed effort, because the operations of a search depend on the data. Only the counts of RANSAC depend on
    ``outliers``. ``ValueCheckError`` when the solver does not run in PyTorch.
    """
    runnable = _solver(solver, n) if isinstance(solver, str) else solver
    mix = OutlierMix(count=outliers)
    problems = SyntheticProblems(n=n, batch_size=_BATCH, outliers=mix, img_sigma=0.0, world_sigma=0.0).batch(0)

    def run(batch: int) -> None:
        runnable(*(torch.cat([x] * (batch // _BATCH)) for x in problems[:3]))

    run(_BATCH)  # what is computed once and kept is not counted
    return count_per_problem(run, _BATCH)


def _solver(spec: str, n: int) -> PnPNet:
    name, colon, options = spec.partition(":")
    solver = load_solver(_ANY_N.get(name, name) + colon + options)
    if not isinstance(solver, PnPNet):
        raise ValueCheckError(f"The operations of {spec!r} cannot be counted: it is not a solver in PyTorch.")
    if name in _ANY_N:
        solver.init = MLPInit(n)
    solver.effort = "fixed"
    return solver


def complexity_results(solvers: Sequence[str] = SOLVERS, n: Iterable[int] = range(6, 51)) -> dict[str, Any]:
    """Count the operations of solvers for the results file behind figure 1, with a third of outliers.

    ``counts`` has one number for each solver and n, ``None`` where a sample of RANSAC has more than n pairs.
    """
    sizes = list(n)
    inits = {name: _solver(name, n=9).init for name in solvers}
    samples = {name: init.minimal.sample_size for name, init in inits.items() if isinstance(init, RANSAC)}

    def count(name: str, n: int) -> float | None:
        return operation_count(name, n, outliers=n // 3) if n >= samples.get(name, 0) else None

    counts = {name: [count(name, size) for size in sizes] for name in solvers}
    made = {"kind": "complexity", "format": 1, "n": sizes, "counts": counts, "ransac": list(samples)}
    outliers = [size // 3 for size in sizes]
    return {**made, "outliers": outliers, "costs": OPERATION_COSTS, "environment": environment()}
