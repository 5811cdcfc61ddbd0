"""Our curricula in a script of one's own that trains with Stable-Baselines3 or sb3-contrib: docs/sb3.md.

    env = ContextVecEnv(MyEnv, "instances.csv", n_envs=8)              # in place of make_vec_env(MyEnv, n_envs=8)
    model.learn(100_000, callback=CurriculumCallback("space"))

Needs neither Ray nor MLflow, and imports neither. What decides is what decides in `space-dist train`: the same
curricula, from the same start values and episodes, at the same moments.
"""

from space_dist.sb3.callback import CurriculumCallback
from space_dist.sb3.vec_env import ContextVecEnv

__all__ = ["ContextVecEnv", "CurriculumCallback"]
