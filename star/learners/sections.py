"""The settings of the learners, and what the levels that have one share. Light: no learner is imported for them."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from star.config.section import Batch, Hidden, Positive, Repeats, Section


class PPOConfig(Section):
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
    max_grad_norm: float = Field(1.0, gt=0, description="global gradient norm is clipped to this")


class BufferedConfig(Section):
    """Settings of what learns from batches of a buffer."""

    batch_size: Batch = Field(128, description="transitions per update")
    buffer_size: Positive = Field(200_000, description="transitions kept")

    @model_validator(mode="after")
    def _batch_fits_the_buffer(self) -> Self:
        if self.batch_size > self.buffer_size:
            raise ValueError(f"batch_size {self.batch_size} exceeds buffer_size {self.buffer_size}")
        return self


class TD3Config(BufferedConfig):
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


class LevelConfig(Section):
    """What Tutor and Controller have in common: a learner and a reward."""

    learner: Literal["ppo", "td3"] = Field("ppo", description="learning algorithm")
    reward: Literal["distance", "progress"] = Field("progress", description="minus the distance, or its decrease")
    reward_scale: float = Field(1.0, gt=0, description="factor on the reward")
    termination_penalty: float = Field(
        0.0, ge=0, description="taken off the reward where the task is terminated, as by a flip"
    )
    ppo: PPOConfig = Field(PPOConfig(), description="settings used when learner is ppo")
    td3: TD3Config = Field(TD3Config(), description="settings used when learner is td3")
