"""PPO on an environment of one's own: `python ppo_lander.py [STEPS]`."""

import sys

import numpy as np
from my_lander import Lander
from stable_baselines3 import PPO

from space_dist.sb3 import ContextVecEnv, CurriculumCallback

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
contexts = np.random.default_rng(0).uniform([1.0, 2.0], [4.0, 6.0], size=(50, 2))  # gravity, thrust
env = ContextVecEnv(Lander, contexts, n_envs=8)
model = PPO("MlpPolicy", env, n_steps=256, seed=0, verbose=1)
model.learn(steps, callback=CurriculumCallback("space"))
model.save("lander")
