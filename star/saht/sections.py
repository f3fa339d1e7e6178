"""The settings of SGIM-SAHT."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from star.config.run import EXPERIMENTS, RunConfig, TrainerConfig, module_name, simple
from star.config.section import Positive, Section, setting
from star.sgim.sections import CuttingConfig, Sha256, TeacherName


class WorldConfig(Section):
    """The world in which skills are learnt."""

    name: str = setting(
        "pen", "Skills are learnt in this world.", allowed="a world that `star envs` lists, or module:name of your own"
    )
    noise: float = setting(
        0.0, "All numbers of executed primitives get noise of this standard deviation.", unit="", ge=0, le=1
    )
    options: dict[str, Any] = setting({}, "These options are passed to the world.", allowed="options of the world")

    _import_nothing_that_only_a_file_names = field_validator("name")(module_name)
    _refuse_what_no_option_holds = field_validator("options")(simple)


class TeacherConfig(Section):
    """One teacher, or one for each task: what is shown, and what it takes to ask."""

    name: TeacherName | None = setting(
        None, "Metrics and figures call the teacher by this name; with null by kind and task."
    )
    kind: Literal["action", "outcome", "procedure"] = setting(
        ..., "The teacher shows sequences to imitate, outcomes to aim at, or two goals that make up one."
    )
    task: str | None = setting(
        None, "The teacher knows this task; with null there is one teacher for each task that can be shown."
    )
    source: str = setting(
        "world",
        "Demonstrations come from the world's own teachers, or from this file.",
        allowed="world, or a file (.npz)",
    )
    sha256: Sha256 | None = setting(None, "The file has this checksum; a run notes it, and goes on with no other file.")
    demos: Annotated[int, Field(gt=0, le=10_000)] = setting(
        10, "The world's teacher shows so many demonstrations.", unit="demonstrations"
    )
    flaw: Literal["repetitive", "other_body"] | None = setting(None, "This makes it a poor teacher, for experiments.")
    cost: float | None = setting(
        None, "An iteration with the teacher costs so many times one alone; with null saht.cost.", unit="", gt=0
    )
    availability: float = setting(1.0, "The teacher is there in this share of epochs.", unit="", ge=0, le=1)
    max_queries: Positive | None = setting(
        None, "So many iterations may be asked for; with null any number.", unit="iterations"
    )

    @model_validator(mode="after")
    def _files_name_their_task(self) -> Self:
        if self.task is None and (self.source != "world" or self.name is not None):
            raise ValueError("a teacher with a file or a name needs its task")
        if self.kind == "procedure" and self.flaw is not None:
            raise ValueError(f"flaw: {self.flaw!r} is of teachers with demonstrations; allowed with procedure: null")
        return self


class ChoiceConfig(Section):
    """The choice of task, strategy and goal by progress over cost."""

    random: float = setting(0.1, "This share of choices is drawn evenly.", unit="", ge=0, le=1)
    tasks: float = setting(1.0, "Tasks are drawn in proportion to their best interest to this power.", unit="", gt=0)
    sharpness: float = setting(
        2.0, "Strategies are drawn in proportion to their interest in the task to this power.", unit="", gt=0
    )
    optimism: float = setting(
        0.003, "The root of a doubt of 1 is worth at most this.", unit="competence per block", ge=0
    )
    drift: float = setting(
        0.001, "The doubt about what a strategy adds begins with 1 and grows by this in a block.", unit="", gt=0
    )
    reached: float = setting(
        0.1, "An outcome reached on the way tells this much of what the goal tells.", unit="", ge=0, le=1
    )
    regions: Annotated[int, Field(gt=0, le=1024)] = setting(
        32, "Goals are drawn in so many regions at most, each of one task.", unit="regions"
    )

    @property
    def selection(self) -> CuttingConfig:
        """The same for `star.sgim.selection`."""
        return CuttingConfig.model_construct(
            random=self.random, sharpness=self.sharpness, optimism=self.optimism, drift=self.drift
        )


class SahtConfig(Section):
    """A learner's abilities and choices."""

    strategies: tuple[Literal["random", "actions", "procedures", "dagger", "cba"], ...] = setting(
        ("actions",),
        "These are the ways to practise: at random, by what is near the goal, or by two subgoals; "
        "and imitation learning, which asks the world's teachers by itself.",
    )
    teachers: tuple[TeacherConfig, ...] = setting(
        (), "These teachers may be asked for help.", allowed="with the keys below", max_length=64
    )
    ask_every: Positive | None = setting(
        None, "A teacher is asked in every so-many-th block and in no other; with null by progress.", unit="blocks"
    )
    cost: float = setting(2.0, "An iteration with a teacher costs so many times one alone.", unit="", gt=0)
    choice: ChoiceConfig = ChoiceConfig()
    block: Annotated[int, Field(gt=0, le=1000)] = setting(
        10, "So many iterations in a row have the same goal and strategy.", unit="iterations"
    )
    generation: Annotated[int, Field(gt=0, le=1000)] = setting(
        10, "So many of them are executed at once; with 1 each knows of the one before.", unit="iterations"
    )
    epoch: Annotated[int, Field(gt=0, le=100_000)] = setting(
        500, "So many iterations lie between two lines of metrics.", unit="iterations"
    )
    memory: Annotated[int, Field(gt=0, le=2**24)] | None = setting(
        None, "So many sequences are remembered; with null those of the whole run.", unit="sequences"
    )

    @model_validator(mode="after")
    def _parts_fit(self) -> Self:
        if self.block % self.generation:
            raise ValueError(f"generation: {self.generation} does not divide block {self.block}")
        if self.epoch % self.block:
            raise ValueError(f"epoch: {self.epoch} is not a multiple of block {self.block}")
        if not self.strategies and not self.teachers:
            raise ValueError("strategies: there are none, and no teachers; allowed: one of either or more")
        twice = next((name for i, name in enumerate(self.strategies) if name in self.strategies[:i]), None)
        if twice:
            raise ValueError(f"strategies: {twice} is given twice")
        if not self.strategies and any(one.availability < 1 or one.max_queries for one in self.teachers):
            raise ValueError("strategies: there are none, so teachers need availability 1 and max_queries null")
        paired = [name for name in self.strategies if name in ("dagger", "cba")]
        if paired and self.generation % 2:
            raise ValueError(f"generation: {self.generation} is odd; {paired[0]} needs pairs of iterations")
        if self.ask_every is not None and not (self.strategies and self.teachers):
            raise ValueError("ask_every: needs strategies and teachers to change between")
        return self


class SahtTrainer(TrainerConfig):
    """The host loop around the jitted epoch."""

    total_env_steps: Annotated[int, Field(gt=0, lt=2**24)] = setting(
        25_000, "Each seed practises for so many iterations; the last epoch is finished.", unit="iterations"
    )
    eval_every: Positive = setting(5, "An evaluation follows every so many epochs.", unit="epochs")
    checkpoint_every: Positive = setting(25, "A checkpoint is written every so many epochs.", unit="epochs")


class Learner(Section):
    """The settings for the jitted functions."""

    saht: SahtConfig = SahtConfig()


class Config(RunConfig):
    """A whole experiment."""

    experiment: str = setting("saht", "This is what learns.", allowed=EXPERIMENTS)
    world: WorldConfig = WorldConfig()
    saht: SahtConfig = SahtConfig()
    trainer: SahtTrainer = SahtTrainer()

    @model_validator(mode="after")
    def _there_is_an_epoch(self) -> Self:
        if self.trainer.total_env_steps < self.saht.epoch:
            raise ValueError(
                f"trainer.total_env_steps: {self.trainer.total_env_steps} is less than an epoch, "
                f"saht.epoch {self.saht.epoch}"
            )
        return self

    def hyper(self) -> Learner:
        """The settings for the jitted functions; they have the world of the experiment."""
        return Learner(saht=self.saht)
