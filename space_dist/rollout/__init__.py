"""Collecting episodes, evaluating policies and scoring instances: pure functions of (policy, selection, seed).

A round is a fixed number of steps, and episodes go on across rounds: what a shard leaves unfinished is part of its
answer, and of the question that the next round asks. Whoever still has these very episodes in its environment goes on
at once; anybody else plays the recorded actions again, which the contract of environments makes exact. What a recurrent
policy remembers of them goes with them: it was seen with earlier weights, and cannot be made again.

A rollout actor imports neither torch nor Stable-Baselines3, unless the policy it is sent does. The number of shards,
the slots of a shard and the size of every chunk are fixed by the config: whoever computes a piece of work, and how
often, it gives the same bits.
"""

from __future__ import annotations

from space_dist.rollout.collecting import Rollout, Shard, Stage, another_way, collect, endless, replayed
from space_dist.rollout.evaluation import Outcomes, Trial, evaluate, joined
from space_dist.rollout.setup import Setup, Split
from space_dist.rollout.table import Episodes, EpisodeTable
from space_dist.rollout.walk import FloatArray, IntArray, Route, Unfinished, Walk, Walking
from space_dist.rollout.worker import Worker

__all__ = [
    "EpisodeTable", "Episodes", "FloatArray", "IntArray", "Outcomes", "Rollout", "Route", "Setup", "Shard", "Split",
    "Stage", "Trial", "Unfinished", "Walk", "Walking", "Worker", "another_way", "collect", "endless", "evaluate",
    "joined", "replayed",
]  # fmt: skip
