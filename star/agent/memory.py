"""The memory that comes and goes in an epoch, at least."""

from __future__ import annotations

from star.agent import levels
from star.agent.sections import Config
from star.spec import Spec
from star.training.memory_budget import size

_NUMBER = 4  # bytes


def scratch(config: Config, spec: Spec, seeds: int) -> dict[str, int]:
    """Bytes of rollouts of so many seeds, and of what networks keep of a batch to learn from it."""
    tutor, model, near = config.tutor, config.forward_model, config.tutor.adjacency
    found = {}
    if config.commander.enabled:
        found["forward_model"] = seeds * _activations(model.batch_size, model.hidden)
    if tutor.off_policy_correction:  # the Controller's policy for each candidate
        hidden = getattr(config.controller.settings, "hidden", ())
        rows = tutor.correction_candidates * getattr(tutor.settings, "batch_size", 0) * tutor.period
        found["tutor.correction_candidates"] = seeds * _activations(rows, hidden[:1])
    if near.enabled:
        found["tutor.adjacency"] = seeds * _activations(near.batch_size, (*near.hidden, near.features))
    agent = levels.of(config.hyper(), spec)
    for name, level, rollout in config.learners():
        example = getattr(agent, name).example(level, agent.task)
        found[f"{name}, trainer.num_envs"] = seeds * rollout.size * size(example)
        found[f"{name}.{level.group}"] = seeds * level.settings.scratch_bytes(rollout)
    return found


def _activations(rows: int, hidden: tuple[int, ...]) -> int:
    return rows * sum(hidden) * _NUMBER
