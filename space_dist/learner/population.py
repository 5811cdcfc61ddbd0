"""The population engine: learners of one shape whose updates are computed together.

On a CPU PPO's are compiled (`lean`), and made one after the other; TRPO's, and all on a GPU, are one tensor program
(`stacked`). Each learner owns its weights and its Adam state, in Stable-Baselines3's own objects, as if it were alone:
a checkpoint cannot tell which engine wrote it, and a learner may be updated with others every time. For one update
parameters are copied, which takes a few of the milliseconds that it lasts.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.utils import explained_variance

from space_dist.config import LearnerConfig, PPOConfig, TRPOConfig, learners_that
from space_dist.envs.observations import concatenate
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.kernels import Shape
from space_dist.learner.heads import evaluate
from space_dist.learner.interface import NOT_A_NUMBER, Update, divergence, require_order
from space_dist.learner.on_policy import Joined, OnPolicyLearner, leaves_policy
from space_dist.learner.stack import ACTOR, ROWS, Layout, Stack, rounded_up
from space_dist.learner.stacked import PPO, PPOSettings, Report, Samples
from space_dist.learner.trust_region import TRPO, TRPOSettings
from space_dist.rollout import Shard
from space_dist.seeding import Purpose, global_seeds

# What a member takes, measured (tests/test_population.py holds it against the memory of a process).
_ROLLOUT_COPIES, _WAITING_COPIES = 10, 4
_PER_STEP = 8  # numbers beside observation and action: reward, value, advantage, ...
_TRPO_KEPT, _PPO_KEPT = 5, 6  # times the units of all layers
_PARAMETER_COPIES = 10
# Python's own (the run, its curriculum, its ledger), and the environments in which it is evaluated.
_OBJECTS_BYTES = 3 << 20
_NUMBER_BYTES = 4

Array = NDArray[np.float32]
Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class _Round:
    """What one member collected, and what its networks made of it. values, advantages, returns: (length, slots)."""

    shards: Sequence[Shard]
    joined: Joined
    values: Array
    advantages: Array

    @property
    def returns(self) -> Array:
        """What the critic is fitted to."""
        return self.advantages + self.values


class PopulationLearner(OnPolicyLearner):
    """A member of a population: SB3's networks and optimiser, updated together with others.

    dtype: of weights and arithmetic; as in SB3's buffer, what it learns from is float32 in any case.
    device: where updates are computed. stacked: whether in a stack; None: unless it is PPO on a CPU, where the compiled
    update is faster at every size that was measured. key: equal for learners that can be updated together.
    """

    def __init__(
        self,
        config: PPOConfig | TRPOConfig,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        *,
        seed: int,
        n_slots: int,
        slot_length: int,
        total_steps: int,
        dtype: torch.dtype = torch.float32,
        device: str = "cpu",
        stacked: bool | None = None,
    ) -> None:
        torch.set_num_threads(1)  # 1 and 2 threads give different gradients
        refuse(config, observation_space, action_space)
        compilable = isinstance(config, PPOConfig) and device == "cpu"
        self.stacked = not compilable if stacked is None else stacked
        super().__init__(
            config, observation_space, action_space,
            seed=seed, n_slots=n_slots, slot_length=slot_length, total_steps=total_steps,
        )  # fmt: skip
        self.model.policy.to(dtype)
        self.settings, self.seed, self.dtype, self.device = config, seed, dtype, torch.device(device)
        self.shape = _shape(config, observation_space, action_space)
        self.key = (stack_key(config, observation_space, action_space), dtype, device, self.stacked)

    @property
    def learners(self) -> Sequence[PopulationLearner]:
        """See `Learner`."""
        return (self,)

    @property
    def _compiled(self) -> bool:
        return not self.stacked

    def update(
        self, shards: Sequence[Shard], *, round: int, steps: int, acted: Mapping[str, NDArray[Any]] | None = None
    ) -> Update:  # fmt: skip
        """As `Learner.update`; the shards must be those of the present weights."""
        if acted is not None:
            raise RuntimeError("a population learns from rounds of its present weights only")
        (result,) = learn_together([self], [shards], round=[round], steps=[steps])
        if isinstance(result, SpaceDistError):
            raise result
        return result

    def begin(self, steps: int) -> float:
        """The learning rate of the update that ends at `steps` environment steps."""
        model = self.model
        model.num_timesteps = steps
        model._update_current_progress_remaining(steps, self._total_steps)
        model._update_learning_rate(model.policy.optimizer)
        return float(model.policy.optimizer.param_groups[0]["lr"])

    def conclude(self, stack: Stack, member: int, made: Report, collected: _Round) -> Update:
        """Take over a member's weights and Adam state, and report as SB3 does."""
        before, model = self._gradient_steps(), self.model
        for name, parameter in model.policy.named_parameters():
            with torch.no_grad():
                parameter.copy_(stack.parameter(stack.weights, name)[member])
            if isinstance(self.settings, PPOConfig) or stack.layout.names[name][0] != ACTOR:  # TRPO's has no Adam
                model.policy.optimizer.state[parameter] = {
                    "step": stack.steps[member].to("cpu", copy=True),
                    "exp_avg": stack.parameter(stack.exp_avg, name)[member]
                    .cpu()
                    .clone(memory_format=torch.contiguous_format),
                    "exp_avg_sq": stack.parameter(stack.exp_avg_sq, name)[member]
                    .cpu()
                    .clone(memory_format=torch.contiguous_format),
                }
        model._n_updates += made.updates
        metrics = {
            **made.metrics,
            "explained_variance": explained_variance(_flat(collected.values), _flat(collected.returns)),
            "n_updates": model._n_updates,
        }
        if not self.shape.discrete:
            metrics["std"] = torch.exp(model.policy.log_std).mean().item()
        for name, metric in metrics.items():
            model.logger.record(f"train/{name}", metric)
        self._advantages = collected.advantages.astype(np.float64) * self.statistics.reward_std
        return self._learnt(collected.shards, before)


def refuse(config: LearnerConfig, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
    """Raise ConfigError where the population engine cannot learn."""
    if not config.can_be_stacked:
        able = " or ".join(learners_that("can_be_stacked"))
        raise ConfigError(f"engine: population learns with learner.kind: {able}, not {config.kind}")
    if config.policy != "MlpPolicy":
        raise ConfigError(f"engine: population learns with learner.policy: MlpPolicy, not {config.policy}")
    if config.import_path is not None:
        raise ConfigError("engine: population has updates of its own; a class that learner.import names needs single")
    if not isinstance(observation_space, spaces.Box) or len(observation_space.shape) != 1:
        raise ConfigError(
            f"engine: population needs flat observations (a one-dimensional Box), not {observation_space}"
        )
    flat = isinstance(action_space, spaces.Box) and len(action_space.shape) == 1
    if not flat and not isinstance(action_space, spaces.Discrete):
        raise ConfigError(
            f"engine: population needs actions that are a one-dimensional Box or Discrete, not {action_space}"
        )


def stack_key(config: LearnerConfig, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> Hashable:
    """Equal for learners that can be updated together. Raises ConfigError as `refuse`."""
    refuse(config, observation_space, action_space)
    if not isinstance(config, PPOConfig | TRPOConfig):
        raise TypeError(config)
    shape = _shape(config, observation_space, action_space)
    return (config.kind, shape, config.n_steps, config.batch_size, _passes(config))


def member_bytes(
    config: LearnerConfig, observation_space: spaces.Space[Any], action_space: spaces.Space[Any], device: str
) -> int:
    """About what a member takes of its process's memory while it learns, no less: rollouts, activations, networks."""
    if not isinstance(config, PPOConfig | TRPOConfig):
        raise TypeError(config)
    shape = _shape(config, observation_space, action_space)
    parameters = 2 * Layout(shape).length
    if isinstance(config, PPOConfig) and device == "cpu":  # one learns at a time, and the others hold what they are
        numbers = config.n_steps * _WAITING_COPIES * (shape.inputs + shape.outputs + _PER_STEP)
        return _OBJECTS_BYTES + _NUMBER_BYTES * (numbers + parameters * _PARAMETER_COPIES)
    # TRPO's products with the Hessian go over the whole rollout at once, and need all that the actor has computed.
    samples, kept = (config.n_steps, _TRPO_KEPT) if isinstance(config, TRPOConfig) else (config.batch_size, _PPO_KEPT)
    numbers = (
        config.n_steps * _ROLLOUT_COPIES * (shape.inputs + shape.outputs + _PER_STEP)
        + samples * kept * sum(shape.sizes)
        + parameters * _PARAMETER_COPIES
    )
    return _OBJECTS_BYTES + _NUMBER_BYTES * numbers


def _passes(config: PPOConfig | TRPOConfig) -> int:
    """Permutations that an update draws: one for each epoch; or for the actor's step and each pass of the critic."""
    return config.n_epochs if isinstance(config, PPOConfig) else 1 + config.n_critic_updates


def _shape(
    config: PPOConfig | TRPOConfig, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
) -> Shape:
    outputs = action_space.n if isinstance(action_space, spaces.Discrete) else np.prod(action_space.shape or ())
    return Shape(
        inputs=int(np.prod(observation_space.shape or ())), outputs=int(outputs),
        discrete=isinstance(action_space, spaces.Discrete),
        hidden=tuple(config.net_arch), activation=config.activation,
    )  # fmt: skip


def learn_together(
    learners: Sequence[PopulationLearner],
    rounds: Sequence[Sequence[Shard]],
    *,
    round: Sequence[int],
    steps: Sequence[int],
) -> list[Update | SpaceDistError]:
    """One update of every learner, on its own round's shards; of one whose networks are no numbers then, the error.

    round, steps: each learner's, as in `Learner.update`. Raises RuntimeError if the learners' keys are not equal.
    """
    if len({learner.key for learner in learners}) != 1:
        raise RuntimeError(f"learners of different shapes cannot learn together: {[one.key for one in learners]}")
    if not learners[0].stacked:
        return [
            _alone(learner, shards, at, reached)
            for learner, shards, at, reached in zip(learners, rounds, round, steps, strict=True)
        ]
    for shards in rounds:
        require_order(shards)
    # One alone is its own companion: matrices that are not stacked may be multiplied in another way.
    members = [*learners, *learners][: max(2, len(learners))]
    shards_of, round_of, steps_of = ([*given, *given][: len(members)] for given in (rounds, round, steps))
    stack = _stacked(members)
    collected, samples = _evaluated(stack, members, shards_of)
    config = members[0].settings
    seeds = [global_seeds(learner.seed, Purpose.UPDATE, at) for learner, at in zip(members, round_of, strict=True)]
    # What SB3 draws permutations from, where NumPy's global generator is seeded for it.
    randoms = [np.random.RandomState(for_numpy) for _, for_numpy, _ in seeds]
    orders = (np.stack([random.permutation(config.n_steps) for random in randoms]) for _ in range(_passes(config)))
    own = [(learner.settings, learner.begin(reached)) for learner, reached in zip(members, steps_of, strict=True)]
    if isinstance(config, PPOConfig):
        ppo = [_ppo(one, rate) for one, rate in own if isinstance(one, PPOConfig)]
        reports = PPO(stack, samples, ppo, config.batch_size).run(orders)
    else:
        trpo = [_trpo(one, rate) for one, rate in own if isinstance(one, TRPOConfig)]
        noise = torch.stack([_noise(stack, for_torch) for _, _, for_torch in seeds])
        reports = TRPO(stack, samples, trpo, config.batch_size, noise).run(orders)
    finite = stack.finite()
    return [
        learner.conclude(stack, member, reports[member], collected[member])
        if finite[member]
        else divergence(round[member], NOT_A_NUMBER)
        for member, learner in enumerate(learners)
    ]


def _alone(learner: PopulationLearner, shards: Sequence[Shard], round: int, steps: int) -> Update | SpaceDistError:
    try:
        return OnPolicyLearner.update(learner, shards, round=round, steps=steps)
    except SpaceDistError as error:
        return error


def _ppo(config: PPOConfig, learning_rate: float) -> PPOSettings:
    return PPOSettings(
        learning_rate=learning_rate, clip_range=config.clip_range, ent_coef=config.ent_coef, vf_coef=config.vf_coef,
        normalize_advantage=config.normalize_advantage,
        max_grad_norm=math.inf if config.max_grad_norm is None else config.max_grad_norm,
        target_kl=math.inf if config.target_kl is None else config.target_kl,
    )  # fmt: skip


def _trpo(config: TRPOConfig, learning_rate: float) -> TRPOSettings:
    return TRPOSettings(
        learning_rate=learning_rate, target_kl=config.target_kl, normalize_advantage=config.normalize_advantage,
        cg_max_steps=config.cg_max_steps, cg_damping=config.cg_damping,
        line_search_shrinking_factor=config.line_search_shrinking_factor,
        line_search_max_iter=config.line_search_max_iter,
    )  # fmt: skip


def _noise(stack: Stack, seed: int) -> torch.Tensor:
    """What sb3-contrib starts conjugate gradients from, where torch's global generator is seeded for it."""
    count = sum(
        stack.parameter(stack.weights, name)[0].numel()
        for name, (network, _, _) in stack.layout.names.items()
        if network == ACTOR
    )
    noise = torch.randn(count, dtype=stack.dtype, generator=torch.Generator().manual_seed(seed))
    return noise.to(stack.device)


def _stacked(members: Sequence[PopulationLearner]) -> Stack:
    """Weights and Adam state of all members, copied."""
    first = members[0]
    stack = Stack(first.shape, len(members), device=first.device, dtype=first.dtype)
    parameters = [dict(learner.model.policy.named_parameters()) for learner in members]
    states = [learner.model.policy.optimizer.state for learner in members]
    for name in stack.layout.names:
        mine = [one[name] for one in parameters]
        stack.parameter(stack.weights, name).copy_(torch.stack([parameter.detach() for parameter in mine]))
        for moment, rows in (("exp_avg", stack.exp_avg), ("exp_avg_sq", stack.exp_avg_sq)):
            moments = [
                state[parameter][moment] if parameter in state else torch.zeros_like(parameter)
                for state, parameter in zip(states, mine, strict=True)
            ]
            stack.parameter(rows, name).copy_(torch.stack(moments))
    stack.steps.copy_(torch.tensor([float(learner._gradient_steps()) for learner in members]))
    return stack


def _evaluated(
    stack: Stack, members: Sequence[PopulationLearner], rounds: Sequence[Sequence[Shard]]
) -> tuple[list[_Round], Samples]:
    """What the members collected, with values, log-probabilities and advantages under the weights that acted.

    As in `OnPolicyLearner.fill`: the value behind a truncated step is added to its reward, and an episode that goes on
    is bootstrapped from the value of its last observation.
    """
    joined = [learner.joined(shards) for learner, shards in zip(members, rounds, strict=True)]
    config = members[0].settings
    count = config.n_steps
    rows = rounded_up(min(config.batch_size, count), ROWS)
    beyond = [
        learner.statistics.scaled(
            concatenate([*(one.truncated_observations for one in shards), *(one.last_observations for one in shards)])
        )
        for learner, shards in zip(members, rounds, strict=True)
    ]
    length = rounded_up(count + max(len(one) for one in beyond), rows)
    observations = np.zeros((len(members), length, stack.shape.inputs), dtype=np.float32)
    width, kind = (1, np.int64) if stack.shape.discrete else (stack.shape.outputs, np.float32)
    actions = np.zeros((len(members), length, width), dtype=kind)
    for member, (one, more) in enumerate(zip(joined, beyond, strict=True)):
        if isinstance(one.observations, dict) or isinstance(more, dict):
            raise TypeError("a population takes flat observations")
        observations[member, :count] = _flat(one.observations)
        observations[member, count : count + len(more)] = more
        actions[member, :count] = _flat(one.actions).reshape(count, -1)
    seen, done = (torch.from_numpy(array).to(stack.device) for array in (observations, actions))
    values, log_probs = evaluate(stack, seen, done, rows)
    collected = _advantages_of(members, rounds, joined, values.cpu().numpy())

    def together(arrays: Sequence[Array]) -> torch.Tensor:
        return torch.from_numpy(np.stack([_flat(array) for array in arrays])).to(stack.device)

    return collected, Samples(
        observations=seen[:, :count].contiguous(), actions=done[:, :count].contiguous(),
        log_probs=log_probs[:, :count].float().contiguous(),
        advantages=together([
            np.zeros_like(one.advantages) if leaves_policy(learner.settings, one.shards) else one.advantages
            for learner, one in zip(members, collected, strict=True)
        ]),
        returns=together([one.returns for one in collected]),
    )  # fmt: skip


def _advantages_of(
    members: Sequence[PopulationLearner], rounds: Sequence[Sequence[Shard]], joined: Sequence[Joined], values: Floats
) -> list[_Round]:
    """values: (members, all) of the samples, slot by slot, then of truncated episodes' ends, then of the slots' ends.

    Members whose slots are equally many and long are computed together.
    """
    groups: dict[tuple[int, ...], list[int]] = {}
    for member, one in enumerate(joined):
        groups.setdefault(one.rewards.shape, []).append(member)
    collected: dict[int, _Round] = {}
    for (length, slots), group in groups.items():
        count = length * slots
        mine = values[group, :count].astype(np.float32).reshape(len(group), slots, length).transpose(2, 0, 1)
        rewards = np.stack([joined[member].rewards for member in group], axis=1)
        last_values = np.empty((len(group), slots), dtype=values.dtype)
        for index, member in enumerate(group):
            first_slot, first = 0, count
            for shard in rounds[member]:
                places = np.argwhere(shard.truncated)
                behind = values[member, first : first + len(places)]
                rewards[places[:, 0], index, places[:, 1] + first_slot] += members[member].settings.gamma * behind
                first_slot, first = first_slot + shard.rewards.shape[1], first + len(places)
            last_values[index] = values[member, first : first + slots]
        gammas = [members[member].settings.gamma for member in group]
        decays = [members[member].settings.gamma * members[member].settings.gae_lambda for member in group]
        advantages = _advantages(
            rewards, mine, last_values, np.stack([joined[member].ended for member in group], axis=1),
            *(np.array(numbers, dtype=np.float32)[:, None] for numbers in (gammas, decays)),
        )  # fmt: skip
        for index, member in enumerate(group):
            collected[member] = _Round(rounds[member], joined[member], mine[:, index], advantages[:, index])
    return [collected[member] for member in range(len(members))]


def _flat(array: NDArray[Any]) -> NDArray[Any]:
    """`(length, slots, ...) -> (slots * length, ...)`, as SB3's buffer does before it draws minibatches."""
    return array.swapaxes(0, 1).reshape(-1, *array.shape[2:])


def _advantages(
    rewards: Array, values: Array, last_values: Floats, ended: NDArray[np.bool_], gammas: Array, decays: Array
) -> Array:
    """Generalised advantages, (length, members, slots), as SB3's buffer computes them, to the bit.

    rewards, values, ended: likewise.  last_values: (members, slots).  gammas, decays (gamma lambda): (members, 1).
    """
    advantages = np.empty_like(rewards)
    following, behind = np.zeros_like(last_values), last_values
    with np.errstate(invalid="ignore"):  # of infinite rewards: the update says that training diverged
        for time in range(len(rewards) - 1, -1, -1):
            going_on = 1 - ended[time].astype(np.float32)
            following = rewards[time] + gammas * behind * going_on - values[time] + decays * going_on * following
            advantages[time], behind = following, values[time]
    return advantages
