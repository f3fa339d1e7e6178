"""A learner in a file outside the package, the one of the how-to page: it trains, resumes, is imported on demand."""

import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from envs.common import plugins
from envs.common.errors import UserError
from star.cli import main
from star.config import loading
from tests.small import ALONE, EPOCH, RUN, arrays, change

PAGE = Path(__file__).parents[2] / "docs" / "howto.md"
LEARNER = ["--controller.learner", "mine:reinforce"]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty folder with the page's mine.py and a small run's config."""
    text = re.search(r'```python title="mine.py"\n(.*?)```', PAGE.read_text(encoding="utf-8"), re.DOTALL).group(1)
    (tmp_path / "mine.py").write_text(text)
    (tmp_path / "run.yaml").write_text(json.dumps(ALONE))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    yield tmp_path
    sys.modules.pop("mine", None)


def forget(monkeypatch):
    """As in a new process: nothing is trusted and nothing imported."""
    monkeypatch.setenv("STAR_IMPORT", "")
    sys.modules.pop("mine", None)


@pytest.mark.usefixtures("undrawn")
def test_it_trains_checkpoints_and_resumes_bit_for_bit(here, monkeypatch, capsys):
    assert len((here / "mine.py").read_text().splitlines()) < 50
    train = [
        "train",
        "run.yaml",
        *LEARNER,
        "--trainer.checkpoint_every",
        "1",
        "--trainer.keep_checkpoints",
        "4",
        "--quiet",
    ]
    assert main([*train, "--run-dir", "whole"]) == 0
    shutil.copytree("whole", "parts")  # as of a run that was killed in its third epoch
    for step in (3 * EPOCH, 4 * EPOCH):
        shutil.rmtree(Path("parts/checkpoints", str(step)))
    forget(monkeypatch)
    again = ["train", "--resume", "parts", "--quiet"]
    assert main(again) == 2
    told = "controller.learner: 'mine:reinforce' is not allowed: only a file names it"
    assert told in capsys.readouterr().err and "mine" not in sys.modules
    assert main([*again, "--import", "mine"]) == 0
    whole, parts = arrays(here / "whole", 4 * EPOCH), arrays(here / "parts", 4 * EPOCH)
    assert whole.keys() == parts.keys() and whole["controller/weights"].any()
    for name, array in whole.items():
        np.testing.assert_array_equal(array, parts[name], err_msg=name)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--controller.own.stds", "1"], "controller.own: 'stds' is no setting of mine:reinforce; allowed: learning_"),
        (["--controller.own.std", "0"], "controller.own.std: 0 is not allowed: should be greater than 0"),
        (["--controller.own.std", "wide"], "controller.own.std: 'wide' is not allowed: should be a number"),
        (["--controller.hindsight", "true"], "controller: hindsight needs learner td3, which replays"),
        (["--controller.learner", "mine:other"], "mine holds no other; allowed: a star.learners.protocol.Learner"),
        (["--controller.learner", "mine:Config"], "is a class; allowed: a star.learners.protocol.Learner"),
        (
            ["--controller.learner", "mine.it"],
            "'mine.it' is not allowed: should be 'ppo', 'td3', 'crl', 'chronosrl' or 'module:name'",
        ),
        (["--controller.learner", "nobody:has"], "cannot be imported: ModuleNotFoundError: No module named 'nobody'"),
        (["--controller.learner", "ppo", "--controller.own.std", "1"], "controller.own: 'std' is no setting of ppo"),
    ],
)
def test_what_is_wrong_with_it_is_said_in_one_line_and_nothing_is_written(here, capsys, words, line):
    assert main(["train", "run.yaml", *LEARNER, "--run-dir", "run", "--quiet", *words]) == 2
    error = capsys.readouterr().err
    assert line in error and error.count("\n") == 1 and not (here / "run").exists()


STEP = "State(state.weights - config.learning_rate * step, optimizer)"
MISTAKES = {
    "settings of no learner": ("Config(LearnerConfig)", "Config", "a subclass of star.learners.LearnerConfig"),
    "no example": (", *, example)", ")", "learner mine:reinforce: init raises TypeError: init() got an unexpected"),
    "an error": ("    def to_go", "    1 / 0\n    def to_go", "update raises ZeroDivisionError: division by zero ("),
    "a state alone": (STEP + ', {"loss": value}', STEP, "update gives a State; allowed: state, {metric: number}"),
    "another shape": (
        STEP,
        STEP.replace("state.weights - config.learning_rate * step", "state.weights[:1]"),
        "update makes weights float32 [1, 2]; allowed: float32 [6, 2], as in init",
    ),
    "a metric that is none": (
        '{"loss": value}',
        '{"loss": step}',
        "update's metric loss is float32 [6, 2]; allowed: one",
    ),
    "an action too long": ("action.size))", "action.size + 1))", "act gives float32 [1, 3] for observations [1, 6]"),
    "an exit": ("import optax", "raise SystemExit", "cannot be imported: SystemExit:  ("),
}


@pytest.mark.parametrize("case", MISTAKES)
def test_a_mistake_in_its_functions_is_one_line_before_anything_is_written(here, capsys, case):
    *mistake, line = MISTAKES[case]
    change(here / "mine.py", *mistake)
    assert main(["train", "run.yaml", *LEARNER, "--run-dir", "run", "--quiet"]) == 2
    error = capsys.readouterr().err
    assert line in error and error.count("\n") == 1 and not (here / "run").exists(), error


def test_a_module_that_breaks_is_one_line_too(here, capsys):
    (here / "mine.py").write_text("raise OSError('no\\nsuch luck')")
    assert main(["train", "run.yaml", *LEARNER, "--run-dir", "run"]) == 2
    assert f"cannot be imported: OSError: no ({here / 'mine.py'}, line 1)\n" in capsys.readouterr().err


def test_a_file_alone_has_nothing_imported_unless_its_user_said_so(here, monkeypatch):
    named = {**RUN, "controller": {"learner": "mine:reinforce"}}
    with pytest.raises(UserError, match="only a file names it, so it is not imported; type --import mine"):
        loading.parse(named)
    assert "mine" not in sys.modules
    monkeypatch.setenv("STAR_IMPORT", "other,mine")
    settings = loading.parse(named).controller.settings
    assert settings.std == 0.5
    forget(monkeypatch)
    monkeypatch.syspath_prepend(here)
    __import__("mine")  # which tells nothing of who named it
    with pytest.raises(UserError, match="only a file names it"):
        loading.parse(named)
    plugins.trust("mine")  # by a program of its user's own
    assert loading.parse(named, {"controller.own.std": 2}).controller.settings.std == 2


def test_its_settings_survive_the_way_through_a_file_and_can_be_swept(here, monkeypatch):
    monkeypatch.setenv("STAR_IMPORT", "mine")
    first = loading.parse(RUN, {"controller.learner": "mine:reinforce", "controller.own.std": 0.25})
    (here / "again.yaml").write_text(first.to_yaml())
    again = loading.load(here / "again.yaml")
    assert again == first and again.controller.own.std == 0.25
    import jax

    names = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_flatten_with_path(first.hyper())[0]]
    assert ".controller.own.std" in names and ".tutor.own.std" not in names
