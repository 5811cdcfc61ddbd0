"""`space-dist export-sb3`: the zip that Stable-Baselines3 loads acts as the run's policy does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sb3_contrib import TRPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO, SAC, TD3
from stable_baselines3.common.vec_env import VecNormalize

from space_dist.ledger import Ledger
from space_dist.rollout.policy import policies_of
from space_dist.run.building import spec_of
from space_dist.run.launch import launch, policy_of
from space_dist.sb3 import ContextVecEnv, CurriculumCallback
from space_dist.system.interrupts import StopRequests
from tests.commanding import command
from tests.test_learners import DISCRETE_LINE, LINE, N_STEPS, PARTS, config_for, learner_section

CLASSES = {"ppo": PPO, "a2c": A2C, "trpo": TRPO, "recurrent_ppo": RecurrentPPO, "dqn": DQN, "sac": SAC, "td3": TD3}
CASES: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    **{kind: (kind, {}, {}) for kind in CLASSES},
    "lean": ("ppo", {"update": "lean"}, {}),
    "discrete": ("ppo", {}, {"env_id": DISCRETE_LINE}),
    "population": ("trpo", {}, {"engine": "population"}),
    "normalised": ("ppo", {"normalize_observations": True, "normalize_rewards": True}, {}),
    "parts": ("sac", {"policy": "MultiInputPolicy"}, {"env_id": PARTS}),
    "several": (
        "ppo", {}, {"engine": "population", "curriculum": {"kind": "space", "aggregate": "population", "policies": 2},
                    "budget": {"steps": 4 * N_STEPS}},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_sb3_acts_as_the_run_does(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    kind, changes, sections = CASES[name]
    budget = {"budget": {"steps": 3 * N_STEPS}}
    config = config_for(tmp_path, learner_section(kind, **changes), **{**budget, **sections})
    launch(config, tmp_path / "run", resume=False, stop=StopRequests())
    monkeypatch.chdir(tmp_path)
    assert command(monkeypatch, "export-sb3", "run", "--out", "made/policy") == 0
    told = capsys.readouterr().out
    policies = policies_of(policy_of(Ledger(tmp_path / "run"), spec_of(config)))
    files = sorted(Path("made").glob("*.zip"))
    assert len(files) == len(policies)
    for file, policy in zip(files, policies, strict=True):
        assert str(file) in told
        model = CLASSES[kind].load(file, device="cpu")
        assert model.num_timesteps >= 3 * N_STEPS
        space = model.observation_space
        space.seed(0)
        if name == "parts":
            samples = [space.sample() for _ in range(1000)]
            observations: Any = {part: np.stack([sample[part] for sample in samples]) for part in samples[0]}
        else:
            observations = (
                np.random.default_rng(0).uniform(space.low, space.high, (1000, *space.shape)).astype(np.float32)
            )
        expected = policy.head.executed(policy.head.best(policy.outputs(observations)))
        seen = observations
        if name == "normalised":
            env = ContextVecEnv(config.env.id, np.array([[0.1], [0.2]]))
            seen = VecNormalize.load("made/policy_vecnormalize.pkl", env).normalize_obs(observations)
        actions, _ = model.predict(seen, deterministic=True)
        if expected.dtype.kind == "i":
            assert actions.tolist() == expected.tolist()
            assert len(set(actions.tolist())) > 1
        else:
            np.testing.assert_allclose(actions, expected, rtol=1e-5, atol=1e-6)
            assert actions.std() > 1e-4


def test_what_was_exported_goes_on_in_a_script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = config_for(tmp_path, learner_section("ppo", update="lean"))
    launch(config, tmp_path / "run", resume=False, stop=StopRequests())
    monkeypatch.chdir(tmp_path)
    assert command(monkeypatch, "export-sb3", "run") == 0
    env = ContextVecEnv(LINE, tmp_path / "train.csv", config.rollout.shards * config.rollout.slots)
    model = PPO.load("tiny_s0.zip", env=env, device="cpu")
    steps, callback = model.num_timesteps, CurriculumCallback("space")
    model.learn(2 * N_STEPS, callback=callback, reset_num_timesteps=False)
    assert model.num_timesteps == steps + 2 * N_STEPS
    assert callback.selection.version > 0


def test_what_cannot_be_exported_is_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command(monkeypatch, "export-sb3", "nowhere") != 0
    assert "nowhere" in capsys.readouterr().err
    config = config_for(tmp_path, learner_section("a2c"))
    launch(config, tmp_path / "run", resume=False, stop=StopRequests())
    (tmp_path / "taken").write_text("a file")
    assert command(monkeypatch, "export-sb3", "run", "--out", "taken/policy.zip") == 2
    assert "taken/policy.zip cannot be written" in capsys.readouterr().err
    (tmp_path / "folder.zip").mkdir()
    for folder in ("folder.zip", "folder", ".", "..", ""):
        assert command(monkeypatch, "export-sb3", "run", "--out", folder) == 2
        assert "is a folder; name" in " ".join(capsys.readouterr().err.split())
    assert {path.name for path in tmp_path.iterdir()} >= {"run", "taken", "folder.zip"}
    assert not [*tmp_path.glob("*zip_*"), *tmp_path.glob("folder.zip/*"), *tmp_path.glob("..*zip")]
