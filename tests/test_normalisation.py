"""Observations and rewards normalised: whatever their scale, wherever a run goes on, and in its policy."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.sac.policies import SACPolicy  # noqa: F401 - named by import path

from space_dist import config as configs
from space_dist.errors import ConfigError
from space_dist.learner import make_learner
from space_dist.learner.normaliser import Normaliser
from space_dist.ledger import CURRICULUM, Ledger
from tests.test_learner import hand_made
from tests.test_learners import (
    N_STEPS,
    NORMALISED,
    ROUNDS,
    SCALED,
    config_for,
    interrupted,
    learner_section,
    resumed,
    run,
    torch_config,
)


def trained(folder: Path) -> list[list[int]]:
    return [row["trained"] for row in Ledger(folder).rows(CURRICULUM)]


def normalised_run(folder: Path, normalise: dict[str, bool], **units: float) -> list[list[int]]:
    config = config_for(
        folder, learner_section("ppo", **normalise), SCALED, env={"id": SCALED, "kwargs": units},
        budget={"steps": 40 * N_STEPS}, evaluation={"every_steps": 10_000}, checkpoint={"every_rounds": 1000},
    )  # fmt: skip
    run(config, folder / "run")
    return trained(folder / "run")


def test_units_of_rewards_and_observations_decide_no_selection(tmp_path: Path) -> None:
    reference = normalised_run(tmp_path / "reference", NORMALISED)
    assert len(reference[0]) == 1
    assert len(reference[-1]) == 4
    assert len({tuple(one) for one in reference}) > 4
    assert normalised_run(tmp_path / "rewards", NORMALISED, rewards=1000.0) == reference
    assert normalised_run(tmp_path / "observations", NORMALISED, observations=1000.0) == reference
    # Without normalisation they do: what is equal above is not equal by itself.
    plain = dict.fromkeys(NORMALISED, False)
    raw = normalised_run(tmp_path / "raw", plain)
    assert normalised_run(tmp_path / "raw-rewards", plain, rewards=1000.0) != raw
    assert normalised_run(tmp_path / "raw-observations", plain, observations=1000.0) != raw


def test_values_are_told_in_the_units_of_rewards(tmp_path: Path) -> None:
    values = {}
    for scale in (1.0, 1000.0):
        folder = tmp_path / str(scale)
        normalised_run(folder, {"normalize_rewards": True}, rewards=scale)
        rows = [row for row in Ledger(folder / "run").rows() if row["kind"] == "iteration" and row["complete"]]
        values[scale] = np.array([[row["curriculum"][f"mean_value_{when}"] for when in ("before", "after")]
                                  for row in rows])  # fmt: skip
        assert np.abs(values[scale][-1]).min() > 0.1 * scale
    np.testing.assert_allclose(values[1000.0], 1000.0 * values[1.0], rtol=1e-3)


@pytest.mark.parametrize("kind", ["ppo", "recurrent_ppo", "sac", "dqn"])
def test_a_change_of_scale_is_no_progress(kind: str, tmp_path: Path) -> None:
    # Networks that stand still under scales that do not: before and after are compared under the same ones.
    learner = learner_section(kind, **NORMALISED, learning_rate=1e-12)
    config = config_for(tmp_path, learner, curriculum={"kind": "random_growth", "eta": 1e-3})
    run(config, tmp_path / "run")
    rows = [row for row in Ledger(tmp_path / "run").rows() if row["kind"] == "iteration" and row["complete"]]
    assert len({row["learner"]["reward_std"] for row in rows}) == len(rows) == ROUNDS - 1
    for row in rows:
        told = row["curriculum"]
        assert told["mean_value_after"] == pytest.approx(told["mean_value_before"], rel=1e-5)
        assert max(abs(told["largest_pic"]), abs(told["smallest_pic"])) < 1e-5 * told["mean_value_after"]
    # In raw numbers they do change, from one iteration to the next.
    after = {round(row["curriculum"]["mean_value_after"], 4) for row in rows if row["curriculum"]["trained_size"] == 4}
    assert len(after) > 1


def test_the_first_scales_are_charged(tmp_path: Path) -> None:
    config = config_for(tmp_path, learner_section("ppo", **NORMALISED))
    run(config, tmp_path / "run")
    rows = Ledger(tmp_path / "run").rows()
    assert (rows[0]["kind"], rows[0]["round"], rows[0]["steps"]) == ("evaluation", 0, N_STEPS)
    assert (rows[-1]["round"], rows[-1]["steps"]) == (ROUNDS - 1, ROUNDS * N_STEPS)


@pytest.mark.parametrize("kind", ["ppo", "recurrent_ppo", "sac", "dqn"])
def test_normalised_runs_resume(kind: str, tmp_path: Path) -> None:
    # Iterations of two rounds and more: runs stop within them, with weights that are not those last scored.
    config = config_for(
        tmp_path, learner_section(kind, **NORMALISED), rollout={"shards": 4, "slots": 2, "passes": 16},
        budget={"steps": 8 * N_STEPS},
    )  # fmt: skip
    expected = run(config, tmp_path / "reference")
    assert Ledger(tmp_path / "reference").rows()[0]["steps"] == N_STEPS
    iterations = [row for row in Ledger(tmp_path / "reference").rows() if row["kind"] == "iteration"]
    assert sum(row["gradient_steps"] for row in iterations) > 0
    assert all(row["learner"]["reward_std"] > 0 for row in iterations)
    assert resumed(config, tmp_path / "run") == expected
    # Stopped in the very first round, whose scales came from the probe alone.
    interrupted(config, tmp_path / "early", 1)
    assert run(config, tmp_path / "early") == expected


@pytest.mark.parametrize("name", ["ppo-dict", "sac-dict", "dqn-image"])
def test_rewards_are_normalised_whatever_is_observed(name: str, tmp_path: Path) -> None:
    config = torch_config(name, tmp_path, normalize_rewards=True)
    expected = run(config, tmp_path / "reference")
    iterations = [row for row in Ledger(tmp_path / "reference").rows() if row["kind"] == "iteration"]
    assert sum(row["gradient_steps"] for row in iterations) > 0
    assert all(row["learner"]["reward_std"] > 0 for row in iterations)
    assert resumed(config, tmp_path / "run") == expected


@pytest.mark.parametrize("kind", ["ppo", "sac"])
def test_running_moments_are_those_of_all_data(kind: str) -> None:
    space = spaces.Box(-np.inf, np.inf, shape=(2,), dtype=np.float32)
    action = spaces.Box(-1.0, 1.0, shape=(2,), dtype=np.float32)
    section = learner_section(kind, **NORMALISED, gamma=0.9) | {"learning_starts": 10_000, "buffer_size": 10}
    if kind == "ppo":
        section = learner_section(kind, **NORMALISED, gamma=0.9)
    model = configs.SACConfig if kind == "sac" else configs.PPOConfig
    learner = make_learner(model(**section), space, action, seed=0, n_slots=4, slot_length=8, total_steps=1000)
    assert learner.normalises
    random = np.random.default_rng(0)
    seen, returns = [], []
    for number in range(5):
        shards = []
        for shard in range(2):
            terminated = random.random((8, 2)) < 0.2
            truncated = (random.random((8, 2)) < 0.2) & ~terminated
            made = hand_made(random.normal(3.0, 20.0, size=(8, 2)), terminated, truncated, shard=shard)
            observations = random.normal([5.0, -100.0], [0.1, 30.0], size=(8, 2, 2)).astype(np.float32)
            made = dataclasses.replace(made, observations=observations, next_observations=observations)
            shards.append(made)
            seen.append(observations.reshape(-1, 2).astype(np.float64))
            for slot in range(2):
                total = 0.0
                for time in range(8):
                    total = 0.9 * total + made.rewards[time, slot]
                    returns.append(total)
                    if terminated[time, slot] or truncated[time, slot]:
                        total = 0.0
        if number == 0:
            learner.observe(shards)
        else:
            learner.update(shards, round=number, steps=32 * number)
        statistics = learner.statistics
        np.testing.assert_allclose(statistics.mean, np.concatenate(seen).mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(statistics.std, np.concatenate(seen).std(axis=0), rtol=1e-12)
        assert statistics.reward_std == pytest.approx(np.std(returns), rel=1e-12)
    policy = learner.policy(5)
    raw = np.float32([[5.05, -130.0], [5.0, 1e6]])
    scaled = np.clip((raw - statistics.mean) / statistics.std, -10.0, 10.0).astype(np.float32)
    with torch.no_grad():
        tensor = torch.as_tensor(scaled)
        if kind == "ppo":
            expected = learner.model.policy.predict_values(tensor)[:, 0]
            outputs = learner.model.policy.get_distribution(tensor).distribution.mean
        else:
            mean, log_std, _ = learner.model.actor.get_action_dist_params(tensor)
            expected = torch.cat(learner.model.critic(tensor, torch.tanh(mean)), dim=1).min(dim=1).values
            outputs = torch.cat([mean, log_std], dim=1)
    np.testing.assert_allclose(policy.values(raw), expected.numpy() * np.std(returns), rtol=1e-5)
    np.testing.assert_allclose(policy.outputs(raw), outputs, rtol=1e-5, atol=1e-6)


def test_what_never_varies_is_not_scaled() -> None:
    # In float64 the mean of equal numbers is not always that number: what is left is no variation.
    space = spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float64)
    normaliser = Normaliser(space, 0.0, observations=True, rewards=True)
    no = np.zeros((32, 3), dtype=np.bool_)
    shard = dataclasses.replace(hand_made(np.full((32, 3), 0.1), no, no), observations=np.full((32, 3, 1), 0.1))
    normaliser.update([shard])
    statistics = normaliser.statistics
    assert statistics.std is not None
    assert (statistics.std.tolist(), statistics.reward_std) == ([1.0], 1.0)


def test_a_budget_that_the_first_scales_use_up_is_refused(tmp_path: Path) -> None:
    config = config_for(tmp_path, learner_section("ppo", **NORMALISED), budget={"steps": N_STEPS})
    with pytest.raises(ConfigError, match=r"budget\.steps"):
        run(config, tmp_path / "run")
