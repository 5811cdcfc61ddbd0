"""Rounds in which nothing was rewarded: what `learner.unrewarded` has the policy and the value function learn."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from space_dist.config import RecurrentPPOConfig
from space_dist.rollout import Shard
from tests.test_learner import DISCRETE_LINE, LINE, bits, learner_for, shards_of, small
from tests.test_population_learner import stacked


def rewardless(shards: list[Shard]) -> list[Shard]:
    return [dataclasses.replace(shard, rewards=np.zeros_like(shard.rewards)) for shard in shards]


@pytest.mark.parametrize("engine", ["stock", "lean", "stacked"])
@pytest.mark.parametrize("env_id", [LINE, DISCRETE_LINE])
def test_rounds_without_a_reward_teach_the_critic_alone(engine: str, env_id: str) -> None:
    made = stacked if engine == "stacked" else learner_for
    own = {"update": "lean"} if engine == "lean" else {}
    learners = {
        unrewarded: made(small(unrewarded=unrewarded, max_grad_norm=None, **own), env_id)
        for unrewarded in ("learn", "critic")
    }
    before = bits(learners["learn"])
    shards = shards_of(learners["learn"], env_id)
    for learner in learners.values():
        assert learner.update(rewardless(shards), round=0, steps=96).gradient_steps == 9
    both, critic = (bits(learner) for learner in learners.values())
    weights = [name for name, _ in learners["learn"].model.policy.named_parameters()]
    for name in weights:
        assert both[name] != before[name]
        if "value_net" in name:  # the critic's, to the bit
            assert critic[name] == both[name]
        else:
            assert critic[name] == before[name]
    # As much as one reward, and the policy learns as ever.
    shards = rewardless(shards_of(learners["critic"], env_id, round=1))
    shards[1].rewards[3, 1] = 1e-3
    rewarded = {}
    for unrewarded in ("learn", "critic"):
        learner = made(small(unrewarded=unrewarded, **own), env_id)
        learner.update(shards, round=0, steps=96)
        rewarded[unrewarded] = bits(learner)
    assert rewarded["learn"] == rewarded["critic"]


def test_the_entropy_bonus_goes_on_without_a_reward() -> None:
    learner = learner_for(small(unrewarded="critic", ent_coef=0.1))
    before = bits(learner)
    learner.update(rewardless(shards_of(learner)), round=0, steps=96)
    assert bits(learner)["log_std"] != before["log_std"]
    assert float(learner.model.policy.log_std.detach().max()) > 0.0


def test_what_was_learned_before_is_carried_over_by_momentum_alone() -> None:
    """Behind a rewarded round Adam's moments are not 0: the policy goes on a little, and less than if it learned."""
    moved = {}
    for unrewarded in ("learn", "critic"):
        learner = learner_for(small(unrewarded=unrewarded))
        learner.update(shards_of(learner), round=0, steps=96)
        before = learner.model.policy.action_net.weight.detach().clone()
        learner.update(rewardless(shards_of(learner, round=1)), round=1, steps=192)
        moved[unrewarded] = float((learner.model.policy.action_net.weight.detach() - before).abs().sum())
    assert 0.0 < moved["critic"] < moved["learn"]


def test_a_recurrent_policy_learns_nothing_without_a_reward() -> None:
    settings = {"kind": "recurrent_ppo", "net_arch": (8,), "n_steps": 96, "batch_size": 32, "n_epochs": 1}
    learner = learner_for(RecurrentPPOConfig(**settings, lstm_hidden_size=4, unrewarded="critic"))
    before = bits(learner)
    learner.update(rewardless(shards_of(learner)), round=0, steps=96)
    after = bits(learner)
    for name, _ in learner.model.policy.named_parameters():
        of_critic = "value_net" in name or "critic" in name
        assert (after[name] != before[name]) == of_critic, name
