"""Going on with a run under a larger budget, to the bytes of one that had that budget from the start."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from space_dist.config import DQNConfig, RunConfig
from space_dist.errors import ConfigError
from space_dist.ledger import Checkpoint, Status

_GROWS: Final = (
    "the budget of a run that is there may only grow, and a larger one counts from when the run was first asked for it"
)


def is_longer(before: RunConfig, now: RunConfig) -> bool:
    """Whether `now`, which is `before` with another budget, has a larger one, in steps or episodes.

    Raises ConfigError if it has a smaller one, and if what was done until now would have come out otherwise under the
    larger.
    """
    old, new = before.budget, now.budget
    if old == new:
        return False
    if new.steps < old.steps:
        raise ConfigError(_refused("steps", f"{old.steps} -> {new.steps}", str(old.steps)))
    if new.episodes is not None and (old.episodes is None or new.episodes < old.episodes):
        change = f"{old.episodes or 'no limit'} -> {new.episodes}"
        raise ConfigError(_refused("episodes", change, str(old.episodes or "null")))
    # Rows and checkpoints that are there must be those that the larger budget would have given.
    reason = _goes_by_budget(before)
    if reason is not None:
        raise ConfigError(
            f"budget: {_grown(before, now)}: {reason}, so a longer run is another from its start: use --out DIR for "
            "it (from Python: out=DIR). With `init_from` it starts from this run's policy. Under the budget that it "
            "has, this one goes on"
        )
    return True


def _refused(key: str, change: str, now: str) -> str:
    """A smaller budget, and with which one the run goes on now."""
    return (
        f"budget.{key}: {change}: {_GROWS}: --set budget.{key}={now} goes on with it (from Python: overrides), --out "
        "DIR starts another (out=DIR)"
    )


def _grown(before: RunConfig, now: RunConfig) -> str:
    """`40,960 -> 81,920 steps`, and the same of episodes, of what has another limit."""
    old, new = before.budget, now.budget
    steps = [] if old.steps == new.steps else [f"{old.steps:,} -> {new.steps:,} steps"]
    if old.episodes == new.episodes:
        return "".join(steps)
    first, second = (f"{limit:,}" if limit is not None else "no limit" for limit in (old.episodes, new.episodes))
    return ", ".join([*steps, f"{first} -> {second} episodes"])


def longer_in_words(before: RunConfig, now: RunConfig, status: Status, *, same_bits: bool) -> str:
    """Where a run goes on that was `before` and was handed over to `now`: `status`, as `hand_over` returned it."""
    if before.budget == now.budget:
        return f"going on at {status.steps:,} steps, under another schedule"
    under = f"under a larger budget: {_grown(before, now)}"
    if status.checkpoint is not None:
        return f"going on at {status.steps:,} steps, {under}"
    repeats = "repeats it from its start, to the same bits," if same_bits else "repeats it from its start"
    why = "no checkpoint is from before the end of the smaller one"
    return f"beginning anew, {under}; {why}, so it {repeats} and goes beyond"


def takes_over(before: RunConfig, now: RunConfig, status: Status | None) -> bool:
    """Whether `now` is `before` with one more change, and the run is paused just where that comes into force."""
    if status is None or status.state != "paused" or not now.schedule or now.schedule[-1].replaces_curriculum:
        return False
    return now.schedule[:-1] == before.schedule and status.paused_at == now.schedule[-1].steps


def _goes_by_budget(config: RunConfig) -> str | None:
    """What of a config has a run do other things under another budget, as a clause; None: nothing."""
    learner = config.learner
    if learner.learning_rate_schedule != "constant":
        return f"learner.learning_rate_schedule: {learner.learning_rate_schedule} falls to 0 at the end of the budget"
    if isinstance(learner, DQNConfig):
        return f"learner.exploration_fraction: {learner.exploration_fraction:g} is a share of the budget"
    if learner.import_path is not None:
        return f"learner.import: {learner.import_path} may go by how much of the budget is left"
    if config.curriculum.may_probe:
        return f"curriculum.kind: {config.curriculum.kind} may probe as long as the budget has room for it"
    return None


def within(config: RunConfig, horizon: int) -> Callable[[Checkpoint], bool]:
    """Whether a checkpoint was made before the end of `config`'s budget: a longer run has passed through it as well."""
    budget, longest = config.budget, config.round_steps(horizon)

    def was_before_the_end(checkpoint: Checkpoint) -> bool:
        run = checkpoint.data["run"]
        enough = budget.episodes is not None and run["episodes"] >= budget.episodes
        return not enough and run["steps"] + longest <= budget.steps

    return was_before_the_end
