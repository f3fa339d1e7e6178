"""The trained agents that come with the package."""

from pathlib import Path

import pytest

from star.config import agents
from star.config.loading import load, load_to_act
from star.training.checkpoint import opened


@pytest.mark.parametrize("name", agents.names())
def test_each_agent_is_whole_and_of_the_task_of_its_name(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = agents.find(Path(name))
    trained, offered = load_to_act(folder, {}).env, load(name).env
    assert (trained.name, trained.options) == (offered.name, offered.options) and agents.told(folder) == name
    with opened(folder) as checkpoints:
        (step,) = checkpoints.steps()
        checkpoints.check(step)
    assert (agents.FOLDER / f"{name}.zip").stat().st_size <= 2_000_000
