"""An experiment in a file outside the package, the bandit of docs/experiments.md: all commands work on it."""

import csv
import json
import re
import shlex
import shutil
import sys
import threading
import time
from pathlib import Path

import jax
import numpy as np
import pytest
import yaml

import star
from envs.common.errors import UserError
from star.cli import main
from star.config import kinds
from star.config.kinds import Measure
from star.config.loading import parse
from star.sweeps import work as working
from star.training.checkpoint import Checkpoints
from star.training.journal import JsonLines
from star.training.program import Program, select_device
from tests.small import arrays, change

PAGE = Path(__file__).parents[2] / "docs" / "experiments.md"
# The same with a measure where less is better, and seeds that share a counter.
CLOSER = """
from bandit import *
from star.config.kinds import Notices

CLOSER = KIND._replace(measures=KIND.measures[::-1], in_step=True)
PARTS = KIND._replace(build=lambda config: Parts(config))
NOTHING = KIND._replace(measures=())
OTHER = KIND._replace(Config=Learning)
NOTED = KIND._replace(notices=Notices(("bandit/error",), lambda rows: late(rows) if len(rows) > 6 else {}))


def late(rows):
    return {"late": f"{sorted(rows[-1])} since {len(rows)}"}


class Parts(Experiment):
    steps_per_epoch, init, rows = 1, None, None
"""


@pytest.fixture(autouse=True)
def drawn_once(request):
    """Where a run's folder is looked at, its figures are drawn: that takes long, and is no other test's concern."""
    if request.function is not test_it_trains_and_goes_on_bit_for_bit:
        request.getfixturevalue("undrawn")


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty folder with the page's files, which are trusted."""
    text = PAGE.read_text(encoding="utf-8")
    for name in ("bandit.py", "run.yaml"):
        block = re.search(rf'```\w+ title="{name}"\n(.*?)```', text, re.DOTALL).group(1)
        (tmp_path / name).write_text(block)
    (tmp_path / "closer.py").write_text(CLOSER)
    (tmp_path / "closer.yaml").write_text((tmp_path / "run.yaml").read_text().replace("bandit:KIND", "closer:CLOSER"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setenv("STAR_IMPORT", "bandit,closer")
    for name in ("bandit", "closer"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    yield tmp_path
    for name in ("bandit", "closer"):
        sys.modules.pop(name, None)


def trained(run, *words, config="run.yaml"):
    assert main(["train", config, "--run-dir", run, "--quiet", *words]) == 0
    return Path(run)


def test_what_there_is_to_note_is_said_once_of_each_seed_unless_quiet_is_wanted(here, capsys):
    (here / "noted.yaml").write_text((here / "run.yaml").read_text().replace("bandit:KIND", "closer:NOTED"))
    trained("quiet", config="noted.yaml")
    assert "note:" not in "".join(capsys.readouterr())
    assert main(["train", "noted.yaml", "--run-dir", "told"]) == 0
    lines = [line for line in "".join(capsys.readouterr()).splitlines() if line.startswith("note:")]
    assert lines == [f"note: seed {seed}: ['bandit/error', 'env_steps'] since 7" for seed in range(5)]


def test_the_evaluation_compiles_once_in_a_thread_before_the_first_epoch(here, caplog):
    jax.config.update("jax_log_compiles", True)
    try:
        trained("run", "--trainer.num_seeds", "7", "--trainer.eval_every", "10")
    finally:
        jax.config.update("jax_log_compiles", False)
    threads = [one.threadName for one in caplog.records if one.getMessage().startswith("Compiling jit(evaluate)")]
    assert len(threads) == 1 and threads[0].startswith("ThreadPool")


def test_nothing_compiles_in_a_thread_while_the_first_epoch_runs_and_errors_there_are_left_to_the_first_use(
    here, monkeypatch
):
    order = []
    evaluation_keys, epoch = Program.evaluation_keys, Program.epoch

    def slow(self, epochs):
        if threading.current_thread().name.startswith("ThreadPool"):
            time.sleep(2.0)
            order.append("evaluation")
            raise RuntimeError("left to the first use")
        return evaluation_keys(self, epochs)

    monkeypatch.setattr(Program, "evaluation_keys", slow)
    monkeypatch.setattr(Program, "epoch", lambda self, state: order.append("epoch") or epoch(self, state))
    trained("run", "--trainer.num_seeds", "6")
    assert order[0] == "evaluation" and set(order[1:]) == {"epoch"}


def test_on_a_gpu_programs_are_kept_unless_jax_is_told_where(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    name, folder = "jax_compilation_cache_dir", str(tmp_path / "star" / "jax")
    before = jax.config.values[name]
    try:
        for backend, told, kept in (("cpu", None, None), ("gpu", "own", "own"), ("gpu", None, folder)):
            jax.config.update(name, told)
            monkeypatch.setattr(jax, "default_backend", lambda backend=backend: backend)
            select_device("auto")
            assert jax.config.values[name] == kept
    finally:
        jax.config.update(name, before)


def test_it_trains_and_goes_on_bit_for_bit(here):
    whole = trained("whole", "--trainer.checkpoint_every", "5", "--trainer.sinks", "[tensorboard]")
    assert {"config.yaml", "metrics.jsonl", "provenance.jsonl", "checkpoints", "figures", "seed_4"} <= {
        entry.name for entry in whole.iterdir()
    }
    assert any(entry.name.startswith("events.out.tfevents") for entry in whole.iterdir())
    assert (whole / "figures" / "summary.png").stat().st_size > 10_000
    rows = JsonLines(whole / "metrics.jsonl").read()
    assert len(rows) == 20 * 5 and {"bandit/error", "values/non_finite"} <= rows[0].keys()
    assert rows[-1]["eval/pay"] == pytest.approx(0.8)
    parts = trained("parts", "--total-env-steps", "200")
    shutil.rmtree(parts / "figures")  # as of a run that was killed: it goes on from its last checkpoint
    with (parts / "metrics.jsonl").open("a") as file:
        file.write('{"seed": 0, "env_')
    assert main(["train", "--resume", "parts", "--total-env-steps", "400", "--quiet"]) == 0
    found, expected = arrays("parts", 400), arrays("whole", 400)
    assert found.keys() == expected.keys() == {"values", "epoch", "key"} and expected["values"].all()
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array, err_msg=name)


def test_what_whole_epochs_make_of_the_env_steps_is_said_and_that_nothing_is_left_to_do(here, capsys):
    assert main(["train", "run.yaml", "--run-dir", "run", "--total-env-steps", "3e1"]) == 0
    out, err = capsys.readouterr()
    assert err.count("note: trainer.total_env_steps: 30 becomes 40, whole epochs of 20\n") == 1
    assert out.startswith("trained 40 pulls")
    before = Path("run/metrics.jsonl").read_text()
    assert main(["train", "--resume", "run", "--total-env-steps", "20"]) == 0
    out, err = capsys.readouterr()
    assert out == "run: already at 40 pulls; nothing to do\n" and "note" not in err
    assert Path("run/metrics.jsonl").read_text() == before


def test_what_to_type_next_lets_its_module_in_and_can_be_pasted(here, capsys, monkeypatch):
    monkeypatch.setenv("STAR_IMPORT", "")
    assert main(["train", "run.yaml", "--run-dir", "a run", "--quiet", "--import", "bandit"]) == 0
    told = capsys.readouterr().out.splitlines()[-1]
    assert told == "next:    star evaluate 'a run' --import bandit"
    assert main(["train", "run.yaml", "--run-dir", "a run", "--quiet"]) == 2
    assert capsys.readouterr().err.endswith(": star train --resume 'a run' --import bandit\n")
    assert main(["report", "a run", "--out", "page.html"]) == 0
    assert "star train 'a run/config.yaml' --run-dir 'a run-again' --import bandit" in Path("page.html").read_text()
    monkeypatch.setenv("STAR_IMPORT", "")
    sys.modules.pop("bandit")
    assert main(shlex.split(told.removeprefix("next:"))[1:]) == 0


def test_programs_measure_it_and_are_told_that_it_has_no_agent(here, capsys):
    result = star.train("run.yaml", {"trainer.total_env_steps": 200}, run_dir="run")
    row = star.evaluate("run", seed=2)
    assert row["env_steps"] == result["env_steps"] == 200 and result["pay"] is not None
    assert main(["evaluate", "run", "--json", "--evaluation-seed", "2"]) == 0
    assert json.loads(capsys.readouterr().out) == row
    with pytest.raises(UserError, match="^run: is a run of experiment bandit:KIND, which has no agent that acts$"):
        star.load("run")


def test_the_other_commands_work_on_it(here, capsys):
    trained("run")
    capsys.readouterr()
    assert main(["evaluate", "run", "--checkpoint", "all", "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [row["env_steps"] for row in rows] == Checkpoints(Path("run")).steps()
    pays = [seed["pay"] for seed in rows[-1]["seeds"]]
    assert rows[-1]["pay"] == pytest.approx(np.mean(pays)) and len(pays) == 5
    assert main(["evaluate", "run"]) == 0 and "distance" in capsys.readouterr().out
    assert main(["report", "run", "--out", "report.html"]) == 0
    page = Path("report.html").read_text()
    assert '"unit":"pulls"' in page and '"key":"eval/pay"' in page and "bandit/error" in page
    assert main(["settings", "--experiment", "bandit:KIND", "learning"]) == 0
    assert "share of an error that is learnt [number above 0, at most 1; default 0.1]" in capsys.readouterr().out


def test_floats_are_tried_side_by_side_and_whole_numbers_apart(here, monkeypatch):
    made = []

    class Noted(working.SideBySide):
        def __init__(self, config, slots):
            made.append((config.learning.pulls, slots))
            super().__init__(config, slots)

    monkeypatch.setattr(working.work, "__kwdefaults__", working.work.__kwdefaults__ | {"make": Noted})
    values = {"learning.step_size": [0.01, 0.1, 0.5], "learning.pulls": [10, 20]}
    Path("sweep.yaml").write_text(yaml.safe_dump({"config": "run.yaml", "parameters": values, "sampler": "grid"}))
    assert main(["sweep", "sweep.yaml", "--out", "out", "--quiet"]) == 0
    assert sorted(made) == [(10, 3), (20, 3)]
    with open("out/trials.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6 and all(row["state"] == "complete" for row in rows)
    alone = trained("alone", "--learning.step_size", "0.5", "--learning.pulls", "10")
    (same,) = [row for row in rows if (row["learning.step_size"], row["learning.pulls"]) == ("0.5", "10")]
    last = [row for row in JsonLines(alone / "metrics.jsonl").read() if row["env_steps"] == 400]
    assert float(same["distance"]) == pytest.approx(np.mean([row["eval/distance"] for row in last]), rel=1e-5)


def test_where_less_is_better_the_least_is_the_best(here, capsys):
    """And where seeds share a counter, no trial begins among others that have begun."""
    words = ("--total-env-steps", "200", "--trainer.checkpoint_every", "1", "--trainer.eval_every", "1")
    trained("run", *words, config="closer.yaml")
    assert "eval/distance" in JsonLines(Path("run/metrics.jsonl")).read()[0]
    noted = {
        int(path.parent.name): json.loads(path.read_text())["distance"]
        for path in Path("run/checkpoints").glob("*/about.json")
    }
    assert Checkpoints(Path("run")).best() == min(noted, key=lambda step: (noted[step], -step))
    every = JsonLines(Path("run/metrics.jsonl")).read()
    least = min(np.mean([row["eval/distance"] for row in every if row["env_steps"] == n]) for n in range(20, 201, 20))
    assert min(noted.values()) == pytest.approx(least)  # the best of all was kept
    values = {"learning.step_size": [0.01, 0.1, 0.5]}
    sweep = {"config": "closer.yaml", "parameters": values, "sampler": "grid", "batch": 2}
    Path("sweep.yaml").write_text(yaml.safe_dump(sweep))
    assert main(["sweep", "sweep.yaml", "--out", "out", "--quiet"]) == 0
    with open("out/trials.csv", newline="") as file:
        found = [float(row["value"]) for row in csv.DictReader(file)]
    assert len(found) == 3 and found == sorted(found)
    best = yaml.safe_load(Path("out/best.yaml").read_text())
    assert f"best:    trial {[0.01, 0.1, 0.5].index(best['learning']['step_size'])}" in capsys.readouterr().out
    assert main(["report", "run", "--out", "report.html"]) == 0
    assert Path("report.html").read_text().index('"key":"eval/distance"') > 0


@pytest.mark.parametrize("better", ["high", "low"])
def test_what_was_not_measured_is_worst(better):
    measure = Measure("x", better=better)
    assert max((0.5, None, float("nan"), -3.0), key=measure.rank) == (0.5 if better == "high" else -3.0)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--learning.step_size", "2"], "learning.step_size: 2 is not allowed: should be at most 1"),
        (["--learning.stepsize", "1"], "learning.stepsize: unknown key (did you mean learning.step_size?)"),
        (["--tutor.period", "3"], "tutor: unknown key, it is one of experiment star (allowed: experiment, learning, "),
        (["--experiment", "sta"], "experiment: 'sta' is not allowed: should be star, saht, tutoring, chime or module"),
        (["--experiment", "bandit:Bandit"], "experiment: bandit:Bandit: is a class; allowed: a star.config.kinds.Kind"),
        (["--experiment", "bandit:ARMS"], "experiment: bandit:ARMS: bandit holds no ARMS; allowed: a star.config.kin"),
        (["--experiment", "closer:PARTS"], "experiment: closer:PARTS: has no epoch; all have steps_per_epoch, init, "),
        (["--experiment", "closer:NOTHING"], "experiment: closer:NOTHING: measures is (); allowed: one star.config."),
        (["--experiment", "closer:OTHER"], "allowed: a subclass of star.config.run.RunConfig"),
    ],
)
def test_what_is_wrong_is_said_in_one_line_and_nothing_is_written(here, capsys, words, line):
    assert main(["train", "run.yaml", "--run-dir", "run", "--quiet", *words]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert line in said and not Path("run").exists()


MISTAKES = {
    "no steps": (
        "return self.config.learning.pulls",
        "return 0",
        "steps_per_epoch is 0; allowed: a whole number above 0",
    ),
    "half a step": ("return self.config.learning.pulls", "return 2.5", "steps_per_epoch is 2.5"),
    "no steps to be had": (
        "return self.config.learning.pulls",
        "return 1 / 0",
        "steps_per_epoch raises ZeroDivisionErr",
    ),
    "one seed alone": (
        "@over_seeds\n    def init",
        "def init",
        "init makes values float32 [3]; allowed: an axis of seeds",
    ),
    "epochs that are no numbers": (
        "jnp.zeros((), jnp.int32)",
        "jnp.zeros(())",
        "init makes epoch float32 [1]; allowed",
    ),
    "an error": ("key, *keys =", "raise OSError('x')\n        key, *keys =", "epoch raises OSError: x ("),
    "a state alone": (', {"bandit/error": errors.mean()}', "", "epoch gives a State; allowed: state, {metric: number}"),
    "another shape": ("State(values=values,", "State(values=values[:2],", "epoch makes values float32 [5, 2]; allowed"),
    "a metric of many": ("errors.mean()", "errors", "epoch's bandit/error is float32 [5, 20]; allowed: a number for"),
    "an error at the end": ("return {", "raise OSError('x')\n        return {", "evaluate raises OSError: x ("),
}
LATER = {  # what only a first epoch and its evaluation can tell
    "epochs that stay": ("epoch=state.epoch + 1", "epoch=state.epoch", "`epoch` is 0 after epoch 1; it must add 1"),
    "no rows": ("return [{", "return\n        return [{", "rows gives null; allowed: a list with a mapping for each"),
    "rows of one": ('(len(evaluated["pay"]))', "(1)", "rows gives [{"),
    "no such measure": ('Measure("pay")', 'Measure("pai")', "rows lacks pai, a measure of its Kind; it has "),
    "text": ("float(x[i])", "str(x[i])", "rows gives distance '"),
    "an error": ("return [{", "return 1 / 0\n        return [{", "rows raises ZeroDivisionError: division by zero ("),
}


@pytest.mark.parametrize("case", [*MISTAKES, *(f"later: {case}" for case in LATER)])
def test_a_mistake_in_its_functions_is_said_in_one_line(here, capsys, case):
    later = case.removeprefix("later: ")
    *mistake, line = MISTAKES[case] if later == case else LATER[later]
    change(here / "bandit.py", *mistake)
    assert main(["train", "run.yaml", "--run-dir", "run", "--quiet"]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert f"experiment: bandit:KIND: {line}" in said and Path("run").exists() == (later != case), said


def test_a_run_is_of_one_experiment(here, capsys):
    trained("run")
    capsys.readouterr()
    assert main(["train", "--resume", "run", "--experiment", "closer:CLOSER", "--quiet"]) == 2
    assert "its checkpoint was made with experiment bandit:KIND, not closer:CLOSER" in capsys.readouterr().err
    for words, told in (
        (["render", "--run", "run", "--out", "a.png"], "run: its experiment draws no episodes"),
        (["record", "run", "--out", "a.npz"], "run: its experiment makes no demonstrations"),
        (["evaluate", "run", "--goals", "grid"], "--goals: experiment bandit:KIND has no such evaluation"),
    ):
        assert main(words) == 2
        (said,) = capsys.readouterr().err.splitlines()
        assert told in said


def test_a_file_alone_imports_nothing(here, capsys, monkeypatch):
    monkeypatch.setenv("STAR_IMPORT", "")
    assert main(["train", "run.yaml", "--run-dir", "run", "--quiet"]) == 2
    assert "only a file names it, so it is not imported; type --import bandit" in capsys.readouterr().err
    assert "bandit" not in sys.modules and not Path("run").exists()
    assert main(["train", "run.yaml", "--run-dir", "run", "--quiet", "--import", "bandit"]) == 0


def test_star_is_one_of_them():
    assert kinds.of(parse({})) is kinds.find("star") and parse({}).experiment == "star"
