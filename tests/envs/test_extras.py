"""What messages say of extras: a command that works from a clone, and one that works with a wheel."""

import tomllib
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest

from envs.common import extras

ROOT = Path(__file__).parents[2]
OPTIONAL = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]


@pytest.fixture
def wheel(monkeypatch, tmp_path):
    """As where a wheel is installed, whose metadata are those of `pyproject.toml`."""
    lines = [f"{one}; extra == '{extra}'" for extra, packages in OPTIONAL.items() for one in packages]
    monkeypatch.setattr(extras, "_ROOT", tmp_path)
    monkeypatch.setattr(extras, "requires", lambda name: ["jax>=0.10", *lines])


def test_a_clone_is_installed_with_its_extras():
    assert extras.install("cuda", "warp") == f"pip install '{ROOT}[cuda,warp]'"


@pytest.mark.parametrize("extra", OPTIONAL)
def test_with_a_wheel_the_packages_themselves_are_named(wheel, extra):
    said = extras.install(extra)
    assert said.startswith("pip install ") and "star-rl" not in said and "jax>=0.10'" not in said
    assert all(package in said for package in OPTIONAL[extra])


def test_several_extras_and_a_copy_that_was_never_installed(wheel, monkeypatch):
    assert extras.install("video", "wandb") == "pip install 'imageio-ffmpeg>=0.8.1' 'wandb>=0.31'"

    def requires(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr(extras, "requires", requires)
    assert extras.install("video") == "pip install 'star-rl[video]'"


def test_no_message_names_a_package_that_is_on_no_index():
    for path in [*ROOT.glob("star/**/*.py"), *ROOT.glob("envs/**/*.py"), *ROOT.glob("docs/*.md"), ROOT / "README.md"]:
        assert "star-rl[" not in path.read_text(encoding="utf-8").replace("`star-rl[", ""), path
