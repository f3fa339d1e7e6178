"""The settings of the three levels, and of a whole experiment with them."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from star.abstraction.sections import AbstractionConfig, ForwardModelConfig, RefinementConfig
from star.config.run import EnvConfig, RunConfig, TrainerConfig
from star.config.section import Batch, Hidden, Positive, Repeats, Section, setting
from star.learners import Rollout
from star.learners.sections import BUILT_IN, OF_PLACES, ChronoSRLConfig, CRLConfig, LevelConfig, one_of
from star.sgim.sections import SgimConfig


class CommanderConfig(Section):
    """The Commander: a table of values over regions."""

    enabled: bool = setting(True, "With false the goal itself is commanded all the time, as in HIRO.")
    learner: Literal["model", "q"] = setting(
        "model", "The Commander plans on a learnt model of regions, or learns by Q-learning."
    )
    period: Positive = setting(30, "The Commander decides once in so many env steps (k).", unit="env steps")
    learning_rate: float = setting(
        0.01,
        "Learner q moves a value by this share of its error, once per stream and visited cell (alpha).",
        unit="",
        gt=0,
        le=1,
    )
    discount: float = setting(
        0.95, "A reward counts by this factor less for each decision that it lies ahead (gamma).", unit="", ge=0, lt=1
    )
    epsilon_start: float = setting(0.5, "This share of targets is random at the start.", unit="", ge=0, le=1)
    epsilon_end: float = setting(0.1, "This share of targets is random after epsilon_steps.", unit="", ge=0, le=1)
    epsilon_steps: float = setting(
        1e6, "The share of random targets falls linearly over so many env steps.", unit="env steps", gt=0
    )
    epsilon_spread: bool = setting(
        True, "True spreads the share of random targets over the environments, from none to twice as much."
    )
    hold: Literal[False, True, "region"] = setting(
        True, "The goal is commanded wherever it counts as reached (true), or all over its region (region)."
    )
    successors: Literal["all", "any", "possible", "known"] = setting(
        "any",
        "Greedy targets are any, those not shown unreachable (possible), or those shown reachable (known); "
        "all ignores reachability in plans too.",
    )
    nearest: Annotated[int, Field(ge=2)] | None = setting(
        None,
        "Only so many of the nearest regions may follow one, so large tables stay small; with null all may.",
        unit="regions",
    )
    reward: Literal["success", "mean", "max"] = setting(
        "success", "A decision earns the mean success of its k env steps, or the mean or maximum of the task's reward."
    )
    sweeps: Repeats = setting(
        10, "Learner model makes so many sweeps of value iteration after every k env steps.", unit="sweeps"
    )
    prior: float = setting(
        5.0,
        "The belief in what was not tried weighs as much as so many decisions; it fades as it is tried.",
        unit="decisions",
        gt=0,
    )
    memory: float = setting(
        0.5,
        "This share of old decisions is left in the model an epoch later; 20 of each command stay.",
        unit="",
        ge=0,
        le=1,
    )
    goal_margin: float = setting(
        1.0,
        "The box around a goal has at most this half-width; it always fits into the ball of success.",
        unit="units of the state",
        gt=0,
    )

    @model_validator(mode="after")
    def _distances_pay_everywhere(self) -> Self:
        if self.nearest is not None and self.learner == "model" and self.reward != "success":
            raise ValueError(f"nearest: {self.nearest}, but reward {self.reward} pays far from the goal; allowed: null")
        return self


class AdjacencyConfig(Section):
    """The adjacency network of HRAC, which keeps the Tutor from subgoals out of reach."""

    enabled: bool = setting(False, "True penalises subgoals that are not adjacent, as in HRAC.")
    weight: float = setting(20.0, "The penalty has this weight in the loss of the Tutor's actor.", unit="", ge=0)
    cell: Positive = setting(1, "States are rounded to cells with sides of this length.", unit="units of the state")
    hidden: Hidden = setting((128, 128, 128), "The network has ReLU layers of these widths.", unit="units")
    features: Annotated[int, Field(gt=0, le=2**14)] = setting(
        32, "The embedding of a state has so many numbers.", unit="numbers"
    )
    learning_rate: float = setting(2e-4, "Adam takes steps of this size.", unit="", gt=0)
    near: float = setting(1.0, "Adjacent cells are to be no further apart in the embedding.", unit="", gt=0)
    far: float = setting(1.2, "Other cells are to be no closer in the embedding.", unit="", gt=0)
    limit: float = setting(1.1, "Subgoals no further than this in the embedding cost nothing.", unit="", gt=0)
    batch_size: Batch = setting(512, "Each update learns from so many anchors.", unit="states")
    updates_per_epoch: Repeats = setting(
        200, "The network makes so many gradient updates after each epoch.", unit="updates"
    )


class TutorConfig(LevelConfig):
    """The Tutor: chooses the subgoal on the way to the target region."""

    enabled: bool = setting(True, "With false the Controller is given the target box itself, as in GARA.")
    period: Positive = setting(10, "The Tutor decides once in so many env steps (l).", unit="env steps")
    heading: float | None = setting(
        None, "Subgoals also say where to face, by a vector of this length; with null they do not.", unit="m", gt=0
    )
    unroll: Positive = setting(5, "Each update learns from so many decisions of each environment.", unit="decisions")
    reward_scale: float = setting(0.3, "The reward is multiplied by this.", unit="", gt=0)
    straight: bool = setting(
        True, "The Tutor aims straight at the box around a goal within half the reach of a subgoal."
    )
    relative_bounds: bool = setting(True, "The Tutor sees the region's bounds relative to the agent.")
    off_policy_correction: bool = setting(
        False, "Replayed subgoals are relabelled, as in HIRO; this needs learner td3."
    )
    correction_candidates: Batch = setting(
        10, "The off-policy correction tries so many random subgoals.", unit="candidates"
    )
    adjacency: AdjacencyConfig = AdjacencyConfig()

    @model_validator(mode="after")
    def _adjacency_needs_a_tutor(self) -> Self:
        if self.adjacency.enabled and not self.enabled:
            raise ValueError("adjacency.enabled needs a Tutor, whose subgoals it is about")
        return self

    @model_validator(mode="after")
    def _futures_are_of_places(self) -> Self:
        if self.enabled and self.settings.futures:
            raise ValueError(f"learner: {self.learner} learns to reach places, to which nobody sends a Tutor")
        return self

    @model_validator(mode="after")
    def _subgoals_are_chosen_one_by_one(self) -> Self:
        if self.enabled and self.settings.chunk > 1:
            raise ValueError(f"learner: {self.learner} decides for some env steps at once, which no Tutor can")
        return self

    @model_validator(mode="after")
    def _correction_needs_replay(self) -> Self:
        if self.off_policy_correction and not self.settings.replays:
            raise ValueError("off_policy_correction needs learner td3, which replays old subgoals")
        return self


class ControllerConfig(LevelConfig):
    """The Controller: drives the joints towards the subgoal."""

    built_in: ClassVar[tuple[str, ...]] = (*BUILT_IN, *OF_PLACES)

    learner: str = one_of(*built_in)
    crl: CRLConfig = Field(CRLConfig(), description="settings used when learner is crl")
    chronosrl: ChronoSRLConfig = Field(ChronoSRLConfig(), description="settings used when learner is chronosrl")
    termination_penalty: float = setting(
        20.0, "This is taken off the reward where the task is terminated, as by a flip.", unit="", ge=0
    )
    tilt_penalty: float = setting(
        0.0, "The reward of an env step loses this times 1 - cos of the body's tilt.", unit="", ge=0
    )
    tilt_start: float = setting(1.0, "At first the penalty is this share of tilt_penalty.", unit="", gt=0, le=1)
    tilt_steps: float = setting(
        1e6, "The share of tilt_penalty rises exponentially to 1 over so many env steps.", unit="env steps", gt=0
    )
    frame: Literal["world", "body", "map"] = setting(
        "world",
        "The Controller sees subgoals in axes of the world or of its body, or the whole state and places on the map.",
    )
    hindsight: bool = setting(
        False, "Half of the replayed transitions get a subgoal that was reached; this needs learner td3."
    )

    @model_validator(mode="after")
    def _futures_need_places(self) -> Self:
        if self.settings.futures and self.frame != "map":
            raise ValueError(f"frame: {self.frame}, but learner {self.learner} needs the places of goals; allowed: map")
        return self

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

    num_envs: Batch = setting(128, "So many environments of each seed are stepped together.", unit="environments")
    eval_episodes: Batch = setting(100, "Each evaluation plays so many episodes of each seed.", unit="episodes")


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
        chunk = self.controller.settings.chunk
        if self.tutor.period % chunk:
            raise ValueError(
                f"tutor.period: {self.tutor.period} is not a multiple of the {chunk} env steps "
                f"for which controller.learner {self.controller.learner} decides at once"
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
