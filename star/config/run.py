"""The settings of a run that do not depend on who learns in it."""

from __future__ import annotations

from functools import cache
from types import NoneType
from typing import Annotated, Any, Literal

from pydantic import Field, create_model, field_validator

from envs.common import reading
from envs.common.errors import shown
from star.config import plugins
from star.config.section import Positive, Section


def _is_simple(value: Any) -> bool:
    """Whether `value` is what JSON has too, but for mappings: YAML knows dates and bytes as well."""
    if isinstance(value, list | tuple):
        return all(map(_is_simple, value))
    return isinstance(value, str | int | float | NoneType)


class EnvConfig(Section):
    """The task and the engine that simulates it."""

    name: str = Field("point_maze", description="task, one of `star envs`, or module:name of your own")
    engine: Literal["auto", "warp", "jax", "native"] = Field("auto", description="physics engine")
    options: dict[str, Any] = Field({}, description="options of the task, passed to envs.make")
    training: dict[str, Any] = Field({}, description="options that differ in training from those above")

    @field_validator("name")
    @classmethod
    def _import_nothing_that_only_a_file_names(cls, value: str) -> str:
        if plugins.is_plugin(value):
            plugins.check_trust(value)
        elif ":" in value:
            raise ValueError("should be module:function, a module that Python can import: no path, no .py, no hyphen")
        return value

    @field_validator("options", "training")
    @classmethod
    def _refuse_what_no_option_holds(cls, value: dict[str, Any]) -> dict[str, Any]:
        for name, option in value.items():
            if not _is_simple(option):
                raise ValueError(
                    f"{name}: {shown(option)} is not allowed: should be text, a number, true, false or a list"
                )
        return value


class TrainerConfig(Section):
    """The host loop around the jitted epoch."""

    total_env_steps: Annotated[int, Field(gt=0, lt=2**63)] = Field(
        2_000_000, description="env steps, or iterations, per seed; the last epoch is finished"
    )
    seed: Annotated[int, Field(ge=0, lt=2**31)] = Field(0, description="first seed")
    num_seeds: Annotated[int, Field(gt=0, le=1024)] = Field(
        1, description="seeds trained side by side: seed, seed + 1, ..."
    )
    eval_every: Positive = Field(2, description="epochs between evaluations")
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
    devices: Positive = Field(1, description="GPUs (or others) that share the work of each seed")
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


class RunConfig(Section):
    """What every experiment's settings have; it adds its own sections."""

    experiment: str = Field("star", description="what learns: star, or module:name of your own")
    trainer: TrainerConfig = TrainerConfig()

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        super().__pydantic_init_subclass__(**kwargs)
        fields = cls.__pydantic_fields__
        fields["trainer"] = fields.pop("trainer")  # after a kind's own sections
        cls.model_rebuild(force=True)

    def hyper(self) -> Section:
        """What the jitted functions see: all but the settings of the run. Its floats are traced."""
        kind = _hyper(type(self))
        return kind.model_construct(**{name: getattr(self, name) for name in kind.model_fields})

    def comparable(self) -> dict[str, Any]:
        """The values that decide whether a checkpoint can go on under other settings."""
        return self.model_dump(mode="json")

    def to_yaml(self) -> str:
        """Every resolved value as YAML that `star.config.loading.load` accepts."""
        return reading.written(self.model_dump(mode="json"))


@cache
def _hyper(config: type[RunConfig]) -> type[Section]:
    own = {name: field for name, field in config.model_fields.items() if name not in RunConfig.model_fields}
    parts: dict[str, Any] = {name: (field.annotation, ...) for name, field in own.items()}
    return create_model(f"{config.__name__}Hyper", __base__=Section, **parts)
