"""DQN on CartPole: `python dqn_cartpole.py [STEPS]`."""

import sys

from stable_baselines3 import DQN
from stable_baselines3.common.env_util import make_vec_env

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 50_000
env = make_vec_env("CartPole-v1")
model = DQN(
    "MlpPolicy",
    env,
    learning_rate=2.3e-3,
    batch_size=64,
    buffer_size=100_000,
    learning_starts=1000,
    train_freq=256,
    gradient_steps=128,
    target_update_interval=10,
    exploration_fraction=0.16,
    exploration_final_eps=0.04,
    policy_kwargs={"net_arch": [256, 256]},
    seed=0,
    verbose=1,
)
model.learn(steps)
model.save("cartpole")
