"""The settings of tutoring."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from star.config.run import EXPERIMENTS, RunConfig
from star.config.section import Batch, Positive, Repeats, Section, setting
from star.sgim.sections import SelectionConfig


class CourseConfig(Section):
    """Skills with prerequisites, and exercises that need them; each seed draws its own."""

    skills: Annotated[int, Field(ge=2, le=256)] = setting(10, "There are so many skills.", unit="skills")
    exercises: Annotated[int, Field(ge=2, le=4096)] = setting(
        30, "There are so many exercises, at least one for each skill.", unit="exercises"
    )
    needs: Annotated[int, Field(ge=0, le=4096)] = setting(
        30, "So many needs of exercises are dealt out besides the first one of each.", unit="needs"
    )

    @model_validator(mode="after")
    def _each_skill_has_an_exercise(self) -> Self:
        if self.exercises < self.skills:
            raise ValueError(f"exercises {self.exercises} are fewer than skills {self.skills}")
        return self


class StudentsConfig(Section):
    """Simulated students."""

    number: Batch = setting(100, "The tutor teaches so many students, each by itself.", unit="students")
    guess: float = setting(
        0.2, "An exercise that a student fails is scored right with this chance.", unit="", ge=0, lt=1
    )
    slip: float = setting(
        0.1, "An exercise that a student solves is scored wrong with this chance.", unit="", ge=0, lt=1
    )


class SkillSelectionConfig(SelectionConfig):
    """SGIM's choice of skills: one exercise is a block, and its goals are not points in a space."""

    window: Annotated[int, Field(ge=4, le=2**20)] = setting(
        4, "So many episodes of each region are remembered.", unit="episodes"
    )
    per_block: Positive = setting(1, "Each region remembers at most so many episodes of one block.", unit="episodes")
    best: float = setting(0.0, "This share of choices has its goal near a region's best point.", unit="", ge=0, le=1)
    optimism: float = setting(0.1, "The root of a doubt of 1 is worth at most this.", unit="competence per block", ge=0)
    sharpness: float = setting(1.0, "Choices are drawn in proportion to interest to this power.", unit="", gt=0)


class TeachingConfig(Section):
    """The choice of exercises."""

    tutor: Literal["random", "fixed", "zpdes", "progress", "sgim_graph"] = setting(
        "sgim_graph", "This tutor chooses the exercises."
    )
    graph: Literal["true", "found", "none", "wrong"] = setting(
        "true", "The tutor knows the true graph, the one found from earlier students, none, or a random one."
    )
    sure: float = setting(
        1.0, "Of a graph found the tutor obeys the edges that this share of models have.", unit="", ge=0, le=1
    )
    rate: float = setting(
        0.2, "Each score moves the running success by this share of the difference.", unit="", gt=0, le=1
    )
    validated: float = setting(0.6, "Above this running success a prerequisite is validated.", unit="", ge=0, le=1)
    mastered: float = setting(0.8, "Above this running success a skill is practised no more.", unit="", ge=0, le=1)
    next: float = setting(0.8, "Above this running success the fixed tutor goes on.", unit="", ge=0, le=1)
    exercises: Repeats = setting(10, "Each student has so many exercises in an epoch.", unit="exercises")
    selection: SkillSelectionConfig = SkillSelectionConfig()


class DiscoveryConfig(Section):
    """The search for the graph from the scores of earlier students."""

    students: Batch = setting(400, "So many earlier students chose exercises at random.", unit="students")
    exercises: Repeats = setting(300, "Each of them chose so many.", unit="exercises")
    preference: float = setting(
        1.0, "Each of them prefers each skill by the logarithm of odds with this deviation.", unit="", ge=0
    )
    members: Annotated[int, Field(gt=0, le=256)] = setting(
        4, "So many models are fitted, each to students drawn anew.", unit="models"
    )
    steps: Repeats = setting(1000, "Each model takes so many steps.", unit="steps")
    batch: Batch = setting(1024, "Each step is of so many scores.", unit="scores")
    learning_rate: float = setting(0.05, "The first step size of Adam; it falls to 0.", unit="", gt=0)
    sparsity: float = setting(1e-3, "A certain edge costs this, over the number of skills.", unit="nats", ge=0)
    one_way: float = setting(
        0.1, "Certain edges both ways cost twice this besides, over the number of skills.", unit="nats", ge=0
    )
    threshold: float = setting(0.05, "Edges above this strength are kept, but for cycles.", unit="", ge=0, lt=1)


class Config(RunConfig):
    """All settings of tutoring."""

    experiment: str = setting("tutoring", "This is what learns.", allowed=EXPERIMENTS)
    course: CourseConfig = CourseConfig()
    students: StudentsConfig = StudentsConfig()
    teaching: TeachingConfig = TeachingConfig()
    discovery: DiscoveryConfig = DiscoveryConfig()
