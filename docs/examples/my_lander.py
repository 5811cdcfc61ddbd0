# my_lander.py
import gymnasium as gym
import numpy as np


class Lander(gym.Env):
    """Touch the ground gently; the context is the gravity and the strength of the engine."""

    context_space = gym.spaces.Box(np.array([1.0, 2.0]), np.array([4.0, 6.0]), dtype=np.float64)
    context_names = ("gravity", "thrust")
    observation_space = gym.spaces.Box(-100.0, 100.0, shape=(2,), dtype=np.float32)
    action_space = gym.spaces.Discrete(2)
    horizon = 200  # steps, after which an episode is truncated
    context = np.array([2.0, 4.0])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if options and "context" in options:
            self.context = np.array(options["context"])
        self.height, self.speed = self.np_random.uniform(4.0, 6.0), 0.0
        return self._observe(), {}

    def step(self, action):
        gravity, thrust = self.context
        self.speed += 0.1 * (thrust * action - gravity)
        self.height += 0.1 * self.speed
        landed = self.height <= 0.0 or self.height > 20.0
        gentle = self.height <= 0.0 and self.speed > -1.0
        return self._observe(), float(gentle), landed, False, {"success": gentle}

    def _observe(self):
        return np.array([self.height, self.speed], dtype=np.float32)
