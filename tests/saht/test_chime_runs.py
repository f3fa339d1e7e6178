"""Whole runs of CHIME in a small room: what they learn, leave, resume and refuse."""

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from PIL import Image

from envs.worlds.room import Room
from star.cli import main
from star.config.loading import parse
from star.saht.chime import figures
from star.training import program as programs
from star.training.journal import JsonLines
from tests.small import assert_the_same, killed

PAGE = Path(__file__).parents[2] / "docs" / "chime.md"
CONFIG = {
    "experiment": "chime",
    "room": {"movable": 1, "fixed": 0, "wall": False},
    "chime": {"models": 2, "candidates": 4, "trial": 1, "steps": 20, "batch": 16, "held": 32, "memory": 200},
    "trainer": {"total_env_steps": 160, "num_seeds": 2, "eval_every": 2, "checkpoint_every": 1, "keep_checkpoints": 9},
}


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a config and a run of it."""
    folder = tmp_path_factory.mktemp("chime")
    (folder / "small.yaml").write_text(yaml.safe_dump(CONFIG))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(["train", "small.yaml", "--run-dir", "whole", "--quiet"]) == 0
    return folder


@pytest.fixture(autouse=True)
def here(place, monkeypatch):
    monkeypatch.chdir(place)


def test_a_robot_finds_itself_first_and_goes_where_it_shall(capsys):
    rows = JsonLines(Path("whole/metrics.jsonl")).read()
    first, last = rows[:2], rows[-2:]
    assert [row["chime/born_robot"] for row in first] == [-1, -1]
    assert all(0 < row["chime/born_robot"] <= 120 and row["chime/competence_robot"] > 0.5 for row in last)
    start = 110.0  # how far the places are at first
    assert np.mean([row["eval/distance_position"] for row in last]) < 0.5 * start
    tables = JsonLines(Path("whole/models.jsonl")).read()
    assert tables[-1]["births"][0][:2] == ["robot", "action"]
    shown = {path.stem for path in Path("whole/figures").glob("*.png")}
    assert shown == {"summary", "births", "competence", "curriculum", "hierarchy"}
    assert main(["ls", "."]) == 0 and "CHIME" in capsys.readouterr().out


def test_every_metric_is_explained_and_every_explained_metric_exists():
    ours = {key for key in JsonLines(Path("whole/metrics.jsonl")).read()[-1] if key.startswith(("chime/", "eval/"))}
    explained = set(re.findall(r"^\| `((?:chime|eval)/\w+)`", PAGE.read_text(encoding="utf-8"), re.MULTILINE))
    names = {"TEST": ("position", "push"), "DISC": ("robot", "object_1")}
    found = {key.replace(mark, name) for key in explained for mark in names if mark in key for name in names[mark]}
    assert found | {key for key in explained if not key.endswith(tuple(names))} == ours


def test_a_run_that_was_killed_goes_on_bit_for_bit_and_nothing_is_compiled_twice(undrawn):
    killed("whole", "killed", steps=(120, 160))
    assert main(["train", "--resume", "killed", "--quiet"]) == 0
    assert_the_same("killed", "whole", 160)
    assert programs.build(parse(CONFIG)).functions.epoch._cache_size() == 1


def test_tasks_that_are_given_are_there_at_the_start():
    program = programs.build(parse({"experiment": "chime", "chime": {"tasks": "given"}}))
    state = program.init(program.seed_keys())
    (row,) = program.experiment.tables(program.hyper, state, [0])
    assert [(model["outcome"], model["control"], *model["inputs"]) for model in row["models"]] == [
        ("robot", "action"),
        ("object_1", "robot", "object_1_from_robot"),
        ("object_2", "robot", "object_2_from_robot"),
        ("object_2", "object_1", "object_2_from_object_1"),
    ]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--chime.episode", "7"], "episode: 7 is odd"),
        (["--chime.memory", "130"], "memory: 130 is not a multiple of 4 and of the 40 actions of an epoch"),
        (
            ["--chime.tasks", "given", "--chime.models", "1"],
            "chime.models: 1 are fewer than the 2 tasks",
        ),
        (["--chime.tasks", "emerges"], "'emerges' is not allowed: should be 'emerge', 'given' or 'none'"),
        (["--room.movable", "9"], "room.movable: 9 is not allowed: should be at most 4"),
        (["--chime.births", "1"], "chime.births: unknown key (did you mean chime.birth?)"),
    ],
)
def test_what_cannot_be_is_said_in_one_line_and_nothing_is_written(capsys, words, said):
    assert main(["train", "small.yaml", "--run-dir", "new", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line and not Path("new").exists()


def test_a_film_shows_the_models_that_are_on_at_each_evaluation(capsys, monkeypatch):
    drawn, graph = [], figures.graph
    monkeypatch.setattr(figures, "graph", lambda axes, room, shares: drawn.append(shares) or graph(axes, room, shares))
    assert main(["render", "models", "--run", "whole", "--seed", "1", "--every", "1", "--out", "models.gif"]) == 0
    assert "2 pictures; models of seed 1 of whole" in capsys.readouterr().out
    rows = [row for row in JsonLines(Path("whole/models.jsonl")).read() if row["seed"] == 1]
    with Image.open("models.gif") as film:
        assert film.n_frames == len(rows) == len(drawn)
    figures.hierarchy(Room(1, 0, False), rows[-1:])
    last, hierarchy = drawn[-2:]
    assert last.keys() == hierarchy.keys() and 0.5 < last["action", "robot"] < 1 == hierarchy["action", "robot"]
    assert main(["render", "models", "--run", "whole", "--out", "models.png", "--height", "90"]) == 0
    assert drawn[-1] != last and "1 picture; models of seed 0" in capsys.readouterr().out


def test_pictures_show_a_robot_that_does_a_test(capsys, monkeypatch):
    path = jnp.full((1, 5, 2, 2), 200.0).at[:, :, 1].set(300.0)
    monkeypatch.setattr("star.saht.chime.commands.tested", lambda *_, **__: path)
    assert main(["render", "room", "--run", "whole", "--out", "push.png", "--episode", "8"]) == 0
    assert "test 8, push, by whole" in capsys.readouterr().out and Path("push.png").stat().st_size > 1000
    for words, said in (
        (["render", "room", "--run", "whole", "--episode", "99", "--out", "new.png"], "--episode: 99 is not one of"),
        (["render", "rom", "--run", "whole", "--out", "new.png"], "rom: is not in a run of experiment chime"),
        (["render", "models", "--run", "whole", "--episode", "1", "--out", "new.png"], "--episode: is for the room"),
        (["render", "models", "--run", "whole", "--seed", "7", "--out", "new.png"], "--seed: 7 is not among those"),
        (["render", "room", "--camera", "top", "--out", "new.png"], "--camera: is for tasks of experiment star"),
        (["record", "whole", "--out", "new.npz"], "a run of experiment chime makes no demonstrations"),
    ):
        assert main(words) == 2
        assert said in capsys.readouterr().err
