"""The settings of SGIM."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from star.config.section import Batch, Positive, Section, setting

TeacherName = Annotated[str, Field(pattern=r"^[a-z0-9_]+$", max_length=64)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class SelectionConfig(Section):
    """SGIM's choice of regions, strategies and goals."""

    window: Annotated[int, Field(ge=4, le=2**20)] = setting(
        80, "So many episodes of each region are remembered.", unit="episodes"
    )
    per_block: Positive = setting(16, "Each region remembers at most so many episodes of one block.", unit="episodes")
    drift: float = setting(
        0.001, "The doubt about what a strategy adds begins with 1 and grows by this in a block.", unit="", gt=0
    )
    optimism: float = setting(
        0.01, "The root of a doubt of 1 is worth at most this.", unit="competence per block", ge=0
    )
    forgetting: float = setting(
        0.0, "Lost competence is worth this share of an equal gain; 1 is absolute progress.", unit="", ge=0, le=1
    )
    random: float = setting(0.05, "This share of choices is drawn evenly.", unit="", ge=0, le=1)
    best: float = setting(0.2, "This share of choices has its goal near a region's best point.", unit="", ge=0, le=1)
    best_point: Literal["progress", "worst"] = setting(
        "progress", "The best point of a region is where competence grew most, or where it is lowest."
    )
    sharpness: float = setting(12.0, "Choices are drawn in proportion to interest to this power.", unit="", gt=0)
    focus: float = setting(
        0.1, "Near the best point means within this share of the region's width.", unit="", gt=0, le=1
    )

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


class CuttingConfig(SelectionConfig):
    """SGIM's choice in regions that it cuts by itself."""

    min_side: Positive = setting(8, "So many remembered goals lie on each side of a cut at least.", unit="goals")
    min_width: float = setting(1e-3, "No region is cut narrower than this.", unit="units of goals", gt=0)


class EpochSelectionConfig(SelectionConfig):
    """SGIM's choices where many environments make them from the same state: spread more widely."""

    sharpness: float = setting(
        2.0,
        "Choices are drawn in proportion to interest to this power.",
        unit="",
        gt=0,
    )


class TeacherConfig(Section):
    """One teacher: demonstrations, what they are used for, and what it takes to ask."""

    name: TeacherName = setting(..., "Metrics and figures call the teacher by this name.")
    kind: Literal["action", "outcome", "decomposition"] = setting(
        ..., "The teacher shows movements to imitate, outcomes to aim at, or routes to a goal."
    )
    source: str = setting(
        "map",
        "The demonstrations come from this file, or are shortest paths on the map, which show routes only.",
        allowed="a file (.npz), or map",
    )
    sha256: Sha256 | None = setting(None, "The file has this checksum; a run notes it, and goes on with no other file.")
    flaw: Literal["repetitive", "wrong_half", "other_body"] | None = setting(
        None, "This makes it a poor teacher, for experiments."
    )
    cost: float = setting(1.0, "An episode with the teacher costs so many times what one alone does.", unit="", gt=0)
    availability: float = setting(1.0, "The teacher is there in this share of epochs.", unit="", ge=0, le=1)
    max_queries: Positive | None = setting(
        None, "So many episodes may be asked for; with null any number.", unit="episodes"
    )


class SgimConfig(Section):
    """SGIM in the trainer: intrinsic motivation chooses goals, strategies, teachers, targets and what to examine."""

    goals: bool = setting(False, "Training goals are chosen by progress, not drawn as the task says.")
    strategies: tuple[Literal["autonomous", "babbling", "decomposition"], ...] = setting(
        ("autonomous",),
        "These are the ways to practise alone: as ever, by random subgoals, or via a region.",
        min_length=1,
    )
    teachers: tuple[TeacherConfig, ...] = setting(
        (), "These teachers may be asked for help.", allowed="with the keys below", max_length=64
    )
    ask: Literal["progress", "evenly"] = setting(
        "progress", "The strategy is chosen by progress over cost, or each as often, as in SGIM-D."
    )
    unaided: bool = setting(True, "With ask progress, who would ask goes alone as often as the region is mastered.")
    exploration: bool = setting(False, "The Commander's random targets are drawn by progress.")
    refinement: bool = setting(False, "Edges half mastered and without progress are examined first.")
    waypoint_radius: float = setting(2.0, "A waypoint counts as passed within this distance.", unit="m", gt=0)
    detours: bool = setting(True, "Regions a teacher only reaches around others are not believed reached directly.")
    subgoals: bool = setting(
        True, "On the way to a teacher's waypoint the Tutor is shown subgoals straight ahead, to imitate."
    )
    margin: float = setting(0.0, "Learner q values a teacher's choice above all others by this.", unit="", ge=0)
    imitation: float = setting(
        1.0, "Demonstrations have this weight in the losses of the Tutor's and Controller's actors.", unit="", ge=0
    )
    imitation_batch: Batch = setting(
        256, "Each update of these actors imitates so many demonstrated actions.", unit="actions"
    )
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
        """True if there is a teacher who sets the Tutor's subgoals."""
        return self.subgoals and bool(self.routes)

    @property
    def enabled(self) -> bool:
        """True if anything is left to intrinsic motivation."""
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
