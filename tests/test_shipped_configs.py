"""What the shipped configs say of their sources: the numbers of the papers and of their public code, once more."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from space_dist.config import RunConfig, load

FOLDER = Path(__file__).parent.parent / "configs"

PAPER = {"learner.gamma": 0.95, "learner.gae_lambda": 0.99}  # the SPaCE paper, appendix A; Klink et al. on PointMass
OLD_TRPO = {"learner.cg_max_steps": 10, "learner.cg_damping": 0.01, "learner.n_critic_updates": 3,
            "learner.batch_size": 128}  # fmt: skip
KLINK_2020 = {"learner.target_kl": 0.004, "learner.learning_rate": 0.239}
RIVALS = {**PAPER, "learner.kind": "ppo", "learner.n_steps": 2048, "learner.n_epochs": 10, "learner.batch_size": 64,
          "learner.net_arch": (64, 64), "learner.learning_rate": 3e-4}  # fmt: skip
SPDRL = {"curriculum.initial_mean": (0.0, 4.25, 2.0), "curriculum.initial_std": (2.0, 1.875, 1.0),
         "curriculum.zeta": 1.6, "curriculum.epsilon": 0.05, "curriculum.warm_up": 5,
         "env.context_visible": True}  # fmt: skip
TARGET = {"curriculum.target_mean": (2.5, 0.5, 0.0), "curriculum.target_std": (4e-3, 3.75e-3, 2e-3),
          "curriculum.least_std": (0.2, 0.1875, 0.1), "curriculum.least_std_until": 8000.0}  # fmt: skip
NOTEBOOK = {
    "learner.net_arch": (128, 64, 64), "learner.learning_rate": 1e-3, "learner.batch_size": 32,
    "learner.buffer_size": 10_000, "learner.learning_starts": 1000, "learner.gradient_steps_per_step": 1.0,
    "learner.gamma": 0.99, "env.kwargs": {"end_reward": -100.0}, "budget.episodes": 100,
}  # fmt: skip

FACTS: dict[str, dict[str, Any]] = {
    "presets/space_trpo_pointmass": {
        **PAPER, **OLD_TRPO, "learner.target_kl": 0.004, "learner.n_steps": 1024, "learner.net_arch": (64, 64),
        "curriculum.eta": 0.1, "curriculum.kappa": 1, "env.context_visible": True,
    },
    "presets/space_trpo_pointmass_printed": {**PAPER, **OLD_TRPO, **KLINK_2020, "learner.n_steps": 1024},
    "presets/space_ppo2_pointmass": {
        **PAPER, "learner.n_steps": 128, "learner.batch_size": 32, "learner.n_epochs": 4,
        "learner.learning_rate": 2.5e-4, "learner.clip_range": 0.2, "learner.ent_coef": 0.0, "learner.vf_coef": 1.0,
        "learner.max_grad_norm": None, "learner.net_arch": (64, 64),
    },
    "presets/released_trpo_pointmass": {
        **PAPER, **OLD_TRPO, **KLINK_2020, "learner.n_steps": 1024, "learner.net_arch": (21,),
        "env.context_visible": False, "curriculum.pic": "lowest_value", "curriculum.mean": "as_printed",
        "curriculum.v0": "zero",
    },
    "presets/klink_trpo_pointmass": {
        **PAPER, **OLD_TRPO, **KLINK_2020, "learner.n_steps": 2048, "learner.net_arch": (21,),
        "env.context_visible": True,
    },
    "presets/klink_trpo_ballcatching": {
        **OLD_TRPO, **KLINK_2020, "learner.gamma": 0.995, "learner.gae_lambda": 0.95, "learner.n_steps": 5000,
        "learner.net_arch": (64, 64, 64), "env.context_visible": False,
    },
    "curricula/pointmass_spdrl": {**RIVALS, **SPDRL, **TARGET, "curriculum.offset": 10},
    "curricula/pointmass_spdrl_klink": {
        **RIVALS, **SPDRL, **TARGET, "curriculum.offset": 10, "learner.n_epochs": 4, "learner.batch_size": 512,
    },
    "curricula/pointmass_spdrl_set": {**RIVALS, **SPDRL, "curriculum.target": "set_moments", "curriculum.offset": 10},
    "curricula/pointmass_spdrl_trpo": {
        **PAPER, **OLD_TRPO, **SPDRL, **TARGET, "curriculum.offset": 20, "learner.n_steps": 2048,
        "curriculum.optimiser": "trust_constr",
    },
    "curricula/pointmass_spdrl_space_paper": {
        **PAPER, **OLD_TRPO, **KLINK_2020, **SPDRL, **TARGET, "curriculum.offset": 70, "learner.n_steps": 2048,
        "learner.net_arch": (21,), "curriculum.optimiser": "conjugate_gradient",
    },
    "curricula/ballcatching_spdrl": {
        "learner.kind": "ppo", "curriculum.zeta": 0.45, "curriculum.offset": 0,
        "curriculum.initial_mean": (0.68, 0.9, 0.85),
        "curriculum.initial_std": (math.sqrt(1e-3), math.sqrt(1e-3), math.sqrt(0.1)),
        "curriculum.target_mean": (0.3375 * math.pi, 0.85, 2.375),
        "curriculum.target_std": (math.sqrt(0.2 * math.pi), math.sqrt(0.15), 1.0),
        "learner.n_steps": 5000, "learner.gamma": 0.995, "learner.gae_lambda": 0.95,
        "learner.net_arch": (64, 64, 64),
    },
    "curricula/pointmass_alp_gmm": {
        **RIVALS, "curriculum.random_share": 0.3, "curriculum.fit_rate": 100, "curriculum.history": 500,
        "curriculum.components": 10,
    },
    "curricula/pointmass_vds": {
        **RIVALS, "curriculum.members": 3, "curriculum.learning_rate": 1e-3, "curriculum.batch_size": 1000,
        "curriculum.n_batches": 100,
    },
    "curricula/pointmass_plr": RIVALS,
    "curricula/pointmass_plr_robust": {
        **RIVALS, "curriculum.replay_share": 0.5, "curriculum.scored_share": 0.5, "curriculum.staleness_share": 0.3,
        "curriculum.robust": True,
    },
    "curricula/pointmass_space_alt": {**RIVALS, "curriculum.score": "improvement", "curriculum.beta": 20.0},
    "curricula/pointmass_learning_progress": {
        **RIVALS, "curriculum.smoothing": 0.1, "curriculum.theta": 0.1, "curriculum.uniform_share": 0.25,
    },
    "curricula/pointmass_currot": {
        **RIVALS, "curriculum.delta": 4.0, "curriculum.particles": 100, "curriculum.performance": "discounted_return",
    },
    "curricula/mixed_maze_accel": {
        "curriculum.replay_share": 0.8, "curriculum.filled_share": 0.5, "curriculum.edits": 5,
        "curriculum.edited": "easiest", "curriculum.score": "positive_value_loss", "curriculum.temperature": 0.3,
        "curriculum.staleness_share": 0.3, "curriculum.robust": True, "curriculum.batch": 32,
    },
    "curricula/pointmass_learnability": {**RIVALS, "curriculum.uniform_share": 0.5},
    "curricula/pointmass_uniform": RIVALS,
    "pointmass_space": {**RIVALS, "curriculum.eta": 0.4, "curriculum.kappa": 16, "budget.steps": 1_000_000},
    "pointmass_round_robin": {**RIVALS, "budget.steps": 1_000_000},
    "antgoal_space": {**RIVALS, "env.kwargs": {"horizon": 500}},
    "antgoal_round_robin": {**RIVALS, "env.kwargs": {"horizon": 500}},
    "ballcatching_space": {"learner.gamma": 0.995, "learner.gae_lambda": 0.95, "env.context_visible": True},
    "ballcatching_round_robin": {"learner.gamma": 0.995, "learner.gae_lambda": 0.95, "env.context_visible": True},
    "cartpole_dqn_space": {**NOTEBOOK, "curriculum.eta": 0.025, "curriculum.kappa": 1},
    "cartpole_dqn_round_robin": NOTEBOOK,
}  # fmt: skip


def shipped(name: str) -> RunConfig:
    return load(FOLDER / f"{name}.yaml")


def value(config: RunConfig, key: str) -> Any:
    found: Any = config
    for part in key.split("."):
        found = getattr(found, part)
    return found


@pytest.mark.parametrize("name", FACTS)
def test_a_config_is_what_its_source_says(name: str) -> None:
    config = shipped(name)
    for key, fact in FACTS[name].items():
        assert value(config, key) == (pytest.approx(fact, rel=1e-5) if isinstance(fact, float | tuple) else fact), key


def test_presets_and_rivals_are_all_held() -> None:
    for folder in ("presets", "curricula"):
        assert {f"{folder}/{path.stem}" for path in (FOLDER / folder).glob("*.yaml")} <= FACTS.keys()


@pytest.mark.parametrize("name", ["cartpole_dqn_space", "cartpole_dqn_round_robin"])
def test_the_epsilon_of_cartpole_is_one_that_acts(name: str) -> None:
    """All of its schedule lies behind the warm-up, whose actions are random whatever epsilon is."""
    learner: Any = shipped(name).learner
    ends = learner.exploration_fraction * value(shipped(name), "budget.steps")
    assert learner.exploration_initial_eps == learner.exploration_final_eps or ends > learner.learning_starts
    assert learner.exploration_final_eps == pytest.approx(0.99 * 0.99**learner.learning_starts, abs=0.01)
    assert learner.exploration_final_eps == 0.01  # where the notebook's stops falling


def test_the_rivals_on_pointmass_have_one_learner() -> None:
    names = {
        name
        for name, facts in FACTS.items()
        if name.startswith("curricula/pointmass") and facts.items() >= RIVALS.items()
    }
    assert "curricula/pointmass_spdrl" in names
    learners = {name: shipped(name).learner for name in sorted(names)}
    assert all(learner == shipped("pointmass_space").learner for learner in learners.values()), learners
