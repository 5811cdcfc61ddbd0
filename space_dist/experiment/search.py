"""A search as its manifest records it: what is searched, and every trial in the order in which it was asked.

The record is the truth. Optuna's study is rebuilt from it (`sampling`), in memory and only as long as it draws; what a
trial was told to have reached stays, whatever becomes of its runs later.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

TrialState = Literal["open", "complete", "pruned", "failed"]
_STATES: tuple[TrialState, ...] = get_args(TrialState)


@dataclass(frozen=True)
class Trial:
    """One setting of an arm, tried with the search's seeds.

    number: within its arm, from 0. generation: with which it was asked, from 0; of a population, at which comparison, 0
    the start. parameters: value by config key, in the order in which they were drawn; without those whose condition did
    not hold. cell: the id of its cell; empty where the setting was refused, and nothing can run. rung: the number, from
    1, of the rung that it is on its way to, or ended at; seeds, steps: how many of the search's seeds, from the first,
    and environment steps of each it is given for that; 0 steps: the whole budget. values: the objective at each rung
    that it has come to, by the rung's number; the last one of a complete trial is what it reached. parent: the number
    of the trial of its arm from whose state it goes on, under other settings; -1: it began on its own. inherited:
    environment steps, of all its seeds together, that are its parent's. remark: why it failed.
    """

    number: int
    arm: str
    generation: int
    parameters: Mapping[str, Any]
    cell: str
    seeds: int
    steps: int = 0
    rung: int = 1
    parent: int = -1
    inherited: int = 0
    state: TrialState = "open"
    values: Mapping[int, float] = dataclasses.field(default_factory=dict)
    remark: str = ""

    @property
    def value(self) -> float | None:
        """The objective of a complete trial, over all seeds and steps; None for any other."""
        return self.values[max(self.values)] if self.state == "complete" else None

    def to_json(self) -> dict[str, Any]:
        """Plain data: parameters as pairs, for their order counts, and the manifest sorts keys."""
        return {
            "number": self.number, "arm": self.arm, "generation": self.generation,
            "parameters": [list(pair) for pair in self.parameters.items()], "cell": self.cell, "seeds": self.seeds,
            "steps": self.steps, "rung": self.rung, "parent": self.parent, "inherited": self.inherited,
            "state": self.state, "values": [list(pair) for pair in self.values.items()], "remark": self.remark,
        }  # fmt: skip

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Trial:
        """The inverse of `to_json`. Raises ValueError, TypeError or KeyError for anything else."""
        values = {int(rung): float(value) for rung, value in data["values"]}
        trial = cls(**{**data, "parameters": dict(data["parameters"]), "values": values})
        if trial.state not in _STATES or (trial.state == "complete") > bool(values):
            raise ValueError("a trial that is none")
        if not all(map(math.isfinite, values.values())):
            raise ValueError("a value that is no number")
        return trial


@dataclass(frozen=True)
class ArmRecord:
    """What the trials of an arm start from.

    base: a run config as plain data, its files relative to the grid's folder. space: the distribution of each searched
    key, as the schema writes it out, in the order of drawing; of `when` only conditions on searched keys are left.
    """

    base: Mapping[str, Any]
    space: Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Search:
    """What is searched, and what was found so far.

    config: the file, checked, every default written out. arms: by name, in the file's order. final: the instance files
    of the confirmation, `train` and `test`, relative to the grid's folder. optuna: the version that draws.
    """

    config: Mapping[str, Any]
    arms: Mapping[str, ArmRecord]
    final: Mapping[str, str]
    optuna: str
    trials: tuple[Trial, ...] = ()

    @property
    def maximizes(self) -> bool:
        """Whether more of the objective is better; of steps to a threshold, less is."""
        return str(self.config["objective"]["kind"]) != "steps"

    @property
    def total(self) -> int:
        """Trials of all arms together, asked or not; of populations, those that have no parent."""
        return int(self.config["trials"]) * len(self.arms)

    @property
    def generation(self) -> int:
        """The number of the last generation that was asked; -1 before the first."""
        return max((trial.generation for trial in self.trials), default=-1)

    @property
    def open(self) -> tuple[Trial, ...]:
        """Trials of which the outcome is not known."""
        return tuple(trial for trial in self.trials if trial.state == "open")

    @property
    def over(self) -> bool:
        """Whether every trial was asked, and its outcome is known."""
        return self.asked == self.total and not self.open

    @property
    def asked(self) -> int:
        """Trials of all arms together that were asked; of populations, those that have no parent."""
        return sum(trial.parent < 0 for trial in self.trials)

    def of_arm(self, arm: str) -> tuple[Trial, ...]:
        """The trials of an arm, by number."""
        return tuple(trial for trial in self.trials if trial.arm == arm)

    def lineage(self, trial: Trial) -> tuple[Trial, ...]:
        """The trials whose settings it has had one after the other, itself the last."""
        of_arm = self.of_arm(trial.arm)
        found = [trial]
        while found[0].parent >= 0:
            found.insert(0, of_arm[found[0].parent])
        return tuple(found)

    def in_force(self, trial: Trial) -> tuple[Mapping[str, Any], list[dict[str, Any]]]:
        """The settings that a trial began with, and how they changed on the way: a config's `schedule`."""
        first, *later = self.lineage(trial)
        # An heir's generation is the number of the comparison at which it was copied.
        return first.parameters, [
            {"steps": int(self.config["population"]["every_steps"]) * heir.generation, "set": dict(heir.parameters)}
            for heir in later
        ]

    def best(self, arm: str) -> Trial | None:
        """The complete trial of an arm with the best objective, the first of equal ones; None: there is none."""
        complete = [(trial.value, trial) for trial in self.of_arm(arm)]
        known = [(value, trial) for value, trial in complete if value is not None]
        sign = -1.0 if self.maximizes else 1.0
        return min(known, key=lambda one: (sign * one[0], one[1].number), default=(0.0, None))[1]

    def with_trials(self, trials: Sequence[Trial]) -> Search:
        """The same search, with these trials in place of all it had."""
        return dataclasses.replace(self, trials=tuple(trials))

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "config": self.config,
            "arms": [[name, {"base": arm.base, "space": [list(pair) for pair in arm.space.items()]}]
                     for name, arm in self.arms.items()],
            "final": dict(self.final), "optuna": self.optuna, "trials": [trial.to_json() for trial in self.trials],
        }  # fmt: skip

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Search:
        """The inverse of `to_json`. Raises ValueError, TypeError or KeyError for anything else."""
        arms = {name: ArmRecord(arm["base"], dict(arm["space"])) for name, arm in data["arms"]}
        search = cls(**{**data, "arms": arms, "trials": tuple(map(Trial.from_json, data["trials"]))})
        counted = dict.fromkeys(arms, 0)
        for trial in search.trials:
            if trial.number != counted[trial.arm] or not -1 <= trial.parent < trial.number:
                raise ValueError("trials that are not in their order")
            counted[trial.arm] += 1
        return search
