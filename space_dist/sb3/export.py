"""A run's policy as a zip that Stable-Baselines3 loads: for scripts that know nothing of this package."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecNormalize

from space_dist.config import GrowingConfig, RunConfig
from space_dist.envs.spec import EnvironmentSpec
from space_dist.errors import ConfigError, LedgerError
from space_dist.instances import read_csv
from space_dist.learner import SB3Learner
from space_dist.learner.networks import ALGORITHMS
from space_dist.ledger import Checkpoint, Ledger
from space_dist.rollout.policy import OBSERVATION_CLIP
from space_dist.run.building import Blueprint, spec_of
from space_dist.run.claiming import stored_config
from space_dist.sb3 import ContextVecEnv


def export_sb3(ledger: Ledger, out: Path) -> list[tuple[Path, str]]:
    """Write a run's last policy to the zip `out`; returns each file and what it is.

    The zip holds SB3's own model: networks, optimisers and counters, of which `load` makes one that acts on the same
    observations (with the context, where the run shows it) as the run's policy does, and can go on learning. A run that
    normalises leaves SB3's VecNormalize beside it, and one of several policies a zip of each, with its number.

    Raises LedgerError where the run has no checkpoint, ConfigError where the files cannot be written.
    """
    config, checkpoint = stored_config(ledger), ledger.last_checkpoint()
    if checkpoint is None:
        raise LedgerError(f"{ledger.folder} has no policy yet: no checkpoint was written")
    if not out.name or out.name == ".." or out.is_dir():
        raise ConfigError(f"{out} is a folder; name the zip to write, like {out / 'policy.zip'}")
    out = out if out.suffix == ".zip" else out.with_name(f"{out.name}.zip")
    spec = spec_of(config)
    written = []
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        for number in range(config.n_policies):
            learner = _stock_learner(config, spec, checkpoint, number)
            path = out if config.n_policies == 1 else out.with_name(f"{out.stem}_{number}.zip")
            model: Any = learner.model
            model.num_timesteps = int(checkpoint.data["run"]["steps"])
            if path.is_dir():  # SB3 would take another name
                raise ConfigError(f"{path} is a folder; name another zip to write")
            model.save(path)
            written.append((path, f"{_importable(config)}.load takes it"))
            if learner.normalises:
                beside = out.with_name(f"{out.stem}_vecnormalize.pkl")
                _normaliser(config, spec, ledger, learner).save(str(beside))
                written.append((beside, "VecNormalize.load takes it; the policy acts on what it normalises"))
    except OSError as error:
        raise ConfigError(f"{out} cannot be written: {error.strerror}") from None
    return written


def _importable(config: RunConfig) -> str:
    """How a script imports the class of a run's algorithm: the user's own, or of SB3 or sb3-contrib."""
    if (own := config.learner.import_path) is not None:
        return own.replace(":", ".")
    algorithm = ALGORITHMS[config.learner.kind]
    return f"{algorithm.__module__.partition('.')[0]}.{algorithm.__name__}"


def _stock_learner(config: RunConfig, spec: EnvironmentSpec, checkpoint: Checkpoint, number: int) -> SB3Learner:
    """A policy's learner as SB3 itself has it, whatever computed the run's updates: their states are the same."""
    changes: dict[str, Any] = {"engine": "single", "device": "cpu"}
    if "update" in type(config.learner).model_fields:
        changes["learner"] = config.learner.model_copy(update={"update": "stock"})
    if isinstance(config.curriculum, GrowingConfig):
        changes["curriculum"] = config.curriculum.model_copy(update={"aggregate": "own"})
    learner = Blueprint(config.model_copy(update=changes), spec).learner()
    if not isinstance(learner, SB3Learner):
        raise TypeError(f"one policy has one learner, not {type(learner).__name__}")
    several = config.n_policies > 1
    prefix, data = f"learner/{number}/" if several else "learner/", checkpoint.data["learner"]
    arrays = {name.removeprefix(prefix): array for name, array in checkpoint.arrays.items() if name.startswith(prefix)}
    learner.load(arrays, data[str(number)] if several else data)
    return learner


def _normaliser(config: RunConfig, spec: EnvironmentSpec, ledger: Ledger, learner: SB3Learner) -> VecNormalize:
    """SB3's, with the run's scales, which stand still."""
    train = read_csv(ledger.instances("train"), spec.context_bounds, config.columns_read)
    settings, statistics = config.learner, learner.statistics
    env = ContextVecEnv(
        config.env.id, train, context_visible=config.env.context_visible, env_kwargs=config.env.kwargs
    )  # fmt: skip
    # SB3 adds `epsilon` below the root, our scales nothing.
    made = VecNormalize(
        env, training=False, norm_obs=settings.normalize_observations, norm_reward=settings.normalize_rewards,
        clip_obs=OBSERVATION_CLIP, gamma=settings.gamma, epsilon=0.0,
    )  # fmt: skip
    if statistics.mean is not None and statistics.std is not None:
        scales: Any = made.obs_rms
        scales.mean, scales.var = statistics.mean, np.square(statistics.std)
    made.ret_rms.var = np.asarray(statistics.reward_std**2)
    return made
