"""From a config's section to its curriculum. Apart from the algorithms, which know no config."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from space_dist.config import (
    AccelConfig,
    AlpGmmConfig,
    ContextSpaceConfig,
    CurriculumConfig,
    CustomConfig,
    EdgeConfig,
    FixedConfig,
    LearnabilityConfig,
    LearningProgressConfig,
    LevelReplayConfig,
    ManualConfig,
    ProximalConfig,
    RandomGrowthConfig,
    ReplayConfig,
    RoundRobinConfig,
    SelfPacedConfig,
    SpaceConfig,
    TransportConfig,
    UniformConfig,
    ValueDisagreementConfig,
    WatchedConfig,
)
from space_dist.curricula import variants
from space_dist.curricula.accel import Accel, Replays
from space_dist.curricula.custom import Custom, make_custom
from space_dist.curricula.draws import Draws, Uniform
from space_dist.curricula.edge import Edge
from space_dist.curricula.generating import ContextGenerator, Unheld
from space_dist.curricula.interface import Curriculum, FloatArray
from space_dist.curricula.learnability import Learnability
from space_dist.curricula.learning_progress import LearningProgress
from space_dist.curricula.plr import LevelReplay, Robust
from space_dist.curricula.procurl import Proximal
from space_dist.curricula.replay import Recording, Replay
from space_dist.curricula.round_robin import RoundRobin
from space_dist.curricula.space import Space
from space_dist.curricula.vds import ValueDisagreement
from space_dist.curricula.watching import Watched
from space_dist.errors import ConfigError, about, nearest
from space_dist.instances import ContextBounds, InstanceSet

if TYPE_CHECKING:  # SciPy takes half a second to import, and few curricula need it
    from space_dist.curricula.alp_gmm import AlpGmm
    from space_dist.curricula.currot import Transport
    from space_dist.curricula.gaussian import Gaussian
    from space_dist.curricula.spdrl import SelfPaced


class Makers:
    """Makes one run's curriculum.

    train: the instance set, and `source` the file it came from.
    draws: how many a round can use.
    bounds: of the contexts of the environment.
    recorded: what another run was trained on, for who follows it.
    generator, held_out: as for `make_curriculum`.
    """

    def __init__(
        self, train: InstanceSet, *, source: str, seed: int, draws: Draws, bounds: ContextBounds,
        recorded: bytes | None = None, generator: Callable[[], ContextGenerator] | None = None,
        held_out: InstanceSet | None = None,
    ) -> None:  # fmt: skip
        self._recorded, self._generator, self._held_out = recorded, generator, held_out
        self._train, self._source, self._seed, self._draws, self._bounds = train, source, seed, draws, bounds

    def make(self, settings: CurriculumConfig) -> Curriculum:
        """The curriculum. Raises ConfigError if it asks for what the instances or the environment do not have."""
        makers: Mapping[type, Callable[[Any], Curriculum]] = {
            SpaceConfig: self._space,
            RandomGrowthConfig: self._random_growth,
            ContextSpaceConfig: self._context_space,
            ManualConfig: self._manual,
            RoundRobinConfig: lambda _: RoundRobin(self._train, seed=self._seed),
            FixedConfig: self._fixed,
            UniformConfig: lambda _: Uniform(self._train, seed=self._seed, draws=self._draws),
            SelfPacedConfig: self._self_paced,
            ValueDisagreementConfig: self._value_disagreement,
            AlpGmmConfig: self._alp_gmm,
            LevelReplayConfig: self._level_replay,
            AccelConfig: self._accel,
            LearnabilityConfig: self._learnability,
            ProximalConfig: self._proximal,
            LearningProgressConfig: self._learning_progress,
            TransportConfig: self._transport,
            EdgeConfig: self._edge,
            ReplayConfig: self._replay,
            WatchedConfig: self._watched,
            CustomConfig: self._custom,
        }
        return makers[type(settings)](settings)

    # ---- sets that grow ----

    def _growing(self, settings: SpaceConfig | RandomGrowthConfig | ContextSpaceConfig | ManualConfig,
                 rank: variants.Rank, first: FloatArray | None = None) -> Space:  # fmt: skip
        return Space(
            self._train, seed=self._seed, eta=settings.eta, kappa=settings.kappa, rank=rank, first=first,
            mean=settings.mean, growth=settings.growth, adaptive_eta=settings.adaptive_eta,
            patience=settings.patience, epsilon=settings.epsilon,
        )  # fmt: skip

    def _space(self, settings: SpaceConfig) -> Space:
        if settings.pic == "random":
            return self._growing(settings, variants.at_random(self._train, seed=self._seed))
        return self._growing(settings, variants.directed(variants.BY_VALUE[settings.pic], settings.reverse))

    def _random_growth(self, settings: RandomGrowthConfig) -> Space:
        return self._growing(settings, variants.at_random(self._train, seed=self._seed))

    def _context_space(self, settings: ContextSpaceConfig) -> Space:
        by_distance = {"centroid": variants.near_centroid, "nearest_member": variants.near_member}
        rank = by_distance[settings.distance](self._bounds.scale(self._train.contexts))
        return self._growing(settings, variants.directed(rank, settings.reverse))

    def _manual(self, settings: ManualConfig) -> Space:
        train = self._train
        columns = {**dict(zip(train.names, train.contexts.T, strict=True)), **train.columns}
        if settings.column not in columns:
            raise ConfigError(
                f"curriculum.column: {self._source} was read without a column {settings.column!r}"
                f"{nearest(settings.column, columns)}"
            )
        scores = columns[settings.column] if settings.reverse else -columns[settings.column]
        return self._growing(settings, variants.in_order(scores), first=scores)

    # ---- fixed sets ----

    def _fixed(self, settings: FixedConfig) -> RoundRobin:
        ids = self._train.ids.tolist()
        holds = f"{self._source} holds {len(ids)} instances, with ids from {ids[0]} to {ids[-1]}"
        if settings.count is not None and settings.count > len(ids):
            raise ConfigError(f"curriculum.count: {settings.count} is too many: {holds}")
        missing = sorted(set(settings.ids or ()).difference(ids))
        if missing:
            more = f" (nor {len(missing) - 1} more of these)" if len(missing) > 1 else ""
            closest = min(ids, key=lambda one: abs(one - missing[0]))
            raise ConfigError(
                f"curriculum.ids: there is no instance {missing[0]}{more}; the nearest is {closest}. {holds}"
            )
        return RoundRobin(self._train, seed=self._seed, ids=settings.ids, count=settings.count)

    # ---- draws ----

    def _value_disagreement(self, settings: ValueDisagreementConfig) -> ValueDisagreement:
        names = self._train.names
        for name in settings.members_see or ():
            if name not in names:
                raise ConfigError(
                    f"curriculum.members_see: contexts have no feature {name!r}{nearest(name, names)} "
                    f"Allowed: {', '.join(names)}"
                )
        return ValueDisagreement(self._train, seed=self._seed, draws=self._draws)

    def _alp_gmm(self, settings: AlpGmmConfig) -> AlpGmm:
        from space_dist.curricula.alp_gmm import AlpGmm

        return AlpGmm(
            self._train, seed=self._seed, draws=self._draws, bounds=self._bounds, from_set=settings.over == "set",
            random_share=settings.random_share, fit_rate=settings.fit_rate, history=settings.history,
            components=settings.components,
        )  # fmt: skip

    def _level_replay(self, settings: LevelReplayConfig) -> LevelReplay:
        return LevelReplay(
            self._train, seed=self._seed, draws=self._draws, temperature=settings.temperature,
            staleness_share=settings.staleness_share, within_update=settings.within_update, score=settings.score,
            robust=Robust(settings.replay_share, settings.scored_share) if settings.robust else None,
        )  # fmt: skip

    def _accel(self, settings: AccelConfig) -> Accel:
        if self._generator is None:
            raise ConfigError("curriculum.kind: accel generates contexts of an environment, and here none is known")
        with about("curriculum.kind: accel"):
            source = Unheld(self._generator(), None if self._held_out is None else self._held_out.contexts)
        replays = Replays(
            settings.replay_share, max(1, math.ceil(settings.filled_share * settings.buffer)), settings.temperature,
            settings.staleness_share,
        )  # fmt: skip
        return Accel(
            seed=self._seed, draws=self._draws, source=source, buffer=settings.buffer, batch=settings.batch,
            new_from=self._train if settings.new_from == "set" else None, edits=settings.edits,
            edited=settings.edited, score=settings.score, replays=replays, robust=settings.robust,
        )  # fmt: skip

    def _learnability(self, settings: LearnabilityConfig) -> Learnability:
        n = len(self._train)
        for name, value in (("top", settings.top), ("candidates", settings.candidates)):
            if value is not None and value > n:
                raise ConfigError(f"curriculum.{name}: {value} is too many: {self._source} holds {n} instances")
        return Learnability(
            self._train, seed=self._seed, draws=self._draws, top=settings.top, uniform_share=settings.uniform_share,
            every=settings.every, candidates=settings.candidates, episodes=settings.episodes,
        )  # fmt: skip

    def _proximal(self, settings: ProximalConfig) -> Proximal:
        return Proximal(
            self._train, seed=self._seed, draws=self._draws, beta=settings.beta, score=settings.score,
            scale=settings.scale, largest=settings.largest_return,
        )  # fmt: skip

    def _learning_progress(self, settings: LearningProgressConfig) -> LearningProgress:
        return LearningProgress(
            self._train, seed=self._seed, draws=self._draws, outcome=settings.outcome, lowest=settings.lowest_return,
            largest=settings.largest_return, smoothing=settings.smoothing, theta=settings.theta,
            uniform_share=settings.uniform_share,
        )  # fmt: skip

    def _edge(self, settings: EdgeConfig) -> Edge:
        return Edge(
            self._train, seed=self._seed, draws=self._draws, bounds=self._bounds, outcome=settings.outcome,
            lowest=settings.lowest_return, largest=settings.largest_return, memory=settings.memory,
            width=settings.width, strength=settings.strength, uniform_share=settings.uniform_share,
        )  # fmt: skip

    def _transport(self, settings: TransportConfig) -> Transport:
        from space_dist.curricula.currot import Transport

        return Transport(
            self._train, seed=self._seed, draws=self._draws, bounds=self._bounds, from_set=settings.over == "set",
            target=None if settings.target == "set" else self._normal(settings), delta=settings.delta,
            discounted=settings.performance == "discounted_return", epsilon=settings.epsilon,
            particles=settings.particles,
        )  # fmt: skip

    def _watched(self, settings: WatchedConfig) -> Watched:
        return Watched(
            self._train, seed=self._seed, draws=self._draws, iterations=settings.iterations, shares=settings.shares,
            advantages=settings.advantages,
        )  # fmt: skip

    def _replay(self, settings: ReplayConfig) -> Replay:
        if self._recorded is None:
            raise ConfigError("curriculum.kind: replay follows the curriculum of a run, which this is none of")
        try:
            recording = Recording.decode(self._recorded)
        except ValueError as error:
            raise ConfigError(f"curriculum.of: {settings.of} holds no recorded curriculum: {error}") from None
        strangers = recording.strangers(self._train)
        if len(strangers):
            more = f" (and {len(strangers) - 1} more)" if len(strangers) > 1 else ""
            raise ConfigError(
                f"curriculum.of: {settings.of} was trained on instance {strangers[0]}{more}, which {self._source} does "
                "not have, or with another context: who follows a run needs its instances"
            )
        return Replay(self._train, recording, draws=self._draws)

    def _self_paced(self, settings: SelfPacedConfig) -> SelfPaced:
        from space_dist.curricula.gaussian import Gaussian
        from space_dist.curricula.spdrl import SelfPaced

        bounds = self._bounds
        middle, width = (bounds.low + bounds.high) / 2.0, bounds.high - bounds.low
        initial = Gaussian.of(
            self._features("initial_mean", settings.initial_mean, bounds, middle),
            self._features("initial_std", settings.initial_std, bounds, width / 4.0),
        )
        target = self._set_moments() if settings.target == "set_moments" else self._normal(settings)
        least = settings.least_std
        return SelfPaced(
            seed=self._seed, draws=self._draws, bounds=bounds, initial=initial, target=target,
            zeta=settings.zeta, offset=settings.offset, epsilon=settings.epsilon, warm_up=settings.warm_up,
            optimiser=settings.optimiser, least_std_until=settings.least_std_until,
            least_std=None if least is None else self._features("least_std", least, bounds, width),
        )  # fmt: skip

    def _normal(self, settings: SelfPacedConfig | TransportConfig) -> Gaussian:
        from space_dist.curricula.gaussian import Gaussian

        bounds = self._bounds
        return Gaussian.of(
            self._features("target_mean", settings.target_mean, bounds, (bounds.low + bounds.high) / 2.0),
            self._features("target_std", settings.target_std, bounds, bounds.high - bounds.low),
        )

    def _set_moments(self) -> Gaussian:
        from space_dist.curricula.gaussian import Gaussian

        contexts = self._train.contexts
        # ddof=0: the set is the whole of what is aimed at, and no sample of it.
        covariance = np.atleast_2d(np.cov(contexts, rowvar=False, ddof=0)) if len(contexts) > 1 else None
        try:
            if covariance is None:
                raise np.linalg.LinAlgError
            return Gaussian(contexts.mean(axis=0), np.linalg.cholesky(covariance).astype(np.float64))
        except np.linalg.LinAlgError:
            raise ConfigError(
                f"curriculum.target: set_moments needs instances that vary in every direction, and the {len(contexts)} "
                f"of {self._source} do not: their covariance is singular. Use target: normal"
            ) from None

    def _features(
        self, key: str, given: tuple[float, ...] | None, bounds: ContextBounds, default: FloatArray
    ) -> FloatArray:
        if given is None:
            return default
        if len(given) != len(bounds.names):
            raise ConfigError(
                f"curriculum.{key}: {len(given)} numbers for the {len(bounds.names)} features of a context "
                f"({', '.join(bounds.names)})"
            )
        values = np.array(given, dtype=np.float64)
        outside = (values < bounds.low) | (values > bounds.high)
        if key.endswith("mean") and outside.any():
            at = int(outside.argmax())
            raise ConfigError(
                f"curriculum.{key}: {bounds.names[at]} = {values[at]:g} is outside its bounds "
                f"[{bounds.low[at]:g}, {bounds.high[at]:g}]"
            )
        return values

    # ---- anybody's ----

    def _custom(self, settings: CustomConfig) -> Custom:
        if features := [name for name in settings.columns if name in self._train.names]:
            raise ConfigError(
                f"curriculum.columns: {features[0]!r} is a feature of the context, which `instances.contexts` holds: "
                "name other columns"
            )
        return make_custom(
            settings.import_path, settings.kwargs,
            instances=self._train, seed=self._seed, draws=self._draws, bounds=self._bounds,
        )  # fmt: skip
