"""One run, from its first instance to its last step. Knows no Ray: `Cluster` says where work is done.

    select   curriculum.start()                          one instance (SPaCE), all (round robin), ...
    repeat
        collect  cluster.collect(policy, selection, walk)  exactly n_steps transitions, in shards; episodes go on
        update   learner.update(shards)                  SB3's own train(); none where the selection says so
        until the selection was passed over once at full horizon (draws: after one update), then
        revalue  cluster.start_values(policy)            V(s0, c) of every instance, straight to the curriculum
        select   cluster.decide(state, evidence)         the next selection, from that and what else was asked for
    now and then: evaluate on all instances, and commit to the ledger

`Training.work` is a generator: it yields what it waits for, values (`Wait`) or an update (`Learn`), and is sent the
answer. `Training.run` answers for one run; a population answers for many, whose shards are then collected, and whose
updates are made, together.

A run waits once per round, for the shards. What is asked for at the end of a round (decision, evaluation) is
picked up at the next wait, or before a commit: `_settle`. Only where a curriculum probes instances does it wait for
those episodes as well: how many steps they took decides whether the budget has room for another round. A run is a pure
function of (config, seed).
"""

from __future__ import annotations

import dataclasses
import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from space_dist.curricula import GENERATED, Selection, decode_state, encode_state
from space_dist.errors import CONTINUES, Interrupted
from space_dist.learner import Arrays, Update
from space_dist.ledger import (
    CURRICULUM,
    METRICS,
    MOST_VALUED,
    TIMING,
    VALUES,
    Checkpoint,
    Row,
    RunWriter,
    Segment,
    Status,
    encode_values,
)
from space_dist.rollout import Outcomes, Setup, Shard, Split, joined
from space_dist.rollout.episodes import curriculum_episodes, joined_episodes, mean_sizes, rounds_over, summed
from space_dist.rollout.policy import Statistics, blind, policies_of
from space_dist.rollout.walk import Walk
from space_dist.run.building import Blueprint, load_learner, model_of
from space_dist.run.cluster import Cluster, Decision, Evidence, Handle, checked
from space_dist.run.pace import TimeLeft
from space_dist.run.requests import Learn, Wait, Work
from space_dist.run.rows import iteration_row, next_evaluation, position, size_of, summary, trained_row
from space_dist.run.starting import start_from
from space_dist.run.state import RunState

log = logging.getLogger("space_dist")

# A number that no real round reaches, so that its seeds are nobody else's.
SCALES_ROUND = (1 << 32) - 1  # the round in which first scales are measured


@dataclass
class Progress:
    """What a display shows, and a function that is given as `progress` is called with.

    steps, budget_steps: environment steps, and those of the whole updates that fit into the budget.  set_size: how many
    of `n_instances` are trained on; with the last call, were last.  train_return, test_return: means of the last
    evaluation, made after `evaluated_at` steps; all None before the first.  episodes, budget_episodes: of training; the
    latter None where they are not limited.  seconds_left: at the pace of the last minute; None until some rounds have
    told that.
    """

    steps: int
    budget_steps: int
    steps_per_second: float
    set_size: int
    n_instances: int
    train_return: float | None = None
    test_return: float | None = None
    episodes: int = 0
    budget_episodes: int | None = None
    seconds_left: float | None = None
    evaluated_at: int | None = None

    @property
    def share(self) -> float:
        """How much is done, from 0 to 1, by the limit that is nearer: steps or episodes."""
        by_steps = self.steps / max(1, self.budget_steps)
        return min(1.0, max(by_steps, self.episodes / self.budget_episodes if self.budget_episodes else 0.0))

    @property
    def so_far(self) -> str:
        """`4,108/20,000 steps`, and `, 40/100 episodes` where these are limited, too."""
        episodes = f", {self.episodes:,}/{self.budget_episodes:,} episodes" if self.budget_episodes else ""
        return f"{self.steps:,}/{self.budget_steps:,} steps{episodes}"

    @property
    def returns(self) -> str:
        """`train 1.20 test 1.10 at 10,240`, the steps after which they were measured; dashes before that."""
        train, test = ("—" if value is None else f"{value:.2f}" for value in (self.train_return, self.test_return))
        at = "" if self.evaluated_at is None else f" at {self.evaluated_at:,}"
        return f"train {train} test {test}{at}"

    @property
    def trained(self) -> str:
        """`27/100`, or a dash for the 27 until curricula that draw have drawn."""
        return f"{self.set_size or '—'}/{self.n_instances}"

    @property
    def pace(self) -> str:
        """`5,012/s`, or a dash until it can be told."""
        return f"{self.steps_per_second:,.0f}/s" if self.steps_per_second > 0 else "—/s"


@dataclass
class _InFlight:
    """What is under way: handles of what was asked for, and who waits for them. A resumed run asks for it again."""

    trained: Selection | None = None  # the selection being trained on, once known
    ahead: list[Handle] = field(default_factory=list)  # shards of the next round, if they were asked for already
    state: Handle = None  # the curriculum's
    selection: Handle = None
    values: Handle = None
    pending: list[_Pending] = field(default_factory=list)


@dataclass(frozen=True)
class _Pending:
    """Something asked for whose answer becomes rows of the ledger."""

    handles: list[Handle]
    settle: Callable[[list[Any]], None]


class Training:
    """One run in progress. `work` is Algorithm 1; the rest keeps its books."""

    def __init__(
        self,
        blueprint: Blueprint,
        setup: Setup,
        cluster: Cluster,
        writer: RunWriter,
        *,
        status: Status,
        pause_at: int = 0,
        change_at: int = 0,
        curriculum_number: int = 0,
        ends_curriculum: bool = False,
        stop_requested: Callable[[], str | None] = lambda: None,
        observe: Callable[[Progress], None] = lambda progress: None,
    ) -> None:
        """pause_at, change_at: steps at which it ends before its budget does, to be gone on with; 0: nowhere.

        curriculum_number: curricula that were in force before this one, which begins anew in a run that has another.
        ends_curriculum: whether another one comes into force at `change_at`.
        """
        self._config, self._setup, self._cluster, self._writer = blueprint.config, setup, cluster, writer
        self._status, self._stop_requested, self._observe = status, stop_requested, observe
        self._pause_at, self._change_at = pause_at, change_at
        self._curriculum_number, self._ends_curriculum = curriculum_number, ends_curriculum
        self._horizon = setup.spec.horizon
        self.learner = blueprint.learner()
        self.ensemble = blueprint.ensemble()
        self._curriculum = blueprint.curriculum(setup.train, setup.test)
        self._run, self._asked = RunState(), _InFlight()
        self._segments: list[Segment] = []  # of the replay buffer, as of the last commit
        self._last_row_time = self._last_commit_time = time.monotonic()
        self._last_row_steps = 0
        self._last_size: int | None = None  # how many instances the last iteration that ended was trained on
        self._time_left = TimeLeft()
        self._last_commit_round, self._commit_cost = 0, 0.0  # seconds, that the last one took to write
        steps = blueprint.reachable_steps(self._curriculum)
        self.progress = Progress(0, steps, 0.0, 0, len(setup.train), budget_episodes=self._config.budget.episodes)

    def run(self) -> None:
        """Train to the end of the budget, or as far as asked. Raises Interrupted, after a commit, if asked to stop."""
        work = self.work()
        answer: Any = None
        while True:
            try:
                request = work.send(answer)
            except StopIteration:
                return
            if isinstance(request, Wait):
                answer = self._cluster.get(request.handles)
            else:
                answer = self.learner.update(
                    request.shards, round=request.round, steps=request.steps, acted=request.acted
                )

    def work(self) -> Work[None]:
        """What `run` does, as a generator: whoever advances it answers `Wait` and `Learn`."""
        cluster, config, asked = self._cluster, self._config, self._asked
        checkpoint = self._writer.restore()
        policy = self._restore(checkpoint) if checkpoint else (yield from self._begin())
        run = self._run
        # Line 4 of Algorithm 1, in rounds: an iteration is several of them (decision 8 of docs/algorithm.md).
        while not self._is_over():
            shards: list[Shard] = yield from self._settle(asked.ahead or self._collect(policy, lag=0))
            asked.ahead, acted, scales = [], run.acted, self.learner.statistics  # of the weights that acted
            self._arrived(shards, lag=1 if acted else 0)
            run.acted = self._look_ahead(policy)
            # Line 5, with SB3's own `train()`.
            if asked.trained is None or asked.trained.learned:
                update = yield Learn(self.learner, shards, run.round - 1, run.steps, acted or None)
            else:
                update = self.learner.look_at(shards, round=run.round - 1, acted=acted or None)
            self._account(shards, self._with_ensemble(update, shards, scales))
            policy = cluster.put(self.learner.policy(run.round))
            # Lines 6 to 13.
            if run.rounds_left == 0:
                yield from self._decide(policy)
            # By steps, not by passes as the paper's: those are of another length for each curriculum (decision 14).
            if self._is_over() or run.steps >= next_evaluation(config.evaluation.every_steps, run.evaluated_at):
                self._evaluate(policy)
            if not self._is_over():
                self._show()
            if (yield from self._has_paused()):
                return
            yield from self._commit_if_due()
        yield from self._finish()

    def _is_over(self, reserved: int = 0) -> bool:
        """Whether another round, and `reserved` steps before it, would exceed the budget."""
        run, budget = self._run, self._config.budget
        enough = budget.episodes is not None and run.episodes >= budget.episodes
        # A round at its longest must fit: the budget is never exceeded.
        return enough or run.steps + reserved + self._config.round_steps(self._horizon) > budget.steps

    # ---- the parts of an iteration ----

    def _begin(self) -> Work[Handle]:
        cluster = self._cluster
        if self._config.init_from is not None:
            ledger = self._writer.ledger
            start_from(self.learner, ledger.read(ledger.given["init_from"]))
        elif self.learner.normalises:
            yield from self._measure_scales()
        policy = cluster.put(self.learner.policy(0))
        # V_0 of the initial network, not the printed 0 (decision 3 of docs/algorithm.md).
        first = cluster.begin(cluster.start_values(policy))
        self._adopt(first)
        bounds = self._setup.spec.context_bounds
        if len(self._setup.train) > MOST_VALUED:
            log.info("%d instances: above %d, %s is not written", len(self._setup.train), MOST_VALUED, VALUES)
        self._keep_values({"iteration": 0, "low": bounds.low.tolist(), "high": bounds.high.tolist()}, first)
        self._evaluate(policy)
        return policy

    def _measure_scales(self) -> Work[None]:
        """One round of actions that ignore the observation gives the first scales; its steps count like any others.

        Its episodes are not gone on with: they say nothing about the policy.
        """
        run, cluster = self._run, self._cluster
        selection = self._curriculum.start()[1]
        (seeing,) = policies_of(self.learner.policy(0))
        policy = blind(seeing, self._setup.spec.action_space, SCALES_ROUND)
        handles = cluster.collect(
            cluster.put(policy), cluster.put(selection), Walk(-1, ()), round=SCALES_ROUND, steps=0,
            version=selection.version,
        )  # fmt: skip
        shards: list[Shard] = yield Wait(handles)
        self.learner.observe(shards)
        run.steps += sum(shard.steps for shard in shards)

    def _with_ensemble(self, update: Update, shards: list[Shard], scales: Statistics) -> Update:
        """The update, and what the ensemble, if there is one, learned from the same shards."""
        if self.ensemble is None:
            return update
        metrics = self.ensemble.update(shards, scales, round=shards[0].round)
        return dataclasses.replace(update, metrics={**update.metrics, **metrics})

    def _decide(self, policy: Handle) -> Work[None]:
        """Gather what the curriculum asks for and let it choose; the answer is picked up at the next wait."""
        run, cluster, asked = self._run, self._cluster, self._asked
        probes = yield from self._probe_instances(policy)
        evidence = self._evidence(policy, probes)
        decision = cluster.decide(
            asked.state, asked.values, evidence, version=run.version, gradient_steps=run.gradient_steps
        )
        row = self._iteration_row(complete=True)

        def settle(answers: list[Any]) -> None:
            row["curriculum"] = answers[0]
            self._append(row)
            self.progress.set_size = int(answers[0]["size"])

        asked.pending.append(_Pending([decision.numbers], settle))
        self._keep_values({"iteration": run.iteration}, decision, evidence.rescored)
        self._adopt(decision)
        run.iteration += 1
        run.version += 1
        run.rollouts, run.updates, run.seen, run.gradient_steps = [], [], [], 0

    def _keep_values(self, row: Row, decision: Decision, rescored: Sequence[Handle] = ()) -> None:
        """Write down what a decision is made from, once that is known, so that anybody can make it again."""
        if len(self._setup.train) > MOST_VALUED:
            return

        def settle(answers: list[Any]) -> None:
            before = {"before": encode_values(np.concatenate(answers[1:]))} if len(answers) > 1 else {}
            self._writer.append(VALUES, {**row, **before, "after": encode_values(answers[0])})

        self._asked.pending.append(_Pending([decision.values, *rescored], settle))

    def _probe_instances(self, policy: Handle) -> Work[list[Outcomes]]:
        """Run the probe episodes that the curriculum asks for, if any, and charge their steps to the budget.

        There are none where they, at their longest, would leave no room for another round.
        """
        run, cluster = self._run, self._cluster
        if not self._curriculum.wants.probes:
            return []
        (state,) = yield from self._settle([self._asked.state])
        indices = self._curriculum.probes(state, joined_episodes(run.seen) if run.seen else None)
        if indices is None or self._is_over(reserved=len(indices) * self._horizon):
            return []
        outcomes: list[Outcomes] = yield from self._settle(cluster.probe(policy, indices, version=run.version))
        # Rivals that play no probes get as many steps in all.
        run.steps += sum(int(part.lengths.sum()) for part in outcomes)
        return outcomes

    def _evidence(self, policy: Handle, probes: list[Outcomes]) -> Evidence:
        """What this iteration showed, as far as the curriculum asks for it: handles, not waited for."""
        run, cluster, wants = self._run, self._cluster, self._curriculum.wants
        rescored, ensemble, episodes, context_values = [], [], [], []
        # Zeros are on every scale.
        from_zero = run.version == 0 and self._config.curriculum.starts_from_zero
        if self.learner.normalises and not from_zero:
            # Both values at one scale: else a change of scale would look like progress.
            rescored = cluster.start_values(cluster.put(self.learner.policy_of(run.scored, run.round)))
        if self.ensemble is not None:
            ensemble = cluster.start_values(cluster.put(self.ensemble.policy(self.learner.statistics)))
        if wants.episodes:
            seen = joined_episodes(run.seen)
            episodes = [cluster.put(seen)]
            if (seen.indices == GENERATED).any():
                context_values = cluster.context_values(policy, seen.contexts, version=run.version)
        return Evidence(
            after=cluster.start_values(policy), rescored=rescored, ensemble=ensemble, episodes=episodes,
            context_values=context_values, probes=[cluster.put(part) for part in probes],
        )  # fmt: skip

    def _adopt(self, decision: Decision) -> None:
        run, asked = self._run, self._asked
        asked.state, asked.selection, asked.values = decision.state, decision.selection, decision.values
        run.rounds_left, asked.trained = None, None
        if self.learner.normalises:
            run.scored = self.learner.scored()

        def settle(answers: list[Any]) -> None:
            self._know_selection(answers[0])
            run.rounds_left = self._rounds_on(answers[0])

        asked.pending.append(_Pending([decision.selection], settle))

    def _know_selection(self, selection: Selection) -> None:
        self._asked.trained = selection
        if not selection.drawn:
            self.progress.set_size = len(selection.ids)

    def _know_returns(self, rows: Sequence[Row]) -> None:
        """Show the returns of the last evaluation among these rows, if there is one."""
        for row in rows:
            if row["kind"] == "evaluation":
                self.progress.train_return, self.progress.test_return = row["train"]["return"], row["test"]["return"]
                self.progress.evaluated_at = row["steps"]

    def _rounds_on(self, selection: Selection) -> int:
        """Rounds of an iteration: as many as pass over the selection at full horizon, and one of what is drawn."""
        config = self._config
        episodes = config.rollout.passes * len(selection.ids)
        if selection.drawn:
            return 1
        if config.n_episodes is not None:
            return max(1, math.ceil(episodes / config.n_episodes))
        return rounds_over(episodes, self._horizon, config.learner.n_steps)  # of each policy: all pass over it

    def _evaluate(self, policy: Handle) -> None:
        run, cluster = self._run, self._cluster
        settings = self._config.evaluation
        row: Row = {"kind": "evaluation", **position(self._run)}
        splits: tuple[Split, ...] = ("train", "test")
        asked = {split: cluster.evaluate(policy, split) for split in splits}
        legacy = {split: cluster.evaluate(policy, split, stochastic=True) for split in splits if settings.legacy_metric}
        handles = [*asked["train"], *asked["test"], *(handle for split in legacy for handle in legacy[split])]

        def settle(answers: list[Any]) -> None:
            arrived = iter(answers)
            for split in splits:
                outcomes = joined([next(arrived) for _ in asked[split]])
                row[split] = summary(outcomes, len(self._setup.instances(split)), settings.episodes)
            for split in legacy:
                outcomes = joined([next(arrived) for _ in legacy[split]])
                # The metric of the released code's plots: the last reward counts most.
                returns = checked(outcomes.backward_discounted_returns, "returns")
                row[split]["legacy_return"] = float(returns.mean())
            self._append(row)
            self._know_returns([row])
            log.info(
                "%d steps: return train %.6g, test %.6g", *(row["steps"], row["train"]["return"], row["test"]["return"])
            )

        self._asked.pending.append(_Pending(handles, settle))
        run.evaluated_at = run.steps

    def _collect(self, policy: Handle, *, lag: int) -> list[Handle]:
        """Ask for the next round."""
        run = self._run
        return self._cluster.collect(
            policy, self._asked.selection, run.walk, round=run.round, steps=run.steps, version=run.version, lag=lag
        )

    def _arrived(self, shards: list[Shard], *, lag: int) -> None:
        """Count a round's shards, and note where the next one goes on."""
        run = self._run
        for shard in shards:
            if (shard.policy_version, shard.selection_version, shard.round) != (
                run.round - lag,
                run.version,
                run.round,
            ):
                raise RuntimeError(f"shard {shard.shard} of round {run.round} answers another question")
        selection = self._asked.trained
        if selection is None or run.rounds_left is None:
            raise RuntimeError("a round ended before its selection was known")
        run.walk = run.walk.after(
            selection, [shard.begun for shard in shards], [shard.unfinished for shard in shards],
            n_shards=self._setup.walks,
        )  # fmt: skip
        run.round += 1
        run.rounds_left -= 1
        run.steps += sum(shard.steps for shard in shards)
        run.episodes += sum(len(shard.episodes) for shard in shards)

    def _look_ahead(self, policy: Handle) -> Arrays:
        """With `rollout.overlap`, ask for the next round before the update on this one; returns the weights that act.

        Not at the end of an iteration: the next selection is not known yet.
        """
        if not self._config.rollout.overlap or self._run.rounds_left == 0 or self._is_over():
            return {}
        self._asked.ahead = self._collect(policy, lag=1)
        return self.learner.scored()

    def _account(self, shards: list[Shard], update: Update) -> None:
        """Note what a round's episodes and its update showed."""
        run, wants = self._run, self._curriculum.wants
        if wants.episodes:
            run.seen.append(curriculum_episodes(self._setup.train, shards, self._advantages(shards, update)))
        run.rollouts.append(summed(shards, lag=run.round - 1 - shards[0].policy_version))
        run.updates.append(update.metrics)
        run.gradient_steps += update.gradient_steps

    def _advantages(self, shards: list[Shard], update: Update) -> NDArray[np.float64] | None:
        """`(m,)` as `Episodes.advantages`, of each that ended, if the curriculum asks for it; earlier rounds count."""
        run, wants = self._run, self._curriculum.wants
        if not wants.advantages or update.advantages is None:
            return None
        before = np.zeros(update.advantages.shape[1]) if run.sizes is None else run.sizes
        means, run.sizes = mean_sizes(shards, wants.counted(update.advantages), before)
        return means

    def _finish(self) -> Work[None]:
        run = self._run
        yield from self._end_iteration()
        yield from self._settle()
        if self._last_size is not None:  # what was decided last is never trained on
            self.progress.set_size = self._last_size
        self._show()  # only now, for the last returns are known
        yield from self._commit("done")
        arrays, description = model_of(self.learner, run.round)
        description |= {"config": self._config.name, "seed": self._config.seed, "env": self._config.env.id}
        bounds = self._setup.spec.context_bounds
        description["context_visible"] = self._config.env.context_visible
        description["context"] = {
            "names": list(bounds.names), "low": bounds.low.tolist(), "high": bounds.high.tolist(),
            "formula": "2 * (context - low) / (high - low) - 1, clipped to [-1, 1]; at the end of an observation",
        }  # fmt: skip
        self._writer.write_model(arrays, description)
        self._writer.set_status(self._new_status("done"))

    def _end_iteration(self) -> Work[bool]:
        """Log the steps of an iteration that is not complete, whose decision is never made. Returns whether one was."""
        run = self._run
        if not run.rollouts:
            return False
        yield from self._settle()
        self._append({**self._iteration_row(complete=False), "curriculum": {}})
        run.rollouts, run.updates, run.seen = [], [], []
        return True

    # ---- waiting, and the ledger ----

    def _settle(self, handles: Sequence[Handle] = ()) -> Work[list[Any]]:
        """Wait for the values of `handles`, and for whatever was asked for since the last wait."""
        pending, self._asked.pending = self._asked.pending, []
        answers: list[Any] = yield Wait([*handles, *(handle for one in pending for handle in one.handles)])
        at = len(handles)
        for one in pending:
            one.settle(answers[at : at + len(one.handles)])
            at += len(one.handles)
        return answers[: len(handles)]

    def _iteration_row(self, *, complete: bool) -> Row:
        """One iteration in numbers; its row of the curriculum's history is written here."""
        run, selection = self._run, self._asked.trained
        if selection is None:
            raise RuntimeError("an iteration ended before its selection was known")
        row = trained_row(run, selection, self._setup.train)
        self._writer.append(CURRICULUM, row)
        self._last_size = size_of(row)
        return iteration_row(run, complete=complete, overlap=self._config.rollout.overlap)

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

    def _has_paused(self) -> Work[bool]:
        """Commit where this part of the run ends, if it does: the next part goes on from there, as if resumed."""
        if self._is_over():
            return False
        if self._ends_curriculum and 0 < self._change_at <= self._run.steps and (yield from self._end_iteration()):
            self._run.iteration += 1
            self._run.gradient_steps = 0
        for place, state in ((self._pause_at, "paused"), (self._change_at, "running")):
            if 0 < place <= self._run.steps:
                yield from self._commit(state)
                return True
        return False

    def _commit_if_due(self) -> Work[None]:
        reason = self._stop_requested()
        if reason is not None:
            yield from self._commit("interrupted", reason)
            raise Interrupted(f"stopped by {reason} after {self._run.steps:,} steps; {CONTINUES}")
        rounds, seconds = self._run.round - self._last_commit_round, time.monotonic() - self._last_commit_time
        if self._config.checkpoint.is_due(rounds, seconds, self._commit_cost):
            yield from self._commit("running")

    def _commit(self, state: str, message: str | None = None) -> Work[None]:
        yield from self._settle()
        # A run is done only once its model is written.
        status = self._new_status("running" if state == "done" else state, message)
        asked = yield Wait([self._asked.state, self._asked.values])
        began = time.monotonic()
        self._writer.commit(self._save(*asked), status)
        self._last_commit_time, self._last_commit_round = time.monotonic(), self._run.round
        self._commit_cost = self._last_commit_time - began

    def _new_status(self, state: Any, message: str | None = None) -> Status:
        return dataclasses.replace(
            self._status, state=state, message=message, steps=self._run.steps, round=self._run.round,
            updated_at=time.time(), paused_at=self._pause_at if state == "paused" else 0,
        )  # fmt: skip

    def _save(self, state: Any, values: Any) -> Checkpoint:
        """state, values: of the curriculum, and of the instances."""
        run = self._run
        arrays, learner = self.learner.save()
        arrays = {f"learner/{name}": array for name, array in arrays.items()}
        remembered, numbers = encode_state(state)
        arrays["values"] = values
        arrays |= {f"curriculum/{name}": array for name, array in remembered.items()}
        data, kept = run.save()
        arrays |= kept
        if self.ensemble is not None:
            arrays |= {f"ensemble/{name}": array for name, array in self.ensemble.save().items()}
        # Before the checkpoint that names them.
        self._store_transitions()
        return Checkpoint(
            run.round, arrays, {"learner": learner, "curriculum": numbers, "run": data}, tuple(self._segments)
        )

    def _store_transitions(self) -> None:
        """Write what is new in the replay buffer; forget pieces that the buffer has forgotten."""
        # Pieces are written once; a checkpoint that held the buffer would write all of it anew each time.
        learner = self.learner
        remembered = learner.seen - learner.capacity
        self._segments = [segment for segment in self._segments if segment.first + segment.count > remembered]
        stored = self._segments[-1].first + self._segments[-1].count if self._segments else 0
        first = max(stored, remembered, 0)
        if learner.seen > first:
            segment = self._writer.write_segment(first, learner.seen - first, learner.transitions(first))
            self._segments.append(segment)

    def _restore(self, checkpoint: Checkpoint) -> Handle:
        cluster, asked = self._cluster, self._asked
        run = self._run = RunState.restored(checkpoint, self._setup)
        load_learner(self.learner, checkpoint)
        self._segments = list(checkpoint.segments)
        for segment in self._segments:
            self.learner.remember(self._writer.read_segment(segment), segment.first)
        self._last_commit_round, self._last_row_steps = run.round, run.steps
        self._know_returns(self._writer.ledger.rows(METRICS))
        policy = cluster.put(self.learner.policy(run.round))
        if run.curriculum_number != self._curriculum_number:
            self._begin_curriculum(policy)
            return policy
        state = decode_state(
            self._curriculum.state_type, checkpoint.under("curriculum/"), checkpoint.data["curriculum"]
        )  # fmt: skip
        selection = self._curriculum.selection(state)
        self._know_selection(selection)
        asked.state, asked.selection = cluster.put(state), cluster.put(selection)
        asked.values = cluster.put(checkpoint.arrays["values"])
        if self.ensemble is not None:
            self.ensemble.load(checkpoint.under("ensemble/"))
        if run.acted:
            # It was in flight when the checkpoint was made: asked again with the weights that acted then.
            asked.ahead = self._collect(cluster.put(self.learner.policy_of(run.acted, run.round - 1)), lag=1)
        return policy

    def _begin_curriculum(self, policy: Handle) -> None:
        """Have this curriculum choose from here on, as if it were at its start: it replaces the one before it.

        The episodes that run go on. Of their advantages only those of the steps from here on are known.
        """
        run, cluster = self._run, self._cluster
        run.version, run.walk = 0, dataclasses.replace(run.walk, order_version=-1)
        run.acted, run.sizes, run.curriculum_number = {}, None, self._curriculum_number
        self._adopt(cluster.begin(cluster.start_values(policy)))

    def _show(self) -> None:
        self.progress.steps, self.progress.episodes = self._run.steps, self._run.episodes
        self.progress.seconds_left = self._time_left.after(self.progress.share, time.monotonic())
        self._observe(self.progress)
