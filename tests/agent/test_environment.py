"""Environments of a user's own, those of docs/your_robot.md: they train, resume, are imported on demand and draw."""

import json
import re
import shutil
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

from envs.common.errors import UserError
from star.agent import environment
from star.agent.figures import draw_regions
from star.agent.growth_map import growth_map
from star.cli import main
from star.config import loading
from star.spec import Spec
from tests.small import ALONE, RUN, arrays

PAGE = (Path(__file__).parents[2] / "docs" / "your_robot.md").read_text(encoding="utf-8")
FILES = dict(re.findall(r'```\w+ title="([\w.]+)"\n(.*?)```', PAGE, re.DOTALL))
MODULES = ("room", "arm", "car", "mapped")
EPOCH = 100 * RUN["trainer"]["num_envs"]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty folder with the files of the page and a small run's config."""
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    settings = json.loads(json.dumps(ALONE | {"env": {"name": "room:make"}}))
    settings["trainer"]["total_env_steps"] = 4 * EPOCH
    (tmp_path / "run.yaml").write_text(json.dumps(settings))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    forget(monkeypatch)
    yield tmp_path
    forget(monkeypatch)


def forget(monkeypatch):
    """As in a new process: nothing is trusted and nothing imported."""
    monkeypatch.setenv("STAR_IMPORT", "")
    for module in MODULES:
        sys.modules.pop(module, None)


def test_an_option_of_ones_own_may_be_called_map(here, capsys):
    (here / "mapped.py").write_text("import room\n\n\ndef make(goals, map):\n    return room.make(goals)\n")
    words = ["train", "run.yaml", "--import", "room", "--env.name", "mapped:make", "--env.options", '{"map": "a\\nb"}']
    assert main([*words, "--dry-run"]) == 0
    assert "env.options.map" not in capsys.readouterr().out


@pytest.mark.usefixtures("undrawn")
def test_it_trains_and_resumes_bit_for_bit_where_it_is_trusted(here, monkeypatch, capsys):
    train = ["train", "run.yaml", "--import", "room", "--trainer.checkpoint_every", "1", "--quiet"]
    assert main([*train, "--run-dir", "whole"]) == 0
    shutil.copytree("whole", "parts")  # as of a run that was killed in its third epoch
    for step in (3 * EPOCH, 4 * EPOCH):
        shutil.rmtree(Path("parts/checkpoints", str(step)))
    forget(monkeypatch)
    for command in (
        ["train", "run.yaml", "--run-dir", "new"],
        ["train", "--resume", "parts"],
        ["evaluate", "parts"],
        ["render", "--run", "parts", "--out", "new.png"],
        ["record", "parts", "--out", "new.npz"],
        ["report", "parts", "--out", "new.html"],
    ):
        capsys.readouterr()
        assert main(command) == 2
        assert "only a file names it, so it is not imported; type --import room" in capsys.readouterr().err
    assert "room" not in sys.modules and not list(here.glob("new*"))
    assert main(["train", "--resume", "parts", "--import", "room", "--quiet"]) == 0
    whole, parts = arrays(here / "whole", 4 * EPOCH), arrays(here / "parts", 4 * EPOCH)
    assert whole.keys() == parts.keys()
    for name, array in whole.items():
        np.testing.assert_array_equal(array, parts[name], err_msg=name)
    assert main(["evaluate", "whole", "--import", "room", "--json", "--quiet"]) == 0
    row = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (row["env"], row["engine"], row["spl"]) == ("room:make", "auto", None)
    assert main(["report", "whole", "--import", "room", "--out", "report.html"]) == 0


@pytest.mark.parametrize("name", ["logging:basicConfig", "subprocess:check_output", "room:make"])
def test_what_a_strangers_run_names_is_not_called_though_python_has_imported_it(here, capsys, name):
    Path("run").mkdir()
    victim = {"filename": "victim", "filemode": "w"}
    Path("run/config.yaml").write_text(json.dumps({**RUN, "env": {"name": name, "options": victim}}))
    Path("victim").write_text("kept")
    Path("sweep.yaml").write_text(json.dumps({"config": "run/config.yaml", "parameters": {"trainer.seed": [1, 2]}}))
    before = sorted(here.rglob("*"))
    for words in (
        "train run/config.yaml --run-dir new",
        "train --resume run",
        "evaluate run",
        "render --run run --out new.png",
        "record run --out new.npz",
        "report run --out new.html",
        "sweep sweep.yaml --out new",
    ):
        assert main(words.split()) == 2
        assert "only a file names it, so it is not imported" in capsys.readouterr().err
    assert Path("victim").read_text() == "kept" and sorted(here.rglob("*")) == before


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--import", "tpyo"], "--import: 'tpyo' is no module here; allowed: a name that Python can import"),
        (["--import", "room.py"], "--import: 'room.py' is no module here"),
        (["--import", "__main__"], "--import: '__main__' is no module here"),
        (["--import", ""], "--import: '' is no module here"),
        (
            ["--env.name", "my-room:make"],
            "env.name: 'my-room:make' is not allowed: should be module:function, a module",
        ),
    ],
)
def test_a_name_that_python_cannot_import_is_told_from_one_that_is_not_trusted(here, capsys, words, line):
    assert main(["train", "run.yaml", "--run-dir", "new", *words]) == 2
    error = capsys.readouterr().err
    assert line in error and error.count("\n") == 1 and not Path("new").exists()


def config(name, **options):
    return loading.parse({"env": {"name": name, "options": options}})


@pytest.fixture
def trusted(here, monkeypatch):
    monkeypatch.setenv("STAR_IMPORT", ",".join(MODULES))
    return here


def test_a_robot_from_an_xml_stands_in_a_room_from_a_map(trusted):
    made = environment.make(config("car:make", episode_length=100), "test")
    spec = Spec.of(made)
    assert (spec.action_size, spec.episode_length, spec.orientation, made.engine) == (2, 100, (3, 4, 5, 6), "native")
    assert spec.state_dim == made.body.physics.model.nq + made.body.physics.model.nv
    assert made.dt == pytest.approx(0.1)
    assert environment.engine_of(config("car:make"), made) == "native"
    with pytest.raises(UserError, match=r'env: engine is "jax", but room:make takes no engine; allowed: auto'):
        environment.make(loading.parse({"env": {"name": "room:make", "engine": "jax"}}), "train")


@pytest.mark.parametrize(
    ("name", "options", "key"),
    [
        ("point_maze", {"engine": "jax"}, "engine"),
        ("point_maze", {"name": "ant_maze"}, "name"),
        ("room:make", {"engine": "jax"}, "engine"),
    ],
)
@pytest.mark.parametrize("where", ["options", "training"])
def test_what_stands_beside_the_options_is_none_of_them(trusted, name, options, key, where):
    with pytest.raises(UserError, match=f"^env: option {key} .* stands beside the options, as env.{key}$"):
        environment.make(loading.parse({"env": {"name": name, where: options}}), "train")


def test_the_angles_of_wheels_stay_within_a_turn_and_all_else_is_as_mujoco_has_it(trusted):
    body = environment.make(config("car:make"), "test").body
    data = body.init(jax.random.key(0), jnp.zeros(2))
    turned = data.replace(qpos=data.qpos.at[7:].set(jnp.array([7.0, -10.0])))
    expected = np.concatenate([turned.qpos, turned.qvel])
    expected[7:9] = [7 - 2 * np.pi, -10 + 4 * np.pi]
    np.testing.assert_allclose(body.observe(turned, 0), expected, atol=1e-5)


def test_a_robot_is_drawn(trusted, can_draw):
    assert main(["render", "car:make", "--steps", "1", "--height", "120", "--out", "car.png", "--quiet"]) == 0
    assert (trusted / "car.png").stat().st_size > 2000


def test_what_has_no_model_is_not_drawn(trusted, can_draw, capsys):
    assert main(["render", "room:make", "--out", "new.png"]) == 2
    assert "room:make has no model, which star render needs" in capsys.readouterr().err


BAD = """def make(goals):
    raise KeyError('no robot')

number = 3
nothing = lambda goals: None
a_class = lambda goals: Exception
alone = lambda: None
"""


def test_what_cannot_be_had_is_said_in_one_line(trusted):
    (trusted / "bad.py").write_text(BAD)
    for name, options, line in (
        ("room:make", {"size": 3}, 'env: option "size" is not one of room:make; allowed: goals'),
        ("room:makes", {}, "env: room:makes: room holds no makes (did you mean make?) (" + str(trusted / "room.py")),
        ("bad:nothing", {}, "env: bad:nothing: gives nothing; allowed: an environment"),
        ("bad:a_class", {}, "env: bad:a_class: gives the class Exception; allowed: an environment"),
        ("bad:alone", {}, "env: bad:alone: takes no goals; allowed: def make(goals), which is given train or test"),
        ("builtins:type", {}, "env: builtins:type: is a type; allowed: a function that makes an environment"),
        ("car:make", {"episode_length": 40.5}, "env: car:make: car_room: episode_length is 40.5; allowed: a whole"),
        ("car:make", {"episode_length": "abc"}, "env: car:make: car_room: episode_length is 'abc'; allowed: a whole"),
        ("bad:number", {}, "env: bad:number: is a int; allowed: a function that makes an environment"),
        ("bad:make", {}, "env: bad:make: raises KeyError: 'no robot' (" + str(trusted / "bad.py") + ", line 2)"),
    ):
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("STAR_IMPORT", "room,car,bad,builtins")
            with pytest.raises(UserError) as error:
                environment.make(config(name, **options), "train")
        assert str(error.value).startswith(line)
    sys.modules.pop("bad", None)


def test_features_that_need_more_say_so_before_anything_begins(trusted, capsys):
    for setting, line in (
        (["--sgim.goals", "true"], "room:make has no with_goal, which SGIM needs"),
        (["--controller.frame", "body"], "the body has no orientation"),
    ):
        assert main(["train", "run.yaml", *setting, "--run-dir", "new", "--quiet"]) == 2
        assert line in capsys.readouterr().err and not (trusted / "new").exists()


def test_regions_along_one_dimension_are_drawn_too(trusted):
    row = {"lower": [[0.0], [4.0]], "upper": [[4.0], [9.0]], "chosen": [1.0, 2.0], "env_steps": 10, "seed": 0}
    axis = Figure().subplots()
    draw_regions(axis, row, np.zeros((0, 4)))
    assert [patch.get_bbox().bounds for patch in axis.patches] == [(0, 0, 4, 1), (4, 0, 5, 1)]
    drawn = growth_map(config("room:make"), [row], [0], most=10)
    assert drawn["boxes"] == [(0, 0, 4, 1), (4, 0, 9, 1)]
    assert (drawn["walls"], drawn["chasms"], drawn["start"]) == ([], [], None)
