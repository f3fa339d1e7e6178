"""The settings of an experiment: one frozen, validated object. `star.loading` reads it from files.

Every section is a pytree. Its float fields are leaves, everything else is static structure, so the agent's
sections can be passed through `jax.jit` and batched with `jax.vmap` to train several values of a numeric
hyperparameter side by side.
"""

from __future__ import annotations

from collections.abc import Iterable
from types import NoneType
from typing import Annotated, Any, Literal, Self

import jax
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from envs.options import shown


class ConfigError(ValueError):
    """A configuration that cannot be used; the message is one line for the user."""


_LARGEST = 3.4e38  # of float32, in round numbers


class Section(BaseModel):
    """A frozen group of settings that refuses unknown keys and is a JAX pytree with its floats as leaves."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _refuse_booleans_as_numbers(cls, value: Any, info: ValidationInfo) -> Any:
        if isinstance(value, bool) and cls.model_fields[str(info.field_name)].annotation in (int, float):
            raise ValueError("should be a number")
        return value

    @field_validator("*", mode="after")
    @classmethod
    def _refuse_what_float32_cannot_hold(cls, value: Any) -> Any:
        if isinstance(value, float) and abs(value) > _LARGEST:
            raise ValueError(f"should lie between {-_LARGEST:.3g} and {_LARGEST:.3g}")
        return value

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        super().__pydantic_init_subclass__(**kwargs)
        jax.tree_util.register_pytree_with_keys(cls, _flatten, lambda aux, leaves: _unflatten(cls, aux, leaves))


def _is_leaf_field(cls: type[Section], name: str) -> bool:
    annotation = cls.model_fields[name].annotation
    return annotation is float or (isinstance(annotation, type) and issubclass(annotation, Section))


def _flatten(section: Section) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
    cls = type(section)
    leaves = [(jax.tree_util.GetAttrKey(n), getattr(section, n)) for n in cls.model_fields if _is_leaf_field(cls, n)]
    static = tuple((n, getattr(section, n)) for n in cls.model_fields if not _is_leaf_field(cls, n))
    return leaves, static


def _unflatten(cls: type[Section], static: tuple[Any, ...], leaves: Iterable[Any]) -> Section:
    names = [n for n in cls.model_fields if _is_leaf_field(cls, n)]
    return cls.model_construct(**dict(zip(names, leaves, strict=True)), **dict(static))


# Upper bounds are far above what is of use. They keep whole numbers within those of a device, loops and the
# programs that are compiled of them finite, and what is allocated within what `star.memory` can add up.
Positive = Annotated[int, Field(gt=0, lt=2**31)]
Batch = Annotated[int, Field(gt=0, le=2**20)]
Repeats = Annotated[int, Field(gt=0, le=100_000)]
Hidden = Annotated[tuple[Annotated[int, Field(gt=0, le=2**14)], ...], Field(max_length=16)]


def _is_simple(value: Any) -> bool:
    """Whether `value` is what JSON has too, but for mappings: YAML knows dates and bytes as well."""
    if isinstance(value, list | tuple):
        return all(map(_is_simple, value))
    return isinstance(value, str | int | float | NoneType)


class EnvConfig(Section):
    """The task and the engine that simulates it."""

    name: str = Field("point_maze", description="task, one of `star envs`")
    engine: Literal["auto", "warp", "jax", "native"] = Field("auto", description="physics engine")
    options: dict[str, Any] = Field({}, description="options of the task, passed to envs.make")
    training: dict[str, Any] = Field({}, description="options that differ in training from those above")

    @field_validator("options", "training")
    @classmethod
    def _refuse_what_no_option_holds(cls, value: dict[str, Any]) -> dict[str, Any]:
        for name, option in value.items():
            if not _is_simple(option):
                raise ValueError(
                    f"{name}: {shown(option)} is not allowed: should be text, a number, true, false or a list"
                )
        return value


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
    prior: float = Field(5.0, gt=0, description="decisions that weigh as much as the belief in what was not tried")
    memory: float = Field(0.5, ge=0, le=1, description="share of a decision's weight in the model left an epoch later")
    goal_margin: float = Field(
        1.0, gt=0, description="half-width of the box around g* given to the Tutor in its region"
    )


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
        if self.off_policy_correction and self.learner != "td3":
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
        if self.hindsight and self.learner != "td3":
            raise ValueError("hindsight needs learner td3, which replays old transitions")
        return self


class AbstractionConfig(Section):
    """The regions the Commander chooses from."""

    max_regions: Annotated[int, Field(ge=1, le=1024)] = Field(64, description="capacity of the table of regions")
    cuts: tuple[tuple[float, ...], ...] | None = Field(
        None, description="initial cut positions per abstract dimension; by default those of the task"
    )
    grid: tuple[Positive, ...] | None = Field(
        None, description="instead of cuts: equal initial parts along each abstract dimension, 1 where left out"
    )
    min_width: float = Field(1.0, gt=0, description="no region is cut narrower than this (units of the state)")
    min_share: float = Field(
        0.0, ge=0, description="no region is cut that is smaller than this times the space over max_regions; 0: any"
    )


class ForwardModelConfig(BufferedConfig):
    """F_k: predicts where k steps under a commanded region lead."""

    hidden: Hidden = Field((32, 32), description="widths of the ReLU layers")
    learning_rate: float = Field(1e-3, gt=0, description="Adam step size")
    batch_size: Batch = Field(512, description="transitions per update")
    buffer_size: Positive = Field(100_000, description="transitions kept")
    updates_per_epoch: Repeats = Field(200, description="gradient updates after each epoch")
    residual: bool = Field(True, description="predict the displacement instead of the final state")
    boxes: Literal["commanded", "reached"] = Field(
        "commanded", description="train on the box that was commanded, or on the region that was reached"
    )


class RefinementConfig(Section):
    """When and where a region is split."""

    enabled: bool = Field(True, description="false keeps the initial regions")
    within: bool = Field(True, description="examine too whether a region reaches the goals inside it")
    neighbours: bool = Field(
        True, description="cut a region only for targets that touch it; others are reached by way of these"
    )
    min_transitions: Positive = Field(100, description="commanded transitions before a pair is examined")
    error_tolerance: float = Field(
        0.5, ge=0, description="the model's error on a pair is stable once it falls by less than this share an epoch"
    )
    reach_share: float = Field(0.7, gt=0, le=1, description="c1: share of the hull inside the target that reaches")
    miss_share: float = Field(0.1, ge=0, lt=1, description="tau2: share of the target covered below which a box misses")
    depth: Annotated[int, Field(ge=1, le=12)] = Field(
        8, description="boxes are halved this often at most: 5 makes 1/32 of the region"
    )
    parts: Annotated[int, Field(ge=2, le=4096)] = Field(
        32, description="parts of a region at most; each round of halving begins with those visited most"
    )
    min_visits: Positive = Field(10, description="visited start states a reaching box needs")
    pairs_per_epoch: Repeats = Field(16, description="pairs examined after each epoch")
    cuts: Literal["best", "random"] = Field("best", description="where a region is cut; random is for comparison")
    cuts_per_pair: Repeats = Field(1, description="cuts one examined pair may make")
    miss_lifetime: Annotated[int, Field(ge=0, lt=2**31)] = Field(
        2, description="a MISSES verdict older than so many epochs is forgotten; with 0 there is none"
    )


class SelectionConfig(Section):
    """SGIM's choice of regions, strategies and goals."""

    window: Annotated[int, Field(ge=4, le=2**20)] = Field(80, description="episodes remembered of each region")
    per_block: Positive = Field(16, description="episodes of one block that each region remembers at most")
    drift: float = Field(
        0.001, gt=0, description="doubt about what a strategy adds grows by this in a block; it begins with 1"
    )
    optimism: float = Field(
        0.01, ge=0, description="what the root of a doubt of 1 is worth at most (units of competence per block)"
    )
    forgetting: float = Field(
        0.0, ge=0, le=1, description="what lost competence is worth of an equal gain; 1 is absolute progress"
    )
    random: float = Field(0.05, ge=0, le=1, description="share of choices drawn evenly")
    best: float = Field(0.2, ge=0, le=1, description="share of choices whose goal is near a region's best point")
    best_point: Literal["progress", "worst"] = Field(
        "progress", description="best point of a region: where competence grew most, or is lowest"
    )
    sharpness: float = Field(12.0, gt=0, description="choices are drawn in proportion to interest to this power")
    focus: float = Field(0.1, gt=0, le=1, description="how near: half-width as a share of the region's width")
    min_side: Positive = Field(8, description="remembered goals on each side of a cut at least")
    min_width: float = Field(1e-3, gt=0, description="no region is cut narrower than this (units of goals)")

    @model_validator(mode="after")
    def _shares_fit(self) -> Self:
        if self.random + self.best > 1:
            raise ValueError(f"random {self.random:g} and best {self.best:g} make more than 1")
        return self

    @model_validator(mode="after")
    def _window_spans_blocks(self) -> Self:
        if 2 * self.per_block > self.window:
            raise ValueError(f"per_block {self.per_block} is more than half of window {self.window}")
        return self


class EpochSelectionConfig(SelectionConfig):
    """SGIM's choices where many environments make them from the same state: spread more widely."""

    sharpness: float = Field(2.0, gt=0, description=SelectionConfig.model_fields["sharpness"].description)


class TeacherConfig(Section):
    """One teacher: demonstrations, what they are used for, and what it takes to ask."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9_]+$", max_length=64)] = Field(description="in metrics and figures")
    kind: Literal["action", "outcome", "decomposition"] = Field(
        description="what is shown: movements to imitate, outcomes to aim at, or routes to a goal"
    )
    source: str = Field("map", description="file of demonstrations (.npz), or map: shortest paths, routes only")
    flaw: Literal["repetitive", "wrong_half", "other_body"] | None = Field(
        None, description="what makes it a poor teacher, for experiments"
    )
    cost: float = Field(1.0, gt=0, description="of an episode, relative to one alone")
    availability: float = Field(1.0, ge=0, le=1, description="share of epochs in which the teacher is there")
    max_queries: Positive | None = Field(None, description="episodes that may be asked for; null: any number")


class SgimConfig(Section):
    """SGIM in the trainer: intrinsic motivation chooses goals, strategies, teachers, targets and what to examine."""

    goals: bool = Field(False, description="training goals are chosen by progress, instead of drawn as the task says")
    strategies: tuple[Literal["autonomous", "babbling", "decomposition"], ...] = Field(
        ("autonomous",),
        min_length=1,
        description="ways to practise alone: as ever, by random subgoals, or via a region",
    )
    teachers: tuple[TeacherConfig, ...] = Field((), max_length=64, description="teachers that may be asked for help")
    ask: Literal["progress", "evenly"] = Field(
        "progress", description="which strategy: by progress over cost, or each as often, as in SGIM-D"
    )
    unaided: bool = Field(
        True, description="ask progress: who would ask goes alone instead, as often as the region is mastered"
    )
    exploration: bool = Field(False, description="the Commander's random targets are drawn by progress")
    refinement: bool = Field(False, description="examine first what is half mastered and makes no progress")
    waypoint_radius: float = Field(2.0, gt=0, description="m: so near a waypoint is passed")
    detours: bool = Field(True, description="what a teacher only goes around to is not believed to be reached directly")
    subgoals: bool = Field(
        True, description="on the way to a teacher's waypoint the Tutor is shown subgoals straight ahead, to imitate"
    )
    margin: float = Field(0.0, ge=0, description="learner q: what a teacher's choice is to be better by than others")
    imitation: float = Field(
        1.0, ge=0, description="weight of what is demonstrated in the losses of the Tutor's and Controller's actors"
    )
    imitation_batch: Batch = Field(256, description="demonstrated actions in each of its updates")
    selection: EpochSelectionConfig = EpochSelectionConfig()

    @property
    def names(self) -> tuple[str, ...]:
        """All strategies: those alone, then the teachers."""
        return (*self.strategies, *(teacher.name for teacher in self.teachers))

    @property
    def routes(self) -> tuple[str, ...]:
        """The teachers that show routes."""
        return tuple(teacher.name for teacher in self.teachers if teacher.kind == "decomposition")

    @property
    def shows_subgoals(self) -> bool:
        """Whether there is a teacher who sets the Tutor's subgoals."""
        return self.subgoals and bool(self.routes)

    @property
    def enabled(self) -> bool:
        """Whether anything is left to intrinsic motivation."""
        return self.goals or self.exploration or self.refinement or self.names != ("autonomous",)

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        twice = next((name for i, name in enumerate(self.names) if name in self.names[:i]), None)
        if twice:
            raise ValueError(f"{twice} is given twice among strategies and teachers")
        return self

    @model_validator(mode="after")
    def _maps_show_routes(self) -> Self:
        for teacher in self.teachers:
            if teacher.source == "map" and teacher.kind != "decomposition":
                raise ValueError(f"teacher {teacher.name}: source map shows routes only; allowed: kind decomposition")
        return self


class TrainerConfig(Section):
    """The host loop around the jitted epoch."""

    num_envs: Batch = Field(128, description="environments stepped together, per seed")
    total_env_steps: Annotated[int, Field(gt=0, lt=2**63)] = Field(
        2_000_000, description="env steps of all environments, per seed; the last epoch is finished"
    )
    seed: Annotated[int, Field(ge=0, lt=2**31)] = Field(0, description="first seed")
    num_seeds: Annotated[int, Field(gt=0, le=1024)] = Field(
        1, description="seeds trained side by side: seed, seed + 1, ..."
    )
    eval_every: Positive = Field(2, description="epochs between evaluations")
    eval_episodes: Batch = Field(100, description="episodes of each evaluation, per seed")
    checkpoint_every: Positive = Field(4, description="epochs between checkpoints")
    keep_checkpoints: Positive = Field(3, description="latest checkpoints kept, besides the best")
    on_non_finite: Literal["stop", "rollback"] = Field(
        "stop",
        description="when a number is NaN or infinite: stop, or go on from the last checkpoint with smaller steps",
    )
    rollback_factor: float = Field(
        0.5, gt=0, lt=1, description="on_non_finite rollback: on all learning rates of the seed, each time"
    )
    rollbacks: Positive = Field(3, description="on_non_finite rollback: of one seed, before the run stops after all")
    device: Literal["auto", "cpu", "gpu"] = Field("auto", description="where to train")
    devices: Positive = Field(1, description="GPUs (or others) that share the environments of each seed")
    sinks: tuple[Literal["tensorboard", "wandb"], ...] = Field(
        (), description="where metrics go besides metrics.jsonl: tensorboard, wandb"
    )

    @field_validator("sinks")
    @classmethod
    def _sinks_differ(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        twice = next((name for i, name in enumerate(value) if name in value[:i]), None)
        if twice:
            raise ValueError(f"{twice} is given twice")
        return value


class Config(Section):
    """A whole experiment."""

    env: EnvConfig = EnvConfig()
    commander: CommanderConfig = CommanderConfig()
    tutor: TutorConfig = TutorConfig()
    controller: ControllerConfig = ControllerConfig()
    abstraction: AbstractionConfig = AbstractionConfig()
    forward_model: ForwardModelConfig = ForwardModelConfig()
    refinement: RefinementConfig = RefinementConfig()
    sgim: SgimConfig = SgimConfig()
    trainer: TrainerConfig = TrainerConfig()

    @model_validator(mode="after")
    def _periods_fit(self) -> Self:
        if self.commander.period % self.tutor.period:
            raise ValueError(
                f"commander.period: {self.commander.period} is not a multiple of tutor.period {self.tutor.period}"
            )
        for name, section, decisions in self.learners():
            rollout = decisions * self.trainer.num_envs
            if section.learner == "ppo" and rollout % section.ppo.minibatches:
                raise ValueError(
                    f"{name}.ppo.minibatches: {section.ppo.minibatches} does not divide the rollout of {rollout} "
                    f"decisions ({decisions} of each of {self.trainer.num_envs} environments)"
                )
        return self

    @model_validator(mode="after")
    def _devices_share_evenly(self) -> Self:
        devices, num_envs = self.trainer.devices, self.trainer.num_envs
        shared = [("trainer.num_envs", num_envs, num_envs)]
        for name, section, decisions in self.learners():
            if section.learner == "td3":
                shared.append((f"{name}.td3.buffer_size", section.td3.buffer_size, section.td3.buffer_size))
            else:
                batch = decisions * num_envs // section.ppo.minibatches
                shared.append((f"{name}.ppo.minibatches", section.ppo.minibatches, batch))
        for key, value, size in shared:
            if size % devices:
                of = "" if size == value else f" makes minibatches of {size}, which"
                raise ValueError(f"{key}: {value}{of} cannot be shared evenly by trainer.devices {devices}")
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

    def learners(self) -> list[tuple[str, LevelConfig, int]]:
        """The levels that learn from rollouts: name, section, and decisions of each environment in a rollout."""
        tutor = [("tutor", self.tutor, self.tutor.unroll)] if self.tutor.enabled else []
        return [*tutor, ("controller", self.controller, self.tutor.period)]

    def agent(self) -> AgentConfig:
        """The sections that the jitted program sees."""
        return AgentConfig(**{name: getattr(self, name) for name in AgentConfig.model_fields})

    def to_yaml(self) -> str:
        """Every resolved value as YAML that `star.loading.load` accepts."""
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False)


class AgentConfig(Section):
    """The part of a `Config` that the jitted program sees; its floats are traced."""

    commander: CommanderConfig
    tutor: TutorConfig
    controller: ControllerConfig
    abstraction: AbstractionConfig
    forward_model: ForwardModelConfig
    refinement: RefinementConfig
    sgim: SgimConfig
