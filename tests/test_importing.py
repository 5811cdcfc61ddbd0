"""Whose modules are imported: libraries' before a user's own, and no library's because a config says so."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from os import system  # noqa: F401 - imported for a stranger's config to name
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from gymnasium.envs.classic_control import CartPoleEnv  # noqa: F401 - likewise, and allowed

from space_dist.envs import make_batched
from space_dist.errors import ConfigError
from space_dist.system.importing import folders_of_user, load, look_in, why_refused
from tests.commanding import command
from tests.grids import ROOT
from tests.patience import PATIENCE

PROGRAM = Path(sys.executable).parent / "space-dist"

ENVIRONMENT = """
import gymnasium as gym
import numpy as np

class Walk(gym.Env):
    context_space = gym.spaces.Box(np.array([0.1]), np.array([1.0]), dtype=np.float64)
    observation_space = gym.spaces.Box(-99.0, 99.0, shape=(1,), dtype=np.float32)
    action_space = gym.spaces.Discrete(2)
    horizon = 8
    context = np.array([0.5])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if options and "context" in options:
            self.context = np.array(options["context"])
        self.place, self.time = self.np_random.uniform(), 0
        return np.array([self.place], dtype=np.float32), {}

    def step(self, action):
        self.place += self.context[0] * (2 * action - 1)
        self.time += 1
        return np.array([self.place], dtype=np.float32), -abs(self.place), False, self.time >= self.horizon, {}
"""
CONFIG = """
name: walk
env: {id: "my_walk:Walk"}
instances: {train: train.csv, test: test.csv}
curriculum: {kind: round_robin}
learner: {kind: ppo, n_steps: 64, batch_size: 32, n_epochs: 1, net_arch: [8]}
rollout: {shards: 2, slots: 2}
budget: {steps: 128}
evaluation: {every_steps: 128}
"""
# Imported by us, by Ray, by torch, or by Python itself; and one package of ours.
NAMES = ("json", "yaml", "typing", "logging", "socket", "psutil", "ray", "torch", "gymnasium", "pydantic", "jinja2",
         "tests")  # fmt: skip
PACKAGES = ("numpy", "space_dist")


@pytest.fixture
def hostile(tmp_path: Path) -> Path:
    """A folder with a user's environment and config, and modules that say when they are imported, and fail."""
    folder = tmp_path / "work"
    folder.mkdir()
    trap = f"open({str(tmp_path / 'imported')!r}, 'a').write(__name__ + chr(10))\nraise ImportError(__name__)\n"
    for name in NAMES:
        (folder / f"{name}.py").write_text(trap)
    for name in PACKAGES:
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text(trap)
    (folder / "my_walk.py").write_text(ENVIRONMENT)
    (folder / "walk.yaml").write_text(CONFIG)
    (folder / "grid.yaml").write_text(
        "name: walks\nextends: walk.yaml\nzip: {learner.n_epochs: [1, 2]}\nseeds: {start: 0, count: 1}\n"
        "tracking: {uri: null}\n"
    )
    for name, first in (("train", 1), ("test", 5)):
        rows = "".join(f"{index},0.{first + index}\n" for index in range(4))
        (folder / f"{name}.csv").write_text(f"id,feature_0\n{rows}")
    return folder


def run(folder: Path, *command: object) -> str:
    """What a command says, from a folder whose modules nobody must import."""
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONSAFEPATH")}
    done = subprocess.run(
        [*map(str, command)], cwd=folder, env=environment, capture_output=True, text=True, timeout=PATIENCE
    )
    imported = folder.parent / "imported"
    assert not imported.exists(), (imported.read_text(), done.stderr)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.ray
def test_rollout_actors_import_libraries_first_and_a_users_module_last(hostile: Path) -> None:
    run(hostile, PROGRAM, "train", "walk.yaml", "--out", "run", "--set", "resources.workers=1", "--set",
        "tracking.uri=null")  # fmt: skip
    assert '"state": "done"' in (hostile / "run/status.json").read_text()


@pytest.mark.ray
def test_a_grids_processes_import_libraries_first_and_a_users_module_last(hostile: Path) -> None:
    run(hostile, PROGRAM, "grid", "run", "grid.yaml", "--root", "runs", "--max-parallel", 1)
    assert run(hostile, PROGRAM, "grid", "status", "grid.yaml", "--root", "runs").count("done") >= 1


def test_python_m_is_mended_as_soon_as_ours_is_reached(hostile: Path) -> None:
    """What Python imports before, and which `space_dist` it finds, is up to who calls it: -P decides both."""
    run(hostile, sys.executable, "-P", "-m", "space_dist.cli", "config", "check", "walk.yaml")
    for name in ("space_dist/__init__.py", "typing.py"):
        (hostile / name).unlink()
    (hostile / "space_dist").rmdir()
    run(hostile, sys.executable, "-m", "space_dist.cli", "config", "check", "walk.yaml")


def test_workers_look_where_their_driver_does_and_last(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", "/my/modules", *sys.path])
    folders = folders_of_user()
    assert folders[:2] == [str(tmp_path), "/my/modules"]
    assert not any("site-packages" in folder for folder in folders)
    monkeypatch.setattr(sys, "path", ["/library"])
    look_in(folders)
    look_in(folders)
    assert sys.path == ["/library", *folders]


# ---- what a config may name -----------------------------------------------------------------------------------------

LIBRARIES = {
    "os:system": "Python's standard library", "posix:system": "Python's standard library",
    "subprocess:getoutput": "Python's standard library", "os.path:join": "Python's standard library",
    "builtins:eval": "Python's standard library", "antigravity:x": "Python's standard library",
    "numpy:load": "numpy", "torch.hub:load": "torch", "ray:init": "ray", "six.moves:reload_module": "six",
    "jinja2.sandbox:modifies_known_mutable": "jinja2", "virtualenv:cli_run": "virtualenv", "pip:main": "pip",
    "setuptools:setup": "setuptools", "gymnasium:make": "gymnasium", "stable_baselines3:PPO": "stable",
    "space_dist.cli:main": "space_dist itself", "tensorboard.program:TensorBoard": "tensorboard",
    "wandb:init": "wandb", "pytest:main": "pytest", "mkdocs.commands.build:build": "mkdocs",
}  # fmt: skip


def test_modules_of_libraries_are_told_from_a_users_own() -> None:
    for path, owner in LIBRARIES.items():
        if path.startswith("setuptools") and why_refused(path) is None:
            continue  # not every environment has it
        assert owner.lower() in (why_refused(path) or "").lower(), path
    for path in ("tests.tiny_env:make", "nowhere_env:make", ":x", "carl.envs:CARLCartPole",
                 "pybullet_envs_gymnasium:x"):  # fmt: skip
        assert why_refused(path) is None


def test_reading_a_strangers_config_runs_no_function_of_a_library(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], hostile: Path
) -> None:
    canary = hostile / "canary"
    monkeypatch.chdir(hostile)
    act = f"command: touch {canary}"
    text = CONFIG.replace('{id: "my_walk:Walk"}', f'{{id: "os:system", kwargs: {{{act}}}}}')
    assert text != CONFIG
    Path("walk.yaml").write_text(text)
    for arguments in (("config", "check", "walk.yaml"), ("grid", "plan", "grid.yaml"), ("train", "walk.yaml")):
        assert command(monkeypatch, *arguments) == 2, arguments
        said = capsys.readouterr().err
        assert arguments[-1] in said
        assert "env.id: 'os' is a module of Python's standard library" in said
    kwarg = ("--kwarg", act.replace(": ", "="))
    for arguments in (("env", "check", "os:system", *kwarg),
                      ("instances", "sample", "uniform", "--env", "os:system", *kwarg, "--out", "x")):  # fmt: skip
        assert command(monkeypatch, *arguments) == 2, arguments
        assert "'os' is a module of Python's standard library" in capsys.readouterr().err
    policy = CONFIG.replace("kind: ppo", 'kind: ppo, policy: "stable_baselines3.ppo.policies:MlpPolicy"')
    Path("walk.yaml").write_text(policy)
    assert command(monkeypatch, "config", "check", "walk.yaml") == 2
    assert "policy: 'stable_baselines3.ppo.policies' is a module of stable" in capsys.readouterr().err
    assert not canary.exists()


made = functools.partial(gym.make, "CartPole-v1")


def test_what_a_users_module_has_imported_from_a_library_is_no_function_of_its() -> None:
    with pytest.raises(ConfigError, match=r"has 'system' from 'posix', a module of Python's standard library"):
        load(f"{__name__}:system", "env.id", of_library=gym.Env)
    with pytest.raises(ConfigError, match="define a function that calls it"):
        load(f"{__name__}:Path", "env.id", of_library=gym.Env)
    for name in ("CartPoleEnv", "made", "run"):
        assert load(f"{__name__}:{name}", "env.id", of_library=gym.Env) is globals()[name]
    assert load(f"{__name__}:nothing", "env.id") is None


def test_a_module_that_is_not_found_is_told_with_the_nearest_of_the_current_folder(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "own_worlds").mkdir()
    for file in ("own_lander.py", "own_worlds/__init__.py", "own_worlds/first.py"):
        (tmp_path / file).write_text("Lander = object\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for asked, told in (
        ("own_landr:Lander", "No module named 'own_landr'; did you mean 'own_lander'? It was looked for where"),
        ("own_world.first:Lander", "No module named 'own_world'; did you mean 'own_worlds'? It was looked for where"),
        ("quite_another:Lander", "No module named 'quite_another'. It was looked for where"),
        ("own_lander.py:Lander", "'own_lander.py:Lander': leave out `.py`: own_lander:Lander"),
        ("./own_lander.py:Lander", "leave out `.py`: own_lander:Lander"),
        ("own_worlds/first.py:Lander", "leave out `.py`: own_worlds.first:Lander"),
        (f"{tmp_path}/own_lander.py:Lander", "leave out `.py`: own_lander:Lander"),
        ("../there.py:Lander", "leave out `.py`: there:Lander, and start in .."),
    ):
        with pytest.raises(ConfigError) as refusal:
            load(asked, "env.id")
        assert told in str(refusal.value)


def test_a_word_without_a_colon_is_told_the_import_path_that_is_meant(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "pack").mkdir()
    (tmp_path / "uncoloned.py").write_text(
        "import gymnasium as gym\nfrom gymnasium import Wrapper\nclass Lander(gym.Env): pass\ndef other(): pass\n"
    )
    (tmp_path / "pack/worlds.py").write_text("def make(): pass\n")
    (tmp_path / "unsound.py").write_text("raise KeyError('x')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for word, told in (
        ("uncoloned", "an import path has a colon: uncoloned:Lander"),
        ("uncoloned.Lander", "an import path has a colon: uncoloned:Lander"),
        ("uncoloned.other", "an import path has a colon: uncoloned:other"),
        ("uncoloned.Landr", "an import path has a colon: uncoloned:Lander"),
        ("uncoloned.py", "an import path has a colon, and no `.py`: uncoloned:Lander"),
        ("./uncoloned.py", "an import path has a colon, and no `.py`: uncoloned:Lander"),
        ("Lander", "an import path has a colon: uncoloned:Lander"),
        ("pack/worlds.py", "an import path has a colon, and no `.py`: pack.worlds:make"),
        ("unsound.py", "an import path has a colon, and no `.py`: unsound:NAME"),
        ("own.yaml", "a YAML file is no import path; `space-dist config check own.yaml` checks a config and what"),
    ):
        with pytest.raises(ConfigError) as refusal:
            make_batched(word, 1, context_visible=False)
        assert str(refusal.value).startswith(f"env.id {word!r}: {told}")
    for word in ("os.system", "json", "quite_another", "space_dist/PointMas-v0", "unsound"):
        with pytest.raises(ConfigError, match="is not known"):
            make_batched(word, 1, context_visible=False)


def test_of_carls_modules_only_environments_are_named(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    assert command(monkeypatch, "env", "check", "carl.envs.gymnasium:import_module") == 2
    assert "Traceback" not in capsys.readouterr().err
    assert command(monkeypatch, "env", "check", "carl.utils.types:Context") == 2
    assert "carl" in capsys.readouterr().err


def test_a_script_elsewhere_finds_what_lies_in_the_current_folder(tmp_path: Path) -> None:
    """Whatever of the package it calls first."""
    (tmp_path / "scripts").mkdir()
    (tmp_path / "own_world.py").write_text("from tests.faulty_env import Honest\n\n\nclass World(Honest):\n    pass\n")
    script = tmp_path / "scripts/script.py"
    script.write_text(
        "from space_dist.sb3 import ContextVecEnv\nprint(ContextVecEnv('own_world:World', [[0.2, 0.0]]).num_envs)\n"
    )
    done = subprocess.run(
        [sys.executable, str(script)], cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, "1\n"), done.stderr
