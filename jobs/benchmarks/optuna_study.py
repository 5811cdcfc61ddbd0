"""What people do today, in a process of its own: an Optuna study over stock Stable-Baselines3's PPO, on all cores.

The study tries the settings that a finished search of ours has drawn (`enqueue_trial`), so both do the same work.
Threads of the study hand the runs of a trial to processes that each train one run at a time, with one thread of torch;
they are started once, and import once.

What is imported here is what somebody else's script would import: nothing of ours that takes time at its start, or
replaces kernels of torch.
"""

from __future__ import annotations

import json
import multiprocessing
import sys
import time
from collections.abc import Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import asdict, dataclass
from itertools import repeat
from pathlib import Path
from typing import Any

import optuna

from benchmarks.contenders import stock_arguments
from space_dist.config import PPOConfig, RunConfig
from space_dist.envs import make_batched
from space_dist.errors import SpaceDistError
from space_dist.experiment.manifest import Grid, Run
from space_dist.experiment.sampling import drawn, inner, space_of
from space_dist.instances import read_csv


@dataclass(frozen=True)
class Asked:
    """What a process of this module is given.

    folder: of the finished search whose settings are tried, which has one arm.  seeds: how many of a trial's, from the
    first.  evaluations: environment steps of a run after which it is evaluated, the last of which are its end.
    n_envs: environments in SB3's batch.  processes: that train, one run at a time each.
    """

    folder: str
    seeds: int
    evaluations: tuple[int, ...]
    n_envs: int
    processes: int


@dataclass(frozen=True)
class Trained:
    """One run of stock SB3. final: its last mean return on the development instances.

    steps, evaluation_steps: of the environment.  collecting, learning, evaluating: seconds.
    """

    final: float
    steps: int
    evaluation_steps: int
    collecting: float
    learning: float
    evaluating: float


def studied(asked: Asked, pool: Executor) -> dict[str, Any]:
    """An Optuna study of the search's trials: `values`, what each reached, and the `runs`, in the order they ended.

    Raises SpaceDistError if the study has not come to the search's settings.
    """
    grid = Grid(asked.folder)
    manifest = grid.manifest()
    search = manifest.searched
    (arm,) = search.arms
    trials, space = search.of_arm(arm), space_of(search, arm)
    runs: list[Trained] = []

    def objective(trial: optuna.Trial) -> float:
        ours = trials[trial.number]
        if drawn(trial, space) != dict(ours.parameters):
            raise SpaceDistError(f"Optuna's trial {trial.number} has other settings than the search's")
        seeds, cell = manifest.seeds[: asked.seeds], manifest.cell(ours.cell)
        wanted = [grid.run_config(manifest, Run(cell, seed)) for seed in seeds]
        done = list(pool.map(_trained, wanted, repeat(asked.n_envs), repeat(asked.evaluations)))
        runs.extend(done)
        return sum(run.final for run in done) / len(done)

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = optuna.create_study(direction="maximize", sampler=optuna.samplers.TPESampler(seed=0))
    for trial in trials:
        study.enqueue_trial({key: inner(space[key], value) for key, value in trial.parameters.items()})
    # As many trials at a time as there are processes: none of these waits while another trial's last run trains.
    study.optimize(objective, n_trials=len(trials), n_jobs=asked.processes)
    return {"values": [trial.value for trial in study.trials], "runs": [asdict(run) for run in runs]}


def _trained(config: RunConfig, n_envs: int, evaluations: Sequence[int]) -> Trained:
    """Train one run, and evaluate it as ours are: deterministic episodes, on all instances of both sets."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.evaluation import evaluate_policy

    from benchmarks.batched_vec_env import BatchedVecEnv

    if not isinstance(config.learner, PPOConfig):
        raise SpaceDistError(f"the search's runs learn by {config.learner.kind}, and not by ppo")
    kwargs, visible = config.env.kwargs, config.env.context_visible
    bounds = make_batched(config.env.id, 1, context_visible=visible, kwargs=kwargs).context_bounds

    def made(path: Path, n_slots: int = 0) -> BatchedVecEnv:
        """On the instances of a file; of as many slots as evaluation has episodes, unless there is a number."""
        contexts = read_csv(path, bounds).contexts.repeat(1 if n_slots else config.evaluation.episodes, axis=0)
        env = make_batched(config.env.id, n_slots or len(contexts), context_visible=visible, kwargs=kwargs)
        return BatchedVecEnv(env, contexts, seed=config.seed, in_turn=True)

    splits = made(config.instances.train), made(config.instances.test)

    class Watch(BaseCallback):
        """Evaluates when it is time, and knows where the time went."""

        def __init__(self) -> None:
            super().__init__()
            self.spent = dict.fromkeys(("collecting", "learning", "evaluating"), 0.0)
            self.evaluation_steps, self.final = 0, float("nan")
            self._since = time.perf_counter()

        def _passed(self, what: str) -> None:
            self.spent[what] += time.perf_counter() - self._since
            self._since = time.perf_counter()

        def _evaluate_if_due(self) -> None:
            if self.num_timesteps in evaluations:
                for env in splits:  # the development instances come last
                    returns, lengths = evaluate_policy(
                        self.model, env, n_eval_episodes=env.num_envs, return_episode_rewards=True, warn=False
                    )
                    assert isinstance(returns, list)  # noqa: S101 - as it was asked for
                    assert isinstance(lengths, list)  # noqa: S101
                    self.evaluation_steps += sum(map(int, lengths))
                    self.final = sum(map(float, returns)) / len(returns)
                self._passed("evaluating")

        def _on_training_start(self) -> None:
            self._since = time.perf_counter()

        def _on_rollout_start(self) -> None:
            self._passed("learning")
            self._evaluate_if_due()

        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            self._passed("collecting")

        def _on_training_end(self) -> None:
            self._passed("learning")
            self._evaluate_if_due()

    watch, env = Watch(), made(config.instances.train, n_envs)
    model = PPO("MlpPolicy", env, seed=config.seed, **stock_arguments(config.learner, n_envs))
    model.learn(evaluations[-1], callback=watch)
    return Trained(watch.final, model.num_timesteps, watch.evaluation_steps, **watch.spent)


def _warm_up() -> None:
    import stable_baselines3  # noqa: F401 - before the first run
    import torch

    torch.set_num_threads(1)


def main() -> None:
    """Do what the command line says, and print what came of it."""
    given = json.loads(sys.argv[-1])
    asked = Asked(**{**given, "evaluations": tuple(given["evaluations"])})
    # Started anew: a fork of a process with threads may hang.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(asked.processes, mp_context=context, initializer=_warm_up) as pool:
        print(json.dumps(studied(asked, pool)))


if __name__ == "__main__":
    main()
