"""A callback of Stable-Baselines3's that has one of our curricula choose the instances of a `ContextVecEnv`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, unwrap_vec_normalize

from space_dist.config import CustomConfig, check
from space_dist.curricula import Selection
from space_dist.curricula.custom import load_maker
from space_dist.errors import ConfigError, SpaceDistError, about
from space_dist.sb3.script import Wrapped
from space_dist.sb3.session import STATE, Asked, Session

FloatArray = NDArray[np.float64]


class CurriculumCallback(BaseCallback):
    """Has a curriculum choose what a model that learns on a `ContextVecEnv` is trained on.

    kind: which curriculum, as `curriculum.kind` of a config: space, cspace, round_robin, fixed, random_growth, manual,
        uniform, spdrl, vds, alp_gmm, plr, accel, learnability, procurl, learning_progress, edge, currot, watched or
        custom (docs/curricula.md). `replay` follows a run, and is refused.
    settings: its settings, by name, as under `curriculum` of a config (`space-dist config schema` explains them).
        One of your own: `CurriculumCallback("custom", kwargs={"share": 0.5}, **{"import": "my_curriculum:Lagging"})`.
    passes: length of an iteration: as many rounds as cover this many passes over the selected instances.
    start_states: seeded start observations per instance whose mean value is its start value.
    round_steps: environment steps of a round, at least; rounds are whole rollouts of SB3's. None: one rollout of an
        on-policy model; 512 steps of an off-policy one.
    resume: go on with what a loaded model remembers; False: begin anew.
    verbose: as any callback's.

    The environment's seed (SB3's `seed=` of the model sets it) decides everything random in the curriculum. What the
    curriculum tells about itself is logged as `curriculum/...` by the model's own logger.

    Raises ConfigError if kind or settings are wrong; and when `learn` begins, if it was given two of these, the model,
    its environment or its instances cannot give the curriculum what it asks for, the model remembers another
    curriculum, or an EvalCallback beside it has the model's own environment, or one whose observations are of another
    shape or scale. Raises SpaceDistError if training diverges, what the model remembers cannot be read, or another
    callback resets or steps the environment.
    """

    def __init__(
        self,
        kind: str = "space",
        *,
        passes: float = 1.0,
        start_states: int = 1,
        round_steps: int | None = None,
        resume: bool = True,
        verbose: int = 0,
        **settings: Any,
    ) -> None:
        super().__init__(verbose)
        if kind == "replay":
            raise ConfigError(
                "CurriculumCallback: curriculum.kind: replay has a run follow another, round by round, and a script is "
                "no run: train with space-dist"
            )
        asked = {"curriculum": {"kind": kind, **settings}, "passes": passes, "start_states": start_states}
        self._asked = check(Asked, {**asked, "round_steps": round_steps}, "CurriculumCallback")
        if isinstance(self._asked.curriculum, CustomConfig):
            with about("CurriculumCallback"):
                load_maker(self._asked.curriculum.import_path)
        self._resume = resume
        self._session: Session | None = None
        self._time: int | None = None  # where this `learn` has left the environment in its round

    @property
    def selection(self) -> Selection:
        """What is trained on now. Raises SpaceDistError before `learn` has begun."""
        return self._begun.selection

    @property
    def numbers(self) -> Mapping[str, Any]:
        """What the curriculum told with its last decision; empty before the first."""
        return self._begun.numbers

    @property
    def values(self) -> FloatArray:
        """`(n,)` the start values of all instances, in id order, behind the last decision, in reward units."""
        return self._begun.values

    @property
    def _begun(self) -> Session:
        if self._session is None:
            raise SpaceDistError("CurriculumCallback: nothing is selected before learn() has begun")
        return self._session

    def _on_training_start(self) -> None:
        beside = list(_callbacks(self.locals.get("callback")))
        if (count := sum(isinstance(one, CurriculumCallback) for one in beside)) > 1:
            raise ConfigError(f"learn was given {count} CurriculumCallbacks, and a model is trained by one curriculum")
        wrapped = Wrapped(self.model.get_env())
        for one in beside:
            if isinstance(one, EvalCallback):
                self._refuse_evaluation(one, wrapped)
        if self._session is None or not self._session.is_of(self.model, wrapped.env):
            self._session = Session(self._asked, self.model, wrapped)
            remembered = getattr(self.model, STATE, None) if self._resume else None
            if remembered is None:
                self._session.begin()
            else:
                self._session.remember(remembered)
        self._session.wrapped = wrapped
        self._time = None

    def _refuse_evaluation(self, beside: EvalCallback, wrapped: Wrapped) -> None:
        """Refuse an evaluation in the env that is being trained on, or in one that the model cannot act in."""
        name, env, space = type(beside).__name__, beside.eval_env, self.model.observation_space
        if _innermost(env) is wrapped.env:
            raise ConfigError(
                f"CurriculumCallback: {name} has the env that is being trained on, whose episodes the curriculum "
                f"chooses; give {name} a ContextVecEnv of its own"
            )
        if _shapes(env.observation_space) != _shapes(space):
            seen = ", which have the context in them" if wrapped.env.context_visible else ""
            raise ConfigError(
                f"CurriculumCallback: {name} has an env whose observations are of another shape than those that the "
                f"model acts on{seen}; give {name} a ContextVecEnv of its own, wrapped as the model's env is"
            )
        if (unwrap_vec_normalize(env) is None) != (self.model.get_vec_normalize_env() is None):
            has, lacks = ("the model's env", name) if unwrap_vec_normalize(env) is None else (name, "the model's env")
            raise ConfigError(
                f"CurriculumCallback: {has} has a VecNormalize, and {lacks} has none, so that the model would be "
                "evaluated on observations of another scale; wrap both (the one to evaluate in with training=False)"
            )

    def _on_rollout_start(self) -> None:
        self._refuse_others_steps(0)
        self._tell(self._begun.on_rollout_start())
        self._time = self._begun.env.time

    def _on_step(self) -> bool:
        self._refuse_others_steps(1)
        return True

    def _on_rollout_end(self) -> None:
        self._refuse_others_steps(0)
        self._begun.on_rollout_end()

    def _on_training_end(self) -> None:
        self._tell(self._begun.on_training_end())

    def _refuse_others_steps(self, steps: int) -> None:
        """Refuse that the environment is elsewhere than `steps` behind where `learn` had left it."""
        if self._time is None:
            return
        self._time += steps
        if not self._begun.plays or self._begun.env.time != self._time:
            raise SpaceDistError(
                "CurriculumCallback: another callback has reset or stepped the env that is being trained on, whose "
                "episodes the curriculum chooses; have it evaluate on a ContextVecEnv of its own"
            )

    def _tell(self, decided: bool) -> None:
        if not decided:
            return
        for name, number in self.numbers.items():
            if number is not None:
                self.logger.record(f"curriculum/{name}", int(number) if isinstance(number, bool) else number)
        if self.verbose:
            session = self._begun
            print(
                f"curriculum: {self.numbers.get('size')} of {len(session.env.instances)} instances from step "
                f"{self.model.num_timesteps} on"
            )


def _callbacks(callback: object) -> Iterator[object]:
    """A callback, and those that it holds."""
    yield callback
    held = callback.callbacks if isinstance(callback, CallbackList) else [getattr(callback, "callback", None)]
    for one in held:
        if one is not None:
            yield from _callbacks(one)


def _shapes(space: spaces.Space[Any]) -> object:
    """Of observations, as far as a model minds: SB3 itself turns images."""
    if isinstance(space, spaces.Dict):
        return {key: _shapes(part) for key, part in space.spaces.items()}
    return sorted(space.shape) if isinstance(space, spaces.Box) else space


def _innermost(env: VecEnv) -> VecEnv:
    while isinstance(env, VecEnvWrapper):
        env = env.venv
    return env
