"""The settings of the three levels, and of a whole experiment with them."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from star.abstraction.sections import AbstractionConfig, ForwardModelConfig, RefinementConfig
from star.config.run import EnvConfig, RunConfig, TrainerConfig
from star.config.section import Batch, Hidden, Positive, Repeats, Section
from star.learners import Rollout
from star.learners.sections import LevelConfig
from star.sgim.sections import SgimConfig


class CommanderConfig(Section):
    """The Commander: a table of values over regions."""

    enabled: bool = Field(True, description="false commands the goal itself all the time, as in HIRO")
    learner: Literal["model", "q"] = Field("model", description="planning on a learnt model of regions, or Q-learning")
    period: Positive = Field(30, description="k: env steps between the Commander's decisions")
    learning_rate: float = Field(
        0.01, gt=0, le=1, description="alpha of learner q, applied once per stream and visited cell"
    )
    discount: float = Field(0.95, ge=0, lt=1, description="gamma per decision")
    epsilon_start: float = Field(0.5, ge=0, le=1, description="share of random targets at the start")
    epsilon_end: float = Field(0.1, ge=0, le=1, description="share of random targets after epsilon_steps")
    epsilon_steps: float = Field(1e6, gt=0, description="env steps over which epsilon falls linearly")
    epsilon_spread: bool = Field(
        True, description="spread epsilon over the environments, from none to twice as much, instead of the same in all"
    )
    arrival: bool = Field(
        True, description="greedy episodes: decide again as soon as the target region is reached, not after k env steps"
    )
    retry: float = Field(
        0.9, ge=0, le=1, description="greedy episodes: what a command is worth where it was given before and led back"
    )
    trust: float = Field(
        0.99,
        ge=0,
        le=1,
        description="greedy episodes: chance that a command works which has led nowhere yet; 1: no doubts",
    )
    hold: Literal[False, True, "region"] = Field(
        True,
        description="command the goal wherever it counts as reached (true), or instead all over its region (region)",
    )
    practice: float = Field(
        0.25, ge=0, le=1, description="share of environments that practise reaching random regions, one after another"
    )
    successors: Literal["all", "any", "possible", "known"] = Field(
        "any",
        description="greedy choice among all targets, those not shown unreachable, or the known-reachable ones, which "
        "known keeps to in random choices too; all disregards reachability in those and in plans",
    )
    reward: Literal["success", "mean", "max"] = Field(
        "success",
        description="of a decision: mean success of its k env steps, or mean or maximum of r_ext",
    )
    sweeps: Repeats = Field(10, description="sweeps of value iteration of learner model after every k env steps")
    prior: float = Field(
        5.0,
        gt=0,
        description="decisions that weigh as much as the belief in what was not tried; it fades as it is tried",
    )
    memory: float = Field(
        0.5, ge=0, le=1, description="share of old decisions left in the model an epoch later; 20 of each command stay"
    )
    goal_margin: float = Field(
        1.0,
        gt=0,
        description="largest half-width of the box around g* given to the Tutor in its region, which is never more "
        "than fits into the ball of success",
    )


class AdjacencyConfig(Section):
    """The adjacency network of HRAC, which keeps the Tutor from subgoals out of reach."""

    enabled: bool = Field(False, description="true penalises subgoals that are not adjacent, as in HRAC")
    weight: float = Field(20.0, ge=0, description="of the penalty in the loss of the Tutor's actor")
    cell: Positive = Field(1, description="side of the cells that states are rounded to (units of the state)")
    hidden: Hidden = Field((128, 128, 128), description="widths of the ReLU layers")
    features: Annotated[int, Field(gt=0, le=2**14)] = Field(32, description="size of the embedding")
    learning_rate: float = Field(2e-4, gt=0, description="Adam step size")
    near: float = Field(1.0, gt=0, description="adjacent cells are to be no further apart in the embedding")
    far: float = Field(1.2, gt=0, description="other cells are to be no closer in the embedding")
    limit: float = Field(1.1, gt=0, description="subgoals no further than this cost nothing")
    batch_size: Batch = Field(512, description="anchors per update")
    updates_per_epoch: Repeats = Field(200, description="gradient updates after each epoch")


class TutorConfig(LevelConfig):
    """The Tutor: chooses the subgoal on the way to the target region."""

    enabled: bool = Field(True, description="false gives the target box to the Controller itself, as in GARA")
    period: Positive = Field(10, description="l: env steps between the Tutor's decisions")
    heading: float | None = Field(
        None, gt=0, description="m: subgoals also say where to face, by a vector of this length"
    )
    unroll: Positive = Field(5, description="decisions of each environment per update")
    reward_scale: float = Field(0.3, gt=0, description="factor on the reward")
    straight: bool = Field(True, description="aim straight at the box around a goal within half the reach of a subgoal")
    relative_bounds: bool = Field(True, description="observe the region's bounds relative to the agent")
    off_policy_correction: bool = Field(False, description="relabel replayed subgoals (HIRO); needs learner td3")
    correction_candidates: Batch = Field(10, description="random candidates of the off-policy correction")
    adjacency: AdjacencyConfig = AdjacencyConfig()

    @model_validator(mode="after")
    def _adjacency_needs_a_tutor(self) -> Self:
        if self.adjacency.enabled and not self.enabled:
            raise ValueError("adjacency.enabled needs a Tutor, whose subgoals it is about")
        return self

    @model_validator(mode="after")
    def _correction_needs_replay(self) -> Self:
        if self.off_policy_correction and not self.settings.replays:
            raise ValueError("off_policy_correction needs learner td3, which replays old subgoals")
        return self


class ControllerConfig(LevelConfig):
    """The Controller: drives the joints towards the subgoal."""

    termination_penalty: float = Field(
        20.0, ge=0, description="taken off the reward where the task is terminated, as by a flip"
    )
    tilt_penalty: float = Field(
        0.0, ge=0, description="taken off the reward of every env step, times 1 - cos of the body's tilt after it"
    )
    tilt_start: float = Field(1.0, gt=0, le=1, description="share of tilt_penalty that is taken off at first")
    tilt_steps: float = Field(1e6, gt=0, description="env steps over which that share rises to 1, exponentially")
    frame: Literal["world", "body"] = Field(
        "world", description="axes of velocity, tilt and subgoal as it sees them: the world's, or turned with the body"
    )
    hindsight: bool = Field(
        False, description="replay half of the transitions with a subgoal that was reached; needs learner td3"
    )

    @model_validator(mode="after")
    def _hindsight_needs_the_axes_of_the_world(self) -> Self:
        if self.hindsight and self.frame != "world":
            raise ValueError("hindsight needs frame world: where a body stood is not replayed, and so not turned")
        return self

    @model_validator(mode="after")
    def _hindsight_needs_replay(self) -> Self:
        if self.hindsight and not self.settings.replays:
            raise ValueError("hindsight needs learner td3, which replays old transitions")
        return self


class StarTrainerConfig(TrainerConfig):
    """The host loop, and the environments of its epochs and evaluations."""

    num_envs: Batch = Field(128, description="environments stepped together, per seed")
    eval_episodes: Batch = Field(100, description="episodes of each evaluation, per seed")


class Config(RunConfig):
    """A whole experiment."""

    env: EnvConfig = EnvConfig()
    commander: CommanderConfig = CommanderConfig()
    tutor: TutorConfig = TutorConfig()
    controller: ControllerConfig = ControllerConfig()
    abstraction: AbstractionConfig = AbstractionConfig()
    forward_model: ForwardModelConfig = ForwardModelConfig()
    refinement: RefinementConfig = RefinementConfig()
    sgim: SgimConfig = SgimConfig()
    trainer: StarTrainerConfig = StarTrainerConfig()

    @model_validator(mode="after")
    def _periods_fit(self) -> Self:
        if self.commander.period % self.tutor.period:
            raise ValueError(
                f"commander.period: {self.commander.period} is not a multiple of tutor.period {self.tutor.period}"
            )
        return self

    @model_validator(mode="after")
    def _learners_have_their_shares(self) -> Self:
        devices, num_envs = self.trainer.devices, self.trainer.num_envs
        if num_envs % devices:
            raise ValueError(f"trainer.num_envs: {num_envs} cannot be shared evenly by trainer.devices {devices}")
        for name, section, rollout in self.learners():
            try:
                section.settings.check(rollout)
            except ValueError as error:
                raise ValueError(f"{name}.{section.group}.{error}") from None
        return self

    @model_validator(mode="after")
    def _strategies_need_levels(self) -> Self:
        if "babbling" in self.sgim.strategies and not self.tutor.enabled:
            raise ValueError("sgim.strategies: babbling needs tutor.enabled, whose subgoals it replaces")
        if not self.commander.enabled and ("decomposition" in self.sgim.strategies or self.sgim.routes):
            raise ValueError("sgim: decomposition needs commander.enabled, whose targets it sets")
        if self.sgim.exploration and not self.commander.enabled:
            raise ValueError("sgim.exploration: needs commander.enabled, whose random targets it draws")
        if self.sgim.refinement and not (self.commander.enabled and self.refinement.enabled):
            raise ValueError("sgim.refinement: needs commander.enabled and refinement.enabled, whose pairs it orders")
        return self

    def learners(self) -> list[tuple[str, LevelConfig, Rollout]]:
        """The levels that learn from rollouts: name, section, and how large these are."""
        size = partial(Rollout, num_envs=self.trainer.num_envs, devices=self.trainer.devices)
        tutor = [("tutor", self.tutor, size(self.tutor.unroll))] if self.tutor.enabled else []
        return [*tutor, ("controller", self.controller, size(self.tutor.period))]

    def hyper(self) -> AgentConfig:
        """The sections that the jitted program sees."""
        return AgentConfig(**{name: getattr(self, name) for name in AgentConfig.model_fields})

    def comparable(self) -> dict[str, Any]:
        """All values but the checksums of teachers' files, which are checked where these are read."""
        return self.model_dump(mode="json", exclude={"sgim": {"teachers": {"__all__": {"sha256"}}}})


class AgentConfig(Section):
    """The part of a `Config` that the jitted program sees; its floats are traced."""

    commander: CommanderConfig
    tutor: TutorConfig
    controller: ControllerConfig
    abstraction: AbstractionConfig
    forward_model: ForwardModelConfig
    refinement: RefinementConfig
    sgim: SgimConfig
