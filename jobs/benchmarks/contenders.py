"""The contenders of `throughput`, each in a process of its own.

All of them train PPO with actor and critic of 64-64 tanh units, 10 epochs and the same settings on the same environment
with its context visible. Times are wall times of whole iterations, collecting and learning, after two to warm up.

What is imported here, rivals import: nothing of ours that takes time at its start, or replaces kernels of torch.
"""

from __future__ import annotations

import importlib
import itertools
import json
import logging
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from space_dist import config as configs
from space_dist.config import PPOConfig
from space_dist.envs import BatchedEnv, ContextObservation, make_batched, make_single
from space_dist.instances import ContextBounds, read_csv

ROOT = Path(__file__).resolve().parents[2]
WARM_UP = 2  # iterations
EPOCHS = 10
# Libraries read the environment once, when they are loaded or first used: what comes later changes nothing.
NATIVE = "import numpy, scipy.linalg, torch; torch.ones(64, 64) @ torch.ones(64, 64); torch.ones(64).exp()"
SINGLE_THREADED = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
XLA_FLAGS = (
    SINGLE_THREADED, f"{SINGLE_THREADED} --xla_cpu_enable_fast_math=true",
    f"{SINGLE_THREADED} --xla_cpu_experimental_onednn_custom_call=true",
)  # fmt: skip


@dataclass(frozen=True)
class Task:
    """What is learnt.

    n_steps, batch_size: transitions per update and minibatch.  shards, slots: how ours collects them.
    """

    title: str
    config: str
    n_steps: int
    batch_size: int
    shards: int
    slots: int
    overrides: tuple[str, ...] = ()

    def run_config(self, *more: str) -> configs.RunConfig:
        """Our run: the curriculum, the ledger and checkpoints as always; evaluation at its ends alone."""
        return configs.load(
            ROOT / "configs" / self.config,
            [
                *self.overrides, f"learner.n_steps={self.n_steps}", f"learner.batch_size={self.batch_size}",
                f"learner.n_epochs={EPOCHS}", f"rollout.shards={self.shards}", f"rollout.slots={self.slots}",
                "budget.steps=1000000000", "evaluation.every_steps=1000000000", "tracking.uri=null", *more,
            ],
        )  # fmt: skip


def _instances(name: str) -> list[str]:
    return [f"instances.{split}={ROOT}/configs/instances/{name}_{split}.csv" for split in ("train", "test")]


TASKS = {
    "pointmass": Task("PointMass, 2,048 / 64", "pointmass_space.yaml", 2048, 64, 1, 16),
    "pointmass_large": Task("PointMass, 8,192 / 1,024", "pointmass_space.yaml", 8192, 1024, 1, 64),
    "cartpole": Task("CartPole, 2,048 / 64", "pointmass_space.yaml", 2048, 64, 1, 8,
                     ("env.id=space_dist/CartPole-v0", *_instances("cartpole_uniform"))),
    "ant": Task("AntGoal, 2,048 / 64", "antgoal_space.yaml", 2048, 64, 4, 1),
}  # fmt: skip


@dataclass(frozen=True)
class Contender:
    """Who learns, and how it is set up.

    kind: ours, sb3, sbx, rllib or jax.  threads: of torch in the learning process.
    update, workers, overlap: of ours; `population` is of so many `members`, as JAX's may be.
    slots: of ours and JAX's, environments in a batch; 0: as many as the task says.
    overrides, checkout: of ours, more settings of the config, and another version.
    vec_env, n_envs: SB3's and SBX's dummy or subproc, or batched, ours in its interface.
    runners, n_envs: RLlib's processes and the environments of each.  flags: XLA's.
    device: where ours and JAX's learn, and JAX's collects. `stacked` of ours is the update alone, of so many members.
    """

    kind: str
    threads: int = 1
    update: str = "stock"
    workers: int = 0
    overlap: bool = False
    vec_env: str = "subproc"
    n_envs: int = 2
    runners: int = 0
    flags: str = ""
    members: int = 1
    slots: int = 0
    overrides: tuple[str, ...] = ()
    checkout: str = ""
    device: str = "cpu"

    @property
    def title(self) -> str:
        """In tables."""
        if self.kind == "ours":
            whose = f"{Path(self.checkout).name}, {self.update}" if self.checkout else f"ours, {self.update}"
            return whose + (", collecting while updating" if self.overlap else "")
        if self.kind in ("rllib", "jax"):
            return {"rllib": "RLlib", "jax": "JAX, everything jitted"}[self.kind]
        names = {"subproc": "SubprocVecEnv", "dummy": "DummyVecEnv", "batched": "our batched environment"}
        return f"{self.kind.upper()}, {names[self.vec_env]}({self.n_envs})"

    @property
    def first(self) -> str:
        """What its process does before it imports anything else.

        Ours settles its arithmetic and its threads before NumPy is loaded. Rivals get what the libraries choose by
        themselves, which they do once.
        """
        native = "import numpy" if self.kind == "jax" else NATIVE
        return "import space_dist.cli" if self.kind == "ours" else native

    @property
    def pinned(self) -> bool:
        """Whether a process of it keeps to one core."""
        return self.device == "cpu" and (self.kind == "jax" or self.update == "population")

    @property
    def setting(self) -> str:
        """What was chosen for it."""
        threads = f"{self.threads} torch thread{'s' if self.threads > 1 else ''}"
        slots = f", {self.slots} slots" if self.slots else ""
        if self.kind == "jax" or self.update in ("population", "stacked"):
            where = "on a core" if self.device == "cpu" else "on the GPU"
            members = f"{self.members:,} member{'s' if self.members > 1 else ''} {where}{slots}"
            return f"{members}, XLA_FLAGS={self.flags!r}" if self.kind == "jax" else members
        if self.kind == "sbx":
            return f"XLA_FLAGS={self.flags!r}"
        if self.kind == "ours":
            return (f"{self.workers} Ray actors" if self.workers else "one process") + slots
        if self.kind == "rllib":
            return f"{self.runners} env runners of {self.n_envs}, {threads}"
        return threads


class _Stopwatch:
    """Marks the ends of iterations, until there are enough."""

    def __init__(self, seconds: float, clock: Callable[[], float]) -> None:
        self._seconds, self._clock = seconds, clock
        self._marks: list[tuple[int, float]] = []

    def mark(self, steps: int) -> bool:
        """At so many steps of the run. Whether that is enough: an iteration at least, and the time asked for."""
        self._marks.append((steps, self._clock()))
        return len(self._marks) > WARM_UP + 1 and self._marks[-1][1] - self._marks[WARM_UP][1] >= self._seconds

    def rate(self) -> float:
        """Environment steps per second."""
        (first, start), (last, end) = self._marks[WARM_UP], self._marks[-1]
        return (last - first) / (end - start)


def measure(task: Task, contender: Contender, seconds: float, clock: Callable[[], float]) -> dict[str, float]:
    """`rate`: environment steps per second of `contender` on `task`, over about `seconds` of the clock.

    compile: seconds before the first iteration that went into compiling, of those who do it apart.
    """
    watch = _Stopwatch(seconds, clock)
    if contender.kind == "jax":
        compiling = _jax(task, contender, watch.mark)
        return {"rate": watch.rate(), "compile": compiling}
    if contender.kind == "rllib":
        _rllib(task, contender, watch)
    elif contender.kind == "ours":
        {"population": _population, "stacked": _stacked}.get(contender.update, _ours)(task, contender, watch)
    else:
        _sb3(task, contender, watch)
    return {"rate": watch.rate()}


def _ours(task: Task, contender: Contender, watch: _Stopwatch) -> None:
    from space_dist.errors import Interrupted
    from space_dist.ledger import Ledger

    launch, stop = _ours_of("run/launch", "launch").launch, _ours_of("system/interrupts", "interrupts").StopRequests()
    slots = [f"rollout.slots={contender.slots}"] if contender.slots else []
    config = task.run_config(
        f"learner.update={contender.update}", f"resources.workers={contender.workers}",
        f"rollout.overlap={str(contender.overlap).lower()}", *slots, *contender.overrides,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        run, seen = Path(folder) / "run", [-1]

        def observe(progress: Any) -> None:
            if progress.steps > seen[0]:
                seen[0] = progress.steps
                if watch.mark(progress.steps):
                    Ledger(run).stop_file.touch()

        try:
            launch(config, run, resume=False, stop=stop, observe=observe)
        except Interrupted:
            return
        raise RuntimeError("the run ended before it was measured")


def _ours_of(*files: str) -> Any:
    """A module of the version that is measured, by where it may lie there: newest first."""
    package = Path(configs.__file__).parents[0 if Path(configs.__file__).name == "config.py" else 1]
    for file in files:
        if (package / f"{file}.py").exists():  # asked of the folder: another version's may be importable, too
            return importlib.import_module(f"{package.name}.{file.replace('/', '.')}")
    raise RuntimeError(f"{package} has none of {', '.join(files)}")


class _Measured(Exception):  # noqa: N818 - no error
    """That is enough."""


def _population(task: Task, contender: Contender, watch: _Stopwatch) -> None:
    """Runs side by side in this process, marked where the last of them has collected."""
    population, training = _ours_of("run/population", "population"), _ours_of("run/training", "training")
    stop = _ours_of("system/interrupts", "interrupts").StopRequests()

    def watched(work: Any) -> Iterator[Any]:
        answer: Any = None
        while True:
            request = work.send(answer)
            if isinstance(request, training.Learn) and watch.mark(request.steps * contender.members):
                raise _Measured
            answer = yield request

    def ended(path: Path, outcome: object) -> None:
        raise RuntimeError(f"{path} ended before it was measured: {outcome}")

    with tempfile.TemporaryDirectory() as folder:
        works = dict[Path, Any]()
        for seed in range(contender.members):
            path = Path(folder) / str(seed)
            device = [] if contender.device == "cpu" else [f"device={contender.device}"]
            config = task.run_config("engine=population", f"seed={seed}", *device, *contender.overrides)
            works[path] = population.member(config, path, stop=stop)
        works[path] = watched(works[path])
        try:
            population.advance(works, ended)
        except _Measured:
            return


def _stacked(task: Task, contender: Contender, watch: _Stopwatch) -> None:
    """Whole updates of a stack of members, of samples that nobody has collected."""
    from benchmarks import kernel

    _, settings = _settings(task)
    update = kernel.stacked_update(
        _shape(task), task.batch_size, task.n_steps, settings.n_epochs, contender.members, contender.device
    )
    steps, enough = 0, watch.mark(0)
    while not enough:
        update()
        steps += task.n_steps * contender.members
        enough = watch.mark(steps)


def _single(config: configs.RunConfig) -> Callable[[], gym.Env[Any, Any]]:
    """The registered Gymnasium environment, which draws a context at each reset, with that context in its observations.

    Without Gymnasium's checkers around it, which cost rivals time.
    """
    return lambda: ContextObservation(make_single(config.env.id, **config.env.kwargs))


def _jax(task: Task, contender: Contender, mark: Callable[[int], bool]) -> float:
    """Train until `mark`, which is told of environment steps, has enough; returns seconds of compiling."""
    _start_xla(contender)
    from benchmarks import jitted

    config, settings = _settings(task)
    start = time.perf_counter()
    bounds = make_batched(config.env.id, 1, context_visible=False, kwargs=config.env.kwargs).context_bounds
    iterate, learning = jitted.prepare(
        settings, _contexts(config, bounds), members=contender.members, n_envs=contender.slots or task.slots
    )
    compiling = time.perf_counter() - start
    steps, enough = 0, mark(0)
    while not enough:
        learning, rewards = iterate(learning)
        rewards.block_until_ready()
        steps += task.n_steps * contender.members
        enough = mark(steps)
    if not np.isfinite(np.asarray(rewards)).all():
        raise RuntimeError("the networks are no longer numbers")
    return compiling


def _start_xla(contender: Contender) -> None:
    os.environ |= {"XLA_FLAGS": contender.flags, "JAX_PLATFORMS": contender.device}


def _sb3(task: Task, contender: Contender, watch: _Stopwatch) -> None:
    """SB3's PPO, or SBX's."""
    import torch
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    class Marks(BaseCallback):
        enough = False

        def _on_rollout_start(self) -> None:
            self.enough = watch.mark(self.num_timesteps)

        def _on_step(self) -> bool:
            return not self.enough

    config, settings = _settings(task)
    n_envs = contender.n_envs
    if contender.vec_env == "batched":
        from benchmarks.batched_vec_env import BatchedVecEnv

        bounds = make_batched(config.env.id, 1, context_visible=False, kwargs=config.env.kwargs).context_bounds
        env: Any = BatchedVecEnv(_batched(config, n_envs), _contexts(config, bounds), seed=0)
    else:
        env = (SubprocVecEnv if contender.vec_env == "subproc" else DummyVecEnv)([_single(config)] * n_envs)
        env.seed(0)
    torch.set_num_threads(contender.threads)
    if contender.kind == "sbx":
        _start_xla(contender)
    algorithm: Any = importlib.import_module({"sb3": "stable_baselines3", "sbx": "sbx"}[contender.kind]).PPO
    algorithm("MlpPolicy", env, seed=0, **stock_arguments(settings, n_envs)).learn(10**9, callback=Marks())
    env.close()


def stock_arguments(settings: PPOConfig, n_envs: int) -> dict[str, Any]:
    """What SB3's PPO, or SBX's, is made with to learn by these settings, of so many environments on a CPU."""
    return {
        "n_steps": settings.n_steps // n_envs, "batch_size": settings.batch_size, "n_epochs": settings.n_epochs,
        "gamma": settings.gamma, "gae_lambda": settings.gae_lambda, "learning_rate": settings.learning_rate,
        "ent_coef": settings.ent_coef, "vf_coef": settings.vf_coef, "clip_range": settings.clip_range,
        "policy_kwargs": {"net_arch": list(settings.net_arch)}, "device": "cpu",
    }  # fmt: skip


def _settings(task: Task) -> tuple[configs.RunConfig, PPOConfig]:
    config = task.run_config()
    if not isinstance(config.learner, PPOConfig):
        raise TypeError(f"{task.config} trains no PPO")
    return config, config.learner


def _shape(task: Task) -> Any:
    """The actor's and the critic's, as `space_dist.kernels.Shape`."""
    from space_dist.kernels import Shape

    config, settings = _settings(task)
    env = _batched(config, 1)
    inputs, space = int(np.prod(env.observation_space.shape or ())), env.action_space
    outputs = int(space.n) if isinstance(space, gym.spaces.Discrete) else int(np.prod(space.shape or ()))
    return Shape(inputs, outputs, isinstance(space, gym.spaces.Discrete), settings.net_arch, settings.activation)


def _batched(config: configs.RunConfig, n_slots: int) -> BatchedEnv:
    return make_batched(config.env.id, n_slots, context_visible=True, kwargs=config.env.kwargs)


def _contexts(config: configs.RunConfig, bounds: ContextBounds) -> NDArray[np.float64]:
    return read_csv(config.instances.train, bounds).contexts


def _rllib(task: Task, contender: Contender, watch: _Stopwatch) -> None:
    from space_dist.system.workplace import private_ray

    private_ray()
    import ray
    from ray.rllib.algorithms import ppo
    from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
    from ray.tune.registry import register_env

    logging.getLogger("ray").setLevel(logging.ERROR)
    config, settings = _settings(task)
    make, rllib_ppo = _single(config), cast(Any, ppo)  # which is untyped
    ray.init(
        address="local", num_cpus=contender.runners + 1, include_dashboard=False, log_to_driver=False,
        logging_level=logging.ERROR,
    )  # fmt: skip
    register_env("task", lambda _: make())
    algorithm = (
        rllib_ppo.PPOConfig()
        .environment("task")
        .env_runners(num_env_runners=contender.runners, num_envs_per_env_runner=contender.n_envs)
        .learners(num_learners=0)
        .training(
            train_batch_size_per_learner=task.n_steps, minibatch_size=task.batch_size, num_epochs=EPOCHS,
            lr=settings.learning_rate, gamma=settings.gamma, lambda_=settings.gae_lambda, grad_clip=0.5,
            clip_param=settings.clip_range, vf_clip_param=math.inf, vf_loss_coeff=settings.vf_coef,
            entropy_coeff=settings.ent_coef, use_kl_loss=False,
        )
        .rl_module(
            model_config=DefaultModelConfig(
                fcnet_hiddens=list(settings.net_arch), fcnet_activation="tanh", vf_share_layers=False
            )
        )
        .debugging(log_level="ERROR", seed=0)
        .build_algo()
    )  # fmt: skip
    enough = watch.mark(0)
    while not enough:
        enough = watch.mark(int(algorithm.train()["num_env_steps_sampled_lifetime"]))
    algorithm.stop()
    ray.shutdown()


def limits(task: Task) -> dict[str, float]:
    """What no contender can avoid, of one core: seconds of arithmetic and of the environment's own steps.

    single, batched: seconds per environment step, alone and among ours.  arithmetic: seconds per environment step for
    the networks' multiplications, when acting and in all epochs, at the rate of a large matrix product.
    kernel: seconds per environment step for our compiled update, alone.
    """
    import torch

    from benchmarks import kernel

    torch.set_num_threads(1)
    config, _ = _settings(task)
    one, many = _single(config)(), _batched(config, task.slots)
    found = {"single": _single_seconds(one), "batched": _batched_seconds(many, config)}
    shape = _shape(task)
    widths = [shape.inputs, *shape.hidden]
    products = 2 * sum(a * b for a, b in itertools.pairwise(widths)) + widths[-1] * (shape.outputs + 1)
    # Forward; backward, by weights and by inputs, of which the first layer needs none.
    learning = EPOCHS * (3 * products - 2 * widths[0] * widths[1])
    matrix = torch.ones(512, 512)
    start, count = time.perf_counter(), 0
    while time.perf_counter() - start < 0.5:
        matrix @ matrix
        count += 1
    per_product = (time.perf_counter() - start) / (count * 512**3)
    update = EPOCHS / task.batch_size * kernel.seconds(shape, task.batch_size)
    return found | {"arithmetic": (products + learning) * per_product, "kernel": update}


def _single_seconds(env: gym.Env[Any, Any], steps: int = 2_000) -> float:
    env.reset(seed=0)
    env.action_space.seed(0)
    start = time.perf_counter()
    for _ in range(steps):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
    return (time.perf_counter() - start) / steps


def _batched_seconds(env: BatchedEnv, config: configs.RunConfig, steps: int = 1_000) -> float:
    space, slots = env.action_space, np.arange(env.n_slots)
    space.seed(0)
    contexts = _contexts(config, env.context_bounds)
    env.reset(slots, contexts[slots % len(contexts)], slots.astype(np.uint64))
    actions = np.stack([space.sample() for _ in slots])
    start = time.perf_counter()
    for _ in range(steps):
        step = env.step(actions)
        ended = np.flatnonzero(step.terminated | step.truncated)
        if len(ended):
            env.reset(ended, contexts[ended % len(contexts)], ended.astype(np.uint64))
    return (time.perf_counter() - start) / (steps * env.n_slots)


def specification(
    task: str, contender: Contender | None, seconds: float,
    *, core: int | None = None, updates: int | None = None, cpu: bool = False,
) -> str:  # fmt: skip
    """What a process of this module is given; without a contender it measures the limits.

    core: the one that it keeps to, of those it may use.  updates: train for so many, and measure nothing (JAX).
    cpu: whether the seconds are the process's CPU time.
    """
    asked = {"task": task, "contender": contender and asdict(contender), "seconds": seconds}
    return json.dumps({**asked, "core": core, "updates": updates, "cpu": cpu})


def main() -> None:
    """Do what the command line's specification says, and print the numbers."""
    given = json.loads(sys.argv[-1])
    task = TASKS[given["task"]]
    if given["core"] is not None:
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[given["core"] % len(cores)]})
    if given["contender"] is None:
        found = limits(task)
    else:
        contender = Contender(**given["contender"] | {"overrides": tuple(given["contender"]["overrides"])})
        if contender.checkout and not Path(configs.__file__).is_relative_to(contender.checkout):
            raise RuntimeError(f"{contender.checkout} holds no space_dist: {configs.__file__} was imported")
        if given["updates"] is not None:
            enough = given["updates"] * task.n_steps * contender.members
            found = {"compile": _jax(task, contender, lambda steps: steps >= enough)}
        else:
            found = measure(task, contender, given["seconds"], time.process_time if given["cpu"] else time.perf_counter)
    print(json.dumps(found))


if __name__ == "__main__":
    main()
