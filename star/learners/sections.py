"""The settings of the learners, and what the levels that have one share. Light: no learner is imported for them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, SerializeAsAny, ValidationInfo, field_validator, model_validator

from envs.common import plugins
from envs.common.errors import shown
from star.config.section import Batch, Hidden, Positive, Repeats, Section, setting
from star.learners.protocol import Learner, LearnerConfig, Rollout

NUMBER = 4  # bytes
BUILT_IN = ("ppo", "td3")
OF_PLACES = ("crl", "chronosrl")  # of a level that is sent to places
DISCOUNT: Any = setting(
    0.95,
    "A reward counts by this factor less for each decision of the level that it lies ahead (gamma).",
    unit="",
    ge=0,
    le=1,
)


def one_of(*names: str) -> Any:
    """The setting `learner` of a level that may have one of these, or one from outside."""
    words = f"{', '.join(names)} or module:name of your own"
    return setting("ppo", "The level learns by this algorithm.", allowed=words)


class PPOConfig(LearnerConfig):
    """Proximal policy optimisation (Schulman et al. 2017) with an adaptive learning rate."""

    hidden: Hidden = setting((256, 256, 128), "Actor and critic have layers of these widths.", unit="units")
    learning_rate: float = setting(
        5e-4, "Adam begins with steps of this size, which adapt and never fall below 1e-5.", unit="", gt=0
    )
    max_learning_rate: float = setting(1e-3, "The adaptive step size never exceeds this.", unit="", gt=0)
    target_kl: float = setting(0.016, "The step size aims at this KL divergence per pass.", unit="nats", gt=0)
    discount: float = DISCOUNT
    gae_lambda: float = setting(0.95, "Generalised advantage estimation uses this lambda.", unit="", ge=0, le=1)
    clip: float = setting(0.2, "The probability ratio is clipped to 1 plus or minus this.", unit="", gt=0)
    entropy: float = setting(0.0, "The entropy bonus has this weight in the loss.", unit="", ge=0)
    passes: Repeats = setting(4, "Each update makes so many passes over its rollout.", unit="passes")
    minibatches: Positive = setting(8, "A pass cuts the rollout into so many equal minibatches.", unit="minibatches")
    initial_std: float = setting(0.8, "Actions in [-1, 1] have this standard deviation at first.", unit="", gt=0)
    min_std: float = setting(0.05, "The standard deviation of actions never falls below this.", unit="", gt=0)
    max_grad_norm: float = setting(1.0, "The gradient norms of actor and critic are clipped to this.", unit="", gt=0)

    def check(self, rollout: Rollout) -> None:
        """Minibatches are equal shares of a rollout, and are cut into equal shares for devices."""
        size, rest = divmod(rollout.size, self.minibatches)
        if rest:
            raise ValueError(
                f"minibatches: {self.minibatches} does not divide the rollout of {rollout.size} decisions "
                f"({rollout.decisions} of each of {rollout.num_envs} environments)"
            )
        if size % rollout.devices:
            raise ValueError(
                f"minibatches: {self.minibatches} makes minibatches of {size}, which cannot be shared evenly by "
                f"trainer.devices {rollout.devices}"
            )

    def scratch_bytes(self, rollout: Rollout) -> int:
        """Memory of networks for a minibatch."""
        return rollout.size // self.minibatches * sum(self.hidden) * NUMBER


class BufferedConfig(Section):
    """Settings of what learns from batches of a buffer."""

    batch_size: Batch = setting(128, "Each update learns from so many transitions.", unit="transitions")
    buffer_size: Positive = setting(200_000, "The buffer keeps so many transitions.", unit="transitions")

    @model_validator(mode="after")
    def _batch_fits_the_buffer(self) -> Self:
        if self.batch_size > self.buffer_size:
            raise ValueError(f"batch_size {self.batch_size} exceeds buffer_size {self.buffer_size}")
        return self


class ReplayConfig(BufferedConfig, LearnerConfig):
    """Settings of a learner that keeps transitions and learns from them again and again."""

    min_transitions: Positive = setting(1000, "The first update waits for so many transitions.", unit="transitions")
    updates_per_rollout: Repeats = setting(10, "Each rollout is followed by so many gradient updates.", unit="updates")

    replays: ClassVar[bool] = True

    def check(self, rollout: Rollout) -> None:
        """The buffer holds what updates wait for."""
        if self.buffer_size < self.min_transitions:
            raise ValueError(f"min_transitions: {self.min_transitions} exceeds buffer_size {self.buffer_size}")

    def samples_per_transition(self, rollout: Rollout) -> float:
        """Samples drawn after a rollout, for each transition in it."""
        return self.updates_per_rollout * self.batch_size / rollout.size


class TD3Config(ReplayConfig):
    """Twin delayed deep deterministic policy gradient (Fujimoto et al. 2018), as published for STAR."""

    hidden: Hidden = setting((300, 300), "Actor and critics have layers of these widths.", unit="units")
    actor_learning_rate: float = setting(1e-4, "Adam takes steps of this size for the actor.", unit="", gt=0)
    critic_learning_rate: float = setting(1e-3, "Adam takes steps of this size for the critics.", unit="", gt=0)
    discount: float = DISCOUNT
    tau: float = setting(
        0.005, "Target networks move by this share of the difference after each update.", unit="", gt=0, le=1
    )
    min_transitions: Positive = setting(
        1000, "The first update waits for so many transitions of random actions.", unit="transitions"
    )
    policy_delay: Positive = setting(2, "The actor is updated once in so many updates of the critics.", unit="updates")
    target_noise: float = setting(
        0.2, "Target actions in [-1, 1] are smoothed by noise of this standard deviation.", unit="", ge=0
    )
    target_noise_clip: float = setting(0.5, "The smoothing noise is clipped to this.", unit="", ge=0)
    exploration_noise: float = setting(
        0.1, "Actions in [-1, 1] are explored with noise of this standard deviation.", unit="", ge=0
    )

    def check(self, rollout: Rollout) -> None:
        """The buffer holds a rollout, and what updates wait for; it is cut into equal shares for devices."""
        if self.buffer_size < rollout.size:
            raise ValueError(f"buffer_size: {self.buffer_size} is below one rollout of {rollout.size}")
        super().check(rollout)
        if self.buffer_size % rollout.devices:
            raise ValueError(
                f"buffer_size: {self.buffer_size} cannot be shared evenly by trainer.devices {rollout.devices}"
            )

    def scratch_bytes(self, rollout: Rollout) -> int:
        """Memory of networks for a batch."""
        return self.batch_size * sum(self.hidden) * NUMBER


class FuturesConfig(ReplayConfig):
    """Settings of what learns which actions lead where, with goals to which the agent came later."""

    representation: Positive = setting(64, "The halves of the critic meet in a space of this size.", unit="units")
    learning_rate: float = setting(3e-4, "Adam takes steps of this size.", unit="", gt=0)
    batch_size: Batch = setting(256, "Each update learns from so many transitions.", unit="transitions")
    buffer_size: Positive = setting(512_000, "The buffer keeps so many transitions.", unit="transitions")

    futures: ClassVar[bool] = True

    def check(self, rollout: Rollout) -> None:
        """The buffer holds whole rollouts, one after the other, and what updates wait for."""
        if self.buffer_size % rollout.size:
            raise ValueError(
                f"buffer_size: {self.buffer_size} is not a multiple of one rollout of {rollout.size} transitions"
            )
        super().check(rollout)


class CRLConfig(FuturesConfig):
    """Contrastive reinforcement learning (Eysenbach et al. 2022); defaults are JaxGCRL's."""

    hidden: Hidden = setting(
        (256, 256), "Actor and both halves of the critic have layers of these widths.", unit="units"
    )
    discount: float = setting(
        0.99,
        "Goals lie so many env steps ahead: geometric, each step going on with this probability (gamma).",
        unit="",
        gt=0,
        lt=1,
    )
    logsumexp_penalty: float = setting(
        0.1, "The critic is kept near a probability by a penalty of this weight.", unit="", ge=0
    )

    def scratch_bytes(self, rollout: Rollout) -> int:
        """Activations of a batch in the networks, and the energies of its pairs."""
        return self.batch_size * (sum(self.hidden) + self.batch_size) * NUMBER


class ChronoSRLConfig(FuturesConfig):
    """ChronoSRL (arXiv 2609.36238); defaults are the published ones."""

    width: Annotated[int, Field(gt=0, le=2**14)] = setting(256, "Layers of all networks are so wide.", unit="units")
    blocks: Annotated[int, Field(gt=0, le=64)] = setting(
        2, "Each network has so many residual blocks of four layers.", unit="blocks"
    )
    action_chunk: Annotated[int, Field(gt=0, le=64)] = setting(
        2, "The actor decides once in so many env steps, for all of them.", unit="env steps"
    )
    horizon: Annotated[int, Field(gt=1, le=10_000)] = setting(
        1000, "The critic looks so far ahead; what comes later counts as never.", unit="env steps"
    )
    radius: float = setting(
        0.5,
        "Goals count as reached within this distance; it should be the task's radius of success.",
        unit="units of the state",
        gt=0,
    )
    discount: float = setting(
        0.999, "An env step counts by this factor less for each one that it lies ahead (gamma).", unit="", gt=0, lt=1
    )
    goal_discount: float = setting(
        0.99,
        "Goals lie so many env steps ahead: geometric, each step going on with this probability.",
        unit="",
        gt=0,
        lt=1,
    )
    batch_size: Batch = setting(512, "Each update learns from so many transitions.", unit="transitions")

    @property
    def chunk(self) -> int:
        """The env steps of one decision."""
        return self.action_chunk

    def scratch_bytes(self, rollout: Rollout) -> int:
        """Activations of a batch in the networks, the distances of its pairs, and the logits of hazards."""
        return self.batch_size * (4 * self.width * (4 * self.blocks + 1) + self.batch_size + self.horizon) * NUMBER


class LevelConfig(Section):
    """The common settings of Tutor and Controller: a learner and a reward."""

    built_in: ClassVar[tuple[str, ...]] = BUILT_IN
    """The learners of this package that it may have."""

    learner: str = one_of(*BUILT_IN)
    reward: Literal["distance", "progress"] = setting(
        "progress", "The reward is minus the distance to the target, or how much it decreases."
    )
    reward_scale: float = setting(1.0, "The reward is multiplied by this.", unit="", gt=0)
    termination_penalty: float = setting(
        0.0, "This is taken off the reward where the task is terminated, as by a flip.", unit="", ge=0
    )
    ppo: PPOConfig = Field(PPOConfig(), description="settings used when learner is ppo")
    td3: TD3Config = Field(TD3Config(), description="settings used when learner is td3")
    own: SerializeAsAny[LearnerConfig] = setting(
        LearnerConfig(),
        "These are the settings of a learner of your own.",
        allowed="those of its Config",
        validate_default=True,
    )

    @field_validator("learner")
    @classmethod
    def _learner_exists(cls, name: str) -> str:
        if plugins.is_plugin(name):
            _own(name)
        elif name not in cls.built_in:
            raise ValueError(f"should be {', '.join(map(repr, cls.built_in))} or 'module:name' of your own")
        return name

    @field_validator("own", mode="before")
    @classmethod
    def _of_the_learner(cls, value: Any, info: ValidationInfo) -> Any:
        name = info.data.get("learner", "")
        kind = _own(name) if plugins.is_plugin(name) else LearnerConfig
        if isinstance(value, LearnerConfig):
            value = value.model_dump()
        if isinstance(value, Mapping):
            for key in value:
                if key not in kind.model_fields:
                    allowed = ", ".join(kind.model_fields) or "none, they stand under its name"
                    raise ValueError(f"{shown(key)} is no setting of {name}; allowed: {allowed}")
        return kind.model_validate(value)

    @property
    def group(self) -> str:
        """The name under which the settings of the learner in use stand."""
        return "own" if plugins.is_plugin(self.learner) else self.learner

    @property
    def settings(self) -> Any:
        """Those of the learner in use."""
        return getattr(self, self.group)


def _own(name: str) -> type[LearnerConfig]:
    """The type of the settings of a learner from outside; ValueError in one line if it cannot be had."""
    found = plugins.find(name, Learner).Config
    if not (isinstance(found, type) and issubclass(found, LearnerConfig)):
        raise ValueError(f"its Config is {shown(found)}; allowed: a subclass of star.learners.LearnerConfig")
    return found
