"""The settings of a run that do not depend on who learns in it."""

from __future__ import annotations

from functools import cache
from types import NoneType
from typing import Annotated, Any, Literal

from pydantic import Field, create_model, field_validator

from envs.common import plugins, reading
from envs.common.errors import shown
from star.config.section import Positive, Section, setting


def _is_simple(value: Any) -> bool:
    """True if `value` is what JSON has too, but for mappings: YAML knows dates and bytes as well."""
    if isinstance(value, list | tuple):
        return all(map(_is_simple, value))
    return isinstance(value, str | int | float | NoneType)


def simple(options: dict[str, Any]) -> dict[str, Any]:
    """`options`, if JSON could hold them; else raises `ValueError`."""
    for name, option in options.items():
        if not _is_simple(option):
            raise ValueError(f"{name}: {shown(option)} is not allowed: should be text, a number, true, false or a list")
    return options


def module_name(value: str) -> str:
    """`value`, if it is no module:name, or one whose module is trusted; else raises `ValueError`."""
    if plugins.is_plugin(value):
        plugins.check_trust(value)
    elif ":" in value:
        raise ValueError("should be module:function, a module that Python can import: no path, no .py, no hyphen")
    return value


class EnvConfig(Section):
    """The task and the engine that simulates it."""

    name: str = setting(
        "point_maze", "The agent learns this task.", allowed="a name that `star envs` lists, or module:name of your own"
    )
    engine: Literal["auto", "warp", "jax", "native"] = setting(
        "auto", "This physics engine simulates the task; auto takes the best of this machine."
    )
    options: dict[str, Any] = setting({}, "These options are passed to envs.make.", allowed="options of the task")
    training: dict[str, Any] = setting(
        {}, "These options differ in training from those above.", allowed="options of the task"
    )

    _import_nothing_that_only_a_file_names = field_validator("name")(module_name)
    _refuse_what_no_option_holds = field_validator("options", "training")(simple)


class TrainerConfig(Section):
    """The host loop around the jitted epoch."""

    total_env_steps: Annotated[int, Field(gt=0, lt=2**63)] = setting(
        2_000_000,
        "Each seed trains for so many env steps, or iterations; the last epoch is finished.",
        unit="env steps",
    )
    seed: Annotated[int, Field(ge=0, lt=2**31)] = setting(0, "This is the first seed.", unit="")
    num_seeds: Annotated[int, Field(gt=0, le=1024)] = setting(
        1, "So many seeds are trained side by side: seed, seed + 1, ...", unit="seeds"
    )
    eval_every: Positive = setting(2, "An evaluation follows every so many epochs.", unit="epochs")
    checkpoint_every: Positive = setting(4, "A checkpoint is written every so many epochs.", unit="epochs")
    keep_checkpoints: Positive = setting(
        3, "So many of the latest checkpoints are kept, besides the best.", unit="checkpoints"
    )
    on_non_finite: Literal["stop", "rollback"] = setting(
        "stop",
        "If a number is NaN or infinite, the run stops, or goes on from the last checkpoint with smaller steps.",
    )
    rollback_factor: float = setting(
        0.5, "Each rollback multiplies all learning rates of the seed by this.", unit="", gt=0, lt=1
    )
    rollbacks: Positive = setting(3, "After so many rollbacks of one seed the run stops after all.", unit="rollbacks")
    device: Literal["auto", "cpu", "gpu"] = setting("auto", "The run trains on this kind of device.")
    devices: Positive = setting(1, "So many GPUs, or others, share the work of each seed.", unit="devices")
    sinks: tuple[Literal["tensorboard", "wandb"], ...] = setting((), "Metrics go there, besides metrics.jsonl.")

    @field_validator("sinks")
    @classmethod
    def _sinks_differ(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        twice = next((name for i, name in enumerate(value) if name in value[:i]), None)
        if twice:
            raise ValueError(f"{twice} is given twice")
        return value


EXPERIMENTS = "star, saht, tutoring, chime, or module:name of your own"


class RunConfig(Section):
    """The settings of every experiment; each adds its own sections."""

    experiment: str = setting("star", "This is what learns.", allowed=EXPERIMENTS)
    trainer: TrainerConfig = TrainerConfig()

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        super().__pydantic_init_subclass__(**kwargs)
        fields = cls.__pydantic_fields__
        fields["trainer"] = fields.pop("trainer")  # after a kind's own sections
        cls.model_rebuild(force=True)

    def hyper(self) -> Section:
        """The settings for the jitted functions: all but the settings of the run. Its floats are traced."""
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
