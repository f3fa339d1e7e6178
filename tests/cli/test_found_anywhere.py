"""What comes with the package, in an empty folder: configs by name, runs as a list, and a run that is only tried."""

import fcntl
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from star.cli import main
from star.config import shipped
from star.config.loading import load, parse
from tests.small import ALONE, RUN

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "150")
    return tmp_path


def test_every_config_file_has_a_name_by_which_it_is_found_and_a_sentence(capsys):
    files = {path.relative_to(ROOT / "configs") for path in (ROOT / "configs").rglob("*.yaml")}
    assert {Path(f"{name}.yaml") for name in shipped.names()} == files
    for name, sentence in shipped.described():
        found = shipped.find(Path(name))
        assert found == shipped.find(Path(f"configs/{name}.yaml")) == shipped.FOLDER / f"{name}.yaml"
        assert 10 < len(sentence) < 160 and sentence[0].isupper() and "\n" not in sentence
    assert main(["configs", "fall"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["ant_fall", "ant_fall_cpu"]


def test_a_file_goes_before_a_config_of_its_name_and_a_folder_does_not(folder):
    (folder / "point_maze").mkdir()
    assert load("point_maze") == load(ROOT / "configs/point_maze.yaml")
    assert load("point_maze", layers=["agents/hiro"]).commander.enabled is False
    (folder / "point_maze").rmdir()
    (folder / "point_maze").write_text("trainer: {num_envs: 64}")
    assert load("point_maze").trainer.num_envs == 64


def test_the_wheel_holds_the_configs_where_they_are_looked_for():
    wheel = (ROOT / "pyproject.toml").read_text()
    assert '"configs" = "star/configs"' in wheel and shipped.__file__ == str(ROOT / "star/config/shipped.py")


@pytest.mark.parametrize("name", ["envs/__init__.py", "envs.py"])
@pytest.mark.parametrize("words", [["-m", "star", "envs"], ["script.py"], ["deep.py"]], ids=" ".join)
def test_a_users_own_envs_in_the_place_of_ours_is_told_in_one_line(name, words, folder):
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).write_text("mine = 1\n")
    (folder / "script.py").write_text("import envs\nprint(envs.mine)\nimport star\n")
    (folder / "deep.py").write_text("from star.config.loading import load\n")
    done = subprocess.run(
        [sys.executable, *words], env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True
    )
    *before, said = done.stderr.splitlines()
    place = folder / name.split("/")[0]
    line = (
        f"{folder / name}: is imported as envs, in the place of {ROOT}/envs; rename {place}, or work in another folder"
    )
    if words[0] == "-m":
        assert (done.returncode, before, said, done.stdout) == (2, [], f"error: {line}", "")
    else:
        assert (done.returncode, said) == (1, f"ImportError: {line}")


def test_a_folder_envs_that_is_no_package_is_in_nobodys_place(folder):
    (folder / "envs").mkdir()
    command = [sys.executable, "-m", "star", "--version"]
    done = subprocess.run(command, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("word", ["--tutor.period 5", "--tutor.period=5", "tutor.period=5"])
def test_a_dry_run_shows_the_settings_and_writes_nothing(word, folder, capsys):
    (folder / "run.yaml").write_text(json.dumps(RUN))
    before = sorted(folder.rglob("*"))
    words = ["train", "run.yaml", "--seeds", "2", "--total-env-steps", "500", "--dry-run", "--tensorboard"]
    assert main([*words, *word.split()]) == 0
    out = capsys.readouterr().out
    assert sorted(folder.rglob("*")) == before
    config = parse(yaml.safe_load(out))
    assert (config.tutor.period, config.trainer.num_seeds, config.trainer.sinks) == (5, 2, ("tensorboard",))
    assert "runs/run-<time>" in out and "would train     720 env steps, 3 epochs of 240, 2 seeds" in out


def test_a_dry_run_says_how_often_a_level_learns_from_what_is_new(folder, capsys):
    (folder / "run.yaml").write_text(json.dumps(RUN | {"tutor": RUN["tutor"] | {"unroll": 2}}))
    td3 = "--tutor.learner td3 --tutor.td3.batch_size 30 --tutor.td3.updates_per_rollout 4 --trainer.num_envs 12"
    td3 += " --controller.termination_penalty 8"
    assert main(["train", "run.yaml", "--dry-run", *td3.split()]) == 0
    assert "# tutor: 5 samples per new transition\n" in (out := capsys.readouterr().out)  # 4 * 30 for 2 * 12
    assert "controller: " not in out and "sees no reward" not in out


def test_a_dry_run_says_which_settings_a_learner_without_reward_ignores(folder, capsys):
    control = {"learner": "crl", "frame": "map", "termination_penalty": 8.0, "crl": {"min_transitions": 100}}
    (folder / "run.yaml").write_text(json.dumps(ALONE | {"controller": control, "env": {"name": "point_u_maze"}}))
    assert main(["train", "run.yaml", "--dry-run"]) == 0
    assert "# controller.learner crl sees no reward; without effect: termination_penalty\n" in capsys.readouterr().out


def test_a_dry_run_says_where_the_goal_of_a_map_is_that_marks_none(folder, capsys):
    (folder / "run.yaml").write_text(json.dumps(RUN))
    for goal, told in (("0", True), ("g", False)):
        (folder / "map.txt").write_text(f"11111\n1{goal}011\n11r01\n11111\n")
        assert (
            main(
                [
                    "train",
                    "run.yaml",
                    "--dry-run",
                    *"--env.options.map map.txt --env.options.cell 2 --abstraction.cuts null".split(),
                ]
            )
            == 0
        )
        note = (
            '# env.options.map: no cell is "g"; the goal of tests is at x -2 m, y 2 m from the start, the longest walk'
        )
        assert (f"{note}\n" in capsys.readouterr().out) == told


def test_a_sink_of_the_command_line_joins_those_of_the_config(folder, capsys):
    pytest.importorskip("wandb")
    (folder / "run.yaml").write_text(json.dumps(RUN | {"trainer": RUN["trainer"] | {"sinks": ["tensorboard"]}}))
    assert main(["train", "run.yaml", "--dry-run", "--wandb", "--tensorboard"]) == 0
    assert parse(yaml.safe_load(capsys.readouterr().out)).trainer.sinks == ("tensorboard", "wandb")


def run_folder(name, *, steps, seeds=2, **values):
    folder = Path("runs", name)
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(json.dumps(RUN | values))
    rows = [
        {"seed": seed, "env_steps": step, **({"eval/success_final": 0.5 * seed} if step % 480 == 0 else {})}
        for step in steps
        for seed in range(seeds)
    ]
    (folder / "metrics.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in rows) + '{"seed": 0, "env')
    return folder


def listed(capsys, *words):
    assert main(["ls", *words]) == 0
    lines = capsys.readouterr().out.splitlines()
    return {line.split()[0]: line for line in lines}


def test_runs_are_listed_with_what_they_came_to(capsys):
    assert main(["ls"]) == 0 and capsys.readouterr().out == "no runs in runs\n"
    run_folder("whole", steps=range(240, 961, 240))
    run_folder("cut", steps=[240, 480, 720], commander=RUN["commander"] | {"enabled": False})
    run_folder("new", steps=[])
    faulty = run_folder("faulty", steps=[240])
    (faulty / "faults.jsonl").write_text("{}\n")
    broken = run_folder("broken", steps=[240])
    (broken / "config.yaml").write_text("tutor: [")
    odd = run_folder("odd", steps=[240])
    (odd / "metrics.jsonl").write_text("5\n")
    (Path("runs") / "no_run").mkdir()
    with (run_folder("busy", steps=[240]) / ".lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        lines = listed(capsys)
    assert "point_maze  STAR" in lines["whole"] and "success_final 0.25" in lines["whole"]
    assert " of " not in lines["whole"]
    assert "HIRO" in lines["cut"] and "success_final 0.25  1 k of 1 k" in lines["cut"]
    assert "success" not in lines["new"] + lines["faulty"]
    ends = {"whole": "done", "cut": "stopped", "new": "stopped", "faulty": "not finite", "busy": "training"}
    for name, state in (ends | {"broken": "cannot be read", "odd": "cannot be read"}).items():
        assert lines[name].rstrip().endswith(state)
    assert "not valid YAML" in lines["runs/broken:"] and "is not what a run writes" in lines["runs/odd:"]
    assert "no_run" not in lines


def test_only_the_end_of_a_long_file_is_read(capsys, monkeypatch):
    from star.report import listing

    monkeypatch.setattr(listing, "_TAIL", 300)
    run_folder("long", steps=range(240, 10 * 240, 240))
    line = listed(capsys)["long"]
    assert "2 k " in line
