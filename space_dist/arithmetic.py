"""One arithmetic: the same bits on every x86-64 CPU with AVX2 and FMA, Intel's or AMD's, with or without AVX-512.

Libraries choose their kernels by the CPU they find, and kernels differ in how they round and in which order they add.
What they choose from is read from the environment when they are loaded, so `settle` runs before anything else of this
package (`space_dist/__init__.py`), and whatever a process of ours starts inherits it. What cannot be held to one kernel
this way is computed by another formula: `learner.elementary`.

Whether it worked is not believed but measured: `digest` is a hash of what the kernels that we use compute. Equal
digests promise equal bits; `REFERENCE` is what published numbers and golden digests are made with.
"""

from __future__ import annotations

import functools
import hashlib
import math
import os
import platform
import sys
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # NumPy must not be loaded before `settle`, and `import space_dist` shall cost nothing
    from numpy.typing import NDArray

SETTINGS = {
    # MKL's one code path that Intel promises to be the same on all CPUs. AVX2 is not: MKL multiplies matrices with
    # other kernels on Intel's CPUs than on AMD's under that name.
    "MKL_CBWR": "COMPATIBLE",
    "ATEN_CPU_CAPABILITY": "avx2",  # torch's own kernels
    "ONEDNN_MAX_CPU_ISA": "AVX2",  # torch's convolutions
    "OPENBLAS_CORETYPE": "Haswell",  # NumPy's and SciPy's products: OpenBLAS's kernels for AVX2 and FMA
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",  # np.log and others have AVX-512 variants
}
"""What libraries read when they are loaded, on a CPU that has AVX2 and FMA."""

REFERENCE = {"numpy": "e630e599df894ccc", "all": "9a84082eb5e4898d"}
"""`digest` of NumPy's part, and of everything, on x86-64 with AVX2 and FMA, with the versions of constraints.txt."""

CHOICE = "SPACE_DIST_ARITHMETIC"
"""What a process computes with, in its environment: `one` (or nothing), or `native`, the libraries' own choice by CPU,
for runs whose config says so. It is read before libraries are loaded, when no config is known yet."""

_DIGITS = 16
_NEEDED = {"avx2", "fma"}
_overruled: dict[str, str] = {}
_late: list[str] = []


def settle() -> None:
    """Make the settings for this process and its children; note what was overruled, and warn of what came too late.

    Leaves another kind of CPU alone, and a process that is to be `native`: there the libraries' own choice holds, and
    `digest` tells it apart. So it does in somebody's script that has imported Stable-Baselines3 before us, where we are
    guests: half of the settings would come too late, and the other half have MKL take five times as long for a product.
    """
    if chosen() == "native":
        for name, ours in SETTINGS.items():
            if os.environ.get(name) == ours:  # from a process of ours that is not
                del os.environ[name]
        return
    if not has_reference_cpu():
        return
    before = {name: os.environ.get(name) for name in SETTINGS}
    if before != SETTINGS and "stable_baselines3" in sys.modules:
        _late.append("Stable-Baselines3")
        return
    os.environ.update(SETTINGS)
    _overruled.update(
        {name: given for name, given in before.items() if given is not None and given != SETTINGS[name]}
    )  # fmt: skip
    loaded = [name for name in ("numpy", "torch") if name in sys.modules]
    if before != SETTINGS and loaded:
        _late.extend(loaded)
        if digest(numpy_checks()) != REFERENCE["numpy"]:  # on some CPUs the libraries' own choice is the same
            warnings.warn(
                f"{' and '.join(loaded)} had been imported before space_dist, too late for the settings that make "
                "results the same on every CPU: import space_dist first",
                stacklevel=3,
            )


def chosen() -> str:
    """What the environment asks of this process: `one` or `native` (or what is neither, which no run begins with)."""
    return os.environ.get(CHOICE) or "one"


def settings() -> dict[str, str]:
    """The variables with which a process elsewhere chooses as this one does."""
    if chosen() == "native":
        return {CHOICE: "native"}
    return SETTINGS if has_reference_cpu() else {}


def has_reference_cpu() -> bool:
    """Whether this is an x86-64 CPU with AVX2 and FMA. Elsewhere some of the settings would end the process."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return False
    try:
        with Path("/proc/cpuinfo").open() as file:
            flags = next((line.partition(":")[2].split() for line in file if line.startswith("flags")), [])
    except OSError:
        return False
    return set(flags) >= _NEEDED


def overruled() -> list[str]:
    """A sentence for each setting of the user's that gave way to ours in this process."""
    return [
        f"{name}={given} of the environment is overruled by {name}={SETTINGS[name]}: results are the same on every CPU"
        for name, given in sorted(_overruled.items())
    ]


def imported_before() -> str:
    """What had been imported before this package, too late for its settings; empty if there was nothing."""
    return " and ".join(_late)


def remarks(found: str) -> list[str]:
    """Sentences about this process's arithmetic, whose `digest` of everything is `found`: for the log of a run."""
    if chosen() == "native":
        return [
            f"arithmetic: native: libraries choose their kernels by the CPU ({found}); results are valid, and "
            "repeatable on CPUs of this kind, but are not the bits of other machines"
        ]
    if found == REFERENCE["all"]:
        return overruled()
    if not has_reference_cpu():
        reason = f"this is no x86-64 CPU with AVX2 and FMA ({platform.machine()})"
    elif _late:
        reason = f"{imported_before()} had been imported before space_dist"
    else:
        reason = "the libraries, or the system's libm, are other versions than those of constraints.txt and Debian 12"
    return [
        *overruled(),
        f"this process's arithmetic ({found}) is not the reference ({REFERENCE['all']}): {reason}. Results are valid "
        "and repeatable where arithmetic is this, but are not the bits of other machines; the run says so in its "
        "fingerprint",
    ]


def digest(checks: Iterable[tuple[str, Any]]) -> str:
    """`(16 hex digits)` a hash of what checks computed: equal for processes that compute the same bits."""
    total = hashlib.sha256()
    for name, values in checks:
        total.update(name.encode())
        total.update(values.tobytes())
    return total.hexdigest()[:_DIGITS]


@functools.cache
def numpy_digest() -> str:
    """`digest` of what every process of ours computes with, actors included: NumPy and the system's libm."""
    return digest(numpy_checks())


def numpy_checks() -> Iterator[tuple[str, NDArray[Any]]]:
    """What NumPy and libm compute of fixed numbers, by kernel; a few milliseconds."""
    import numpy as np

    # Numbers from integers alone: what is checked must not depend on what is to be checked.
    values: Any
    ramp = (np.arange(4096, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15) >> np.uint64(11)).astype(np.float64)
    doubles = ramp * 2.0**-52 - 1.0  # in [-1, 1)
    for kind in (np.float32, np.float64):
        values = doubles.astype(kind)
        positive = np.abs(values) * kind(10) + kind(1e-3)
        for function in (np.exp, np.tanh, np.sin, np.cos, np.expm1, np.arctan):
            yield function.__name__, function(values * kind(5))
        for rising in (np.log, np.log1p, np.sqrt):
            yield rising.__name__, rising(positive)
        yield "power", positive ** kind(1.7)
        yield "arctan2", np.arctan2(values, values[::-1])
        for rows, inner, columns in ((1, 5, 64), (16, 64, 64), (60, 64, 2), (64, 33, 1), (33, 21, 17)):
            left, right = values[: rows * inner].reshape(rows, inner), values[-inner * columns :].reshape(inner, -1)
            yield "matmul", left @ right
        stack = values.reshape(8, 16, 32)
        yield "stacked matmul", stack @ stack.transpose(0, 2, 1)
        yield "einsum", np.einsum("ij,ij->i", values.reshape(64, 64), values.reshape(64, 64)[::-1])
        yield "sums", np.concatenate([values[:100].reshape(10, 10).sum(axis=axis) for axis in (0, 1)])
        yield "sum", np.array([values.sum(), values.mean(), values.std(), values @ values])
    with np.errstate(all="ignore"):
        yield "order", np.argsort(np.round(doubles, 1))
    random = np.random.default_rng(1)
    yield "normal", random.standard_normal(512)
    yield "normal32", random.standard_normal(512, dtype=np.float32)
    yield "gumbel", random.gumbel(size=256)
    yield "gamma", random.gamma(0.7, size=256)
    yield "integers", random.integers(1000, size=64)
    one = (math.exp, math.tanh, math.sin, math.cos, math.tan, math.atan, math.log1p, math.expm1)
    yield "libm", np.array([function(value) for function in one for value in doubles[1:129].tolist()])
    yield "libm of positive", np.array([
        [math.log(value), math.sqrt(value), math.pow(value, 0.3), math.asin(value), math.acos(value)]
        for value in np.abs(doubles[1:128]).tolist()
    ])  # fmt: skip


def scipy_checks() -> Iterator[tuple[str, NDArray[Any]]]:
    """What SciPy's linear algebra computes, of which SPDRL's optimiser and the reports' statistics are made."""
    import numpy as np
    from scipy import linalg, special

    values = (np.arange(400, dtype=np.float64) * 0.754877666 % 1.0 - 0.5).reshape(20, 20)
    spread = values @ values.T + 20.0 * np.eye(20)
    yield "cholesky", linalg.cholesky(spread, lower=True)
    yield "solve_triangular", linalg.solve_triangular(linalg.cholesky(spread, lower=True), values, lower=True)
    yield "qr", linalg.qr(values)[1]
    yield "svd", linalg.svd(values, compute_uv=False)
    yield "eigh", linalg.eigh(spread, eigvals_only=True)
    yield "logsumexp", special.logsumexp(values, axis=1)
