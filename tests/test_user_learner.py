"""Anyone's own learner, by import path: the example in the documentation, the same bytes wherever it goes on."""

# ruff: noqa: F811 - a fixture that is imported
from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from space_dist import config as configs
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.ledger import Ledger, encode_row
from space_dist.run.building import Blueprint
from space_dist.run.launch import launch
from space_dist.sb3.export import export_sb3
from space_dist.system.interrupts import StopRequests
from tests.commanding import command
from tests.own_code import Example, example  # noqa: F401
from tests.test_learners import RESULTS, interrupted, results

EXAMPLE = Example(
    "your_learner.md", "my_learner", rounds=8,
    quick=("budget.steps=2048", "learner.n_steps=256", "learner.n_epochs=1", "evaluation.every_steps=2048",
           "checkpoint.every_rounds=1", "tracking.uri=null"),
)  # fmt: skip
chosen, trained = EXAMPLE.chosen, EXAMPLE.trained
OFF_POLICY = ["budget.steps=1024", "evaluation.every_steps=1024", "checkpoint.every_rounds=1", "tracking.uri=null",
              "resources.workers=0"]  # fmt: skip


def written(folder: Path, code: str) -> None:
    """Another module of one's own, `others`."""
    (folder / "others.py").write_text(
        f"import numpy as np\nimport torch\nfrom stable_baselines3 import DQN, PPO, SAC\n\n{code}\n"
    )
    sys.modules.pop("others", None)


def refusal(folder: Path, code: str, *settings: str) -> str:
    written(folder, code)
    with pytest.raises(SpaceDistError) as caught:
        trained(folder / "refused", "learner.import=others:Mine", "learner.kwargs={}", *settings)
    text = str(caught.value)
    assert len(text.splitlines()) == 1
    return text


def test_the_example_in_the_documentation_is_short_and_works(
    example: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert len((example / "my_learner.py").read_text().splitlines()) <= 30
    (train,) = (line.split()[1:] for line in EXAMPLE.blocks("bash")[0].splitlines()[1:])
    quick = [part for setting in (*EXAMPLE.quick, "resources.workers=0") for part in ("--set", setting)]
    assert command(monkeypatch, *train, "--out", "run", *quick) == 0, capsys.readouterr().err
    rows = [row["learner"] for row in Ledger(Path("run")).rows() if row["kind"] == "iteration"]
    coefficients = [row["ent_coef"] for row in rows]
    assert len({*coefficients}) == len(coefficients) > 1
    stock = trained(example / "stock", "learner.import=null", "learner.kwargs={}")
    assert stock["model.npz"] != Path("run/model.npz").read_bytes()
    assert [*np.load("run/model.npz")] == [*np.load("stock/model.npz")]  # the kind's arrays


@pytest.mark.ray
@pytest.mark.usefixtures("one_ray")
def test_neither_workers_nor_a_kill_change_a_byte(example: Path) -> None:
    reference = trained(example / "reference")
    assert trained(example / "workers", workers=2) == reference
    EXAMPLE.assert_a_kill_changes_no_byte(example, reference)


def test_its_arguments_and_its_source_are_part_of_what_a_run_is(example: Path) -> None:
    assert configs.identity(chosen("learner.kwargs.target=0.25"), "", "") != configs.identity(chosen(), "", "")
    EXAMPLE.assert_its_source_is_part_of_a_run(example)


BESIDE = """
class Mine(SAC):
    '''Keeps a network beside its policy, its optimiser, a generator, and how often it trained.'''

    def _setup_model(self):
        super()._setup_model()
        self.net = torch.nn.Linear(3, 1)
        self.optimizer = torch.optim.SGD(self.net.parameters(), lr=0.1, momentum=0.9)
        self.random = np.random.Generator(np.random.PCG64(0))
        self.trained = 0

    def train(self, gradient_steps, batch_size=64):
        self.optimizer.zero_grad()
        self.net(torch.as_tensor(self.random.random(3), dtype=torch.float32)).square().sum().backward()
        self.optimizer.step()
        self.trained += 1
        self.critic.optimizer.param_groups[0]["weight_decay"] = float(self.net.bias.abs().item())
        super().train(gradient_steps, batch_size)
        self.told = self.trained * 2

    def extra_state(self):
        state = {f"net.{name}": tensor.numpy(force=True) for name, tensor in self.net.state_dict().items()}
        for index, slots in self.optimizer.state_dict()["state"].items():
            state[f"momentum.{index}"] = slots["momentum_buffer"].numpy(force=True)
        number = self.random.bit_generator.state["state"]
        words = [number[name] >> shift & (1 << 64) - 1 for name in ("state", "inc") for shift in (64, 0)]
        return {**state, "random": np.array(words, dtype=np.uint64), "trained": self.trained}

    def load_extra_state(self, state):
        self.net.load_state_dict({name: torch.as_tensor(state[f"net.{name}"]) for name in ("weight", "bias")})
        groups = self.optimizer.state_dict()["param_groups"]
        slots = {index: {"momentum_buffer": torch.as_tensor(state[f"momentum.{index}"])}
                 for index in (0, 1) if f"momentum.{index}" in state}
        self.optimizer.load_state_dict({"state": slots, "param_groups": groups})
        high, low, inc_high, inc_low = map(int, state["random"])
        now = self.random.bit_generator.state
        now["state"] = {"state": high << 64 | low, "inc": inc_high << 64 | inc_low}
        self.random.bit_generator.state = now
        self.trained = state["trained"]

    transient = ("told",)
"""


def off_policy() -> configs.RunConfig:
    learner = ("learner={kind: sac, import: 'others:Mine', n_steps: 128, net_arch: [16], learning_starts: 50, "
               "gradient_steps_per_step: 0.1}")  # fmt: skip
    return configs.load(EXAMPLE.config, [*OFF_POLICY, learner])


def test_what_it_keeps_beside_its_policy_survives_a_checkpoint(example: Path) -> None:
    written(example, BESIDE)
    config = off_policy()
    launch(config, example / "through", resume=False, stop=StopRequests())
    interrupted(config, example / "stopped", 4)
    launch(config, example / "stopped", resume=True, stop=StopRequests())
    for name in RESULTS:
        assert (example / "stopped" / name).read_bytes() == (example / "through" / name).read_bytes(), name
    forgetful = BESIDE.replace(', "trained": self.trained}', "}").replace('self.trained = state["trained"]', "pass")
    written(example, forgetful)
    with pytest.raises(SpaceDistError, match="would not have trained as training left it"):
        launch(config, example / "forgetful", resume=False, stop=StopRequests())
    written(example, BESIDE.replace("slots = {", "slots = {} and {"))  # the momentum is not put back
    with pytest.raises(SpaceDistError, match="would not have optimizer as training left it"):
        launch(config, example / "momentum", resume=False, stop=StopRequests())


def test_what_is_lost_is_named_with_what_to_do(example: Path) -> None:
    said = refusal(example, """
class Mine(PPO):
    def train(self):
        super().train()
        self.ent_coef += 0.01
        self.history = [*getattr(self, "history", []), self.ent_coef]
""")  # fmt: skip
    assert "learner.import 'others:Mine': a run that goes on from a checkpoint would not have ent_coef, history" in said
    assert "extra_state()" in said


@pytest.mark.parametrize(
    ("kwargs", "said"),
    [
        ("{targte: 3.0}", "argument 'targte'; did you mean 'target'? Its own are: target, rate"),
        ("{zzz: 3.0}", "argument 'zzz'. Its own are: target, rate"),
        ("{n_epochz: 3}", "argument 'n_epochz'; did you mean 'n_epochs'? That stands beside kwargs: learner.n_epochs. "
                            "Its own are: target, rate"),
        ("{target_kl: 3.0}", "'target_kl' is an argument of Stable-Baselines3's ppo, and stands beside kwargs: "
                             "learner.target_kl"),
    ],
)  # fmt: skip
def test_arguments_that_its_class_does_not_take_are_refused_by_check_and_run_alike(
    example: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], kwargs: str, said: str
) -> None:
    for line in (["config", "check"], ["train", "--out", "run"]):
        assert command(monkeypatch, *line, "my_learner.yaml", "--set", f"learner.kwargs={kwargs}") == 2
        text = " ".join(capsys.readouterr().err.split())
        assert text.startswith(f"space-dist: my_learner.yaml with --set learner.kwargs={kwargs}: learner.")
        assert text.endswith(said)
    assert not (example / "run").exists()


def test_a_fault_in_its_update_is_told_with_where_and_holds_nobody_up(example: Path) -> None:
    (example / "own_fault.py").write_text(
        "from stable_baselines3 import PPO\nclass Mine(PPO):\n    def train(self):\n        {}['a']\n"
    )
    run = example / "run"
    failing = chosen("learner.import=own_fault:Mine", "learner.kwargs={}")
    with pytest.raises(SpaceDistError, match=r"failed: KeyError: 'a' \(own_fault.py, line 4, in train\)\. The "):
        launch(failing, run, resume=False, stop=StopRequests())
    assert (run / "metrics.jsonl").read_bytes()
    launch(chosen(), run, resume=False, stop=StopRequests())
    assert results(run) == trained(example / "alone")


def test_a_run_that_failed_before_its_first_iteration_holds_nobody_up(
    example: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As by a class that cannot be made on that machine: nothing is lost if another config takes its folder."""
    right, run = chosen("learner.kwargs={target: 3.0}"), example / "run"
    setup = Blueprint.of(right).setup(*Blueprint.of(right).instances())
    with monkeypatch.context() as patched:
        patched.setattr(Blueprint, "setup", lambda *_: setup)  # which would have refused it
        with pytest.raises(SpaceDistError, match="cannot be made of"):
            launch(chosen("learner.kwargs={targte: 3.0}"), run, resume=False, stop=StopRequests())
    assert Ledger(run).status().state == "failed"
    (run / "metrics.jsonl").write_bytes(encode_row({"kind": "iteration"}))  # as of one that failed later
    with pytest.raises(SpaceDistError, match="already holds a run"):
        launch(right, run, resume=False, stop=StopRequests())
    (run / "metrics.jsonl").unlink()
    launch(right, run, resume=False, stop=StopRequests())
    assert results(run) == trained(example / "alone", "learner.kwargs={target: 3.0}")
    with pytest.raises(SpaceDistError, match="already holds a run"):
        launch(right, run, resume=False, stop=StopRequests())


HOOKS = "class Mine(PPO):\n    def train(self):\n        super().train()\n"


@pytest.mark.parametrize(
    ("code", "settings", "sentence"),
    [
        ("class Mines(PPO): pass", [], "has no class 'Mine'; did you mean 'Mines'?"),
        ("class Mine: pass", [], "is not derived from stable_baselines3.PPO, which learner.kind: ppo stands for"),
        ("def Mine(*args): return PPO(*args)", [], "is not derived from stable_baselines3.PPO"),
        ("class Mine(DQN): pass", [], "is not derived from stable_baselines3.PPO"),
        ("class Mine(PPO):\n    def collect_rollouts(self): pass", [], "has a collect_rollouts() of its own, which"),
        ("class Mine(PPO):\n    def train(self, rounds): pass", [], "its train() is called as train(self): missing"),
        ("class Mine(PPO):\n    def __init__(self, *args): super().__init__(*args)", [], "cannot be made of lea"),
        ("class Mine(PPO): pass", ["learner.kwargs.gamma=0.5"], "'gamma' is an argument of Stable-Baselines3's ppo"),
        ("class Mine(PPO): pass", ["learner.kwargs.device=cuda"], "'device' is an argument of Stable-Baselines3's ppo"),
        ("class Mine(PPO): pass", ["learner.kwargs.beta=0.5"], "cannot be made of learner.kwargs: TypeError"),
        ("class Mine(PPO):\n    def _setup_model(self): 1 / 0", [], "cannot be set up: ZeroDivisionError"),
        ("class Mine(PPO):\n    def _setup_model(self):\n        self.policy_kwargs['net_arch'] = [8]\n"
         "        super()._setup_model()", [], "it changed the policy's net_arch, and actors act with what"),
        ("class Mine(PPO):\n    def _setup_model(self):\n        super()._setup_model()\n"
         "        self.policy = type('Other', (type(self.policy),), {})(self.observation_space, self.action_space, "
         "self.lr_schedule)", [], "it made a policy of the class Other, and actors act with ActorCriticPolicy"),
        (f"{HOOKS}    def extra_state(self): return [1]", [], "extra_state() must return a dictionary, not a list"),
        (f"{HOOKS}    def extra_state(self): return {{'a/b': 1}}", [], "extra_state() names 'a/b'; names are letters"),
        (f"{HOOKS}    def extra_state(self): return {{'a': np.float32(1)}}", [], "gives a as float32: a"),
        (f"{HOOKS}    def extra_state(self): return {{'a': 1}}", [], "has an extra_state(), and no load_extra_state()"),
        (f"{HOOKS}    def extra_state(self): return self.nothing", [], "cannot say what a checkpoint must hold"),
        (f"{HOOKS}    def extra_state(self): return {{}}\n    def load_extra_state(self, state): state['a']", [],
         "cannot take back what its extra_state() gave: KeyError"),
    ],
)  # fmt: skip
def test_faults_are_told_in_a_sentence(example: Path, code: str, settings: list[str], sentence: str) -> None:
    assert sentence in refusal(example, code, *settings)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (["learner.import=json:loads"], "'json' is a module of Python's standard library"),
        (["learner.import=stable_baselines3:PPO"], "'stable_baselines3' is a module of stable_baselines3"),
        (["learner.import=space_dist.learner.lean:LeanPPO"], "is a module of space_dist itself"),
        (["learner.import=mine"], "must be an import path with a colon, like my_package.my_module:MyPPO"),
        (["learner.update=lean"], "update: lean is Stable-Baselines3's update, compiled; with import it must be stock"),
        (["engine=population"], "learner.import says nothing with engine: population"),
        (["engine=auto", "curriculum.aggregate=population"], "and so none for a class that learner.import names"),
        (
            ["learner.import=null", "learner.kwargs={target: 3.0, rate: 0.1}"],
            "learner: import, which names the class of your own that kwargs are for, is empty",
        ),
    ],
)
def test_what_cannot_go_with_it_is_refused_when_a_config_is_read(
    example: Path, settings: list[str], sentence: str
) -> None:
    with pytest.raises(ConfigError, match=re.escape(sentence)):
        chosen(*settings)
    assert example.is_dir()


def test_a_class_of_a_library_that_a_module_imports_is_refused(example: Path) -> None:
    written(example, "")
    with pytest.raises(ConfigError, match="a config may name what you have made yourself"):
        trained(example / "run", "learner.import=others:PPO", "learner.kwargs={}")


@pytest.mark.usefixtures("example")
def test_auto_engine_leaves_it_alone() -> None:
    config = chosen("engine=auto")
    assert Blueprint.of(config).config.engine == "single"
    stock = chosen("engine=auto", "learner.import=null", "learner.kwargs={}")
    assert Blueprint.of(stock).config.engine == "population"


KINDS = {"ppo": "stable_baselines3.PPO", "a2c": "stable_baselines3.A2C", "trpo": "sb3_contrib.TRPO",
         "recurrent_ppo": "sb3_contrib.RecurrentPPO", "sac": "stable_baselines3.SAC",
         "td3": "stable_baselines3.TD3"}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_a_class_of_each_kind_that_changes_nothing_has_the_bits_of_the_stock_one(example: Path, kind: str) -> None:
    library, name = KINDS[kind].split(".")
    (example / "others.py").write_text(f"from {library} import {name}\nclass Mine({name}): pass\n")
    found: list[Any] = []
    for own in ("null", "others:Mine"):
        settings = f"learner={{kind: {kind}, import: {own}, n_steps: 256, net_arch: [16]}}"
        config = configs.load(EXAMPLE.config, [*OFF_POLICY, settings])
        launch(config, example / own, resume=False, stop=StopRequests())
        found.append(results(example / own))
    assert found[0] == found[1]


def test_its_export_is_a_zip_that_it_loads(example: Path) -> None:
    trained(example / "run", "budget.steps=1024")
    ((path, what),) = export_sb3(Ledger(example / "run"), example / "out")
    assert what == "my_learner.TargetEntropyPPO.load takes it"
    model = sys.modules["my_learner"].TargetEntropyPPO.load(path)
    assert model.target == 3.0
    checkpoint = Ledger(example / "run").last_checkpoint()
    assert checkpoint is not None
    assert checkpoint.data["learner"]["own"] == {"ent_coef": model.ent_coef}
