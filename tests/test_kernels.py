"""Compiled arithmetic: how exact its functions are, that its bits are no CPU's, and how what is compiled is kept."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import mpmath
import numba
import numpy as np
import pytest
from numba.core import types
from numpy.typing import NDArray

from space_dist.kernels import Layout, Settings, Shape, aligned, build, dqn, functions, lanes, prepare, sac, td3
from space_dist.kernels.replay import ReplayLayout, ReplayShape
from tests.patience import PATIENCE

ROOT = Path(__file__).resolve().parent.parent


def applied(function: Any, numbers: NDArray[Any]) -> NDArray[Any]:
    """A function of lanes, of numbers whose count is a multiple of sixteen."""

    @numba.njit(error_model="numpy")
    def every_one(x: Any, y: Any) -> None:
        for at in range(0, len(x), lanes.width(x)):
            lanes.store(y, at, function(lanes.load(x, at)))

    found = np.empty_like(numbers)
    every_one(numbers, found)
    return found


def units(found: NDArray[Any], exact: NDArray[np.longdouble]) -> float:
    """The largest error in units of the last place of the exact results."""
    with np.errstate(under="ignore"):
        place = np.spacing(np.abs(exact.astype(found.dtype))).astype(np.longdouble)
    return float(np.max(np.abs(found - exact) / place))


def bits_between(low: float, high: float, step: int) -> NDArray[np.float32]:
    """Every `step`-th float32 from one positive number to another."""
    ends = np.array([low, high], dtype=np.float32).view(np.uint32)
    found = np.arange(ends[0], ends[1], step, dtype=np.uint32).view(np.float32)
    return found[: len(found) // 16 * 16]


SINGLE: dict[str, tuple[Any, Any, float, list[NDArray[np.float32]]]] = {
    "exp": (functions.exp, np.exp, 1.0, [bits_between(1e-30, 88.722, 997), -bits_between(1e-30, 87.33, 997)]),
    "log": (functions.log, np.log, 1.0, [bits_between(1.2e-38, 1e38, 997), bits_between(0.4, 1.6, 3)]),
    "tanh": (functions.tanh, np.tanh, 6.0, [bits_between(1e-30, 12.0, 997), -bits_between(1e-30, 12.0, 997)]),
}


@pytest.mark.parametrize("name", SINGLE)
def test_functions_of_float32_are_as_exact_as_their_table_says(name: str) -> None:
    function, exact, limit, inputs = SINGLE[name]
    for numbers in inputs:
        assert units(applied(function, numbers), exact(numbers.astype(np.longdouble))) <= limit


DOUBLE: dict[str, tuple[Any, Any, float, float, float]] = {
    "exp": (functions.exp, mpmath.exp, 1.0, -708.0, 709.0),
    "log": (functions.log, mpmath.log, 1.0, 1.0, 1e6),
    "log of little": (functions.log, mpmath.log, 1.0, 1e-7, 1.5),
    "tanh": (functions.tanh, mpmath.tanh, 4e-16, -20.0, 20.0),
}


@pytest.mark.parametrize("name", DOUBLE)
def test_functions_of_float64_are_as_exact_as_their_table_says(name: str) -> None:
    function, exact, limit, low, high = DOUBLE[name]
    numbers = np.random.default_rng(0).uniform(low, high, 4096)
    with mpmath.workdps(40):
        results = [np.longdouble(mpmath.nstr(exact(mpmath.mpf(float(number))), 25)) for number in numbers]
    found = applied(function, numbers)
    error = np.max(np.abs(found - np.array(results))) if name == "tanh" else units(found, np.array(results))
    assert error <= limit


def test_functions_at_their_ends() -> None:
    numbers = np.zeros(16, dtype=np.float32)
    numbers[:6] = [np.nan, np.inf, -np.inf, 1e30, -1e30, -0.0]
    with np.errstate(over="ignore"):
        np.testing.assert_array_equal(applied(functions.exp, numbers)[:6], np.exp(numbers[:6]))
    np.testing.assert_array_equal(applied(functions.tanh, numbers)[:6], np.tanh(numbers[:6]))


def test_sums_and_blocks_are_what_they_say() -> None:
    @numba.njit
    def summed(m: Any) -> float:
        return lanes.total(lanes.load(m, 0))

    @numba.njit
    def turned(m: Any, source: int, target: int) -> None:
        lanes.transpose(m, source, target)

    for dtype in (np.float32, np.float64):
        count = 64 // np.dtype(dtype).itemsize
        m = np.concatenate([np.random.default_rng(0).normal(size=count**2), np.zeros(count**2)]).astype(dtype)
        halves = m[:count]
        while len(halves) > 1:
            halves = halves[: len(halves) // 2] + halves[len(halves) // 2 :]
        assert summed(m) == halves[0]
        turned(m, 0, count**2)
        np.testing.assert_array_equal(m[count**2 :].reshape(count, count), m[: count**2].reshape(count, count).T)


@pytest.mark.parametrize(("rows", "panels"), [(1, 1), (4, 1), (8, 2)])
def test_products_have_one_order_whatever_registers_hold(rows: int, panels: int) -> None:
    """A chain of fused multiply-adds, of which each is the float64 result rounded once more, rarely in another way."""
    block, random = lanes.product(rows, panels), np.random.default_rng(0)

    @numba.njit
    def multiplied(m: Any, c: int, a: int, b: int, start: int, count: int) -> None:
        block(m, c, rows * 16, start, 0, 0, a, 16, 1, rows * 16 - 16, 16, b, count * 16, count)

    count, a, b, c = 40, 0, 48 * rows, 48 * rows + 40 * 16 * panels
    m = np.concatenate([random.normal(size=c), np.full(rows * 16 * panels, 9.0), np.zeros(16)]).astype(np.float32)
    left = m[a:b].reshape(3, rows, 16).swapaxes(0, 1).reshape(rows, 48)[:, :count]
    right = m[b:c].reshape(panels, count, 16)
    multiplied(m, c, a, b, len(m) - 16, count)
    exact = np.einsum("rk,pkl->prl", left.astype(np.float64), right.astype(np.float64))
    found = m[c : c + rows * 16 * panels].reshape(panels, rows, 16)
    np.testing.assert_allclose(found, exact, rtol=0.0, atol=2e-5)
    chain = np.zeros_like(found)
    for k in range(count):
        chain = (chain.astype(np.float64) + left[None, :, k, None].astype(np.float64) * right[:, None, k]).astype("f4")
    assert np.mean(found == chain) > 0.99


# ---- the same bits everywhere ----


def learnt() -> str:
    """A digest of what a few minibatches leave of small networks: every kind of head and unit, odd sizes."""
    digest, random = hashlib.sha256(), np.random.default_rng(0)
    update, evaluate, _ = prepare(np.dtype(np.float32))
    for discrete, activation in ((False, "tanh"), (True, "relu")):
        shape = Shape(7, 3, discrete, (40, 19), activation)
        layout = Layout.of(shape, 50, 4)
        m = aligned(layout.size, np.float32)
        for places in layout.places.values():
            m[places] = 0.3 * random.normal(size=len(places))
        samples = np.zeros((130, layout.plan.record), dtype=np.float32)
        samples[:, : shape.inputs] = random.normal(size=(130, shape.inputs))
        fields = samples[:, layout.record_at : layout.record_at + layout.plan.fields]
        fields[:] = random.integers(0, 3, size=(130, 1)) if discrete else random.normal(size=fields.shape)
        orders = np.stack([random.permutation(130) for _ in range(3)])
        outputs, values, log_probs = np.zeros((130, 3), "f4"), np.zeros(130, "f4"), np.zeros(130, "f4")
        evaluate(m, layout.plan, layout.layers, samples.ravel(), orders[0], outputs, values, log_probs)
        fields[orders[0], -4] = log_probs
        settings = Settings(1e-3, 0.9, 0.999, 1e-5, 0, 0.2, 0.3, 0.01, 0.5, 0.5, np.inf, True)
        told = np.zeros((9, 6))
        done = update(m, layout.plan, layout.layers, settings, samples.ravel(), orders, 50, told)
        assert done == (9, 9, 3)
        for array in (outputs, values, log_probs, m[: layout.plan.length], told):
            assert np.isfinite(array).all()
            digest.update(array.tobytes())
    for algorithm in ("dqn", "td3", "sac"):
        digest.update(learnt_from_samples(algorithm, random))
    return digest.hexdigest()


def learnt_from_samples(algorithm: Any, random: np.random.Generator) -> bytes:
    """What three gradient steps on samples leave of an off-policy learner's networks, targets and optimisers."""
    shape = ReplayShape(algorithm, 7, 3, (40, 19), "tanh" if algorithm == "td3" else "relu")
    layout = ReplayLayout.of(shape, 50, 4)
    m, actions = aligned(layout.size, np.float32), random.uniform(-1.0, 1.0, size=(150, 3)).astype("f4")
    for places in layout.places.values():
        m[places] = 0.3 * random.normal(size=len(places))
    observed, following, noise, more = random.normal(size=(4, 150, 7)).astype("f4")
    rewards, factors = random.normal(size=(2, 150, 1)).astype("f4")
    samples = [observed, following, actions, rewards, factors]
    if algorithm == "dqn":
        samples[2] = random.integers(0, 3, size=(150, 1)).astype("f4")
    told, adam = np.zeros((3, {"dqn": dqn, "td3": td3, "sac": sac}[algorithm].N_RECORDED)), (1e-3, 0.9, 0.999, 1e-8)
    arguments: tuple[Any, ...] = m, layout.plan, layout.layers
    if algorithm == "dqn":
        dqn.prepare(np.dtype("f4"))(*arguments, dqn.Settings(*adam, 0, 10.0), *samples, 50, told)
    elif algorithm == "td3":
        settings = td3.Settings(*adam, 0, 0, 0, 2, 0.05)
        td3.prepare(np.dtype("f4"))(*arguments, settings, *samples, noise[:, :3].copy(), 50, told)
    else:
        noises = noise[:, :3].copy(), more[:, :3].copy()
        sac.prepare(np.dtype("f4"))(
            *arguments, sac.Settings(*adam, 0, 0, 1, 0.05, True, 0.0, -3.0), *samples, *noises, 50, told
        )
    length = layout.plan.length
    everything = m[: layout.plan.targets + length]
    unused = np.ones(length, dtype=np.bool_)  # what is too much is zero, and stays it
    unused[np.concatenate([places for places in layout.places.values() if places[0] < length])] = False
    assert not everything.reshape(5, length)[:, unused].any()
    assert np.isfinite(everything).all()
    assert np.isfinite(told).all()
    return everything.tobytes() + told.tobytes()


def test_what_optimisers_remember_of_dead_units_vanishes_at_once() -> None:
    """Numbers below the normal ones take many times as long, and would stay: 0.9 of the least rounds to the least."""
    layout = ReplayLayout.of(ReplayShape("dqn", 7, 3, (40,), "relu"), 16, 4)
    m, length, random = aligned(layout.size, np.float32), layout.plan.length, np.random.default_rng(0)
    weights, biases = (layout.places[f"q_net.q_net.0.{name}"] for name in ("weight", "bias"))
    m[weights], m[biases] = random.normal(size=(2, 280))[0], -100.0  # nothing is ever active
    m[2 * length + weights], m[3 * length + weights] = 1e-37, 2e-38
    before, told = m[weights].copy(), np.zeros((60, dqn.N_RECORDED))
    samples = [random.normal(size=(60 * 16, columns)).astype("f4") for columns in (7, 7, 1, 1, 1)]
    samples[2] = random.integers(0, 3, size=(60 * 16, 1)).astype("f4")
    settings = dqn.Settings(1e-3, 0.9, 0.99, 1e-8, 1000, 10.0)
    dqn.prepare(np.dtype("f4"))(m, layout.plan, layout.layers, settings, *samples, 16, told)
    np.testing.assert_array_equal(m[weights], before)
    assert not m[2 * length + weights].any()
    assert not m[3 * length + weights].any()
    assert m[2 * length + layout.places["q_net.q_net.2.bias"]].all()


def test_another_cpus_code_has_the_same_bits(tmp_path: Path) -> None:
    """Without AVX and FMA: vectors of four, and the C library's `fmaf`, which rounds once as well."""
    code = "from tests.test_kernels import learnt; print(learnt())"
    environment = os.environ | {
        "NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": "-avx,-fma,-avx2", "NUMBA_CACHE_DIR": str(tmp_path),
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, env=environment, timeout=PATIENCE
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == learnt()


# ---- what is compiled is kept ----


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where compiled functions are kept."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "numba"))
    return tmp_path / "numba"


def small_entry() -> Any:
    """A function that compiles in a moment."""
    return numba.njit(_doubled)


def _doubled(x: float) -> float:
    return 2.0 * x


def test_the_second_time_it_is_loaded(place: Path) -> None:
    first, second = small_entry(), small_entry()
    build.ready([(first, (1.0,))])
    assert sum(first.stats.cache_misses.values()) == 1
    build.ready([(second, (1.0,))])
    assert sum(second.stats.cache_hits.values()) == 1
    assert second(4.0) == 8.0
    (folder,) = (place / "kernels").iterdir()
    assert folder.stat().st_mode & 0o777 == 0o700


def test_a_damaged_file_costs_a_compilation(place: Path) -> None:
    build.ready([(small_entry(), (1.0,))])
    (data,) = place.rglob("*.nbc")
    data.write_bytes(b"not a pickle")
    again = small_entry()
    build.ready([(again, (1.0,))])
    assert again(4.0) == 8.0
    assert not list(place.rglob("*.nbc"))  # gone, for the next to compile


def test_a_folder_that_others_may_write_to_is_not_run(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (place / "kernels").mkdir(parents=True)
    (place / "kernels").chmod(0o777)
    monkeypatch.setenv("XDG_CACHE_HOME", str(place.parent / "cache"))
    build.ready([(small_entry(), (1.0,))])
    assert not list(place.rglob("*.nbc"))
    assert len(list((place.parent / "cache").rglob("*.nbc"))) == 1


def test_under_a_groups_umask_the_folders_are_still_the_users_own(place: Path) -> None:
    before = os.umask(0o002)
    try:
        build.ready([(small_entry(), (1.0,))])
    finally:
        os.umask(before)
    assert len(list(place.rglob("*.nbc"))) == 1


def test_without_any_folder_it_still_compiles(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    nowhere = tmp_path / "file"
    nowhere.touch()
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, str(nowhere))
    monkeypatch.setattr(build.tempfile, "gettempdir", lambda: str(nowhere))
    entry = small_entry()
    build.ready([(entry, (1.0,))])
    assert entry(4.0) == 8.0


def test_of_several_processes_one_compiles(place: Path) -> None:
    code = (
        "from tests.test_kernels import small_entry; from space_dist.kernels import build; entry = small_entry(); "
        "build.ready([(entry, (1.0,))]); print(sum(entry.stats.cache_misses.values()))"
    )
    processes = [
        subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True) for _ in range(3)
    ]
    assert sorted(int(one.communicate(timeout=PATIENCE)[0]) for one in processes) == [0, 0, 1]
    assert len(list(place.rglob("*.nbc"))) == 1


def test_a_lock_that_is_never_given_back_is_waited_for_no_longer_than_patience(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build, "_PATIENCE", 0.2)
    place.mkdir()
    with build._alone(place, lambda: False):
        start = time.monotonic()
        with build._alone(place, lambda: False):
            assert time.monotonic() - start >= 0.2


def test_only_what_was_prepared_is_compiled() -> None:
    update = prepare(np.dtype(np.float32)).update
    with pytest.raises((TypeError, RuntimeError)):
        update(np.zeros(1, np.float16), *([0] * 7))
    assert {signature[0].dtype for signature in update.signatures} <= {types.float32, types.float64}
