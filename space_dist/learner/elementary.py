"""Functions of torch's whose bits depend on the CPU, or are slow where they don't, by NumPy; a check of the others.

torch computes some elementary functions of contiguous tensors with MKL's vector library, which starts from the CPU's
own approximations (`rsqrtps`, `rcpps`) in all of its code paths, `MKL_CBWR=COMPATIBLE` included; these approximations
are not the same on Intel's and AMD's CPUs. Adam's square root is one of them. NumPy's square root is the exactly
rounded one of IEEE 754, on every CPU; its other functions have one code path under the settings of `arithmetic`.

`x ** 0.5` and `torch.cdist` reach MKL on a way that cannot be replaced: a policy of your own that wants the same bits
on every CPU uses `torch.sqrt`. exp, log, tanh, sin, cos and erf are the same everywhere as they are (`arithmetic`).

Products of stacked matrices (`bmm`, `baddbmm`), of which populations' updates are made, are OpenBLAS's, product by
product: under the settings of `arithmetic` its kernels are AVX2's, and MKL's a third as fast.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from space_dist.arithmetic import chosen

_REPLACED: dict[str, np.ufunc] = {
    "sqrt": np.sqrt, "asin": np.arcsin, "acos": np.arccos, "atan": np.arctan, "tan": np.tan,
}  # fmt: skip
_KNOWN_TO_NUMPY = (torch.float32, torch.float64, torch.complex64, torch.complex128)


def _replace() -> object:
    """Give torch's dispatcher other kernels for tensors on the CPU; derivatives are torch's own, as before."""
    library: Any = torch.library.Library("aten", "IMPL")  # type: ignore[no-untyped-call]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # torch warns of every kernel that is replaced
        for name, function in _REPLACED.items():
            for overload, kernel in _kernels(function).items():
                library.impl(name + overload, kernel, "CPU")
        for name, product in _PRODUCTS.items():
            library.impl(name, product, "CPU")
    return library


def _kernels(function: np.ufunc) -> dict[str, Callable[..., torch.Tensor]]:
    """`function` of a tensor: as a new one, in place, and into another."""

    def new(values: torch.Tensor) -> torch.Tensor:
        if values.dtype in _KNOWN_TO_NUMPY:
            # torch gives NaN and infinity in silence.
            with np.errstate(all="ignore"):
                # asarray: of a tensor without dimensions NumPy makes a scalar.
                return torch.from_numpy(np.asarray(function(values.detach().numpy())))
        if values.dtype.is_floating_point:  # halves
            return new(values.float()).to(values.dtype)
        return new(values.to(torch.get_default_dtype()))

    def in_place(values: torch.Tensor) -> torch.Tensor:
        return values.copy_(new(values))

    def into(values: torch.Tensor, *, out: torch.Tensor) -> torch.Tensor:
        computed = new(values)
        if out.shape != computed.shape:
            out.resize_(computed.shape)
        return out.copy_(computed)

    return {"": new, "_": in_place, ".out": into}


def _array(values: torch.Tensor) -> NDArray[Any]:
    """The memory of a tensor, or, of a type that NumPy does not know, its values in single precision."""
    return (values if values.dtype != torch.bfloat16 else values.float()).detach().numpy()


def _product(left: torch.Tensor, right: torch.Tensor, out: NDArray[Any] | None = None) -> NDArray[Any]:
    if left.dim() != 3 or right.dim() != 3 or left.shape[0] != right.shape[0] or left.shape[2] != right.shape[1]:
        raise RuntimeError(f"stacks of shapes {tuple(left.shape)} and {tuple(right.shape)} have no products")
    return np.matmul(_array(left), _array(right), out=out)


def _bmm(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    return torch.from_numpy(_product(left, right)).to(left.dtype)


def _bmm_into(left: torch.Tensor, right: torch.Tensor, *, out: torch.Tensor) -> torch.Tensor:
    return _baddbmm_into(None, left, right, out=out)


def _baddbmm(
    added: torch.Tensor, left: torch.Tensor, right: torch.Tensor, *, beta: float = 1, alpha: float = 1
) -> torch.Tensor:
    return _plus(added, _product(left, right), beta, alpha).to(left.dtype)


def _baddbmm_in_place(
    added: torch.Tensor, left: torch.Tensor, right: torch.Tensor, *, beta: float = 1, alpha: float = 1
) -> torch.Tensor:
    return added.copy_(_baddbmm(added, left, right, beta=beta, alpha=alpha))


def _baddbmm_into(
    added: torch.Tensor | None, left: torch.Tensor, right: torch.Tensor, *, out: torch.Tensor, beta: float = 1,
    alpha: float = 1,
) -> torch.Tensor:  # fmt: skip
    shape = (*left.shape[:2], right.shape[-1])
    if out.shape != shape:
        out.resize_(shape)
    ours = out.dtype in _KNOWN_TO_NUMPY and left.dtype == out.dtype
    if ours and added is not None and np.may_share_memory(_array(added), _array(out)):
        ours = False  # it would be lost before it is added
    product = _product(left, right, _array(out) if ours else None)
    result = torch.from_numpy(product) if added is None else _plus(added, product, beta, alpha)
    return out if ours else out.copy_(result)


def _plus(added: torch.Tensor, product: NDArray[Any], beta: float, alpha: float) -> torch.Tensor:
    """`beta * added + alpha * product`, in the memory of `product`; where beta is 0, whatever `added` holds."""
    if alpha != 1:
        product *= alpha
    if beta == 1:
        product += _array(added)
    elif beta != 0:
        product += beta * _array(added)
    return torch.from_numpy(product)


_PRODUCTS: dict[str, Callable[..., torch.Tensor]] = {
    "bmm": _bmm, "bmm.out": _bmm_into, "baddbmm": _baddbmm, "baddbmm_": _baddbmm_in_place, "baddbmm.out": _baddbmm_into,
}  # fmt: skip

_library = _replace() if chosen() != "native" else None  # holds for as long as this is kept


def torch_checks() -> Iterator[tuple[str, NDArray[Any]]]:
    """What torch computes of fixed numbers, by kernel; a few milliseconds. Global generators are left as they were."""
    ramp = (np.arange(4096, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15) >> np.uint64(11)).astype(np.float64)
    values = torch.from_numpy((ramp * 2.0**-52 - 1.0).astype(np.float32))
    positive = values.abs() * 10 + 1e-3
    for name in ("exp", "tanh", "sigmoid", "sin", "cos", "erf", "expm1"):
        yield name, getattr(torch, name)(values * 5).numpy()
    for name in ("log", "sqrt", "rsqrt", "log1p", "reciprocal"):
        yield name, getattr(torch, name)(positive).numpy()
    for name in ("softplus", "mish", "elu", "silu"):
        yield name, getattr(torch.nn.functional, name)(values * 5).numpy()
    yield "log_softmax", torch.log_softmax(values.reshape(-1, 4), dim=1).numpy()
    yield "logsumexp", torch.logsumexp(values.reshape(-1, 4), dim=1).numpy()
    square = values.reshape(64, 64)
    yield "bmm", torch.bmm(values.reshape(8, 16, 32), values.reshape(8, 32, 16)).numpy()
    stack = values.reshape(4, 32, 32)
    yield "baddbmm", torch.baddbmm(values[:128].reshape(4, 1, 32), stack, stack.transpose(1, 2)).numpy()
    yield "double mm", (square.double() @ square.double()).numpy()
    yield "sums", torch.stack([values.sum(), values.mean(), values.std(), values.norm()]).numpy()
    yield "mean", square.mean(dim=1).numpy()
    yield "qr", torch.linalg.qr(square[:, :20])[1].numpy()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        yield "normal", torch.randn(100).numpy()
        yield "permutation", torch.randperm(100).numpy()
        yield "orthogonal", torch.nn.init.orthogonal_(torch.empty(64, 7)).numpy()
        yield from _update(square)


def _update(inputs: torch.Tensor) -> Iterator[tuple[str, NDArray[Any]]]:
    """One step of Adam, and of a convolution, forwards and backwards."""
    network = torch.nn.Sequential(torch.nn.Linear(64, 33), torch.nn.Tanh(), torch.nn.Linear(33, 5))
    convolution = torch.nn.Conv2d(1, 4, 3, stride=2)
    optimizer = torch.optim.Adam([*network.parameters(), *convolution.parameters()], lr=1e-2)
    loss = network(inputs).pow(2).mean() + torch.relu(convolution(inputs[None, None])).mean()
    loss.backward()
    optimizer.step()
    for parameter in (*network.parameters(), *convolution.parameters()):
        yield "updated", parameter.detach().numpy()
