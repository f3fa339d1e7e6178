"""YAML files, run folders and dotted overrides become the config of an experiment; what is wrong becomes one line."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from envs.common import reading
from envs.common.errors import UserError, shown
from envs.common.files import nearest_file
from envs.common.plainly import plain
from star.config import agents, kinds, shipped
from star.config.described import EACH, settings
from star.config.run import RunConfig
from star.config.section import ConfigError, Section

DEFAULT = "star"
"""The experiment of a config that names none."""


def load(
    path: str | Path,
    overrides: Mapping[str, Any] | None = None,
    *,
    layers: Sequence[str | Path] = (),
    typed: str = "command line",
) -> Any:
    """Read a YAML file, lay others over it, apply dotted overrides such as `{"tutor.period": 5}` and validate.

    Files are paths, or names of those that come with the package, such as `ant_maze` or `agents/hiro`. The result is a
    `Config` of the kind that its `experiment` names. `typed` says in errors where the overrides come from.

    Raises:
      UserError: with one line that names the key, the value and what is allowed.

    """
    values: dict[str, Any] = {}
    for file in (path, *layers):
        found = shipped.find(Path(file))
        if os.path.isfile(found / "config.yaml"):
            raise ConfigError(f"{file}: is a run, not a config; did you mean --resume {file}, or {file}/config.yaml?")
        read = read_file(found)
        if {"config", "parameters"} <= set(read):
            raise ConfigError(f"{file}: is a sweep file, for star sweep")
        values = _merged(values, read)
    return parse(values, overrides, source=" with ".join(map(str, (path, *layers))), typed=typed)


def experiment_of(run_dir: Path) -> str:
    """The name of the experiment of a run; raises `UserError` if the folder is none of a run."""
    return read_file(_config_file(run_dir)).get("experiment", DEFAULT)


def kind_of(run_dir: Path) -> kinds.Kind:
    """The kind of the experiment of a run; raises `UserError` that names the run."""
    try:
        return kinds.find(experiment_of(run_dir))
    except UserError as error:
        named = str(error).startswith(str(run_dir))
        raise ConfigError(str(error) if named else f"{_config_file(run_dir)}: {error}") from None


def load_run(run_dir: Path, overrides: Mapping[str, Any]) -> Any:
    """The settings of a run, with others in their place; raises `UserError`."""
    path = _config_file(run_dir)
    return parse(read_file(path), overrides, source=str(path), kept=True)


def load_to_act(run_dir: Path, overrides: Mapping[str, Any]) -> Any:
    """Those of a run whose agents act on this machine, whatever they were trained on; raises `UserError`."""
    anywhere = kind_of(run_dir).anywhere
    return load_run(run_dir, {"trainer.devices": 1} | dict(anywhere) | dict(overrides))


def _config_file(run_dir: Path) -> Path:
    path = run_dir / "config.yaml"
    try:
        if not run_dir.exists():
            meant = agents.near(run_dir)
            raise ConfigError(f"{run_dir}: is not a run directory, there is nothing of this name{meant}")
        if run_dir.is_file():
            raise ConfigError(f"{run_dir}: is a file, not a run directory")
        if not path.is_file():
            raise ConfigError(f"{run_dir}: is not a run directory, it holds no config.yaml")
    except OSError as error:
        raise ConfigError(f"{run_dir}: cannot be read: {error.strerror}") from None
    return path


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """`below` with what `above` says in its place, section by section; another task brings options of its own."""
    another = "name" in above and above["name"] != below.get("name")
    merged = {key: old for key, old in below.items() if not (another and key in ("options", "training"))}
    for key, value in above.items():
        old = merged.get(key)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            merged[key] = _merged(old, value)
        else:
            merged[key] = value
    return merged


def read_file(path: Path) -> dict[str, Any]:
    """The values of a YAML file with sections; raises `UserError`."""
    try:
        values = reading.plain(reading.text(path))
    except FileNotFoundError:
        near = [nearest_file(path, (".yaml", ".yml")), shipped.near(path)]
        meant = next(filter(None, near if path.suffix else reversed(near)), "")
        raise ConfigError(f"{path}: no such file{meant}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or 'not UTF-8 text'}") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" line {mark.line + 1} column {mark.column + 1}:" if mark else ""
        raise ConfigError(f"{path}:{where} not valid YAML: {reading.problem(error)}") from None
    if values is None:
        values = {}
    if not isinstance(values, dict):
        raise ConfigError(f"{path}: should hold sections such as `trainer:`, not {shown(values)}")
    return values


def parse(
    values: Mapping[str, Any],
    overrides: Mapping[str, Any] | None = None,
    *,
    source: str = "configuration",
    typed: str = "command line",
    kept: bool = False,
) -> Any:
    """Validate nested `values` after applying dotted `overrides`; raises `UserError`. As in `load`.

    `source` says in errors where the values come from, and `typed` where the overrides do. What is `kept` by a run or a
    checkpoint names all settings that there were: one that it does not name is newer, and one may be gone.
    """
    given, told = plain(values), plain(overrides or {})
    try:
        kind = kinds.find(told.get("experiment", given.get("experiment", DEFAULT)))
    except UserError as error:
        culprit = typed if "experiment" in (overrides or {}) else source
        raise ConfigError(f"{culprit}: {error}") from None
    model = kind.Config
    nested = _with_overrides(_without(given, kind.gone) if kept else given, told)
    if kept:
        nested = _merged(_with_overrides({}, kind.older), nested)
    try:
        return model.model_validate(nested)
    except ValidationError as error:
        first = first_of(error)
        mine = _is_among(overrides or {}, first["loc"]) or (not first["loc"] and overrides and _fits(values, model))
        raise ConfigError(f"{typed if mine else source}: {explain(first, model)}") from None


def first_of(error: ValidationError) -> ErrorDetails:
    """The error to tell of: the first, but a key that is unknown rather than one that is missing for it."""
    found = error.errors()
    unknown = [one for one in found if one["type"] == "extra_forbidden"]
    return unknown[0] if unknown and found[0]["type"] == "missing" else found[0]


def _fits(values: Mapping[str, Any], model: type[BaseModel]) -> bool:
    """True if these values go together by themselves."""
    try:
        model.model_validate(plain(values))
    except ValidationError:
        return False
    return True


def _is_among(overrides: Mapping[str, Any], place: Sequence[str | int]) -> bool:
    """True if what is wrong at this `place` is one of the `overrides`, or a section or a part of one."""
    return any(all(a == str(b) for a, b in zip(key.split("."), place, strict=False)) for key in overrides if place)


def check_setting(config: RunConfig, key: str, value: Any, *, source: str) -> None:
    """Raise `UserError` if there is no setting `key`, or `value` is none of its values whatever the others are."""
    try:
        type(config).model_validate(_with_overrides(config.model_dump(mode="json"), {key: value}))
    except ValidationError as error:
        for each in error.errors():
            if each["type"] == "extra_forbidden" or ".".join(map(str, each["loc"])).startswith(key):
                raise ConfigError(f"{source}: {explain(each, type(config))}") from None


def type_of(key: str, model: type[RunConfig]) -> Any:
    """The type of the setting `key` of a `model`, or None if there is none or it is an option of the task."""
    annotation: Any = model
    for part in key.split("."):
        known = getattr(annotation, "model_fields", {})
        if part not in known:
            return None
        annotation = known[part].annotation
    return annotation


def fields(section: type[Section]) -> Iterator[tuple[str, Any, str]]:
    """All settings as (dotted key, default, description), without those of what is in lists."""
    return ((one.key, one.default, one.about) for one in settings(section) if EACH not in one.key)


def dotted(config: RunConfig) -> dict[str, Any]:
    """The settings of `config` by their dotted keys, as overrides have them; task options have keys of their own."""
    return flat(config.model_dump(mode="json"))


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested `values` by dotted keys."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        found |= flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return found


def changed(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that `after` has, by its dotted keys, and `before` has not or not so."""
    return {key: value for key, value in after.items() if key not in before or before[key] != value}


def _with_overrides(values: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    nested = {key: dict(value) if isinstance(value, Mapping) else value for key, value in values.items()}
    for key, value in overrides.items():
        *parents, last = key.split(".")
        level = nested
        for parent in parents:
            child = level.get(parent)
            level[parent] = dict(child) if isinstance(child, Mapping) else {}
            level = level[parent]
        level[last] = value
    return nested


def _without(values: Mapping[str, Any], keys: Sequence[str]) -> dict[str, Any]:
    """Nested `values` but for these dotted `keys`."""
    left = dict(values)
    for key in keys:
        name, _, rest = key.partition(".")
        if not rest:
            left.pop(name, None)
        elif isinstance(inner := left.get(name), Mapping):
            left[name] = _without(inner, [rest])
    return left


_PLAIN = {
    "a valid tuple": "a list such as [a, b]",
    r"a valid dictionary( or instance of \w+)?": "a mapping such as {key: value}",
    "a valid boolean(, unable to interpret input)?": "true or false",
    "False, True": "false, true",
    r"a valid integer(, (unable to parse.*|got a number with a fractional part))?": "a whole number",
    r"[Uu]nable to parse input string as an integer, exceeded maximum size": "should be a smaller whole number",
    r"a valid number(, unable to parse.*)?": "a number",
    r"[Ii]nput is not a valid path for .*": "should be the name of a file",
    r"[Dd]ictionary should have at least 1 item.*": "should name at least one",
    r"[Tt]uple should have at least 1 item.*": "should have at least one",
    "greater than or equal to": "at least",
    "less than or equal to": "at most",
}  # pydantic's words (regular expressions), and what users of YAML say


def explain(error: ErrorDetails, model: type[BaseModel]) -> str:
    """One pydantic error of `model` as one line: key, value, what is allowed."""
    path = [part if len(part) <= 60 else f"{part[:57]}..." for part in map(str, error["loc"])]
    key = ".".join(path)
    if error["type"] == "extra_forbidden":
        return f"{key}: unknown key{_nearest_key(path, model)}"
    if error["type"] == "missing":
        return f"{key}: is missing"
    message = error["msg"].removeprefix("Value error, ").replace("Input should be", "should be")
    for words, ours in _PLAIN.items():
        message = re.sub(words, ours, message)
    message = message[:1].lower() + message[1:]
    if error["type"] == "value_error" and not isinstance(error["input"], str | int | float | bool):
        return f"{key}: {message}" if key else message
    if error["type"] == "literal_error":
        choices = re.findall(r"'(.*?)'", error.get("ctx", {}).get("expected", ""))
        near = difflib.get_close_matches(str(error["input"]), choices, n=1)
        message += f" (did you mean {near[0]}?)" if near else ""
    return f"{key}: {shown(error['input'])} is not allowed: {message}" if key else message


def _nearest_key(path: Sequence[str], model: type[BaseModel]) -> str:
    """` (did you mean ...?)` with the most similar valid key, looked for in the section and then everywhere."""
    section: Any = model
    for part in path[:-1]:
        if hasattr(section, "model_fields"):
            section = section.model_fields[part].annotation
        else:  # a list or a mapping of sections: next comes an index or a name
            section = get_args(section)[-1] if not part.isdigit() else get_args(section)[0]
    matches = difflib.get_close_matches(path[-1], section.model_fields, n=1, cutoff=0.5)
    if matches:
        return f" (did you mean {'.'.join([*path[:-1], matches[0]])}?)"
    if issubclass(model, RunConfig):
        everywhere = {key.rsplit(".", 1)[-1]: key for key, _, _ in fields(model)}
        matches = difflib.get_close_matches(path[-1], everywhere, n=1, cutoff=0.8)
        if matches:
            return f" (did you mean {everywhere[matches[0]]}?)"
        for name in kinds.OURS:
            if model is not (other := kinds.find(name).Config) and _has(other, path):
                return f", it is one of experiment {name} (allowed: {', '.join(section.model_fields)})"
    return f" (allowed: {', '.join(section.model_fields)})"


def _has(model: Any, path: Sequence[str]) -> bool:
    """True if `path` leads to a setting or a section of `model`."""
    for part in path:
        if part not in getattr(model, "model_fields", {}):
            return False
        model = model.model_fields[part].annotation
    return True
