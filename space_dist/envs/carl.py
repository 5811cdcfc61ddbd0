"""Environments of CARL (Benjamins et al. 2023; the package carl-bench) by config: which features vary, and how far.

CARL's own contexts are sets that its selectors walk through; here each reset brings its context. Written for
carl-bench 1.1.1, which declares gymnasium<1.0: docs/environments.md ("CARL") says what that means.
"""

from __future__ import annotations

import math
import re
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from space_dist.errors import ConfigError, nearest

_FEATURE = re.compile(r"\s*(?P<name>\w+)\s*(?:\[\s*(?P<low>[^\s,\]]+)\s*,\s*(?P<high>[^\s,\]]+)\s*\])?\s*(?:,|$)")


def is_carl(found: object) -> bool:
    """Whether something imported is a class of CARL's, without importing CARL."""
    return isinstance(found, type) and any(
        (base.__module__, base.__name__) == ("carl.envs.carl_env", "CARLEnv") for base in found.__mro__
    )


class CarlEnv(gym.Wrapper[Any, Any, Any, Any]):
    """One of CARL's environments as an environment with a `context_space`.

    features: the context's features, as CARL names them, each with its bounds where CARL's are not finite:
        `"length, gravity [5, 15]"`. All others stay at CARL's defaults.
    Observations are the environment's own, without CARL's copy of the context. Raises ConfigError for unknown features.
    """

    def __init__(self, carl_class: type[Any], *, features: str = "", **kwargs: Any) -> None:
        with np.errstate(invalid="ignore"):  # ConfigSpace divides infinite bounds
            env = carl_class(**kwargs)
            space = env.get_context_space()
        super().__init__(env)
        self._carl = env
        self.observation_space = env.base_observation_space
        self._defaults = space.get_default_context()
        bounds = _parse(features, space)
        self.context_names = tuple(bounds)
        low, high = np.array(list(bounds.values())).T
        self.context_space = spaces.Box(low, high, dtype=np.float64)
        self._context: dict[str, float] = {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """As Gymnasium's; the context stays until another one is given."""
        from carl.context.selection import RoundRobinSelector

        if options is not None and "context" in options:
            self._context = dict(zip(self.context_names, np.asarray(options["context"]).tolist(), strict=True))
        # A new selector has chosen nothing yet, so that CARL takes this choice for a change and applies it.
        self._carl.context_selector = RoundRobinSelector(contexts={0: {**self._defaults, **self._context}})
        with np.errstate(invalid="ignore"):
            observation, info = self._carl.reset(seed=seed)
        return observation["obs"], info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """As Gymnasium's."""
        observation, reward, terminated, truncated, info = self._carl.step(action)
        return observation["obs"], float(reward), terminated, truncated, info


def _parse(features: str, space: Any) -> dict[str, tuple[float, float]]:
    """Feature -> bounds, in the order given."""
    known = ", ".join(space.context_feature_names)
    found: dict[str, tuple[float, float]] = {}
    at = 0
    while at < len(features):
        match = _FEATURE.match(features, at)
        if match is None:
            raise ConfigError(f"env.kwargs.features: {features[at:]!r} is not `name` or `name [low, high]`")
        at, name = match.end(), match["name"]
        if name not in space.context_feature_names:
            raise ConfigError(
                f"env.kwargs.features: {name!r} is not known{nearest(name, space.context_feature_names)} Known: {known}"
            )
        if name in found:
            raise ConfigError(f"env.kwargs.features names {name!r} twice")
        found[name] = _feature_bounds(name, match["low"], match["high"], space)
    if not found:
        raise ConfigError(f"env.kwargs.features must name the features of the context that vary, of: {known}")
    return found


def _feature_bounds(name: str, low: str | None, high: str | None, space: Any) -> tuple[float, float]:
    feature = space.context_space[name]
    if not hasattr(feature, "lower"):
        raise ConfigError(f"env.kwargs.features: {name!r} is no number but one of {feature.choices}")
    if low is None or high is None:
        if not (math.isfinite(feature.lower) and math.isfinite(feature.upper)):
            raise ConfigError(
                f"env.kwargs.features: CARL's bounds of {name!r} are [{feature.lower:g}, {feature.upper:g}]; give "
                f"finite ones: `{name} [low, high]`"
            )
        return float(feature.lower), float(feature.upper)
    try:
        bounds = float(low), float(high)
    except ValueError:
        raise ConfigError(f"env.kwargs.features: the bounds [{low}, {high}] of {name!r} are not numbers") from None
    if not feature.lower <= bounds[0] < bounds[1] <= feature.upper:
        raise ConfigError(
            f"env.kwargs.features: the bounds [{low}, {high}] of {name!r} must lie within CARL's, "
            f"[{feature.lower:g}, {feature.upper:g}]"
        )
    return bounds
