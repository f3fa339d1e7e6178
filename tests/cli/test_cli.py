import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import envs
from envs import worlds
from envs.common.errors import UserError
from star.agent import exam_tables, exams
from star.agent.sections import Config
from star.cli import main
from star.cli.words import split_settings
from star.config import agents, described
from star.config.loading import fields
from star.training import trainer
from tests.cli.refused import refusal

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.usefixtures("folder")


@pytest.fixture
def calls(monkeypatch):
    """What `trainer.train` and `assessment.evaluate` are called with; neither does anything."""
    calls = []

    def train(config, run_dir, *, resume, quiet, profile):
        calls.append({"config": config, "run_dir": run_dir, "resume": resume, "quiet": quiet, "profile": profile})
        return trainer.Result(run_dir, 1_500, False, 0.25)

    def evaluate(targets, exam, *, quiet):
        calls.append({"targets": targets, "exam": exam, "config": targets[0].config})
        return [evaluation(agents.told(target.run_dir), env_steps=10) for target in targets]

    monkeypatch.setattr(trainer, "train", train)
    monkeypatch.setattr(exams, "evaluate", evaluate)
    return calls


def evaluation(run, *, env_steps):
    """A row as of `assessment.evaluate`."""
    shares = {name: 0.5 for name in ("success_any", "success_final")}
    others = dict.fromkeys(("distance", "return", "seconds_to_goal", "path_length", "stayed"), 7.0) | {"spl": None}
    others |= {"failures": {"flipped": 0, "fallen": 0, "stuck": 3, "out_of_time": 1}}
    row = {"episodes": 8} | shares | others | {f"{name}_interval": [0.25, 0.75] for name in shares}
    about = {"run": run, "env": "point_maze", "options": {}, "engine": "jax", "env_steps": env_steps, "goals": "test"}
    return about | row | {"film": True, "seeds": [{"seed": 3} | row | {"failed": [2, 5, 6, 7]}]}


def test_a_table_names_runs_as_they_are_called(capsys):
    names = ["[red]a[/red]", ":smile:", "<script>"]
    exam_tables.show([evaluation(name, env_steps=10) for name in names], None, again="")
    shown = capsys.readouterr().out
    assert all(name in shown for name in names) and "3 stuck, 1 out of time" in shown


def test_a_table_of_seeds_fits_into_100_columns_and_the_rest_is_told_below(capsys):
    row = evaluation("a", env_steps=90_000_000)
    over = {f"{name}_seeds_interval": [0.1, 1.0] for name in ("success_any", "success_final")}
    above = {"seeds": 1, "of": 2, "interval": [0.01, 0.99]}
    over |= dict.fromkeys(("success_any_above", "success_final_above"), above)
    seeds = [row["seeds"][0], row["seeds"][0] | {"seed": 4, "failed": []}]
    exam_tables.show([row | over | {"seeds": seeds}], None, again="")
    failed = "seed 3: fails in episodes 2, 5, 6, ... (3 stuck, 1 out of time)\n"
    table, _, below = capsys.readouterr().out.partition(failed)
    assert "8 episodes a seed" in table and max(map(len, table.splitlines())) <= 100
    assert "seed 4" not in below and "seeds above 0.9: success_any 1 of 2 [0.01, 0.99], success_final 1 of 2" in below


def test_runs_that_played_other_numbers_of_episodes_have_a_column_of_them(capsys):
    one, other = (evaluation(name, env_steps=10) for name in "ab")
    other = other | {"episodes": 500, "seeds": [other["seeds"][0] | {"episodes": 500}]}
    exam_tables.show([one, other], None, again="")
    shown = capsys.readouterr().out
    assert "episodes a seed" not in shown and " episodes " in shown
    assert [line.split()[2:4] for line in shown.splitlines() if "[0.250" in line] == [["3", "8"], ["3", "500"]]


def test_a_run_never_writes_over_another(capsys, folder):
    (folder / "full").mkdir()
    (folder / "full" / "thesis.txt").write_text("ten years of work")
    message = refusal(capsys, folder, "train point.yaml --run-dir full".split())
    assert "full: is not empty" in message and "--resume" not in message
    (folder / "full" / "config.yaml").write_text("{}")  # that of a run
    message = refusal(capsys, folder, "train point.yaml --run-dir full".split())
    assert "full: is not empty" in message and "star train --resume full" in message


def test_a_seed_that_is_too_large_is_refused(capsys, folder):
    assert "seed" in refusal(capsys, folder, f"train point.yaml --run-dir new --seed {2**32}".split())


@pytest.mark.parametrize("value", ["!!timestamp 2020-13-45", "1" * 5000])
def test_a_value_that_yaml_chokes_on_is_refused(capsys, folder, value):
    refusal(capsys, folder, ["train", "point.yaml", "--env.name", value])


def test_settings_and_flags_override_the_file(calls):
    arguments = "train point.yaml --seed 3 --seeds 2 --total-env-steps 4000 --quiet --run-dir new"
    settings = "--tutor.ppo.hidden [32,16] --commander.learning_rate=1e-3 --tutor.reward distance --env.options.a b"
    assert main([*arguments.split(), *settings.split()]) == 0
    (call,) = calls
    config = call["config"]
    assert (config.trainer.seed, config.trainer.num_seeds, config.trainer.total_env_steps) == (3, 2, 4000)
    assert (config.tutor.ppo.hidden, config.commander.learning_rate) == ((32, 16), 0.001)
    assert (config.tutor.reward, config.env.options) == ("distance", {"a": "b"})
    assert config.trainer.num_envs == 8
    assert (call["run_dir"], call["resume"], call["quiet"]) == (Path("new"), False, True)


@pytest.mark.parametrize(("flag", "epochs"), [([], 0), (["--profile"], 1), (["--profile", "3"], 3)])
def test_a_profile_is_of_as_many_epochs_as_asked_for(calls, flag, epochs):
    assert main(["train", "point.yaml", *flag]) == 0
    assert calls[0]["profile"] == epochs


def test_a_run_is_named_after_its_config_file_and_the_time(calls):
    assert main(["train", "point.yaml"]) == 0
    run_dir = calls[0]["run_dir"]
    assert run_dir.parent == Path("runs") and run_dir.name.startswith("point-")


def test_layers_lie_over_the_file_and_name_the_run(calls, folder):
    (folder / "calm.yaml").write_text("commander: {epsilon_end: 0}")
    assert main("train point.yaml --with calm.yaml --commander.period 60".split()) == 0
    config, run_dir = calls[0]["config"], calls[0]["run_dir"]
    assert (config.commander.epsilon_end, config.commander.period) == (0, 60)
    assert run_dir.name.startswith("point-calm-")


def test_a_finished_run_says_where_its_results_are(calls, capsys):
    assert main("train point.yaml --run-dir new".split()) == 0
    out, err = capsys.readouterr()
    assert err == ""
    for text in ("1,500 env steps", "0.25", "new/figures/summary.png", "new/metrics.jsonl", "star evaluate new"):
        assert text in out


def test_resume_goes_on_in_the_same_directory_with_its_config(calls):
    assert main("train --resume runs/old --total-env-steps 9000".split()) == 0
    (call,) = calls
    assert (call["run_dir"], call["resume"]) == (Path("runs/old"), True)
    assert call["config"].trainer.total_env_steps == 9000


@pytest.mark.parametrize(
    "arguments",
    [
        "train --resume runs/old --tutor.reward_scale 2",
        "train --tutor.reward_scale 2 point.yaml",
        "evaluate --tutor.reward_scale 2 runs/old",
    ],
)
def test_settings_may_stand_anywhere(calls, arguments):
    assert main(arguments.split()) == 0
    assert calls[0]["config"].tutor.reward_scale == 2.0


@pytest.mark.parametrize(("terminated", "code"), [(False, 130), (True, 0)])
def test_an_interrupted_run_says_how_to_go_on(monkeypatch, capsys, terminated, code):
    stopped = trainer.Result(Path("new"), 500, True, None, terminated)
    monkeypatch.setattr(trainer, "train", lambda config, run_dir, **_: stopped)
    assert main("train point.yaml --run-dir new".split()) == code
    assert "star train --resume new" in capsys.readouterr().out


def test_a_second_interrupt_ends_without_a_traceback(monkeypatch, capsys):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(trainer, "train", interrupted)
    assert main(["train", "point.yaml"]) == 130
    assert capsys.readouterr().err == ""


def test_evaluate_prints_a_line_for_each_seed_and_how_to_watch_a_failure(calls, capsys):
    assert (
        main("evaluate runs/old --episodes 7 --checkpoint best --evaluation-seed 4 --env.options.cell 4".split()) == 0
    )
    out = capsys.readouterr().out
    assert (
        "3 0.500 [0.250, 0.750] 0.500 [0.250, 0.750] 7.0 7.0 - 7.00 7.00 seed 3: fails in episodes 2, 5, 6, ..."
        in " ".join(out.split())
    )
    assert "8 episodes a seed" in out
    again = "--run runs/old --checkpoint 10 --seed 3 --episode 2 --evaluation-seed 4 --episodes 7 --env.options.cell 4"
    assert f"star render {again} --out failure.html" in out
    (call,) = calls
    ((target,), exam) = call["targets"], call["exam"]
    assert (target.run_dir, target.checkpoint, target.config.trainer.eval_episodes) == (Path("runs/old"), "best", 7)
    assert (exam.seed, exam.grid, exam.task, target.config.env.options) == (4, None, {"env.options.cell": 4}, {})


def test_evaluate_prints_a_line_of_json_for_each_checkpoint_on_request(calls, capsys):
    assert main("evaluate runs/old/checkpoints/30 runs/old --json --checkpoint all".split()) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [row["seeds"][0]["seed"] for row in rows] == [3, 3]
    assert [(t.run_dir, t.checkpoint) for t in calls[0]["targets"]] == [
        (Path("runs/old"), "30"),
        (Path("runs/old"), "all"),
    ]


def test_evaluate_compares_groups_of_runs_and_each_other_run_by_itself(calls, folder, capsys):
    for name in ("a", "b"):
        shutil.copytree(folder / "runs" / "old", folder / "runs" / name)
    twice = "evaluate --group ours=runs/a,runs/b".split()
    assert "--group: ours: seed 0 is in runs/a and in runs/b; allowed: once" in refusal(capsys, folder, twice)
    (folder / "runs" / "b" / "config.yaml").write_text("trainer: {seed: 1}")
    assert main(f"evaluate runs/old --group ours=runs/a,{folder}/runs/b/ --out eval --json".split()) == 0
    lines = capsys.readouterr().out.splitlines()
    comparison = json.loads(lines[-1])
    assert len(lines) == 4
    assert [(group["name"], len(group["runs"])) for group in comparison["groups"]] == [("ours", 2), ("runs/old", 1)]
    assert comparison["groups"][0]["success_any"]["scores"] == {"point_maze": [0.5, 0.5]}
    assert [pair["success_final"] for pair in comparison["improvement"]] == [0.5, 0.5]
    ours, old = (group["success_any"] for group in comparison["groups"])
    assert ours["mean_interval"] == [0.0, 1.0] and old["mean_interval"] is None  # one seed tells nothing of others
    assert all(pair["success_any_difference_interval"] is None for pair in comparison["improvement"])
    assert (folder / "eval" / "evaluation.jsonl").read_text().splitlines() == lines
    assert {path.name for path in (folder / "eval").iterdir()} == {"evaluation.jsonl", "profile.png"}
    assert "eval/evaluation.jsonl: exists" in refusal(capsys, folder, "evaluate runs/old --out eval".split())
    assert main("evaluate runs/old --out eval --force --quiet".split()) == 0
    assert {path.name for path in (folder / "eval").iterdir()} == {"evaluation.jsonl"}


def test_agents_of_the_package_are_compared_by_their_names(calls, capsys):
    assert main("evaluate ant_maze runs/old --group ours=point_maze --json".split()) == 0
    comparison = json.loads(capsys.readouterr().out.splitlines()[-1])
    found = {group["name"]: group["runs"] for group in comparison["groups"]}
    assert found == {"ours": ["point_maze"], "ant_maze": ["ant_maze"], "runs/old": ["runs/old"]}


def test_files_about_an_agent_of_the_package_need_a_folder(calls, capsys, folder):
    command = "evaluate point_maze --goals grid --grid 2".split()
    assert "point_maze has no folder for them; add --out DIR" in refusal(capsys, folder, command)
    assert main([*command, "--out", "seen"]) == 0 and (folder / "seen" / "evaluation.jsonl").exists()


def test_evaluate_takes_the_engine_of_this_machine(calls, folder):
    (folder / "runs" / "old" / "config.yaml").write_text("env: {name: ant_maze, engine: warp}")
    assert main("evaluate runs/old".split()) == 0
    assert calls[0]["config"].env.engine == "auto"


@pytest.mark.parametrize("arguments", [[], ["--help"]])
def test_help_shows_how_to_train_resume_and_evaluate(capsys, arguments):
    try:
        code = main(arguments)
    except SystemExit as end:
        code = end.code
    out, err = capsys.readouterr()
    assert (code, err) == (0, "")
    for text in (
        "star train configs/",
        "--resume",
        "star evaluate",
        "star render",
        "star record",
        "star report",
        "star envs",
        "star settings",
    ):
        assert text in out


def test_settings_lists_every_key_with_its_default(capsys):
    assert main(["settings"]) == 0
    lines = capsys.readouterr().out.splitlines()
    every = list(described.settings(Config))
    assert [line.split()[0] for line in lines] == [one.key for one in every]
    assert [one.key for one in every if "[]" not in one.key] == [key for key, _, _ in fields(Config)]
    for line, one in zip(lines, every, strict=True):
        default = "none" if one.field.is_required() else json.dumps(one.default)
        assert one.about in line and line.endswith(f"; default {default}]")


@pytest.mark.parametrize(
    ("word", "keys"),
    [
        ("tutor.ppo", [key for key, _, _ in fields(Config) if key.startswith("tutor.ppo.")]),
        ("TILT", ["controller.tilt_penalty", "controller.tilt_start", "controller.tilt_steps"]),
        ("checksum", ["sgim.teachers[].sha256"]),
        ("wandb", ["trainer.sinks"]),
    ],
)
def test_settings_are_found_by_a_part_of_key_or_text(word, keys, capsys):
    assert main(["settings", word]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == keys


def test_envs_lists_every_task(capsys):
    assert main(["envs"]) == 0
    lines = capsys.readouterr().out.splitlines()
    others = [*worlds.names(), "room"]
    assert [line.split()[0] for line in lines] == [*envs.names(), *others]
    assert [line for line in lines if " " in line] == lines[-len(others) :]


@pytest.mark.parametrize(
    ("value", "read"),
    [
        ("1e-3", 0.001),
        ("0.5", 0.5),
        ("5", 5),
        ("true", True),
        ("null", None),
        ("[1, 2]", [1, 2]),
        ("[[4, 8], []]", [[4, 8], []]),
        ("a=b", "a=b"),
        ("-1", -1),
        ("[1", "[1"),
    ],
)
def test_values_are_read_as_yaml(value, read):
    assert split_settings(["--a.b", value]) == split_settings([f"--a.b={value}"]) == ([], {"a.b": read})


def test_of_two_values_the_last_one_counts():
    assert split_settings("--a.b 1 --a.b 2".split()) == ([], {"a.b": 2})


@pytest.mark.parametrize("arguments", ["a.b 1", "--ab 1", "-a.b 1"])
def test_what_is_no_setting_is_left_to_the_command(arguments):
    assert split_settings(arguments.split()) == (arguments.split(), {})


def test_a_setting_without_a_value_is_refused():
    with pytest.raises(UserError, match="needs a value"):
        split_settings(["--a.b"])


def test_the_program_itself_prints_help_and_no_warnings():
    command = [sys.executable, "-W", "default", "-m", "star", "--help"]
    where = {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | where, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("usage: star")


@pytest.mark.parametrize("key", ["\\e[31mred", "two\\nlines", "\\ud800", "\\u202egpj", "x" * 5000])
def test_a_refusal_is_one_printable_line_whatever_was_typed(folder, capsys, key):
    (folder / "odd.yaml").write_text(f'"{key}": 1\n')
    assert main(["train", "odd.yaml", "--run-dir", "new"]) == 2
    line = capsys.readouterr().err.removesuffix("\n")
    assert line.startswith("error: odd.yaml: ") and line.isprintable() and len(line) < 1200
    assert not (folder / "new").exists()


@pytest.mark.parametrize("words", [["--run-dir", "x" * 300], ["--resume", "x" * 300], ["x" * 300]])
def test_a_name_that_no_file_can_have_is_refused_in_one_line(words, capsys):
    config = [] if words[0] != "--run-dir" else ["point.yaml"]
    assert main(["train", *config, *words, "--trainer.device", "cpu"]) == 2
    assert "File name too long" in capsys.readouterr().err
