"""Optuna draws, prunes and weighs settings; its studies live here, in memory, and are rebuilt from the record.

What a generation of an arm is drawn from is (the search's seed, the arm's name, the generation's number, what the arm's
earlier generations were told, in their order). Who finished first, where, and how often it was killed is no part of it.
"""

from __future__ import annotations

import json
import math
import warnings
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any, Final

import numpy as np
import optuna
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.importance import FanovaImportanceEvaluator, get_param_importances
from optuna.pruners import BasePruner, MedianPruner
from optuna.samplers import BaseSampler, RandomSampler, TPESampler
from optuna.trial import FrozenTrial, TrialState, create_trial

from space_dist.experiment.search import Search, Trial
from space_dist.experiment.tuning import Distribution, Population, Pruner, Sampler, allowed
from space_dist.seeding import Purpose, seed_sequence

DIGITS: Final = 6  # of a real number that is drawn: what a label shows is what was tried
# Complete trials from which importance is told. Ours: of nine, a setting that decided nothing was given the most.
FEWEST_WEIGHED: Final = 20
_NO_GENERATION: Final = 2**31  # of draws that are no trial's


def optuna_version() -> str:
    """Of the Optuna that draws here."""
    return version("optuna")


def draw(search: Search, arm: str, count: int) -> list[dict[str, Any]]:
    """The settings of an arm's next generation: `count` of them, value by config key."""
    generation = search.generation + 1
    with _quietly():
        study = _study(search, arm, _sampler(search, arm, generation))
        return [drawn(study.ask(), space_of(search, arm)) for _ in range(count)]


def completions(space: Mapping[str, Distribution], seed: int, key: str, value: Any, count: int) -> list[dict[str, Any]]:
    """`count` seeded random settings of a whole space in which `key` has this value, wherever that can be drawn."""
    with _quietly():
        sampler = RandomSampler(seed=_sampler_seed(seed, key, _NO_GENERATION))
        study = optuna.create_study(sampler=sampler)
        # What the key's own condition names comes first: else it would be drawn by chance only.
        return [drawn(study.ask(), space, {**_needed(space, key), key: value}) for _ in range(count)]


def _needed(space: Mapping[str, Distribution], key: str) -> dict[str, Any]:
    """Values with which the condition of a key holds, and the conditions of what it names."""
    found: dict[str, Any] = {}
    for name, values in space[key].when.items():
        found |= {**_needed(space, name), name: next(filter(space[name].can_be, allowed(values)))}
    return found


def ranked_at_rung(search: Search, trials: Sequence[Trial]) -> list[Trial]:
    """Trials with a value at their rung, the best first, of equal ones that which was asked first."""
    sign = -1.0 if search.maximizes else 1.0
    return sorted(trials, key=lambda trial: (sign * trial.values[trial.rung], trial.number))


def explored(
    search: Search, arm: str, rung: int, best: Sequence[Trial], count: int, population: Population
) -> list[tuple[Trial, dict[str, Any]]]:  # fmt: skip
    """What becomes of `count` members at a rung: one of the best, each as likely, and a setting near its own.

    Each setting is drawn anew, with the chance `resample`, or multiplied by one of the factors, each as likely, and
    kept within its range. Source: Jaderberg et al. 2017, truncation selection and perturbation.
    """
    space = space_of(search, arm)
    seed = _sampler_seed(int(search.config["seed"]), arm, rung)
    random = np.random.default_rng(seed)
    with _quietly():
        study = optuna.create_study(sampler=RandomSampler(seed=seed))
        found = []
        for _ in range(count):
            parent = best[int(random.integers(len(best)))]
            anew = drawn(study.ask(), space)
            setting = {key: anew[key] if random.random() < population.resample
                       else _perturbed(one, parent.parameters[key], random.choice(population.factors))
                       for key, one in space.items()}  # fmt: skip
            found.append((parent, setting))
        return found


def _perturbed(one: Distribution, value: Any, factor: float) -> Any:
    if one.choice is not None:
        return value
    if one.ints is not None:
        return min(max(round(float(value * factor)), one.ints[0]), one.ints[1])
    return _outer(one, value * factor)


def given_up(search: Search, arm: str, trials: Sequence[Trial], pruner: Pruner) -> set[int]:
    """The numbers of those that go no further; `trials` are the open ones of an arm, with a value at their rung."""
    if pruner.kind == "halving":
        ranked = ranked_at_rung(search, trials)
        # Rounded up, but for what is rounding: a third of three is one.
        return {trial.number for trial in ranked[math.ceil(pruner.keep * len(ranked) - 1e-9) :]}
    median: BasePruner = MedianPruner(n_startup_trials=pruner.startup)
    with _quietly():
        study = _study(search, arm, RandomSampler(seed=0))
        return {trial.number for trial in trials if median.prune(study, _frozen(trial, space_of(search, arm)))}


def importance(search: Search, arm: str) -> dict[str, float]:
    """How much of the objective's variance each searched key explains, alone and with others (fANOVA), the most first.

    Of keys that every complete trial of the arm has; their sum is 1. Empty below twenty complete trials, where all
    reached the same, and of populations, whose members had several settings. Source: Hutter et al. 2014, as Optuna
    computes it, with the search's seed.
    """
    values = [trial.value for trial in search.of_arm(arm) if trial.value is not None]
    if len(values) < FEWEST_WEIGHED or len({*values}) < 2 or search.config["population"] is not None:
        return {}
    with _quietly():
        study = _study(search, arm, RandomSampler(seed=0))
        evaluator = FanovaImportanceEvaluator(seed=_sampler_seed(int(search.config["seed"]), arm, _NO_GENERATION))
        return {key: float(share) for key, share in get_param_importances(study, evaluator=evaluator).items()}


# ---- a study ---------------------------------------------------------------------------------------------------------


def _study(search: Search, arm: str, sampler: BaseSampler) -> optuna.Study:
    """Everything that the arm's trials were told, in their order; open ones are not in it."""
    study = optuna.create_study(direction="maximize" if search.maximizes else "minimize", sampler=sampler)
    space = space_of(search, arm)
    for trial in search.of_arm(arm):
        if trial.state != "open":
            study.add_trial(_frozen(trial, space))
    return study


def _frozen(trial: Trial, space: Mapping[str, Distribution]) -> FrozenTrial:
    """A trial as Optuna keeps it."""
    states = {"complete": TrialState.COMPLETE, "pruned": TrialState.PRUNED, "failed": TrialState.FAIL,
              "open": TrialState.RUNNING}  # fmt: skip
    return create_trial(
        state=states[trial.state], value=trial.value,
        params={key: inner(space[key], value) for key, value in trial.parameters.items()},
        distributions={key: _distribution(space[key]) for key in trial.parameters},
        intermediate_values=dict(trial.values),
    )  # fmt: skip


def _sampler(search: Search, arm: str, generation: int) -> BaseSampler:
    config = Sampler.model_validate(search.config["sampler"])
    seed = _sampler_seed(int(search.config["seed"]), arm, generation)
    if config.kind == "random":
        return RandomSampler(seed=seed)
    # constant_liar: trials of one generation keep away from each other, though none is over.
    return TPESampler(
        seed=seed, n_startup_trials=config.startup, multivariate=config.multivariate, constant_liar=True
    )  # fmt: skip


def _sampler_seed(seed: int, name: str, generation: int) -> int:
    """By the arm's name, not by its place: another arm in the file changes no draw."""
    sequence = seed_sequence(seed, Purpose.TRIALS, zlib.crc32(name.encode()), generation)
    return int(sequence.generate_state(1)[0])


def space_of(search: Search, arm: str) -> dict[str, Distribution]:
    return {key: Distribution.model_validate(one) for key, one in search.arms[arm].space.items()}


def drawn(
    trial: optuna.Trial, space: Mapping[str, Distribution], fixed: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """One setting: key by key, in the space's order, where conditions hold."""
    known: dict[str, Any] = {}
    for key, one in space.items():
        if not one.holds(known):
            continue
        known[key] = fixed[key] if fixed is not None and key in fixed else _outer(one, _suggested(trial, key, one))
    return known


def _suggested(trial: optuna.Trial, key: str, one: Distribution) -> Any:
    if one.floats is not None:
        return trial.suggest_float(key, *one.floats, log=one.log)
    if one.ints is not None:
        return trial.suggest_int(key, *one.ints, log=one.log)
    return trial.suggest_categorical(key, one.encoded)


def _distribution(one: Distribution) -> BaseDistribution:
    if one.floats is not None:
        return FloatDistribution(*one.floats, log=one.log)
    if one.ints is not None:
        return IntDistribution(*one.ints, log=one.log)
    return CategoricalDistribution(one.encoded)


def _outer(one: Distribution, value: Any) -> Any:
    """What a config is given, of what Optuna draws."""
    if one.floats is not None:
        low, high = one.floats
        return min(max(float(f"{value:.{DIGITS}g}"), low), high)
    return int(value) if one.ints is not None else json.loads(value)


def inner(one: Distribution, value: Any) -> Any:
    """The inverse: what Optuna is told was tried."""
    return value if one.choice is None else json.dumps(value, sort_keys=True)


@contextmanager
def _quietly() -> Iterator[None]:
    """Optuna tells every trial, and of options that may change; here the display tells what there is."""
    before = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", category=UserWarning)
            yield
    finally:
        optuna.logging.set_verbosity(before)
