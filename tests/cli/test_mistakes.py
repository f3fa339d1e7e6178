"""What people type by mistake, each with the one line that they read: mistakes.txt. And output that nobody reads."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from star.agent import commands as star_commands
from star.agent import demonstrations, exam_results, exam_tables, exams, films
from star.cli import command, main
from star.report import page, watching
from star.sweeps import work
from star.training import trainer
from star.tutoring import discover
from tests.cli.refused import refusal

ROOT = Path(__file__).parents[2]
FILES = {
    "odd.yaml": "tutor: {period: ten}\n",
    "wrong.yaml": "tutor: {perod: 5}\n",
    "unfit.yaml": "tutor: {period: 7}\n",
    "fine.yaml": "tutor: {period: 10}\n",
    "list.yaml": "- 1\n",
    "sweep.yaml": "config: point.yaml\nparameters: {tutor.period: {choices: [5, 10]}}\n",
    "oddsweep.yaml": "config: point.yaml\nparameters: {tutor.perod: {choices: [5, 10]}}\n",
    "oddkey.yaml": "config: point.yaml\nparametrs: {tutor.period: {choices: [5, 10]}}\n",
    "skills.csv": "exercise,skill\nsums,add\ntables,multiply\n",
    "scores.csv": "student,exercise,correct\nann,sums,1\nann,tables,0\n",
    "nocorrect.csv": "student,exercise,score\nann,sums,1\n",
    "twocolumns.csv": "student,student,exercise,correct\nann,ann,sums,1\n",
    "half.csv": "student,exercise,correct\nann,sums,1\nann,tables,0.5\n",
    "alone.csv": "student,exercise,correct\nann,sums,1\nann,tables,0\nbo,sums,1\n",
    "short.csv": "student,exercise,correct\nann,sums,1\nann,tables\n",
    "nobody.csv": "student,exercise,correct\nann,sums,1\n,tables,0\n",
    "unknown.csv": "student,exercise,correct\nann,sums,1\nann,halves,0\n",
    "quoted.csv": 'student,exercise,correct\n"ann"x,sums,1\n',
    "empty.csv": "",
    "header.csv": "student,exercise,correct\n",
    "unused.csv": "exercise,skill\nsums,add\ntables,multiply\nunions,sets\n",
    "twice.csv": "exercise,skill\nsums,add\nsums,add\n",
    "oneskill.csv": "exercise,skill\nsums,add\ntables,add\n",
    "large.txt": "1" * 65 + "\n1r" + "0" * 62 + "1\n" + "1" * 65 + "\n",
    "taken/graph.json": "precious",
    "runs/bad/config.yaml": "tutor: [",
    "runs/alien/config.yaml": "experiment: their:KIND\n",
}


def listed():
    """(section, command line, line that is said) of the file."""
    text = (Path(__file__).parent / "mistakes.txt").read_text(encoding="utf-8")
    for section in text.split("\n# ")[1:]:
        title = section.splitlines()[0]
        for words, said in re.findall(r"^\$ (.*)\n(.+)$", section, re.MULTILINE):
            yield title, words, said


LISTED = list(listed())
ANYWHERE, MACHINE, VARIABLES = dict.fromkeys(title for title, *_ in LISTED)


def of(title):
    return [pytest.param(words, said, id=words) for one, words, said in LISTED if one == title]


def is_said(line, said):
    """Whether a line is the one in the file, whose `...` is anything."""
    pattern = ".*".join(map(re.escape, said.replace("ROOT", str(ROOT)).split("...")))
    return re.fullmatch(f"error: {pattern}\n", line) is not None


@pytest.fixture(autouse=True)
def here(folder):
    for name, text in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def test_there_are_more_than_sixty_and_each_is_listed_once():
    assert len(LISTED) == len({words for _, words, _ in LISTED}) > 60
    text = (Path(__file__).parent / "mistakes.txt").read_text(encoding="utf-8")
    assert text.count("\n$ ") == len(LISTED)
    commands = {words.split()[1] for _, words, _ in LISTED}
    assert commands >= command.COMMANDS.keys()


@pytest.mark.parametrize(("words", "said"), of(ANYWHERE))
def test_a_mistake_is_told_in_one_line_and_nothing_is_written(capsys, folder, words, said):
    line = refusal(capsys, folder, words.split()[1:])
    assert is_said(line, said), line


@pytest.mark.parametrize(("words", "said"), of(MACHINE))
def test_what_machine_or_task_cannot_do_is_told_in_one_line_and_nothing_is_written(capsys, folder, bare, words, said):
    line = refusal(capsys, folder, [*words.split()[1:], "--run-dir", "new"])
    assert is_said(line, said), line


@pytest.mark.parametrize(("words", "said"), of(VARIABLES))
def test_a_wrong_variable_is_told_in_one_line_and_nothing_is_written(folder, words, said):
    variable, _, *arguments = words.split()
    environment = os.environ | {"PYTHONPATH": str(ROOT)} | dict([variable.split("=")])
    done = subprocess.run(
        [sys.executable, "-m", "star", *arguments, "--run-dir", "new"], env=environment, capture_output=True, text=True
    )
    *of_jax, line = done.stderr.splitlines(keepends=True)  # JAX's own plugins may speak up first
    assert done.returncode == 2 and is_said(line, said) and "star" not in "".join(of_jax), done.stderr
    assert not (folder / "new").exists()


PRINTING = {
    "train": "train point.yaml",
    "dry run": "train point.yaml --dry-run",
    "sweep": "sweep sweep.yaml",
    "ls": "ls",
    "evaluate": "evaluate runs/old --json",
    "render": "render point_maze --out new.png",
    "record": "record runs/old --out new.npz",
    "report": "report runs/old --out new.html",
    "watch": "watch runs/old",
    "tutor": "tutor discover scores.csv skills.csv",
    "configs": "configs",
    "envs": "envs",
    "settings": "settings",
    "completion": "completion bash",
    "help": "--help",
    "help of a command": "train --help",
    "version": "--version",
}


@pytest.mark.parametrize("words", PRINTING.values(), ids=PRINTING)
def test_output_that_nobody_reads_is_no_error(words, monkeypatch, capsys):
    assert {one.split()[0] for one in PRINTING.values()} >= command.COMMANDS.keys()
    monkeypatch.setattr(trainer, "train", lambda config, run_dir, **_: trainer.Result(run_dir, 9, False, None))
    monkeypatch.setattr(work, "run", lambda found, out, **_: work.Summary([], True, {"trial": 0}))
    monkeypatch.setattr(exams, "evaluate", lambda targets, exam, **_: [{"run": "old"}])
    monkeypatch.setattr(exam_results, "check_groups", lambda groups, configs: None)
    monkeypatch.setattr(exam_tables, "show", lambda rows, comparison, **_: None)
    monkeypatch.setattr(star_commands, "check_output", lambda out, force: None)
    monkeypatch.setattr(discover, "discover", lambda options, overrides: print("found") or 0)
    for module, name in ((films, "render"), (demonstrations, "record"), (page, "write")):
        monkeypatch.setattr(module, name, lambda *_, **__: "written")
    monkeypatch.setattr(watching, "serve", lambda *_, say, **__: say("served"))
    reading, writing = os.pipe()
    os.close(reading)
    with monkeypatch.context() as patch, os.fdopen(writing, "w") as nowhere:
        patch.setattr(sys, "stdout", nowhere)
        try:
            code = main(words.split())
        except SystemExit as end:  # argparse, after help
            code = end.code
    assert code == 0 and capsys.readouterr().err == ""


def test_the_first_line_alone_may_be_read(folder):
    line = f"{shlex.quote(sys.executable)} -m star settings | head -n 1"
    done = subprocess.run(
        ["bash", "-o", "pipefail", "-c", line],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, "") and done.stdout.startswith("experiment ")
