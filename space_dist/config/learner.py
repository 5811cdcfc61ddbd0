"""Sections of the learners: their hyperparameters, and what each can do."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, Self, get_args

from pydantic import Field, field_validator, model_validator

from space_dist.config.sections import Section, own_path, refuse_library
from space_dist.errors import misspelt, nearest


class LearnerSection(Section):
    """What all learners have in common."""

    has_advantages: ClassVar[bool] = False
    """Whether an update tells the advantages of the transitions it is made of."""
    keeps_next_observations: ClassVar[bool] = False
    """Whether it is off-policy: it learns from a replay buffer, which holds what each step led to."""
    can_be_stacked: ClassVar[bool] = False
    """Whether updates of several can be computed together (engine: population)."""
    actions: ClassVar[Literal["any", "discrete", "bounded"]] = "any"
    """What it chooses among. bounded: numbers within bounds. any: numbers, with bounds or without, or one of a few."""
    policies: ClassVar[tuple[str, str, str]] = ("MlpPolicy", "CnnPolicy", "MultiInputPolicy")
    """SB3's names of its policies: for flat observations, for images, for dictionaries."""

    policy: str = Field(default="MlpPolicy", min_length=1, max_length=300)
    """SB3's MlpPolicy (acts in NumPy, without torch), CnnPolicy (images), MultiInputPolicy (dictionaries), or the
    import path of a policy class (my_package.my_module:MyPolicy)."""
    import_path: str | None = Field(default=None, alias="import", min_length=1, max_length=300)
    """Import path (my_package.my_module:MyPPO) of a learner of your own: a class derived from Stable-Baselines3's of
    this kind (docs/your_learner.md). null: Stable-Baselines3's."""
    kwargs: dict[str, bool | int | float | str] = Field(default={})
    """Arguments that your own class has beside Stable-Baselines3's, by name."""
    learning_rate_schedule: Literal["constant", "linear"] = "constant"
    """`linear` falls to 0 at the end of the budget."""
    gamma: float = Field(default=0.95, ge=0.0, le=1.0)
    """Discount per step. Source: the paper, appendix A (0.95)."""
    net_arch: tuple[Annotated[int, Field(ge=1, le=16384)], ...] = Field(default=(64, 64), max_length=16, strict=False)
    """Units of each hidden layer, for actor and critic each. Source: the paper, appendix A (two layers of 64)."""
    normalize_observations: bool = False
    """Scale observations to mean 0 and standard deviation 1, as of the rounds before; one round of actions that ignore
    the observation, charged to the budget, gives the first scales."""
    normalize_rewards: bool = False
    """Divide rewards by the standard deviation of the discounted return, as of the rounds before. Start values are
    reported in unscaled reward units."""

    @field_validator("policy")
    @classmethod
    def _known_policy(cls, value: str) -> str:
        if value not in cls.policies and ":" not in value:
            raise ValueError(
                f"not known{nearest(value, cls.policies)} Allowed: {', '.join(cls.policies)}, or an import path with a "
                "colon"
            )
        return refuse_library(value)

    @field_validator("import_path")
    @classmethod
    def _of_your_own(cls, value: str | None) -> str | None:
        return None if value is None else own_path(value, "MyPPO")

    @property
    def import_paths(self) -> tuple[str, ...]:
        """Import paths of what somebody else has written."""
        named = (self.policy, self.import_path)
        return tuple(path for path in named if path is not None and ":" in path)

    @property
    def episodes_per_round(self) -> int | None:
        """Episodes that end a round, where steps do not."""
        return None

    @property
    def memory_size(self) -> int:
        """How many numbers its policy remembers of an episode that it acts in."""
        return 0

    def policy_settings(self) -> dict[str, Any]:
        """What SB3's policies of this kind are made with, besides layers and their activation."""
        return {}

    def is_compiled(self, engine: str) -> bool:  # noqa: ARG002 - some are not with any
        """Whether its updates are a compiled function of ours with this engine, where they are computed on a CPU."""
        return False

    @model_validator(mode="after")
    def _lean_knows_mlps_only(self) -> Self:
        if getattr(self, "update", "stock") == "lean" and self.policy != "MlpPolicy":
            raise ValueError(f"update: lean knows MlpPolicy only, not {self.policy}; allowed with it: stock")
        return self

    @model_validator(mode="after")
    def _own_updates_are_its_own(self) -> Self:
        if self.import_path is not None and getattr(self, "update", "stock") == "lean":
            raise ValueError("update: lean is Stable-Baselines3's update, compiled; with import it must be stock")
        if self.import_path is None and self.kwargs:
            lack = "is empty" if "import_path" in self.model_fields_set else "is missing"
            what = f"import, which names the class of your own that kwargs are for, {lack}"
            raise ValueError(f"{what}{self._beside_kwargs()}")
        return self

    def _beside_kwargs(self) -> str:
        """Where the first of its kwargs that is a key of its own, or is misspelt, stands; empty for none."""
        keys = type(self).model_fields
        for name in self.kwargs:
            hint = misspelt(name, keys)
            if (key := next((one for one in keys if f" {one!r}?" in hint), None)) is not None:
                asked = "" if key == name else f"{hint} That"
                return f"{asked or f'; {name!r}'} stands beside kwargs: learner.{key}"
        return ""


class _OnPolicy(LearnerSection):
    has_advantages: ClassVar[bool] = True

    n_steps: int = Field(default=2048, ge=2)
    """Environment transitions per update, over all shards and slots; the same constant for every curriculum. Source:
    SB3's PPO (2048); sb3-contrib's TRPO and the released SPaCE code on PointMass differ (2048 and 1024)."""
    learning_rate: float = Field(default=3e-4, gt=0.0)
    """Step size of Adam. Source: SB3's PPO (3e-4); for TRPO it is the critic's, sb3-contrib has 1e-3."""
    gae_lambda: float = Field(default=0.99, ge=0.0, le=1.0)
    """Lambda of generalised advantage estimation. Source: the paper, appendix A (0.99)."""
    normalize_advantage: bool = True
    """Scale advantages to mean 0 and standard deviation 1 per minibatch. Source: SB3's PPO; its A2C does not."""
    activation: Literal["tanh", "relu"] = "tanh"
    """Activation of the hidden layers. Source: SB3."""
    log_std_init: float = 0.0
    """Natural logarithm of the initial standard deviation of continuous actions, in action units. Source: SB3."""

    def policy_settings(self) -> dict[str, Any]:
        """See `LearnerSection`."""
        return {"log_std_init": self.log_std_init}


class _Clipped(_OnPolicy):
    n_epochs: int = Field(default=10, ge=1)
    """Passes over each update's transitions. Source: SB3 (10); the paper's PPO2 default is 4."""
    clip_range: float = Field(default=0.2, gt=0.0)
    """Clipping of the probability ratio. Source: SB3."""
    ent_coef: float = Field(default=0.0, ge=0.0)
    """Weight of the entropy bonus. Source: the paper, appendix A (0)."""
    vf_coef: float = Field(default=0.5, ge=0.0)
    """Weight of the value loss. Source: SB3 (0.5); the reference for the paper's learners has 1."""
    max_grad_norm: float | None = Field(default=0.5, gt=0.0)
    """Largest norm of the gradient; null: no clipping (the paper, appendix A). Source of the default: SB3."""
    target_kl: float | None = Field(default=None, gt=0.0)
    """Stop an update's epochs early at 1.5 times this divergence; null: never. Source: SB3."""
    unrewarded: Literal["learn", "critic"] = "learn"
    """What learns from a round in which every reward is 0. learn: the policy as well, as in SB3, though its advantages
    are nothing but the errors of the value function, and normalised to size 1. critic: only the value function, so that
    the policy does not drift before it has seen a reward. What still moves it: the entropy bonus, what Adam's momentum
    carries over from rounds before, and layers that it shares with the value function (images). Source: ours."""


class PPOConfig(_Clipped):
    """Stable-Baselines3 PPO."""

    can_be_stacked: ClassVar[bool] = True
    kind: Literal["ppo"]
    """Which learner: PPO."""
    batch_size: int = Field(default=64, ge=2)
    """Transitions per minibatch. Source: SB3 (64)."""
    update: Literal["stock", "lean"] = "stock"
    """stock: SB3's own train(). lean: the same minibatches, loss and optimiser in one compiled function, many times
    faster where networks are small, equal but for rounding, and with the same bits on every CPU; MlpPolicy only. Part
    of what a run is."""

    def is_compiled(self, engine: str) -> bool:
        """See `LearnerSection`."""
        return engine == "population" or self.update == "lean"


class RecurrentPPOConfig(_Clipped):
    """sb3-contrib RecurrentPPO: PPO that remembers what it has seen of an episode, in an LSTM (hidden contexts)."""

    policies: ClassVar[tuple[str, str, str]] = ("MlpLstmPolicy", "CnnLstmPolicy", "MultiInputLstmPolicy")
    kind: Literal["recurrent_ppo"]
    """Which learner: RecurrentPPO."""
    policy: str = Field(default="MlpLstmPolicy", min_length=1, max_length=300)
    """sb3-contrib's MlpLstmPolicy, CnnLstmPolicy (images), MultiInputLstmPolicy (dictionaries), or the import path of a
    policy class (my_package.my_module:MyPolicy). All act through torch."""
    batch_size: int = Field(default=128, ge=2)
    """Transitions per minibatch: neighbours in time, for the LSTM is trained on stretches of episodes. Source:
    sb3-contrib."""
    lstm_hidden_size: int = Field(default=256, ge=1, le=16384)
    """Units of each layer of an LSTM. `net_arch` is what follows it. Source: sb3-contrib."""
    n_lstm_layers: int = Field(default=1, ge=1, le=16)
    """Layers of an LSTM. Source: sb3-contrib."""
    enable_critic_lstm: bool = True
    """An LSTM of its own for the critic; false: it sees the present observation alone, unless `shared_lstm`. Source:
    sb3-contrib."""
    shared_lstm: bool = False
    """The critic reads the actor's LSTM, which learns from the actor alone; needs enable_critic_lstm: false. Source:
    sb3-contrib."""

    @model_validator(mode="after")
    def _one_lstm_of_the_critic(self) -> Self:
        if self.shared_lstm and self.enable_critic_lstm:
            raise ValueError(
                "shared_lstm: true needs enable_critic_lstm: false: the critic reads the actor's LSTM or one of its own"
            )
        return self

    @model_validator(mode="after")
    def _no_minibatch_of_one(self) -> Self:
        if self.normalize_advantage and self.n_steps % self.batch_size == 1:
            raise ValueError(
                f"batch_size = {self.batch_size} leaves one of n_steps = {self.n_steps} transitions for a minibatch of "
                "its own, and the advantage of one cannot be normalised; use a divisor of n_steps"
            )
        return self

    @property
    def memory_size(self) -> int:
        """See `LearnerSection`: hidden and cell state of each layer, of the actor's LSTM and of the critic's own."""
        return (4 if self.enable_critic_lstm else 2) * self.n_lstm_layers * self.lstm_hidden_size

    def policy_settings(self) -> dict[str, Any]:
        """See `LearnerSection`."""
        return {
            **super().policy_settings(), "lstm_hidden_size": self.lstm_hidden_size,
            "n_lstm_layers": self.n_lstm_layers, "shared_lstm": self.shared_lstm,
            "enable_critic_lstm": self.enable_critic_lstm,
        }  # fmt: skip


class TRPOConfig(_OnPolicy):
    """sb3-contrib TRPO."""

    can_be_stacked: ClassVar[bool] = True
    kind: Literal["trpo"]
    """Which learner: TRPO."""
    learning_rate: float = Field(default=1e-3, gt=0.0)
    """Step size of the critic's Adam. Source: sb3-contrib (1e-3); the paper's old library: about 0.24 (appendix A)."""
    batch_size: int = Field(default=128, ge=2)
    """Transitions per minibatch of the critic. Source: sb3-contrib."""
    target_kl: float = Field(default=0.004, gt=0.0)
    """Largest KL divergence of one policy step. Source: the paper, appendix A (0.004); sb3-contrib has 0.01."""
    n_critic_updates: int = Field(default=10, ge=1)
    """Passes of the critic over each update's transitions. Source: sb3-contrib (10); the paper's old library: 3."""
    cg_max_steps: int = Field(default=15, ge=1)
    """Conjugate gradient steps. Source: sb3-contrib (15); the paper's old library: 10."""
    cg_damping: float = Field(default=0.1, ge=0.0)
    """Damping of the Hessian-vector product. Source: sb3-contrib (0.1); the paper's old library: 0.01."""
    line_search_shrinking_factor: float = Field(default=0.8, gt=0.0, lt=1.0)
    """Factor by which a rejected policy step is shortened. Source: sb3-contrib."""
    line_search_max_iter: int = Field(default=10, ge=1)
    """Shortened steps tried before an update is given up. Source: sb3-contrib."""


class A2CConfig(_OnPolicy):
    """Stable-Baselines3 A2C: one gradient step on all of an update's transitions."""

    kind: Literal["a2c"]
    """Which learner: A2C."""
    learning_rate: float = Field(default=7e-4, gt=0.0)
    """Step size. Source: SB3."""
    normalize_advantage: bool = False
    """Scale advantages to mean 0 and standard deviation 1. Source: SB3."""
    ent_coef: float = Field(default=0.0, ge=0.0)
    """Weight of the entropy bonus. Source: SB3."""
    vf_coef: float = Field(default=0.5, ge=0.0)
    """Weight of the value loss. Source: SB3."""
    max_grad_norm: float | None = Field(default=0.5, gt=0.0)
    """Largest norm of the gradient; null: no clipping. Source: SB3."""
    use_rms_prop: bool = True
    """RMSProp as in TensorFlow, instead of Adam. Source: SB3."""
    rms_prop_eps: float = Field(default=1e-5, gt=0.0)
    """Epsilon of RMSProp. Source: SB3."""


class _OffPolicy(LearnerSection):
    keeps_next_observations: ClassVar[bool] = True

    n_steps: int = Field(default=512, ge=1)
    """Environment transitions per round, over all shards and slots, collected with the policy of the round before:
    SB3's train_freq."""
    n_episodes: int | None = Field(default=None, ge=1)
    """End a round with this many episodes instead; rollout.shards and rollout.slots must be 1. null: by n_steps."""
    gamma: float = Field(default=0.99, ge=0.0, le=1.0)
    """Discount per step. Source: SB3."""
    activation: Literal["tanh", "relu"] = "relu"
    """Activation of the hidden layers. Source: SB3."""
    batch_size: int = Field(default=256, ge=1)
    """Transitions per gradient step. Source: SB3's SAC and TD3 (256); its DQN has 32."""
    buffer_size: int = Field(default=100_000, ge=1, le=10**8)
    """Transitions that the replay buffer remembers. Source: ours (SB3: 1e6)."""
    learning_starts: int = Field(default=100, ge=0)
    """Environment steps of uniformly random actions, and before the first gradient step. Source: SB3 (100)."""
    gradient_steps_per_step: float = Field(default=1.0, gt=0.0, le=100.0)
    """Gradient steps per environment step. Source: SB3's SAC and TD3 (1); its DQN makes 1 every 4 steps (0.25)."""
    tau: float = Field(default=0.005, gt=0.0, le=1.0)
    """Share of the online network that enters the target network per update. Source: SB3's SAC and TD3."""
    update: Literal["stock", "lean"] = "stock"
    """stock: SB3's own train(). lean: the same minibatches, losses and optimisers in one compiled function, several
    times faster where networks are small, equal but for rounding, and with the same bits on every CPU; MlpPolicy only.
    Part of what a run is."""

    @property
    def episodes_per_round(self) -> int | None:
        """See `LearnerSection`."""
        return self.n_episodes

    def is_compiled(self, engine: str) -> bool:  # noqa: ARG002 - there are no populations of these
        """See `LearnerSection`."""
        return self.update == "lean"


class DQNConfig(_OffPolicy):
    """Stable-Baselines3 DQN (Huber loss, linear epsilon)."""

    actions: ClassVar[Literal["any", "discrete", "bounded"]] = "discrete"
    kind: Literal["dqn"]
    """Which learner: DQN."""
    learning_rate: float = Field(default=1e-4, gt=0.0)
    """Step size of Adam. Source: SB3."""
    batch_size: int = Field(default=32, ge=1)
    """Transitions per gradient step. Source: SB3."""
    gradient_steps_per_step: float = Field(default=0.25, gt=0.0, le=100.0)
    """Gradient steps per environment step. Source: SB3 (one every 4 steps)."""
    tau: float = Field(default=1.0, gt=0.0, le=1.0)
    """Share of the online network that enters the target network per update. Source: SB3 (1: a copy)."""
    target_update_interval: int = Field(default=10_000, ge=1)
    """Environment steps between updates of the target network. Source: SB3."""
    exploration_fraction: float = Field(default=0.1, ge=0.0, le=1.0)
    """Share of the run over which epsilon falls. Source: SB3."""
    exploration_initial_eps: float = Field(default=1.0, ge=0.0, le=1.0)
    """Probability of a random action at the start. Source: SB3. Before `learning_starts` all actions are random, so of
    the schedule only what lies behind it acts, and is logged."""
    exploration_final_eps: float = Field(default=0.05, ge=0.0, le=1.0)
    """Probability of a random action in the end. Source: SB3."""
    max_grad_norm: float | None = Field(default=10.0, gt=0.0)
    """Largest norm of the gradient; null: no clipping. Source: SB3."""
    scored_network: Literal["online", "target"] = "online"
    """The network whose max_a Q is an instance's start value. Source: ours; the paper's notebook scores the target."""


class SACConfig(_OffPolicy):
    """Stable-Baselines3 SAC. Its start values contain the entropy bonus."""

    actions: ClassVar[Literal["any", "discrete", "bounded"]] = "bounded"
    kind: Literal["sac"]
    """Which learner: SAC."""
    learning_rate: float = Field(default=3e-4, gt=0.0)
    """Step size of Adam, for actor, critic and entropy coefficient. Source: SB3."""
    net_arch: tuple[Annotated[int, Field(ge=1, le=16384)], ...] = Field(default=(256, 256), max_length=16, strict=False)
    """Units of each hidden layer, for actor and critics each. Source: SB3."""
    ent_coef: Literal["auto"] | float = "auto"
    """Entropy coefficient alpha; auto: learned. Source: SB3."""
    target_update_interval: int = Field(default=1, ge=1)
    """Gradient steps between updates of the target network. Source: SB3."""

    @field_validator("ent_coef")
    @classmethod
    def _not_negative(cls, value: str | float) -> str | float:
        if not isinstance(value, str) and value < 0.0:
            raise ValueError("must be at least 0, or auto")
        return value


class TD3Config(_OffPolicy):
    """Stable-Baselines3 TD3."""

    actions: ClassVar[Literal["any", "discrete", "bounded"]] = "bounded"
    kind: Literal["td3"]
    """Which learner: TD3."""
    learning_rate: float = Field(default=1e-3, gt=0.0)
    """Step size of Adam. Source: SB3."""
    net_arch: tuple[Annotated[int, Field(ge=1, le=16384)], ...] = Field(default=(400, 300), max_length=16, strict=False)
    """Units of each hidden layer, for actor and critics each. Source: SB3."""
    action_noise_std: float = Field(default=0.1, ge=0.0)
    """Standard deviation of the noise on executed actions, scaled to [-1, 1]. Source: Fujimoto et al. 2018 (0.1); SB3
    has none."""
    policy_delay: int = Field(default=2, ge=1)
    """Critic updates per actor update. Source: SB3."""
    target_policy_noise: float = Field(default=0.2, ge=0.0)
    """Standard deviation of the noise on target actions. Source: SB3."""
    target_noise_clip: float = Field(default=0.5, ge=0.0)
    """Limit of that noise. Source: SB3."""


LearnerConfig = Annotated[
    PPOConfig | TRPOConfig | A2CConfig | RecurrentPPOConfig | DQNConfig | SACConfig | TD3Config,
    Field(discriminator="kind"),
]


def learners_that(ability: Literal["has_advantages", "keeps_next_observations", "can_be_stacked"]) -> list[str]:
    """The kinds of learners that can do something, for sentences."""
    sections: tuple[type[LearnerSection], ...] = get_args(get_args(LearnerConfig)[0])
    able = (section for section in sections if getattr(section, ability))
    return [get_args(section.model_fields["kind"].annotation)[0] for section in able]
