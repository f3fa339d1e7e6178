"""The package in Python: `star.train`, `star.evaluate` and `star.load`, by the parts that the commands are made of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from envs.common.errors import UserError, shown
from envs.common.files import given_back, new_place
from star.config import agents, kinds
from star.config.loading import experiment_of, kind_of, load_to_act, parse
from star.config.loading import load as load_config
from star.config.run import RunConfig

_SETTINGS = "settings"  # what errors call those that were passed
_DOTTED = "a mapping of dotted keys"


def train(
    config: str | Path | Mapping[str, Any] | RunConfig,
    settings: Mapping[str, Any] | None = None,
    *,
    layers: Sequence[str | Path] = (),
    run_dir: str | Path | None = None,
    quiet: bool = True,
) -> dict[str, Any]:
    """Train a run to its end, as `star train` does; Ctrl-C writes a checkpoint and returns.

    Args:
      config: the name of a config, a YAML file, or its nested values.
      settings: others by their dotted keys, as `{"trainer.num_seeds": 5}`.
      layers: names or files that are laid over `config`, as `--with` does.
      run_dir: where to write; None: a new folder in `runs/`.
      quiet: no progress on stderr.

    Returns:
      `run`, its folder; `env_steps` of each seed; the first measure by its name, as `success_final`, the mean over
      seeds in the latest evaluation or None; `interrupted`; and `fault`, what was not finite, or None.

    Raises:
      UserError: in one line, if something is wrong.
    """
    from star.training import trainer  # after what can be refused at once

    resolved = _config(config, settings or {}, layers)
    kind = kinds.of(resolved)
    place = Path(run_dir) if run_dir is not None else new_place(Path("runs"), _name(config, layers, kind, resolved))
    with given_back(place):
        result = trainer.train(resolved, place, quiet=quiet)
    return {
        "run": str(result.run_dir),
        "env_steps": result.env_steps,
        kind.measures[0].name: result.score,
        "interrupted": result.interrupted,
        "fault": None if result.fault is None else str(result.fault),
    }


def evaluate(
    run: str | Path,
    settings: Mapping[str, Any] | None = None,
    *,
    checkpoint: str | int = "last",
    seed: int = 0,
) -> dict[str, Any]:
    """Evaluate a checkpoint of a run, as `star evaluate RUN --json` does.

    Args:
      run: the folder of the run, or the name of an agent that comes with the package.
      settings: by their dotted keys, as `{"trainer.eval_episodes": 200}`; those of `env.name` and `env.options` send
        the agents to another task.
      checkpoint: "last", "best", or its env steps.
      seed: chooses starts and goals.

    Returns:
      The numbers of the checkpoint, with those of each seed under `seeds`.

    Raises:
      UserError: in one line, if something is wrong.
    """
    if checkpoint == "all":
        raise UserError("checkpoint: 'all' is not allowed: should be last, best or env steps")
    run_dir = agents.find(_path(run))
    _check_keys(settings or {}, _SETTINGS, allowed=_DOTTED)
    measure = kind_of(run_dir).commands.get("measure", _measure)
    (row,) = measure(run_dir, settings or {}, checkpoint=str(checkpoint), seed=seed)
    return row


def load(run: str | Path, *, checkpoint: str | int = "last", seed: int | None = None) -> Any:
    """The trained agent of a run, to act with: of STAR's runs a `star.agent.acting.TrainedAgent`.

    Args:
      run: the folder of the run, or the name of an agent that comes with the package.
      checkpoint: "last", "best", or its env steps.
      seed: which agent of the run; None: its first.

    Raises:
      UserError: in one line, if there is no such run or checkpoint, or its experiment has no agent that acts.
    """
    run_dir = agents.find(_path(run))
    commands = kind_of(run_dir).commands
    if "load" not in commands:
        name = experiment_of(run_dir)
        raise UserError(f"{run}: is a run of experiment {name}, which has no agent that acts")
    return commands["load"](run_dir, checkpoint=str(checkpoint), seed=seed)


def _config(config: Any, settings: Mapping[str, Any], layers: Sequence[str | Path]) -> RunConfig:
    """The validated settings of a run."""
    if not isinstance(config, str | Path | RunConfig):
        _check_keys(config, "config", allowed="a name, a file, or a mapping of sections")
    _check_keys(settings, _SETTINGS, allowed=_DOTTED)
    if isinstance(config, str | Path):
        return load_config(config, settings, layers=layers, typed=_SETTINGS)
    if layers:
        raise UserError("layers: need a config that is a name or a file")
    values = config.model_dump(mode="json") if isinstance(config, RunConfig) else config
    return parse(values, settings, typed=_SETTINGS)


def _check_keys(given: Any, name: str, *, allowed: str) -> None:
    """Raise `UserError` for what is no mapping whose keys are text."""
    if not (isinstance(given, Mapping) and all(isinstance(key, str) for key in given)):
        raise UserError(f"{name}: {shown(given)} is not allowed: should be {allowed}")


def _path(run: Any) -> Path:
    """The folder or name of a run."""
    if not isinstance(run, str | Path):
        raise UserError(f"run: {shown(run)} is not allowed: should be the folder of a run, or the name of an agent")
    return Path(run)


def _name(config: Any, layers: Sequence[str | Path], kind: kinds.Kind, resolved: RunConfig) -> str:
    """The name of a run's folder, before the time."""
    files = [config, *layers] if isinstance(config, str | Path) else []
    return "-".join(Path(file).stem for file in files) or Path(kind.title(resolved)).name


def _measure(run_dir: Path, settings: Mapping[str, Any], *, checkpoint: str, seed: int) -> list[dict[str, Any]]:
    """The rows of an experiment that has no `measure` of its own."""
    from star.report import evaluations

    return evaluations.evaluate(load_to_act(run_dir, settings), run_dir, checkpoint=checkpoint, seed=seed)
