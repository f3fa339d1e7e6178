"""The settings of the learners, and what the levels that have one share. Light: no learner is imported for them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, SerializeAsAny, ValidationInfo, field_validator, model_validator

from envs.common.errors import shown
from star.config import plugins
from star.config.section import Batch, Hidden, Positive, Repeats, Section
from star.learners.protocol import Learner, LearnerConfig, Rollout

NUMBER = 4  # bytes


class PPOConfig(LearnerConfig):
    """Proximal policy optimisation (Schulman et al. 2017) with an adaptive learning rate."""

    hidden: Hidden = Field((256, 256, 128), description="widths of the actor's and critic's layers")
    learning_rate: float = Field(5e-4, gt=0, description="initial Adam step size; adaptive, never below 1e-5")
    max_learning_rate: float = Field(1e-3, gt=0, description="ceiling of the adaptive step size")
    target_kl: float = Field(0.016, gt=0, description="KL divergence per pass that the step size aims at")
    discount: float = Field(0.95, ge=0, le=1, description="gamma per decision of the level")
    gae_lambda: float = Field(0.95, ge=0, le=1, description="lambda of generalised advantage estimation")
    clip: float = Field(0.2, gt=0, description="clip range of the probability ratio")
    entropy: float = Field(0.0, ge=0, description="weight of the entropy bonus")
    passes: Repeats = Field(4, description="passes over each rollout")
    minibatches: Positive = Field(8, description="minibatches per pass")
    initial_std: float = Field(0.8, gt=0, description="initial standard deviation of actions in [-1, 1]")
    min_std: float = Field(0.05, gt=0, description="floor of the standard deviation")
    max_grad_norm: float = Field(1.0, gt=0, description="gradient norms of actor and critic are clipped to this")

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
        """What networks keep of a minibatch to learn from it."""
        return rollout.size // self.minibatches * sum(self.hidden) * NUMBER


class BufferedConfig(Section):
    """Settings of what learns from batches of a buffer."""

    batch_size: Batch = Field(128, description="transitions per update")
    buffer_size: Positive = Field(200_000, description="transitions kept")

    @model_validator(mode="after")
    def _batch_fits_the_buffer(self) -> Self:
        if self.batch_size > self.buffer_size:
            raise ValueError(f"batch_size {self.batch_size} exceeds buffer_size {self.buffer_size}")
        return self


class TD3Config(BufferedConfig, LearnerConfig):
    """Twin delayed deep deterministic policy gradient (Fujimoto et al. 2018), as published for STAR."""

    hidden: Hidden = Field((300, 300), description="widths of the actor's and critics' layers")
    actor_learning_rate: float = Field(1e-4, gt=0, description="Adam step size of the actor")
    critic_learning_rate: float = Field(1e-3, gt=0, description="Adam step size of the critics")
    discount: float = Field(0.95, ge=0, le=1, description="gamma per decision of the level")
    tau: float = Field(0.005, gt=0, le=1, description="rate at which the target networks follow")
    min_transitions: Positive = Field(1000, description="transitions needed before the first update")
    updates_per_rollout: Repeats = Field(10, description="gradient updates after each rollout")
    policy_delay: Positive = Field(2, description="critic updates per actor update")
    target_noise: float = Field(0.2, ge=0, description="smoothing noise of target actions in [-1, 1]")
    target_noise_clip: float = Field(0.5, ge=0, description="clip of the smoothing noise")
    exploration_noise: float = Field(0.1, ge=0, description="standard deviation of exploration, actions in [-1, 1]")

    replays: ClassVar[bool] = True

    def check(self, rollout: Rollout) -> None:
        """A rollout fits into the buffer, which is cut into equal shares for devices."""
        if self.buffer_size < rollout.size:
            raise ValueError(f"buffer_size: {self.buffer_size} is below one rollout of {rollout.size}")
        if self.buffer_size % rollout.devices:
            raise ValueError(
                f"buffer_size: {self.buffer_size} cannot be shared evenly by trainer.devices {rollout.devices}"
            )

    def scratch_bytes(self, rollout: Rollout) -> int:
        """What networks keep of a batch to learn from it."""
        return self.batch_size * sum(self.hidden) * NUMBER

    def samples_per_transition(self, rollout: Rollout) -> float:
        """Samples drawn after a rollout, for each transition in it."""
        return self.updates_per_rollout * self.batch_size / rollout.size


class LevelConfig(Section):
    """What Tutor and Controller have in common: a learner and a reward."""

    learner: str = Field("ppo", description="learning algorithm: ppo, td3, or module:name of your own")
    reward: Literal["distance", "progress"] = Field("progress", description="minus the distance, or its decrease")
    reward_scale: float = Field(1.0, gt=0, description="factor on the reward")
    termination_penalty: float = Field(
        0.0, ge=0, description="taken off the reward where the task is terminated, as by a flip"
    )
    ppo: PPOConfig = Field(PPOConfig(), description="settings used when learner is ppo")
    td3: TD3Config = Field(TD3Config(), description="settings used when learner is td3")
    own: SerializeAsAny[LearnerConfig] = Field(
        LearnerConfig(), validate_default=True, description="settings of a learner of your own"
    )

    @field_validator("learner")
    @classmethod
    def _learner_exists(cls, name: str) -> str:
        if plugins.is_plugin(name):
            _own(name)
        elif name not in BUILT_IN:
            raise ValueError(f"should be {', '.join(map(repr, BUILT_IN))} or 'module:name' of your own")
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


BUILT_IN = ("ppo", "td3")


def _own(name: str) -> type[LearnerConfig]:
    """The type of the settings of a learner from outside; ValueError in one line if it cannot be had."""
    return plugins.find(name, Learner).Config
