"""torch's compiler, and what else training does not need, is imported by who asks for it, and by nobody else."""

from __future__ import annotations

import subprocess
import sys

from tests.patience import PATIENCE

TRAINS = """
import inspect, sys
import space_dist.learner
from space_dist.run.claiming import arithmetic_digest
import torch
weights = torch.nn.Parameter(torch.ones(3))
optimizer = torch.optim.SGD([weights], lr=0.5)
weights.sum().backward()
optimizer.step()
optimizer.zero_grad()
inspect.getmodule(inspect.currentframe())  # looks at every module
arithmetic_digest()
generator = torch.Generator().manual_seed(1)
loaded = [name for name in ("sympy", "torch._decomp", "torch._export", "tensorboard") if name in sys.modules]
print(weights.tolist(), loaded)
"""
COMPILES = """
import torch._dynamo.config
print(torch.compile(lambda x: 2 * x + 1, backend="eager")(torch.ones(2)).tolist())
import torch._dynamo as compiler
print(compiler.__file__.endswith("__init__.py"), "sympy" in sys.modules)
optimizer.step()
"""
EXPORTS = """
from torch.export import Dim
print(Dim("batch").__name__, type(torch.export.export(torch.nn.Linear(2, 1), (torch.ones(1, 2),))).__name__)
"""
SHAPES = """
torch.compiler.is_compiling(), torch.export.Dim
print(tuple(torch.nn.Conv2d(3, 4, 3, device="meta")(torch.empty(1, 3, 8, 8, device="meta")).shape))
"""
REACHES = """
print(tuple(torch.broadcast_shapes((3, 1), (2,))))
normal = torch.distributions.MultivariateNormal(torch.zeros(2), torch.eye(2))
print(tuple(normal.expand((3,)).rsample().shape), torch._refs.__file__ is not None)
print(len(torch._decomp.decomposition_table) > 100, torch._custom_ops.__file__ is not None)
import torch._refs
"""
PICKLES = """
import importlib.util, cloudpickle
exports = torch.export
print([importlib.util.find_spec(name).origin.endswith("__init__.py") for name in ("torch.export", "torch._dynamo")])
print(cloudpickle.loads(cloudpickle.dumps(lambda: exports.Dim("batch").__name__))())
"""
LOGS = """
import tempfile
from pathlib import Path
from stable_baselines3.common.logger import configure
folder = tempfile.mkdtemp()
logger = configure(folder, ["tensorboard"])
logger.record("a", 1.0)
logger.dump(step=1)
logger.close()
import torch.utils.tensorboard
print([file.stat().st_size > 60 for file in Path(folder).iterdir()], torch.utils.tensorboard.SummaryWriter.__module__)
"""
GUEST = """
import sys
import torch
import space_dist.sb3
print("torch._decomp" in sys.modules, torch.export.__file__ is not None)
"""
DISABLES = """
import torch._dynamo
asked = [torch.compiler.disable(lambda: 1), torch.compiler.disable()(lambda: 2),
         torch.compiler.disable(recursive=False)(lambda: 3)]
print([function() for function in asked], "sympy" in sys.modules)
"""


def said(program: str) -> list[str]:
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_an_optimiser_imports_no_compiler_and_who_compiles_has_it() -> None:
    trained = "[0.5, 0.5, 0.5] []"
    assert said(TRAINS + DISABLES) == [trained, "[1, 2, 3] True"]
    assert said(TRAINS + COMPILES) == [trained, "[3.0, 3.0]", "True True"]


def test_who_exports_or_logs_has_what_it_takes() -> None:
    assert said(TRAINS + EXPORTS + SHAPES)[1:] == ["batch ExportedProgram", "(1, 4, 6, 6)"]
    assert said(TRAINS + LOGS)[1:] == ["[True] torch.utils.tensorboard.writer"]


def test_what_torch_reaches_without_importing_it_is_there() -> None:
    assert said(TRAINS + REACHES)[1:] == ["(3, 2)", "(3, 2) True", "True True"]


def test_torch_may_ask_for_its_compiler_while_it_is_imported() -> None:
    """As it does for debugging, and in the hooks of backends."""
    debugging = "import os; os.environ['TORCH_COMPILE_DEBUG'] = '1'\n"
    assert said(debugging + TRAINS)[0].startswith("[0.5, 0.5, 0.5]")


def test_what_stands_in_is_found_and_pickled_as_a_module_is() -> None:
    assert said(TRAINS + PICKLES)[1:] == ["[True, True]", "batch"]


def test_a_script_that_imports_torch_has_all_of_it() -> None:
    assert said(GUEST) == ["True True"]
