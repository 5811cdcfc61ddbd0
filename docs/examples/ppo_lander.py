"""PPO on an environment of one's own: `python ppo_lander.py [STEPS]`."""

import sys

from my_lander import Lander
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 100_000
env = make_vec_env(Lander, n_envs=8)
model = PPO("MlpPolicy", env, n_steps=256, seed=0, verbose=1)
model.learn(steps)
model.save("lander")
