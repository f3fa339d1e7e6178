"""Tutoring as an experiment: run folder, resume bit for bit, figures, and what its page says."""

import json
import re
import shutil
from inspect import signature
from pathlib import Path

import numpy as np
import pytest
from jax import random

from star.cli import main
from star.config.loading import load, parse
from star.training import program as programs
from star.training.journal import JsonLines
from star.tutoring import graphs, tracing
from star.tutoring.experiment import Tutoring
from star.tutoring.tracing import Found
from tests.small import arrays, assert_the_same

ROOT = Path(__file__).parents[2]
SMALL = {
    "experiment": "tutoring",
    "course": {"skills": 4, "exercises": 6, "needs": 4},
    "students": {"number": 6},
    "teaching": {"graph": "found", "sure": 0.3, "exercises": 5},
    "discovery": {"students": 8, "exercises": 10, "threshold": 0.2},
    "trainer": {"total_env_steps": 20, "num_seeds": 2, "eval_every": 1, "checkpoint_every": 1},
}


def guessed(config, needs, scores, students, *, key):
    """A graph in the place of `tracing.discover`, which has tests of its own and takes long to compile."""
    assert needs.shape == (6, 4) and scores.right.shape == scores.student.shape == (students * 10,)
    strength = random.uniform(key, (4, 4)) * scores.right.mean()
    return Found(parents=graphs.acyclic(strength, config.threshold), strength=strength, share=strength)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run."""
    folder = tmp_path_factory.mktemp("tutoring")
    (folder / "small.yaml").write_text(json.dumps(SMALL))
    assert signature(guessed).parameters.keys() == signature(tracing.discover).parameters.keys()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tracing, "discover", guessed)
        assert main(["train", str(folder / "small.yaml"), "--run-dir", str(folder / "whole"), "--quiet"]) == 0
        yield folder / "whole"


def test_a_run_goes_on_bit_for_bit(whole, tmp_path, monkeypatch):
    monkeypatch.setattr(Tutoring, "figures", lambda *_: {})  # nobody looks at them
    part = tmp_path / "part"
    shutil.copytree(whole, part)
    for steps in ("15", "20"):  # as of a run that was killed in its third epoch
        shutil.rmtree(part / "checkpoints" / steps)
    lines = (part / "metrics.jsonl").read_text().splitlines(keepends=True)
    (part / "metrics.jsonl").write_text("".join(lines[:5]))
    assert main(["train", "--resume", str(part), "--quiet"]) == 0
    names = assert_the_same(part, whole, 20)
    assert names >= {"students/level", "seen/success", "seen/own/gains", "plan/parents"}


def test_the_page_explains_every_metric_of_a_run_and_every_figure(whole):
    text = (ROOT / "docs/tutoring.md").read_text()
    told = set(re.findall(r"^\| `([a-z]+/[a-z_]+)`", text, re.MULTILINE))
    written = set(JsonLines(whole / "metrics.jsonl").read()[-1])
    assert told == {key for key in written if "/" in key and not key.endswith("/non_finite")}
    figures = {path.name for path in (whole / "figures").iterdir()}
    assert figures == {"summary.png", "skills.png", "graph.png"} and all(name in text for name in figures)


def test_what_is_measured_is_what_the_tables_say(whole):
    rows, tables = (JsonLines(whole / name).read() for name in ("metrics.jsonl", "skills.jsonl"))
    for row, table in zip(rows, tables, strict=True):
        assert (row["seed"], row["env_steps"]) == (table["seed"], table["env_steps"])
        assert row["eval/level"] == row["students/level"] == pytest.approx(np.mean(table["level"]), rel=1e-3)
        assert row["eval/mastered"] == pytest.approx(np.mean(table["mastered"]), abs=1e-3)
        assert sum(table["practised"]) == pytest.approx(1, abs=1e-3)
        true, found = ({tuple(edge[:2]) for edge in table[key]} for key in ("prerequisites", "found"))
        assert row["graph/precision"] == pytest.approx(len(true & found) / len(found) if found else 1.0)
        assert [edge[:2] for edge in table["found"] if edge[3] >= 0.3] == table["known"]
    levels = [row["eval/level"] for row in rows if row["seed"] == 0]
    assert levels == sorted(levels)  # what lasts is never lost


def test_other_commands_work_on_a_run(whole, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "150")
    assert main(["evaluate", str(whole), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    last = [row["eval/level"] for row in JsonLines(whole / "metrics.jsonl").read() if row["env_steps"] == 20]
    assert [seed["level"] for seed in found["seeds"]] == pytest.approx(last)
    assert main(["report", str(whole), "--out", str(tmp_path / "page.html")]) == 0
    assert '"unit":"exercises"' in (tmp_path / "page.html").read_text()
    assert main(["ls", str(whole.parent)]) == 0
    assert re.search(r"whole +4 skills +sgim_graph +2 +level \d+\.\d\d", capsys.readouterr().out.replace("page", ""))
    assert main(["settings", "tutoring"]) == 0
    assert {"teaching.selection.sharpness", "discovery.members"} <= {
        line.split()[0] for line in capsys.readouterr().out.splitlines()
    }


def test_all_tutors_teach_the_same_students_on_the_same_course(whole):
    program = programs.build(parse(SMALL, {"teaching.tutor": "random", "teaching.graph": "wrong"}))
    state, other = program.init(program.seed_keys()), arrays(whole, 20)
    for name in ("parents", "needs", "difficulty"):
        np.testing.assert_array_equal(getattr(state.course, name), other[f"course/{name}"])
    np.testing.assert_array_equal(state.students.speed, other["students/speed"])
    assert not np.array_equal(state.plan.parents, state.course.parents)


def test_each_shipped_config_has_the_tutor_of_its_name():
    for path in sorted((ROOT / "configs/tutoring").glob("*.yaml")):
        config = load(path)
        named = path.stem.removesuffix("_found")
        assert config.teaching.tutor == named and config.trainer.total_env_steps == 300
        assert (config.teaching.graph == "found") == path.stem.endswith("_found")
