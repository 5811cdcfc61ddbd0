"""torch's compiler is imported by who compiles, and by nobody else."""

from __future__ import annotations

import subprocess
import sys

from tests.patience import PATIENCE

TRAINS = """
import inspect, sys
import space_dist.learner
from space_dist.run.launch import arithmetic_digest
import torch
weights = torch.nn.Parameter(torch.ones(3))
optimizer = torch.optim.SGD([weights], lr=0.5)
weights.sum().backward()
optimizer.step()
optimizer.zero_grad()
inspect.getmodule(inspect.currentframe())  # looks at every module
arithmetic_digest()
print(weights.tolist(), "sympy" in sys.modules)
"""
COMPILES = """
import torch._dynamo.config
print(torch.compile(lambda x: 2 * x + 1, backend="eager")(torch.ones(2)).tolist())
import torch._dynamo as compiler
print(compiler.__file__.endswith("__init__.py"), "sympy" in sys.modules)
optimizer.step()
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
    trained = "[0.5, 0.5, 0.5] False"
    assert said(TRAINS + DISABLES) == [trained, "[1, 2, 3] True"]
    assert said(TRAINS + COMPILES) == [trained, "[3.0, 3.0]", "True True"]
