"""A small single environment without fault, and one with each fault that the checker knows."""

from __future__ import annotations

import itertools
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from space_dist.envs.interface import FloatArray, IntArray, Observations, Step
from tests.tiny_env import Line

HORIZON = 12


class Honest(gym.Env[Any, Any]):
    """x moves by the action times `gain` (the context) with seeded noise, and is paid for being near 0."""

    context_space: Any = spaces.Box(np.array([0.1, -0.5]), np.array([0.5, 0.5]), dtype=np.float64)
    context_names: Any = ("gain", "drift")
    observation_space: Any = spaces.Box(-10.0, 10.0, shape=(1,), dtype=np.float32)
    action_space: Any = spaces.Discrete(3)
    horizon: Any = HORIZON

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.context = np.array([0.3, 0.0])
        self.x, self.time = 0.0, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if options and "context" in options:
            self.context = np.array(options["context"])
        self.x, self.time = self.np_random.uniform(-1.0, 1.0), 0
        return self.observe(), {}

    def move(self, action: Any) -> float:
        return float(self.context[0] * (action - 1) + 0.1 * self.context[1])

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.x += self.move(action) + 0.01 * self.np_random.standard_normal()
        self.time += 1
        ended = abs(self.x) > 5.0
        return self.observe(), 1.0 - abs(self.x), ended, self.time >= HORIZON and not ended, self.told()

    def observe(self) -> Any:
        return np.array([self.x], dtype=np.float32)

    def told(self) -> dict[str, Any]:
        return {"is_success": abs(self.x) < 0.1}

    def render(self) -> Any:
        picture = np.full((40, 60, 3), 255, dtype=np.uint8)
        picture[:, int(np.clip(30 + 5 * self.x, 0, 59))] = 0
        return picture


class Edits(Honest):
    """Honest, and its contexts can be edited."""

    def edit_contexts(self, rng: np.random.Generator, contexts: FloatArray, edits: int) -> FloatArray:
        return np.clip(contexts + 0.01 * edits * rng.random(contexts.shape), [0.1, -0.5], 0.5)


class EditsUnseeded(Edits):
    def edit_contexts(self, rng: np.random.Generator, contexts: FloatArray, edits: int) -> FloatArray:  # noqa: ARG002
        return super().edit_contexts(np.random.default_rng(), contexts, edits)


class EditsTooFar(Edits):
    def edit_contexts(self, rng: np.random.Generator, contexts: FloatArray, edits: int) -> FloatArray:
        return contexts + np.array([0.0, edits * rng.random()])


class EditsToTheUnplayable(Edits):
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if options and options["context"][1] == 0.25:
            raise KeyError("no such drift")
        return super().reset(seed=seed, options=options)

    def edit_contexts(self, rng: np.random.Generator, contexts: FloatArray, edits: int) -> FloatArray:  # noqa: ARG002
        return np.column_stack((contexts[:, 0], np.full(len(contexts), 0.25)))


class EditsNothing(Edits):
    def edit_contexts(self, rng: np.random.Generator, contexts: FloatArray, edits: int) -> FloatArray:  # noqa: ARG002
        return contexts


class IgnoresContexts(Honest):
    def move(self, action: Any) -> float:
        return 0.3 * (action - 1)


class UnseededStart(Honest):
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed, options=options)
        self.x = np.random.default_rng().uniform(-1.0, 1.0)
        return self.observe(), {}


class UnseededStep(Honest):
    def move(self, action: Any) -> float:
        return super().move(action) + 0.01 * np.random.default_rng().standard_normal()


class Remembers(Honest):
    """Friction wears off from episode to episode."""

    wear = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.wear += 0.01
        return super().reset(seed=seed, options=options)

    def move(self, action: Any) -> float:
        return super().move(action) + self.wear


class KeepsFirstContext(Honest):
    given = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        told = super().reset(seed=seed, options=None if self.given else options)
        self.given |= options is not None
        return told


class Forgets(Honest):
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.context = np.array([0.3, 0.0])
        return super().reset(seed=seed, options=options)


class NeedsOne(Honest):
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        assert options is not None
        return super().reset(seed=seed, options=options)


class SharesItsState(Honest):
    shared = np.zeros(1)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        told = super().reset(seed=seed, options=options)
        self.shared[0] = self.x
        return told

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.x = self.shared[0]
        told = super().step(action)
        self.shared[0] = self.x
        return told


class UsesGlobalGenerator(Honest):
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        np.random.seed((seed or 0) % 2**32)  # noqa: NPY002
        return super().reset(seed=seed, options=options)

    def move(self, action: Any) -> float:
        return super().move(action) + np.random.uniform(0.0, 0.1)  # noqa: NPY002


class Exits(Honest):
    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:  # noqa: ARG002
        raise SystemExit(0)


class EndsInArrays(Honest):
    def step(self, action: Any) -> tuple[Any, float, Any, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, np.array([terminated, terminated]), truncated, info


class FromOne(Honest):
    action_space: Any = spaces.Discrete(3, start=1)


class TwoChoices(Honest):
    action_space: Any = spaces.MultiDiscrete([2, 3])


class AnyHorizon(Honest):
    """Its episodes end by themselves, after a dozen steps."""

    horizon: Any = 2**62


class WrongShape(Honest):
    def observe(self) -> Any:
        return np.zeros(2, dtype=np.float32)


class WrongDtype(Honest):
    def observe(self) -> Any:
        return np.array([self.x])


class NoArray(Honest):
    def observe(self) -> Any:
        return [self.x]


class Outside(Honest):
    observation_space = spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32)

    def observe(self) -> Any:
        return np.array([2.0 if self.time == 5 else 0.5], dtype=np.float32)


class NaNs(Honest):
    def observe(self) -> Any:
        return np.array([np.nan if self.time == 4 else self.x], dtype=np.float32)


class InfiniteReward(Honest):
    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, _, *rest = super().step(action)
        return observation, float("inf"), *rest  # type: ignore[return-value]


class TellsNowAndThen(Honest):
    def told(self) -> dict[str, Any]:
        return {"success": True} if abs(self.x) < 0.7 else {}


class NoOptions(Honest):
    def reset(self, *, seed: int | None = None) -> tuple[Any, dict[str, Any]]:  # type: ignore[override]
        return super().reset(seed=seed)


class NoInfo(Honest):
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return super().reset(seed=seed, options=options)[0]


class OldStep(Honest):
    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, terminated or truncated, info


class FailsAtTheEdge(Honest):
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if options and options["context"][0] >= 0.5:
            raise KeyError("no such gain")
        return super().reset(seed=seed, options=options)


class FailsInStep(Honest):
    def told(self) -> dict[str, Any]:
        return {"success": 1 / (self.time - 3) > 0}


class ChangesActions(Honest):
    action_space = spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32)

    def move(self, action: Any) -> float:
        moved = super().move(float(action[0]))
        action *= 0.0
        return moved


class NumberObserved(Honest):
    observation_space: Any = spaces.Discrete(5)


class OnePartOnly(Honest):
    observation_space: Any = spaces.Dict({"place": Honest.observation_space, "clock": Honest.observation_space})

    def observe(self) -> Any:
        return {"place": super().observe()}


class NoContextSpace(Honest):
    context_space = property()


class EndlessBounds(Honest):
    context_space = spaces.Box(-np.inf, np.inf, shape=(2,), dtype=np.float64)


class NamesTwice(Honest):
    context_names = ("gain", "gain")


class OneName(Honest):
    context_names = ("gain",)


class Word(Honest):
    context_names = "ab"


class NoLength(Honest):
    horizon = property()


class Whole(Honest):
    """Without fault: whole numbers for contexts, and no name for them."""

    context_space = spaces.Box(1, 4, shape=(1,), dtype=np.int64)
    context_names = property()

    def __init__(self) -> None:
        super().__init__()
        self.context = np.array([2])

    def move(self, action: Any) -> float:
        assert self.context.dtype == np.int64
        return 0.1 * float(self.context[0]) * (action - 1)


class Parts(Honest):
    """Without fault: a dictionary is observed, and actions are continuous."""

    observation_space: Any = spaces.Dict(
        {"place": Honest.observation_space, "clock": spaces.Box(0, HORIZON, shape=(), dtype=np.int64)}
    )
    action_space = spaces.Box(0.0, 2.0, shape=(1,), dtype=np.float32)

    def move(self, action: Any) -> float:
        return super().move(float(action[0]))

    def observe(self) -> Any:
        return {"place": super().observe(), "clock": np.array(self.time)}


class HalfUsed(Honest):
    """Without fault, but `drift` decides nothing."""

    def move(self, action: Any) -> float:
        return float(self.context[0] * (action - 1))


_ONE = Honest()


def the_same_one() -> Honest:
    return _ONE


def make(size: int) -> Honest:
    return Honest(str(size))


# ---- batched ----


class Endless(Line):
    def step(self, actions: Any) -> Step:
        step = super().step(actions)
        return Step(step.observations, step.rewards, step.terminated, np.zeros_like(step.truncated), step.success)


class Neighbourly(Line):
    def step(self, actions: Any) -> Step:
        self._x += 0.01 * self._x.mean()
        return super().step(actions)


class SlotMatters(Line):
    def step(self, actions: Any) -> Step:
        self._x += 0.01 * np.arange(self.n_slots)
        return super().step(actions)


class ChangesContexts(Line):
    def reset(self, slots: IntArray, contexts: FloatArray, seeds: Any) -> Observations:
        observations = super().reset(slots, contexts, seeds)
        contexts *= 0.0
        return observations


class ChangesBatchedActions(Line):
    def step(self, actions: Any) -> Step:
        actions *= 0.5
        return super().step(actions)


class OneReward(Line):
    def step(self, actions: Any) -> Step:
        step = super().step(actions)
        return Step(step.observations, step.rewards[:1], step.terminated, step.truncated, step.success)


class NumbersForEnds(Line):
    def step(self, actions: Any) -> Step:
        step = super().step(actions)
        return Step(step.observations, step.rewards, step.terminated * 1.0, step.truncated, step.success)  # type: ignore[arg-type]


class Counts(Line):
    """Every copy of the world is another one."""

    copies = itertools.count()

    def __init__(self, n_slots: int, action_space: spaces.Space[Any]) -> None:
        super().__init__(n_slots, action_space)
        self._shift = 1e-3 * next(self.copies)

    def step(self, actions: Any) -> Step:
        self._x += self._shift
        return super().step(actions)


def batched(n_slots: int, kind: str = "Line") -> Line:
    return globals()[kind](n_slots, spaces.Box(-1.0, 1.0, shape=(1,), dtype=np.float32))
