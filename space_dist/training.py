"""One run, from its first instance to its last step. Knows no Ray: `Cluster` says where work is done.

    select   curriculum.start()                          one instance (SPaCE), all (round robin), ...
    repeat
        collect  cluster.collect(weights, selection)     exactly n_steps transitions, in shards
        update   learner.update(shards)                  SB3's own train()
        until the selection was passed over once at full horizon, then
        revalue  cluster.start_values(weights)           V(s0, c) of every instance, straight to the curriculum
        select   cluster.decide(state, before, after)    the next selection
    now and then: evaluate on all instances, and commit to the ledger

The driver waits once per round, for the shards. What is asked for at the end of a round (decision, evaluation) is
picked up at the next wait, or before a commit: `_settle`. A run is a pure function of (config, seed).
"""

from __future__ import annotations

import dataclasses
import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from space_dist.cluster import Cluster, Decision, Handle, checked, make_curriculum
from space_dist.config import RunConfig
from space_dist.curricula import Selection, State
from space_dist.envs import make_batched
from space_dist.errors import ConfigError, Interrupted
from space_dist.instances import InstanceSet
from space_dist.learner import Learner, Update
from space_dist.ledger import CURRICULUM, METRICS, TIMING, Checkpoint, Row, RunWriter, Status
from space_dist.rollout import (
    CUT,
    MlpWeights,
    Outcomes,
    Setup,
    Shard,
    Walk,
    joined,
    to_arrays,
)

log = logging.getLogger("space_dist")

_COMPARED_STARTS = 4096  # instances that are enough to see whether starts differ


def make_setup(config: RunConfig, train: InstanceSet, test: InstanceSet) -> Setup:
    """What workers must know. Raises ConfigError if the config cannot work with its environment or instances."""
    setup = Setup(
        env_id=config.env.id,
        context_visible=config.env.context_visible,
        seed=config.seed,
        gamma=config.learner.gamma,
        shards=config.rollout.shards,
        slots=config.rollout.slots,
        slot_length=config.slot_length,
        start_states=config.rollout.start_states,
        evaluation_episodes=config.evaluation.episodes,
        train=train,
        test=test,
    )
    horizon = make_batched(config.env.id, 1, context_visible=False).horizon
    if config.slot_length < horizon:
        raise ConfigError(
            f"learner.n_steps / (rollout.shards * rollout.slots) = {config.learner.n_steps} / ({config.rollout.shards} "
            f"* {config.rollout.slots}) = {config.slot_length} steps per slot, less than the horizon of "
            f"{config.env.id} ({horizon}): no episode could end. Use fewer shards or slots, or larger updates"
        )
    curriculum = config.curriculum
    if (
        curriculum.kind == "space"
        and curriculum.pic != "random"
        and not curriculum.allow_context_blind
        and _starts_alike(config, train)
    ):
        raise ConfigError(
            "curriculum.kind: space ranks instances by the value of their start, but all instances start with the same "
            "observation, so all values tie and the order would be a random one. Set env.context_visible: true, or "
            "curriculum.allow_context_blind: true to run the released code's setting"
        )
    make_curriculum(config, train)  # asks for instances that are not there? Better refused now than on an actor
    return setup


def _starts_alike(config: RunConfig, train: InstanceSet) -> bool:
    """Whether the context leaves no trace in the first observation: with one seed, all instances start the same."""
    slots = min(len(train), _COMPARED_STARTS)
    env = make_batched(config.env.id, slots, context_visible=config.env.context_visible)
    starts = env.reset(np.arange(slots), train.contexts[:slots], np.zeros(slots, dtype=np.uint64))
    return slots > 1 and bool((starts == starts[0]).all())


@dataclass
class Progress:
    """What a display shows."""

    steps: int
    budget_steps: int
    steps_per_second: float
    set_size: int
    n_instances: int
    train_return: float | None = None
    test_return: float | None = None


@dataclass
class _Run:
    """Everything that changes from round to round; `_save` and `_restore` know every field that must survive."""

    round: int = 0
    iteration: int = 1
    rounds_left: int | None = None  # in this iteration; None until the selection is known
    version: int = 0  # of the selection being trained on
    walk: Walk = field(default_factory=lambda: Walk(-1, ()))
    rows: int = 0
    evaluated_at: int = -1  # steps
    rollouts: list[dict[str, float]] = field(default_factory=list)  # of this iteration's rounds
    updates: list[dict[str, float]] = field(default_factory=list)
    gradient_steps: int = 0  # in this iteration
    trained: Selection | None = None  # the selection being trained on, once known
    # Handles, and what they wait for
    state: Handle = None
    selection: Handle = None
    values: Handle = None
    pending: list[_Pending] = field(default_factory=list)


@dataclass(frozen=True)
class _Pending:
    """Something asked for whose answer becomes rows of the ledger."""

    handles: list[Handle]
    settle: Callable[[list[Any]], None]


class Training:
    """One run in progress. `run` is Algorithm 1; the rest keeps its books."""

    def __init__(
        self,
        config: RunConfig,
        setup: Setup,
        cluster: Cluster,
        writer: RunWriter,
        *,
        status: Status,
        stop_requested: Callable[[], str | None] = lambda: None,
        observe: Callable[[Progress], None] = lambda progress: None,
    ) -> None:
        self._config, self._setup, self._cluster, self._writer = config, setup, cluster, writer
        self._status, self._stop_requested, self._observe = status, stop_requested, observe
        self._horizon = make_batched(config.env.id, 1, context_visible=False).horizon
        self._total_steps = config.rounds * config.learner.n_steps
        self.learner = make_learner(config)
        self._run = _Run()
        self._last_row_time = self._last_commit_time = time.monotonic()
        self._last_row_steps = 0
        self._last_commit_round = 0
        self.progress = Progress(0, self._total_steps, 0.0, 0, len(setup.train))

    def run(self) -> None:
        """Train to the end of the budget. Raises Interrupted, after a commit, if asked to stop."""
        run, cluster, config = self._run, self._cluster, self._config
        checkpoint = self._writer.restore()
        weights = self._restore(checkpoint) if checkpoint else self._begin()
        while run.round < config.rounds:
            shards: list[Shard] = self._wait_for(
                cluster.collect(weights, run.selection, run.walk, round=run.round, version=run.version)
            )
            update = self.learner.update(shards, round=run.round, steps=self._steps(run.round + 1))
            self._account(shards, update)
            weights = cluster.put(self.learner.weights(run.round))
            if run.rounds_left == 0:
                self._decide(weights)
            if self._steps() >= next_evaluation(config.evaluation.every_steps, run.evaluated_at, self._total_steps):
                self._evaluate(weights)
            self._show()
            self._commit_if_due()
        self._finish()

    # ---- the parts of an iteration ----

    def _begin(self) -> Handle:
        cluster = self._cluster
        weights = cluster.put(self.learner.weights(0))
        self._adopt(cluster.begin(cluster.start_values(weights)))
        self._evaluate(weights)
        return weights

    def _decide(self, weights: Handle) -> None:
        """Revalue all instances and let the curriculum choose; the answer is picked up at the next wait."""
        run, cluster = self._run, self._cluster
        decision = cluster.decide(
            run.state, run.values, cluster.start_values(weights),
            version=run.version, gradient_steps=run.gradient_steps,
        )  # fmt: skip
        row = self._iteration_row(complete=True)

        def settle(answers: list[Any]) -> None:
            row["curriculum"] = answers[0]
            self._append(row)
            self.progress.set_size = int(answers[0]["size"])

        run.pending.append(_Pending([decision.numbers], settle))
        self._adopt(decision)
        run.iteration += 1
        run.version += 1
        run.rollouts, run.updates, run.gradient_steps = [], [], 0

    def _adopt(self, decision: Decision) -> None:
        run = self._run
        run.state, run.selection, run.values = decision.state, decision.selection, decision.values
        run.rounds_left, run.trained = None, None

        def settle(answers: list[Any]) -> None:
            self._know_selection(answers[0])

        run.pending.append(_Pending([decision.selection], settle))

    def _know_selection(self, selection: Selection) -> None:
        run, config = self._run, self._config
        steps = config.rollout.passes * len(selection.ids) * self._horizon
        run.rounds_left = max(1, math.ceil(steps / config.learner.n_steps))
        run.trained = selection
        self.progress.set_size = len(selection.ids)

    def _evaluate(self, weights: Handle) -> None:
        run, cluster = self._run, self._cluster
        train, test = cluster.evaluate(weights, "train"), cluster.evaluate(weights, "test")
        row: Row = {"kind": "evaluation", **self._position()}

        def settle(answers: list[Any]) -> None:
            outcomes = {"train": answers[: len(train)], "test": answers[len(train) :]}
            for split, parts in outcomes.items():
                row[split] = _summary(joined(parts), self._config.evaluation.episodes)
            self._append(row)
            self.progress.train_return, self.progress.test_return = row["train"]["return"], row["test"]["return"]
            log.info("%d steps: return train %s, test %s", row["steps"], row["train"]["return"], row["test"]["return"])

        run.pending.append(_Pending([*train, *test], settle))
        run.evaluated_at = self._steps()

    def _account(self, shards: list[Shard], update: Update) -> None:
        run = self._run
        for shard in shards:
            if (shard.weights_version, shard.selection_version, shard.round) != (run.round, run.version, run.round):
                raise RuntimeError(f"shard {shard.shard} of round {run.round} answers another question")
        order, n_shards = shards[0].order_version, len(shards)
        selection = run.trained
        if selection is None or run.rounds_left is None:
            raise RuntimeError("a round ended before its selection was known")
        run.walk = Walk(
            order,
            tuple(
                (run.walk.position(selection, shard.shard, n_shards) + len(shard.episodes)) % len(selection.ids)
                for shard in shards
            ),
        )
        run.rollouts.append(_rollout_sums(shards))
        run.updates.append(update.metrics)
        run.gradient_steps += update.gradient_steps
        run.round += 1
        run.rounds_left -= 1

    def _finish(self) -> None:
        run = self._run
        if run.rollouts:  # the budget ended inside an iteration: its steps are told, its decision never falls
            self._settle()
            self._append({**self._iteration_row(complete=False), "curriculum": {}})
            run.rollouts, run.updates = [], []
        self._commit("done")
        arrays, description = to_arrays(self.learner.weights(run.round))
        description |= {"config": self._config.name, "seed": self._config.seed, "env": self._config.env.id}
        self._writer.write_model(arrays, {**description, "context_visible": self._config.env.context_visible})
        self._writer.set_status(self._new_status("done"))

    # ---- waiting, and the ledger ----

    def _wait_for(self, handles: Sequence[Handle]) -> list[Any]:
        """The one wait of a round: the shards, and whatever was asked for since the last one."""
        return self._settle(handles)

    def _settle(self, handles: Sequence[Handle] = ()) -> list[Any]:
        pending, self._run.pending = self._run.pending, []
        answers = self._cluster.get([*handles, *(handle for one in pending for handle in one.handles)])
        at = len(handles)
        for one in pending:
            one.settle(answers[at : at + len(one.handles)])
            at += len(one.handles)
        return answers[: len(handles)]

    def _iteration_row(self, *, complete: bool) -> Row:
        """One iteration in numbers, and its row of the curriculum's history."""
        run = self._run
        if run.trained is None:
            raise RuntimeError("an iteration ended before its selection was known")
        self._writer.append(
            CURRICULUM, {"iteration": run.iteration, "steps": self._steps(), "trained": run.trained.ids.tolist()}
        )
        totals = {name: sum(one[name] for one in run.rollouts) for name in run.rollouts[0]}
        finished = totals["finished"]
        return {
            "kind": "iteration",
            **self._position(),
            "complete": complete,
            "episodes": int(totals["episodes"]),
            "episodes_cut": int(totals["cut"]),
            "gradient_steps": run.gradient_steps,
            "rollout": {
                name: totals[name] / finished if finished and math.isfinite(totals[name]) else None
                for name in ("return", "discounted_return", "length", "success")
            },
            "learner": {
                name: float(np.mean([update[name] for update in run.updates if name in update]))
                for name in sorted({name for update in run.updates for name in update})
            },
        }

    def _position(self) -> Row:
        return {"iteration": self._run.iteration, "round": self._run.round, "steps": self._steps()}

    def _append(self, row: Row) -> None:
        now = time.monotonic()
        seconds, steps = now - self._last_row_time, row["steps"] - self._last_row_steps
        rate = steps / seconds if steps > 0 and seconds > 0 else None
        self._writer.append(METRICS, row)
        self._writer.append(
            TIMING,
            {"row": self._run.rows, "unix_time": time.time(), "seconds": seconds, "steps_per_second": rate},
        )
        self._run.rows += 1
        self._last_row_time, self._last_row_steps = now, row["steps"]
        if rate is not None:
            self.progress.steps_per_second = rate

    def _commit_if_due(self) -> None:
        reason = self._stop_requested()
        if reason is not None:
            self._commit("interrupted", reason)
            raise Interrupted(f"stopped by {reason} after {self._steps()} steps; --resume continues")
        settings = self._config.checkpoint
        if (
            self._run.round - self._last_commit_round >= settings.every_rounds
            or time.monotonic() - self._last_commit_time >= settings.every_seconds
        ):
            self._commit("running")

    def _commit(self, state: str, message: str | None = None) -> None:
        self._settle()
        # A run is done only once its model is written.
        status = self._new_status("running" if state == "done" else state, message)
        self._writer.commit(self._save(), status)
        self._last_commit_time, self._last_commit_round = time.monotonic(), self._run.round

    def _new_status(self, state: Any, message: str | None = None) -> Status:
        return dataclasses.replace(
            self._status, state=state, message=message, steps=self._steps(), round=self._run.round,
            updated_at=time.time(),
        )  # fmt: skip

    def _save(self) -> Checkpoint:
        run = self._run
        arrays, learner = self.learner.save()
        arrays = {f"learner/{name}": array for name, array in arrays.items()}
        state, values = self._cluster.get([run.state, run.values])
        arrays["curriculum/values"] = values
        arrays["curriculum/selected"] = state.selected
        fields = [item.name for item in dataclasses.fields(state) if item.name != "selected"]
        numbers = {name: getattr(state, name) for name in fields}
        data = {
            "learner": learner,
            "curriculum": numbers,
            "run": {
                "round": run.round, "iteration": run.iteration, "rounds_left": run.rounds_left, "version": run.version,
                "walk": [run.walk.order_version, list(run.walk.positions)], "rows": run.rows,
                "evaluated_at": run.evaluated_at, "rollouts": run.rollouts, "updates": run.updates,
                "gradient_steps": run.gradient_steps,
            },
        }  # fmt: skip
        return Checkpoint(run.round, arrays, data)

    def _restore(self, checkpoint: Checkpoint) -> Handle:
        run, cluster, data = self._run, self._cluster, checkpoint.data["run"]
        _load_learner(self.learner, checkpoint)
        for name in ("round", "iteration", "version", "rows", "evaluated_at", "rollouts", "updates", "gradient_steps"):
            setattr(run, name, data[name])
        order, positions = data["walk"]
        run.walk = Walk(order, tuple(positions))
        state = State(selected=checkpoint.arrays["curriculum/selected"], **checkpoint.data["curriculum"])
        selection = make_curriculum(self._config, self._setup.train).selection(state)
        self._know_selection(selection)
        run.rounds_left = data["rounds_left"]
        run.state, run.selection = cluster.put(state), cluster.put(selection)
        run.values = cluster.put(checkpoint.arrays["curriculum/values"])
        self._last_commit_round, self._last_row_steps = run.round, self._steps()
        return cluster.put(self.learner.weights(run.round))

    # ---- small things ----

    def _steps(self, round: int | None = None) -> int:
        return (self._run.round if round is None else round) * self._config.learner.n_steps

    def _show(self) -> None:
        self.progress.steps = self._steps()
        self._observe(self.progress)


def make_learner(config: RunConfig) -> Learner:
    """A config's learner with its initial network."""
    env = make_batched(config.env.id, 1, context_visible=config.env.context_visible)
    return Learner(
        config.learner, env.observation_space, env.action_space,
        seed=config.seed, n_slots=config.rollout.shards * config.rollout.slots, slot_length=config.slot_length,
        total_steps=config.rounds * config.learner.n_steps,
    )  # fmt: skip


def policy_in(checkpoint: Checkpoint, config: RunConfig) -> MlpWeights:
    """The policy that a checkpoint holds."""
    learner = make_learner(config)
    _load_learner(learner, checkpoint)
    return learner.weights(checkpoint.round)


def _load_learner(learner: Learner, checkpoint: Checkpoint) -> None:
    prefix = "learner/"
    arrays = {name.removeprefix(prefix): array for name, array in checkpoint.arrays.items() if name.startswith(prefix)}
    learner.load(arrays, checkpoint.data["learner"])


def next_evaluation(every_steps: int | Literal["log"], evaluated_at: int, total_steps: int) -> float:
    """Steps at which the next evaluation falls due; it is made after the first update at or behind them.

    The end is always evaluated; after it, nothing is (infinity).
    """
    if evaluated_at >= total_steps:
        return math.inf
    if every_steps == "log":
        marks = (factor * 10**power for power in range(3, 13) for factor in (1, 3))
        return min(next((mark for mark in marks if mark > evaluated_at), total_steps), total_steps)
    return min((evaluated_at // every_steps + 1) * every_steps, total_steps)


def _rollout_sums(shards: list[Shard]) -> dict[str, float]:
    """Sums over a round's finished episodes (cut ones have no return), and how many there were."""
    sums = dict.fromkeys(("episodes", "cut", "finished", "return", "discounted_return", "length", "success"), 0.0)
    for shard in shards:
        episodes = shard.episodes
        finished = episodes.ends != CUT
        sums["episodes"] += len(episodes)
        sums["cut"] += int((~finished).sum())
        sums["finished"] += int(finished.sum())
        sums["return"] += float(episodes.returns[finished].sum())
        sums["discounted_return"] += float(episodes.discounted_returns[finished].sum())
        sums["length"] += float(episodes.lengths[finished].sum())
        sums["success"] += float(episodes.success[finished].sum())
    return sums


def _summary(outcomes: Outcomes, episodes: int) -> dict[str, Any]:
    """Means over a split, and each instance's mean return in id order."""
    returns = checked(outcomes.returns, "returns")
    return {
        "return": float(returns.mean()),
        "discounted_return": float(outcomes.discounted_returns.mean()),
        "length": float(outcomes.lengths.mean()),
        "success": None if np.isnan(outcomes.success).any() else float(outcomes.success.mean()),
        "returns": returns.reshape(-1, episodes).mean(axis=1).tolist(),
    }
