"""What a run logs of itself: pure functions of its state, and of outcomes."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np

from space_dist.curricula import GENERATED, Selection
from space_dist.instances import InstanceSet
from space_dist.ledger import Row
from space_dist.rollout import Outcomes
from space_dist.rollout.episodes import joined_episodes
from space_dist.run.cluster import checked
from space_dist.run.state import RunState


def position(run: RunState) -> Row:
    """Where the run stands."""
    return {"iteration": run.iteration, "round": run.round, "steps": run.steps}


def trained_row(run: RunState, selection: Selection, train: InstanceSet) -> Row:
    """One iteration in the curriculum's history: the instances that were trained on."""
    trained: Row = {"trained": selection.ids.tolist()}
    if selection.drawn:  # the draws whose episodes ended
        seen = joined_episodes(run.seen)
        generated = seen.indices == GENERATED
        trained = {"trained": np.where(generated, GENERATED, train.ids[seen.indices]).tolist()}
        trained |= {"contexts": seen.contexts.tolist()} if generated.any() else {}
    return {"iteration": run.iteration, "steps": run.steps, **trained}


def size_of(trained: Row) -> int:
    """How many instances an iteration was trained on, by its `trained_row`; generated contexts count each."""
    ids = trained["trained"]
    return len(ids) if GENERATED in ids else len(set(ids))


def iteration_row(run: RunState, *, complete: bool, overlap: bool) -> Row:
    """One iteration in numbers: means over its episodes, and over its updates.

    complete: whether it came to its end within the budget. overlap: whether weights may have been behind.
    """
    totals = {name: sum(one[name] for one in run.rollouts) for name in run.rollouts[0]}
    episodes = int(totals["episodes"])
    return {
        "kind": "iteration",
        **position(run),
        "complete": complete,
        "episodes": episodes,
        "gradient_steps": run.gradient_steps,
        **({"lagged_steps": int(totals["lagged"])} if overlap else {}),
        "rollout": {
            name: totals[name] / episodes if episodes and math.isfinite(totals[name]) else None
            for name in ("return", "discounted_return", "length", "success")
        },
        "learner": {
            name: float(np.mean([update[name] for update in run.updates if name in update]))
            for name in sorted({name for update in run.updates for name in update})
        },
    }


def summary(outcomes: Outcomes, instances: int, episodes: int) -> dict[str, Any]:
    """Means over a split, and each instance's mean return in id order; over all policies, where there are several.

    With several episodes an instance, its mean over the first, third, ... and over the others is there as well, so that
    instances can be chosen by one half and measured by the other.
    """
    returns = checked(outcomes.returns, "returns")
    each = returns.reshape(-1, instances, episodes)
    return {
        "return": float(returns.mean()),
        "discounted_return": float(outcomes.discounted_returns.mean()),
        "length": float(outcomes.lengths.mean()),
        "success": None if np.isnan(outcomes.success).any() else float(outcomes.success.mean()),
        "returns": each.mean(axis=(0, 2)).tolist(),
        **({"halves": [each[:, :, half::2].mean(axis=(0, 2)).tolist() for half in (0, 1)]} if episodes > 1 else {}),
    }


def next_evaluation(every_steps: int | Literal["log"], evaluated_at: int) -> int:
    """Steps at which the next evaluation falls due; it is made after the first update at or behind them."""
    if every_steps == "log":
        marks = (factor * round(10.0**power) for power in range(3, 16) for factor in (1, 3))
        return next(mark for mark in marks if mark > evaluated_at)
    return (evaluated_at // every_steps + 1) * every_steps
