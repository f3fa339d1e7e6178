import sys

import jax
import pytest

from star.agent.sections import Config


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty working directory with three config files and one run."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "point.yaml").write_text("env: {name: point_maze}\ntrainer: {num_envs: 8}\n")
    (tmp_path / "ant.yaml").write_text("env: {name: ant_maze}\ntrainer: {num_envs: 8}\n")
    (tmp_path / "old.png").write_text("precious")
    (tmp_path / "old.npz").write_text("precious")
    (tmp_path / "old.html").write_text("precious")
    (tmp_path / "broken.yaml").write_text("tutor:\n  period: [5\ntrainer: {}\n")
    run = tmp_path / "runs" / "old"
    run.mkdir(parents=True)
    (run / "config.yaml").write_text(Config().to_yaml())
    return tmp_path


@pytest.fixture
def bare(monkeypatch):
    """A machine without a GPU and without Warp."""
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    monkeypatch.setitem(sys.modules, "warp", None)
