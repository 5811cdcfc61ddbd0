"""DQN on CartPole: `python dqn_cartpole.py [STEPS]`."""

import sys

from stable_baselines3 import DQN

from space_dist.sb3 import ContextVecEnv, CurriculumCallback

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 50_000
lengths = [0.3, 0.4, 0.5, 0.6, 0.7]  # half of the pole's, as in Gymnasium, whose own is 0.5
env = ContextVecEnv("space_dist/CartPole-v0", lengths, env_kwargs={"horizon": 500})
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
model.learn(steps, callback=CurriculumCallback("space", eta=0.025))
model.save("cartpole")
