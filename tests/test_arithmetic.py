"""One arithmetic: settings before libraries, exact square roots, and a fingerprint of what is computed."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from space_dist import arithmetic
from space_dist import config as configs
from space_dist.arithmetic import REFERENCE, SETTINGS, digest, numpy_digest, remarks, settle
from space_dist.errors import ConfigError
from space_dist.learner import torch_checks
from space_dist.run.launch import launch
from space_dist.system.interrupts import StopRequests
from tests.patience import PATIENCE

ROOT = Path(__file__).resolve().parent.parent

pytestmark = pytest.mark.skipif(not arithmetic.has_reference_cpu(), reason="settings are for x86-64 with AVX2 and FMA")


def fresh(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """A new interpreter that inherits none of our settings."""
    inherited = {name: value for name, value in os.environ.items() if name not in SETTINGS}
    return subprocess.run(
        [sys.executable, "-c", code], env=inherited | environment, capture_output=True, text=True, check=True
    )  # fmt: skip


def test_importing_us_settles_this_process_and_its_children() -> None:
    said = fresh(f"import space_dist, os; print({{name: os.environ[name] for name in {list(SETTINGS)}}} == "
                 "space_dist.arithmetic.SETTINGS)")  # fmt: skip
    assert (said.stdout, said.stderr) == ("True\n", "")


@pytest.mark.parametrize("given", ["AVX2", "AUTO", "COMPATIBLE"])
def test_ours_wins_over_the_users_and_says_so(given: str) -> None:
    code = "import sys; sys.argv[1:] = ['--help']; from space_dist.cli import main; main()"
    said = fresh(code, MKL_CBWR=given).stderr
    assert said == (
        "" if given == "COMPATIBLE" else
        f"space-dist: MKL_CBWR={given} of the environment is overruled by MKL_CBWR=COMPATIBLE: results are the same on "
        "every CPU\n"
    )  # fmt: skip


def test_a_numpy_that_was_there_before_is_noticed() -> None:
    early = fresh("import numpy; import space_dist", OPENBLAS_CORETYPE="Prescott").stderr
    assert "numpy had been imported before space_dist, too late for the settings" in early
    assert fresh("import space_dist; import numpy").stderr == ""


def test_another_kind_of_cpu_is_left_alone_and_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arithmetic, "has_reference_cpu", lambda: False)
    monkeypatch.setenv("MKL_CBWR", "AUTO")
    settle()
    assert os.environ["MKL_CBWR"] == "AUTO"
    (said,) = remarks("0123456789abcdef")
    assert "is not the reference" in said
    assert "no x86-64 CPU with AVX2 and FMA" in said


def test_the_reference_needs_no_words_and_anything_else_does() -> None:
    assert remarks(REFERENCE["all"]) == []
    (said,) = remarks("0123456789abcdef")
    assert "other versions than those of constraints.txt" in said


def test_the_digest_is_of_bits() -> None:
    values = np.linspace(0.0, 1.0, 7)
    moved = values.copy()
    moved[3] = np.nextafter(moved[3], 1.0)
    assert digest([("a", values)]) != digest([("a", moved)])
    assert digest([("a", values)]) != digest([("b", values)])
    assert numpy_digest() == digest(arithmetic.numpy_checks())
    assert digest(torch_checks()) == digest(torch_checks())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_square_roots_are_exactly_rounded(dtype: torch.dtype) -> None:
    """MKL's are not, and not equal on Intel's and AMD's CPUs; Adam takes one of every weight's second moment."""
    values = torch.from_numpy(np.random.default_rng(0).random(5000) * 100).to(dtype)
    exact = np.sqrt(values.numpy())
    into, here = torch.empty(0, dtype=dtype), values.clone()
    torch.sqrt(values, out=into)
    here.sqrt_()
    strided = values.reshape(50, 100).t().sqrt().t().reshape(-1)
    for found in (values.sqrt(), into, here, strided, torch._foreach_sqrt([values])[0]):
        np.testing.assert_array_equal(found.numpy(), exact)
    with torch.inference_mode():
        np.testing.assert_array_equal(values.sqrt().numpy(), exact)


def test_what_is_replaced_still_has_derivatives_and_takes_every_kind() -> None:
    values = torch.tensor([0.25, 0.5], requires_grad=True)
    for function, derivative in (
        (torch.sqrt, lambda x: 0.5 / x**0.5), (torch.atan, lambda x: 1 / (1 + x**2)),
        (torch.asin, lambda x: (1 - x**2) ** -0.5), (torch.tan, lambda x: 1 / torch.cos(x) ** 2),
    ):  # fmt: skip
        (gradient,) = torch.autograd.grad(function(values).sum(), values)
        torch.testing.assert_close(gradient, derivative(values.detach()))
    assert torch.sqrt(torch.tensor([4, 9])).tolist() == [2.0, 3.0]
    assert torch.sqrt(torch.tensor(4.0)).shape == ()
    assert torch.sqrt(torch.tensor([4.0], dtype=torch.bfloat16)).dtype == torch.bfloat16
    assert torch.isnan(torch.sqrt(torch.tensor(-1.0)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16, torch.int64])
@pytest.mark.parametrize("shape", [(3, 4, 5, 6), (1, 1, 5, 7), (2, 33, 17, 1)])
def test_products_of_stacks_are_what_they_should_be(shape: tuple[int, int, int, int], dtype: torch.dtype) -> None:
    """In each way that they can be asked for, against sums in double precision; transposed operands among them."""
    count, rows, inner, columns = shape
    generator = torch.Generator().manual_seed(0)
    left = torch.randn(count, rows, inner, generator=generator).mul(3).to(dtype)
    right = torch.randn(count, columns, inner, generator=generator).mul(3).to(dtype).transpose(1, 2)
    added = torch.randn(count, 1, columns, generator=generator).mul(3).to(dtype)
    exact = (left.double()[:, :, :, None] * right.double()[:, None]).sum(dim=2)
    within = {"rtol": 0.02, "atol": 0.2} if dtype == torch.bfloat16 else {"rtol": 1e-5, "atol": 1e-5}

    def same(found: torch.Tensor, expected: torch.Tensor) -> None:
        assert found.dtype == dtype
        torch.testing.assert_close(found.double(), expected, **within)

    into, turned = torch.empty(0, dtype=dtype), torch.empty(count, columns, rows, dtype=dtype).transpose(1, 2)
    same(torch.bmm(left, right), exact)
    same(torch.bmm(left, right, out=into), exact)
    same(into, exact)
    same(torch.bmm(left, right, out=turned), exact)
    same(torch.baddbmm(added, left, right), added.double() + exact)
    same(torch.baddbmm(added, left, right, beta=2, alpha=3), 2 * added.double() + 3 * exact)
    same(torch.baddbmm(added, left, right, out=into), added.double() + exact)
    same(torch.baddbmm(into, left, right, out=into), added.double() + 2 * exact)
    same(into.baddbmm_(left, right), added.double() + 3 * exact)
    if dtype.is_floating_point:
        same(torch.baddbmm(torch.full_like(added, float("nan")), left, right, beta=0), exact)
    with pytest.raises(RuntimeError, match="have no products"):
        torch.bmm(left, right[:, :-1])


def test_products_of_stacks_have_derivatives_and_no_companions() -> None:
    generator = torch.Generator().manual_seed(0)
    left, right = torch.randn(4, 16, 33, generator=generator), torch.randn(4, 33, 7, generator=generator)
    added = torch.randn(4, 1, 7, generator=generator)
    inputs = [one.double().requires_grad_() for one in (added, left, right)]
    assert torch.autograd.gradcheck(lambda *of: torch.baddbmm(*of) + torch.bmm(*of[1:]), inputs)
    for member in range(4):
        one = slice(member, member + 1)
        assert torch.equal(torch.baddbmm(added, left, right)[one], torch.baddbmm(added[one], left[one], right[one]))


RUN = """
import sys
sys.argv[1:] = ["train", "configs/pointmass_space.yaml", "--out", sys.argv[1], "--workers", "0", "--resume", "--set",
                "tracking.uri=null", "--set", "learner.n_steps=112", "--set", "rollout.slots=4", *sys.argv[2:]]
from space_dist.cli import main
main()
"""


def train(folder: Path, *settings: str, **environment: str) -> subprocess.CompletedProcess[str]:
    words = [word for setting in settings for word in ("--set", setting)]
    inherited = {name: value for name, value in os.environ.items() if name not in SETTINGS}
    return subprocess.run(
        [sys.executable, "-c", RUN, str(folder), *words], env=inherited | environment, capture_output=True, text=True,
        cwd=ROOT, timeout=PATIENCE,
    )  # fmt: skip


def test_a_native_process_leaves_libraries_their_choice() -> None:
    code = ("import space_dist, os, space_dist.learner.elementary as elementary; print(sorted(set(os.environ) & set("
            "space_dist.arithmetic.SETTINGS)), os.environ.get('MKL_CBWR'), elementary._library)")  # fmt: skip
    assert fresh(code, SPACE_DIST_ARITHMETIC="native").stdout == "[] None None\n"
    assert fresh(code, SPACE_DIST_ARITHMETIC="native", **SETTINGS).stdout == "[] None None\n"  # a child of ours
    assert fresh(code, SPACE_DIST_ARITHMETIC="native", MKL_CBWR="AVX2").stdout == "['MKL_CBWR'] AVX2 None\n"


def test_a_native_run_says_so_and_is_another_run(tmp_path: Path) -> None:
    budget = ("budget.steps=224", "arithmetic=native")
    done = train(tmp_path / "run", *budget, SPACE_DIST_ARITHMETIC="native")
    assert done.returncode == 0, done.stderr
    assert "arithmetic: native: libraries choose their kernels by the CPU" in (tmp_path / "run/log.txt").read_text()
    refused = train(tmp_path / "run", *budget)
    assert refused.returncode == 2
    assert "start with SPACE_DIST_ARITHMETIC=native in the environment" in " ".join(refused.stderr.split())
    assert "Traceback" not in refused.stderr


def test_a_choice_that_is_not_the_configs_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = [configs.load(ROOT / "configs/pointmass_space.yaml", [f"arithmetic={one}"]) for one in ("one", "native")]
    one, native = made
    assert configs.identity(one, "", "") != configs.identity(native, "", "")
    for config, given, words in (
        (native, None, "arithmetic: native is chosen before libraries are loaded"),
        (native, "one", "or use arithmetic: one"),
        (one, "native", "arithmetic: one in the config: unset it, or use --set arithmetic=native"),
        (one, "natve", "SPACE_DIST_ARITHMETIC=natve of the environment is not known; did you mean 'native'? Allowed:"),
    ):
        if given is None:
            monkeypatch.delenv(arithmetic.CHOICE, raising=False)
        else:
            monkeypatch.setenv(arithmetic.CHOICE, given)
        with pytest.raises(ConfigError, match=re.escape(words)):
            launch(config, tmp_path / "run", resume=False, stop=StopRequests())
    assert not (tmp_path / "run").exists()


def test_actors_elsewhere_choose_as_this_process_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(arithmetic.CHOICE, raising=False)
    assert arithmetic.settings() == SETTINGS
    monkeypatch.setenv(arithmetic.CHOICE, "native")
    assert arithmetic.settings() == {arithmetic.CHOICE: "native"}
    monkeypatch.delenv(arithmetic.CHOICE)
    monkeypatch.setattr(arithmetic, "has_reference_cpu", lambda: False)
    assert arithmetic.settings() == {}
