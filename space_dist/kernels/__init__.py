"""Compiled arithmetic with bits of its own: the same on every CPU, whatever its vectors (`lanes` says why).

`ppo` is PPO's whole update of one actor-critic, and its passes forward alone; `dqn`, `td3` and `sac` are gradient steps
on samples of a replay buffer (`replay`). `networks` says where numbers lie.
"""

from space_dist.kernels.lanes import COMPILES
from space_dist.kernels.networks import Layout, Shape, aligned
from space_dist.kernels.ppo import Settings, prepare

__all__ = ["COMPILES", "Layout", "Settings", "Shape", "aligned", "prepare"]
