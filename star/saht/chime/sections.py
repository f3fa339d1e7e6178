"""The settings of CHIME."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from star.config.run import EXPERIMENTS, RunConfig, TrainerConfig
from star.config.section import Positive, Section, setting
from star.sgim.sections import SelectionConfig


class RoomConfig(Section):
    """The room."""

    movable: Annotated[int, Field(ge=0, le=4)] = setting(2, "The robot can push so many discs.", unit="discs")
    fixed: Annotated[int, Field(ge=0, le=4)] = setting(1, "So many discs cannot be moved.", unit="discs")
    wall: bool = setting(True, "A wall stands in the room.")

    @property
    def given(self) -> int:
        """Tasks that can be learnt: the robot, each object by the robot, and each by every object before it."""
        return 1 + self.movable + self.movable * (self.movable - 1) // 2


class ChoiceConfig(Section):
    """The choice of a task, and of a way to practise it, by progress."""

    random: float = setting(0.1, "This share of choices is drawn evenly.", unit="", ge=0, le=1)
    sharpness: float = setting(2.0, "Choices are drawn in proportion to interest to this power.", unit="", gt=0)
    optimism: float = setting(
        0.003, "The root of a doubt of 1 is worth at most this.", unit="competence per block", ge=0
    )
    drift: float = setting(
        0.005, "The doubt about what a strategy adds begins with 1 and grows by this in a block.", unit="", gt=0
    )

    @property
    def selection(self) -> SelectionConfig:
        """The same for `star.sgim.selection`, which remembers no goals here."""
        own = {name: getattr(self, name) for name in ChoiceConfig.model_fields}
        return SelectionConfig.model_construct(**own, best=0.0, window=4, per_block=1)


class ChimeConfig(Section):
    """The birth of tasks, and the evolution of their models."""

    tasks: Literal["emerge", "given", "none"] = setting(
        "emerge", "Tasks are found, or all are given at the start, or there are none and actions are random."
    )
    models: Annotated[int, Field(gt=0, le=64)] = setting(8, "So many models are kept at most.", unit="models")
    candidates: Annotated[int, Field(gt=0, le=256)] = setting(
        16, "So many new or changed models are tried at a time.", unit="models"
    )
    trial: Positive = setting(4, "A candidate is judged after so many evolutions.", unit="evolutions")
    birth: float = setting(0.3, "A new model needs this competence.", unit="competence", ge=0, le=1)
    controllable: float = setting(
        0.4, "An observable is controllable if a model of it has this competence.", unit="competence", ge=0, le=1
    )
    gain: float = setting(0.1, "A candidate is better if it makes an error smaller by this share.", unit="", ge=0, lt=1)
    smooth: float = setting(
        0.3, "Each evolution moves a competence by this share of the difference.", unit="", gt=0, le=1
    )
    lowest: float = setting(0.2, "A model below this competence is of no use.", unit="competence", ge=0, le=1)
    patience: Positive = setting(
        5, "A model that is of no use so often more than of use is switched off.", unit="evolutions"
    )
    few: Annotated[int, Field(ge=4)] = setting(
        6, "A model is tried when its outcome has moved so often with its control.", unit="actions"
    )
    steps: Annotated[int, Field(gt=0, le=10_000)] = setting(
        40, "Each model takes so many steps of Adam in an evolution.", unit="steps"
    )
    batch: Annotated[int, Field(gt=0, le=2**16)] = setting(64, "Each step is on so many actions.", unit="actions")
    held: Annotated[int, Field(gt=0, le=2**16)] = setting(
        256, "Competence is measured on so many draws of actions that were held out.", unit="draws"
    )
    episode: Annotated[int, Field(gt=0, le=10_000)] = setting(
        20, "After so many actions all discs are put somewhere else.", unit="actions"
    )
    blocks: Annotated[int, Field(gt=0, le=10_000)] = setting(
        2, "Models evolve after so many episodes: an epoch.", unit="episodes"
    )
    memory: Annotated[int, Field(gt=0, le=2**24)] = setting(5000, "So many actions are remembered.", unit="actions")
    choice: ChoiceConfig = ChoiceConfig()

    @property
    def epoch(self) -> int:
        """Actions in an epoch."""
        return self.episode * self.blocks

    @model_validator(mode="after")
    def _parts_fit(self) -> Self:
        if self.episode % 2:
            raise ValueError(f"episode: {self.episode} is odd; a plan is followed for two actions")
        if self.memory % self.epoch or self.memory % 4:
            raise ValueError(
                f"memory: {self.memory} is not a multiple of 4 and of the {self.epoch} actions of an epoch, "
                f"episode {self.episode} x blocks {self.blocks}"
            )
        return self


class ChimeTrainer(TrainerConfig):
    """The host loop around the jitted epoch."""

    total_env_steps: Annotated[int, Field(gt=0, lt=2**24)] = setting(
        12_000, "Each seed does so many actions; the last epoch is finished.", unit="actions"
    )
    eval_every: Positive = setting(25, "An evaluation follows every so many epochs.", unit="epochs")
    checkpoint_every: Positive = setting(25, "A checkpoint is written every so many epochs.", unit="epochs")


class Learner(Section):
    """The settings that jitted functions see."""

    chime: ChimeConfig = ChimeConfig()


class Config(RunConfig):
    """A whole experiment."""

    experiment: str = setting("chime", "This is what learns.", allowed=EXPERIMENTS)
    room: RoomConfig = RoomConfig()
    chime: ChimeConfig = ChimeConfig()
    trainer: ChimeTrainer = ChimeTrainer()

    @model_validator(mode="after")
    def _tasks_have_room(self) -> Self:
        if self.chime.tasks == "given" and self.chime.models < self.room.given:
            raise ValueError(
                f"chime.models: {self.chime.models} are fewer than the {self.room.given} tasks that are given"
            )
        return self

    def hyper(self) -> Learner:
        """The settings that jitted functions see; they have the room of the experiment."""
        return Learner(chime=self.chime)
