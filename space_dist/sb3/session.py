"""One model's curriculum while `learn` goes on, and what the model remembers of it.

It is `training.Training` without its collecting, learning and bookkeeping, and follows it step by step: a *round* is
one rollout of an on-policy model, or rollouts of at least `round_steps` steps; behind its update, the start values of
all instances are asked for where the selection was passed over once (draws: always), and the curriculum decides.

What there is to remember is written into the model as text, at the beginning of every round and of every rollout of an
on-policy model, and when `learn` returns: `model.save` saves it with the model, whoever calls it, and a callback that
meets a model with such a text goes on from there. The text is a checkpoint as `ledger` encodes them, in base64: arrays
and JSON under a hash, and never a pickle.
"""

from __future__ import annotations

import base64
import contextlib
import random
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from space_dist.config import (
    CurriculumConfig,
    GrowingConfig,
    PPOConfig,
    Section,
    ValueDisagreementConfig,
    changes,
)
from space_dist.curricula import (
    GENERATED,
    Draws,
    Episodes,
    Selection,
    State,
    decode_state,
    encode_state,
)
from space_dist.curricula.configured import Makers
from space_dist.envs import BatchedEnv
from space_dist.envs.generating import EnvironmentGenerator
from space_dist.envs.interface import knows_success, starts_alike
from space_dist.envs.observations import put, take
from space_dist.envs.spec import EnvironmentSpec
from space_dist.errors import ConfigError, SpaceDistError
from space_dist.ledger import Checkpoint, decode_checkpoint, encode_checkpoint
from space_dist.rollout import Outcomes, Setup, Worker, endless
from space_dist.rollout.episodes import curriculum_episodes, joined_episodes, mean_sizes, rounds_over
from space_dist.rollout.policy import Valuing
from space_dist.rollout.walk import Unfinished, Walk, stacked, unstacked
from space_dist.run.cluster import CurriculumHost, Evidence
from space_dist.sb3.script import Scored, Wrapped, gradient_steps, network, refuse_model, weights, with_weights
from space_dist.sb3.vec_env import ContextVecEnv, Played, RoundPlan
from space_dist.seeding import Purpose, episode_seeds, global_generators, global_seeds

if TYPE_CHECKING:
    from space_dist.learner import Ensemble

FloatArray = NDArray[np.float64]

STATE = "curriculum_state"  # the model's attribute
_SCALED = "VecNormalize"  # in what it remembers
_ROUND_STEPS = 512  # of an off-policy model, whose rollouts are a few steps; as `learner.n_steps` of a config
_COMPARED_STARTS = 4096  # instances that are enough to see whether starts differ
_MOST_TEXT = 1 << 30  # characters


class Asked(Section):
    """The arguments of `CurriculumCallback`."""

    curriculum: CurriculumConfig
    passes: float = Field(default=1.0, gt=0.0)
    start_states: int = Field(default=1, ge=1, le=1000)
    round_steps: int | None = Field(default=None, ge=1)


@dataclass(frozen=True)
class _ScriptsSpec(EnvironmentSpec):
    """Of an environment that a script makes."""

    maker: Callable[[int], BatchedEnv] = field(kw_only=True)

    def make(self, n_slots: int) -> BatchedEnv:
        """See `EnvironmentSpec`."""
        return self.maker(n_slots)

    def generator(self) -> EnvironmentGenerator:
        """See `EnvironmentSpec`."""
        return EnvironmentGenerator(self.opened, "ContextVecEnv's environment")


class Session:
    """One model's curriculum. Public fields are those that change from round to round; `_checkpoint` knows them all."""

    def __init__(self, asked: Asked, model: BaseAlgorithm, wrapped: Wrapped) -> None:
        refuse_model(model)
        self._asked, self._model, self.wrapped, self.env = asked, model, wrapped, wrapped.env
        self._on_policy = isinstance(model, OnPolicyAlgorithm)
        self._shape_rounds()
        self._restored_random: Mapping[str, Any] | None = None  # to go on with, behind the next `begin_round`
        self._open = False  # whether a rollout is being collected
        self._plan: RoundPlan | None = None  # of the round that is played
        self._make()
        self.round = 0
        self.walk = Walk(-1, ())
        self.learnt: Played | None = None  # of this round: the on-policy model's rollouts that have ended
        self.sizes_now: list[FloatArray] = []  # what counts of their advantages
        self.sizes: FloatArray | None = None  # (n_envs,) sums of that over running episodes, before this round
        self.seen: list[Episodes] = []  # of this iteration's rounds
        self.gradient_steps = gradient_steps(model)  # as of the last decision
        self.scored: dict[str, NDArray[Any]] = {}  # weights that `values` belong to, where scales change
        self.numbers: Mapping[str, Any] = {}

    def is_of(self, model: BaseAlgorithm, env: ContextVecEnv) -> bool:
        """Whether it is about this model in this environment."""
        return model is self._model and env is self.env

    def _shape_rounds(self) -> None:
        """How many steps a round has."""
        model, env, asked = self._model, self.env, self._asked.round_steps
        by_episodes = False
        if isinstance(model, OnPolicyAlgorithm):
            rollout = model.n_steps * env.num_envs
            wanted = asked or rollout
        elif isinstance(model, OffPolicyAlgorithm):
            every = model.train_freq
            if not isinstance(every, TrainFreq):
                raise TypeError(f"SB3 has not converted train_freq: {every}")
            by_episodes = every.unit == TrainFrequencyUnit.EPISODE
            rollout = every.frequency * (env.horizon if by_episodes else env.num_envs)
            wanted = asked or _ROUND_STEPS
        if by_episodes:  # ends behind the episode that makes it long enough
            self._round_steps, most = wanted, wanted + rollout
        else:
            self._round_steps = most = -(-wanted // rollout) * rollout
        self._length = -(-most // env.num_envs)

    def _make(self) -> None:
        """The curriculum, its host, and whoever scores instances, of the environment's seed."""
        settings, env, model = self._asked.curriculum, self.env, self._model
        if isinstance(settings, GrowingConfig) and settings.aggregate != "own":
            raise ConfigError(
                "CurriculumCallback: aggregate: population trains several policies that share a curriculum, and a "
                "script has one; use aggregate: own"
            )
        source = "ContextVecEnv's instances"
        spec = _ScriptsSpec(
            "", env.context_visible, {}, env.horizon, env.observation_space, env.action_space, env.bounds,
            maker=env.make_batched,
        )  # fmt: skip
        makers = Makers(
            env.instances, source=source, seed=env.run_seed, draws=Draws(self._length * env.num_envs, 1),
            bounds=env.bounds, generator=spec.generator,
        )  # fmt: skip
        self._host = CurriculumHost(makers.make(settings), settings)
        self._wants = self._host.curriculum.wants
        setup = Setup(
            spec=spec, seed=env.run_seed, gamma=self._gamma, shards=1, slots=env.num_envs, slot_length=self._length,
            start_states=self._asked.start_states, evaluation_episodes=1, train=env.instances, test=env.instances,
        )  # fmt: skip
        self._setup, self._worker = setup, Worker(setup)
        buffer = getattr(model, "rollout_buffer", None)
        if self._wants.advantages and not hasattr(buffer, "compute_returns_and_advantage"):
            raise ConfigError(
                f"CurriculumCallback: {settings.kind} scores episodes by their advantages, which "
                f"{type(model).__name__} does not compute; PPO, A2C, TRPO, MaskablePPO and RecurrentPPO do"
            )
        if self._wants.unlearned:
            raise ConfigError(
                f"CurriculumCallback: {settings.kind}, as it is set, plays rounds that are not learned from, and "
                "model.learn learns from every one: train with space-dist"
                + (", or set robust: false" if "robust" in type(settings).model_fields else "")
            )
        if self._wants.probes:
            self._refuse_probes()
        if self._wants.probes or self._wants.success:
            self._refuse_silence()
        if settings.ranks_by_start_value:
            self._refuse_blindness()
        self._ensemble = self._made_ensemble() if isinstance(settings, ValueDisagreementConfig) else None

    def _refuse_probes(self) -> None:
        kind, name = self._asked.curriculum.kind, type(self._model).__name__
        if name in ("MaskablePPO", "RecurrentPPO"):
            raise ConfigError(
                f"CurriculumCallback: {kind} plays episodes of its own, in which {name} could not act: it asks for "
                + ("masks" if name == "MaskablePPO" else "what it remembers of the episode")
            )

    def _refuse_silence(self) -> None:
        kind = self._asked.curriculum.kind
        with self.env.opened(1) as env:
            success_is_known = knows_success(env, self._host.curriculum.start()[1].contexts[:1])
        if not success_is_known:
            raise ConfigError(
                f"CurriculumCallback: {kind} needs to know whether an episode succeeded, and the environment does not "
                "say (its steps have no `success`)"
            )

    def _refuse_blindness(self) -> None:
        contexts = self.env.instances.contexts[:_COMPARED_STARTS]
        with self.env.opened(len(contexts)) as env:
            blind = starts_alike(env, contexts)
        if blind:
            raise ConfigError(
                f"CurriculumCallback: {self._asked.curriculum.kind} ranks instances by the value of their start, but "
                "all instances start with the same observation, so all values tie and the order would be a random one. "
                "Use ContextVecEnv(..., context_visible=True)"
            )

    def _made_ensemble(self) -> Ensemble:
        # It replaces kernels of torch's in this process, so it comes only where it is asked for.
        from space_dist.learner import Ensemble

        settings, env = self._asked.curriculum, self.env
        if not isinstance(settings, ValueDisagreementConfig):
            raise TypeError(settings)
        if settings.members_see is not None and not env.context_visible:
            raise ConfigError(
                "CurriculumCallback: members_see: observations hold no context with context_visible=False"
            )
        net_arch, activation = network(self._model)
        alike = {"kind": "ppo", "gamma": self._gamma, "net_arch": net_arch, "activation": activation}
        return Ensemble(
            settings, PPOConfig.model_validate(alike), env.observation_space, env.bounds.names, seed=env.run_seed
        )

    @property
    def _gamma(self) -> float:
        return float(getattr(self._model, "gamma", 1.0))

    # ---- decisions ----

    def begin(self) -> None:
        """Select for the first time."""
        state, selection, _, values = self._host.begin(*self._start_values())
        self._adopt(state, selection, values)

    def _adopt(self, state: State, selection: Selection, values: FloatArray) -> None:
        self.state, self.selection, self.values = state, selection, values
        episodes = self._asked.passes * len(selection.ids)
        self.rounds_left = 1 if selection.drawn else rounds_over(episodes, self.env.horizon, self._round_steps)
        if self.wrapped.normaliser is not None:
            self.scored = weights(self._model)

    def _start_values(self, policy: Valuing | None = None) -> list[FloatArray]:
        asked = policy or Scored(self._model, self.wrapped)
        return [self._worker.start_values(asked, chunk) for chunk in range(self._setup.chunks)]

    def _decide(self) -> None:
        version, steps = self.state.version, gradient_steps(self._model)
        seen = joined_episodes(self.seen) if self._wants.episodes else None
        probes = self._probed(seen)
        settings = self._asked.curriculum
        from_zero = version == 0 and isinstance(settings, GrowingConfig) and settings.v0 == "zero"
        rescored: list[FloatArray] = []
        if self.wrapped.normaliser is not None and not from_zero:
            # Both values at one scale: else a change of scale would look like progress.
            with with_weights(self._model, self.scored):
                rescored = self._start_values()
        context_values = []
        if seen is not None and (seen.indices == GENERATED).any():
            scored = Scored(self._model, self.wrapped)
            context_values = [self._worker.context_values(scored, seen.contexts, version)]
        ensemble = self._ensemble
        evidence = Evidence(
            after=self._start_values(), rescored=rescored, episodes=[] if seen is None else [seen],
            ensemble=[] if ensemble is None else self._start_values(ensemble.policy(self.wrapped.statistics)),
            context_values=context_values, probes=probes,
        )  # fmt: skip
        layout, pieces = evidence.flat()
        state, selection, self.numbers, values = self._host.decide(
            self.state, self.values, version, steps - self.gradient_steps, layout, *pieces
        )
        self._adopt(state, selection, values)
        self.seen, self.gradient_steps = [], steps

    # ---- rounds ----

    @property
    def plays(self) -> bool:
        """Whether the environment is in the midst of this session's round: others may have used it meanwhile."""
        return self.env.driven and self.env.plan is self._plan

    def on_rollout_start(self) -> bool:
        """Begin a round where the last one is over; returns whether there was a decision."""
        env, decided = self.env, False
        broken = self._open and self._on_policy  # SB3 has thrown away what was collected
        if self.plays and not broken and env.time * env.num_envs >= self._round_steps:
            decided = self._end_round()
        begins = not self.plays or broken
        if begins:
            self._begin_round()
            if env.time * env.num_envs >= self._round_steps:  # it was broken off behind its last rollout
                decided = self._end_round()
                self._begin_round()
            if self._restored_random is not None:
                _restore_random(self._model, self._restored_random)
                self._restored_random = None
        if begins or self._on_policy:
            self._write()
        self._open = True
        return decided

    def on_rollout_end(self) -> None:
        """Note what is learnt from, and its advantages before the update lays them out in its own way."""
        self._open = False
        if self._on_policy:
            self.learnt = self.env.played()
        if self._wants.advantages:
            model: Any = self._model
            advantages: FloatArray = (
                model.rollout_buffer.advantages.astype(np.float64) * self.wrapped.statistics.reward_std
            )
            self.sizes_now.append(self._wants.counted(advantages))

    def on_training_end(self) -> bool:
        """A round ends with `learn`, unless its last rollout was broken off and will never be learnt from."""
        if not self.plays or not self.env.time or (self._open and self._on_policy):
            return False
        self._open = False
        decided = self._end_round()
        self._write()
        return decided

    def _begin_round(self) -> None:
        walk, env = self.walk, self.env
        unfinished = walk.running(0)
        if unfinished is not None and len(unfinished.ids) != env.num_envs:  # saved with another number of them
            unfinished, self.sizes = None, None
        start = walk.position(self.selection, 0, 1)
        self._plan = RoundPlan(self.selection, start, self._gamma, env.run_seed, self.round, unfinished)
        current = env.begin_round(self._plan, length=self._length, record=self._ensemble is not None)
        if self.learnt is not None:  # in this round, which was broken off in a later rollout
            current = env.play_again(self.learnt)
        self.wrapped.put(self._model, current)

    def _end_round(self) -> bool:
        """Take in what a round showed, behind its update, and decide where an iteration is over."""
        shard = self.env.end_round()
        self.walk = self.walk.after(self.selection, [shard.begun], [shard.unfinished], n_shards=1)
        self.round += 1
        self.rounds_left -= 1
        if self._wants.episodes:
            means = None
            if self._wants.advantages:
                sizes = np.concatenate(self.sizes_now)
                before = np.zeros(sizes.shape[1]) if self.sizes is None else self.sizes
                means, self.sizes = mean_sizes([shard], sizes, before)
            self.seen.append(curriculum_episodes(self.env.instances, [shard], means))
        if self._ensemble is not None:
            self._ensemble.update([shard], self.wrapped.statistics, round=shard.round)
        self.learnt, self.sizes_now = None, []
        if self.rounds_left > 0:
            return False
        self._decide()
        return True

    def _probed(self, seen: Episodes | None) -> list[Outcomes]:
        """Play the probe episodes that the curriculum asks for, if any; their steps are the model's like any others.

        There are none where they, at their longest, would leave no room for another round. They are played as
        `model.predict` acts where it explores, on an environment and random numbers of their own.
        """
        env, model = self.env, self._model
        indices = self._host.curriculum.probes(self.state, seen) if self._wants.probes else None
        if indices is None:
            return []
        most = model.num_timesteps + len(indices) * env.horizon + self._round_steps
        if most > model._total_timesteps:
            return []
        version = self.state.version
        seeds = episode_seeds(env.run_seed, Purpose.PROBE_EPISODES, version, count=len(indices))
        outcomes = []
        with _random_apart(env.run_seed, version):
            for first in range(0, len(indices), env.num_envs):
                some = slice(first, first + env.num_envs)
                with env.opened(len(indices[some])) as played:
                    outcomes.append(self._played(played, env.instances.contexts[indices[some]], seeds[some]))
        model.num_timesteps += sum(int(part.lengths.sum()) for part in outcomes)
        return outcomes

    def _played(self, env: BatchedEnv, contexts: FloatArray, seeds: NDArray[np.uint64]) -> Outcomes:
        """Episodes of (k, d) contexts with (k,) seeds, in one batch of `env`, which has k slots."""
        count = len(contexts)
        observations = take(env.reset(np.arange(count), contexts, seeds), slice(None))
        alive, success = np.ones(count, dtype=np.bool_), np.full(count, np.nan)
        returns, discounted, backward = np.zeros(count), np.zeros(count), np.zeros(count)
        lengths, discount = np.zeros(count, dtype=np.int64), 1.0
        while alive.any():
            if lengths.max() == env.horizon:
                raise endless(env)
            inputs: Any = self.wrapped.seen(observations)
            actions, _ = self._model.predict(inputs, deterministic=False)
            step = env.step(np.asarray(actions))
            returns += np.where(alive, step.rewards, 0.0)
            discounted += np.where(alive, discount * step.rewards, 0.0)
            backward = np.where(alive, self._gamma * backward + step.rewards, backward)
            discount *= self._gamma
            lengths += alive
            if step.success is not None:
                success = np.where(alive, step.success, success)
            observations = take(step.observations, slice(None))
            ended = np.flatnonzero(step.terminated | step.truncated)
            alive[ended] = False
            if len(ended) and alive.any():  # every slot must be steppable; what follows in these is not counted
                begun = env.reset(ended, contexts[ended], seeds[ended])
                put(observations, ended, begun)
        return Outcomes(self.round, returns, discounted, lengths, success, backward)

    # ---- what a model remembers ----

    def _identity(self) -> dict[str, Any]:
        """What must be the same for a model to go on: settings, the instances' digest, and what is normalised."""
        asked = self._asked.model_dump(mode="json", exclude_defaults=True)
        return {**asked, "instances": self.env.instances.digest(), _SCALED: self.wrapped.scaled}

    def _write(self) -> None:
        """Have the model remember how to go on from here."""
        setattr(self._model, STATE, base64.b64encode(encode_checkpoint(self._checkpoint())).decode())

    def _checkpoint(self) -> Checkpoint:
        remembered, numbers = encode_state(self.state)
        arrays: dict[str, NDArray[Any]] = {"values": self.values}
        arrays |= {f"curriculum/{name}": array for name, array in remembered.items()}
        arrays |= {f"scored/{name}": array for name, array in self.scored.items()}
        arrays |= {f"unfinished/{name}": array for name, array in stacked(self.walk).items()}
        if self.seen:
            arrays |= {f"seen/{name}": array for name, array in vars(joined_episodes(self.seen)).items()}
        if self.sizes is not None:
            arrays["sizes"] = self.sizes
        if self.learnt is not None:
            arrays |= {f"learnt/{name}": array for name, array in vars(self.learnt).items()}
        if self.sizes_now:
            arrays["sizes_now"] = np.concatenate(self.sizes_now)
        if self._ensemble is not None:
            arrays |= {f"ensemble/{name}": array for name, array in self._ensemble.save().items()}
        random_arrays, random_numbers = _random_state(self._model)
        arrays |= {f"random/{name}": array for name, array in random_arrays.items()}
        data = {
            "asked": self._identity(),
            "curriculum": numbers,
            "numbers": dict(self.numbers),
            "random": random_numbers,
            "run": {
                "seed": self.env.run_seed, "steps": self._model.num_timesteps, "rounds_left": self.rounds_left,
                "walk": [self.walk.order_version, list(self.walk.positions)], "gradient_steps": self.gradient_steps,
                "gradient_steps_now": gradient_steps(self._model),
            },
        }  # fmt: skip
        return Checkpoint(self.round, arrays, data)

    def remember(self, text: object) -> None:
        """Go on with what a model remembers. Raises ConfigError if that belongs to another curriculum."""
        with _readable():
            if not isinstance(text, str) or len(text) > _MOST_TEXT:
                raise ValueError(f"it is a {type(text).__name__}")
            checkpoint = decode_checkpoint(base64.b64decode(text, validate=True))
            asked, now = checkpoint.data["asked"], self._identity()
            found = changes({_SCALED: now[_SCALED], **asked}, now)  # models of before it was kept lack it
        others = ["the instances are others"] if found.pop("instances", None) else []
        differences = others + [
            f"{key} was {_told(before)} and is {_told(after)}" for key, (before, after) in found.items()
        ]
        if differences:
            raise ConfigError(
                f"CurriculumCallback: the model remembers another curriculum: {'; '.join(differences)}. "
                "Ask for the same, or begin anew with CurriculumCallback(..., resume=False)"
            )
        with _readable():
            self._restore(checkpoint)

    def _restore(self, checkpoint: Checkpoint) -> None:
        arrays, run, env, model = checkpoint.arrays, checkpoint.data["run"], self.env, self._model
        env.run_seed = int(run["seed"])
        self._make()
        curriculum = self._host.curriculum
        self.state = decode_state(curriculum.state_type, _under("curriculum/", arrays), checkpoint.data["curriculum"])
        self.selection, self.values = curriculum.selection(self.state), arrays["values"]
        if self.values.shape != (len(env.instances),) or self.selection.version != self.state.version:
            raise ValueError("its values are not those of these instances")
        order, positions = run["walk"]
        self.walk = Walk(int(order), tuple(int(position) for position in positions), self._unfinished(arrays))
        self.round, self.rounds_left = checkpoint.round, int(run["rounds_left"])
        self.gradient_steps, self.numbers = int(run["gradient_steps"]), checkpoint.data["numbers"]
        self.sizes, self.scored = arrays.get("sizes"), _under("scored/", arrays)
        seen = _under("seen/", arrays)
        self.seen = [Episodes(**seen)] if seen else []
        if self._ensemble is not None:
            self._ensemble.load(_under("ensemble/", arrays))
        behind = model.num_timesteps - int(run["steps"])
        rollout = model.n_steps * env.num_envs if isinstance(model, OnPolicyAlgorithm) else 0
        learnt_since = gradient_steps(model) != run.get("gradient_steps_now", gradient_steps(model))
        goes_on = self._restore_round(arrays) and not learnt_since
        if goes_on and 0 <= behind <= rollout:  # what had been collected since, SB3 does not save: collected again
            model.num_timesteps = int(run["steps"])
            self._restored_random = {**_under("random/", arrays), "numbers": checkpoint.data["random"]}
        elif behind > 0 or not goes_on:  # in the midst of a round, whose first steps were learnt from: another follows
            self.round += 1
            self.learnt, self.sizes_now = None, []

    def _restore_round(self, arrays: Mapping[str, NDArray[Any]]) -> bool:
        """Take in which rollouts of a round were learnt from; False: it cannot go on, for it had another shape."""
        found, model = _under("learnt/", arrays), self._model
        if not found:
            return True
        learnt = Played(**found)
        steps, slots = learnt.rewards.shape
        shape = (steps, slots, *(self.env.action_space.shape or ()))
        if learnt.actions.shape != shape or learnt.actions.dtype.kind not in "if" or learnt.rewards.dtype != np.float64:
            raise ValueError("what was played of its round is not that of this environment")
        if not isinstance(model, OnPolicyAlgorithm) or slots != self.env.num_envs:
            return False
        if steps % model.n_steps or steps + model.n_steps > self._length:
            return False
        self.learnt = learnt
        if self._wants.advantages:
            self.sizes_now = [arrays["sizes_now"]]
            if self.sizes_now[0].shape != (steps, slots):
                raise ValueError("the advantages of its round are not those of its steps")
        return True

    def _unfinished(self, arrays: Mapping[str, NDArray[Any]]) -> tuple[Unfinished, ...]:
        found = _under("unfinished/", arrays)
        if not found:
            return ()
        env, action_space = self.env, self.env.action_space
        return unstacked(
            found, shards=1, slots=found["ids"].shape[1], features=len(env.bounds.names), horizon=env.horizon,
            action_shape=action_space.shape or (),
        )  # fmt: skip


def _told(value: object) -> str:
    return "the default" if value is None else str(value)


@contextlib.contextmanager
def _readable() -> Iterator[None]:
    """Have whatever a damaged text leads to be a sentence."""
    try:
        yield
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, RuntimeError, OverflowError) as error:
        raise SpaceDistError(
            f"CurriculumCallback: what the model remembers of its curriculum cannot be read ({str(error)[:120]}); "
            "begin anew with CurriculumCallback(..., resume=False)"
        ) from error


def _random_state(model: BaseAlgorithm) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """All that SB3 draws random numbers from on a CPU: torch's, NumPy's and Python's generators, and the actions'."""
    _, keys, position, has_gauss, gauss = np.random.get_state(legacy=True)  # noqa: NPY002
    version, words, following = random.getstate()
    arrays = {
        "torch": torch.get_rng_state().numpy().copy(), "numpy": np.array(keys),
        "python": np.array(words, dtype=np.uint64),
    }  # fmt: skip
    return arrays, {
        "numpy": [int(position), int(has_gauss), float(gauss)],
        "python": [version, following],
        "actions": _plain(model.action_space.np_random.bit_generator.state),
    }


def _restore_random(model: BaseAlgorithm, state: Mapping[str, Any]) -> None:
    with _readable():
        numbers = state["numbers"]
        torch.set_rng_state(torch.as_tensor(state["torch"].copy()))
        np.random.set_state(("MT19937", state["numpy"], *numbers["numpy"]))  # noqa: NPY002
        version, following = numbers["python"]
        random.setstate((version, tuple(state["python"].tolist()), following))
        model.action_space.np_random.bit_generator.state = numbers["actions"]


@contextlib.contextmanager
def _random_apart(seed: int, version: int) -> Iterator[None]:
    """Have what is drawn meanwhile come from numbers of its own."""
    purpose = Purpose.PROBE_EPISODES
    with global_generators(seed, purpose, version), torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(global_seeds(seed, purpose, version)[2])
        yield


def _plain(state: Any) -> Any:
    """A generator's state without NumPy's numbers."""
    if isinstance(state, dict):
        return {name: _plain(value) for name, value in state.items()}
    return state.item() if isinstance(state, np.generic) else state


def _under(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
