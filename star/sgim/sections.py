"""The settings of SGIM."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from star.config.section import Batch, Positive, Section


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
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = Field(
        None, description="of that file; a run notes it, and goes on with no other file"
    )
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
