"""No SGIM: goals are those that the task draws, and levels decide for themselves. The same functions as `lessons`."""

from __future__ import annotations

from typing import Any

from star.sgim.lessons import Marks


def init(*_: Any) -> None:
    """Nothing is known."""


def begin(config: Any, spec: Any, env: Any, state: None, graph: Any, teachers: Any, env_state: Any, **_: Any) -> Any:
    """No lesson; environments and graph as they are."""
    return (), env_state, graph


def mark(config: Any, lesson: tuple[()], *_: Any, **__: Any) -> tuple[tuple[()], Marks]:
    """Nothing is said."""
    return lesson, Marks()


def restart(config: Any, spec: Any, env: Any, lesson: tuple[()], env_state: Any, *_: Any, **__: Any) -> Any:
    """New episodes as the task has drawn them."""
    return lesson, env_state


def end(*_: Any, **__: Any) -> tuple[None, dict[str, Any]]:
    """Nothing is learnt."""
    return None, {}


def follow(*_: Any) -> None:
    """There is nothing that could follow."""


def demonstrated(*_: Any, **__: Any) -> None:
    """Nothing is shown."""


def imitating(*_: Any) -> None:
    """Nothing is imitated."""


def attraction(*_: Any) -> None:
    """Random targets are drawn evenly."""


def urgency(*_: Any) -> float:
    """All pairs are as urgent."""
    return 1.0
