import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import pytest

import envs
from envs.common.errors import UserError
from star.agent import exam_tables, exams
from star.agent.sections import Config
from star.cli import main
from star.cli.words import split_settings
from star.config import described
from star.config.loading import fields
from star.training import trainer

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
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


@pytest.fixture
def calls(monkeypatch):
    """What `trainer.train` and `assessment.evaluate` are called with; neither does anything."""
    calls = []

    def train(config, run_dir, *, resume, quiet, profile):
        calls.append({"config": config, "run_dir": run_dir, "resume": resume, "quiet": quiet, "profile": profile})
        return trainer.Result(run_dir, 1_500, False, 0.25)

    def evaluate(targets, exam, *, quiet):
        calls.append({"targets": targets, "exam": exam, "config": targets[0].config})
        return [evaluation(str(target.run_dir), env_steps=10) for target in targets]

    monkeypatch.setattr(trainer, "train", train)
    monkeypatch.setattr(exams, "evaluate", evaluate)
    return calls


def evaluation(run, *, env_steps):
    """A row as of `assessment.evaluate`."""
    shares = {name: 0.5 for name in ("success_any", "success_final")}
    others = dict.fromkeys(("distance", "return", "seconds_to_goal", "path_length", "stayed"), 7.0) | {"spl": None}
    row = {"episodes": 8} | shares | others | {f"{name}_interval": [0.25, 0.75] for name in shares}
    about = {"run": run, "env": "point_maze", "options": {}, "engine": "jax", "env_steps": env_steps, "goals": "test"}
    return about | row | {"film": True, "seeds": [{"seed": 3} | row | {"failed": [2, 5, 6, 7]}]}


def test_a_table_names_runs_as_they_are_called(capsys):
    names = ["[red]a[/red]", ":smile:", "<script>"]
    exam_tables.show([evaluation(name, env_steps=10) for name in names], None, again="")
    shown = capsys.readouterr().out
    assert all(name in shown for name in names)


def contents(folder):
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def refusal(capsys, folder, arguments):
    """What a command that fails says: exit code 2, one line on stderr, nothing on stdout, nothing written."""
    before = contents(folder)
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == "" and contents(folder) == before
    assert err.startswith("error: ") and err.endswith("\n") and err.count("\n") == 1
    return err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        pytest.param("train point.yaml --commander.perod 5", "commander.period?", id="misspelt key"),
        pytest.param("trian point.yaml", "star: 'trian' is no command (did you mean star train?)", id="command"),
        pytest.param("practise point.yaml", "'practise' is no command (allowed: train, sweep, ", id="no command"),
        pytest.param("train point.yaml tutor.perod=5", "command line: tutor.perod: unknown key", id="misspelt word"),
        pytest.param("train point.yaml tutor.period=x", "command line: tutor.period: 'x' is not", id="value of a word"),
        pytest.param("train pointmaze", "pointmaze: no such file (did you mean point_maze?)", id="name of a config"),
        pytest.param("train point.yaml --with agents/hiros", "(did you mean agents/hiro?)", id="name of a layer"),
        pytest.param("train sweeps/point_maze", "is a sweep file, for star sweep", id="sweep as a config"),
        pytest.param("sweep point_maze", "point_maze.yaml: is no sweep file", id="config as a sweep"),
        pytest.param("configs arm", "arm: no config has this in its name", id="no such configs"),
        pytest.param("ls nowhere", "nowhere: cannot be read: No such file", id="runs of no folder"),
        pytest.param("train point.yaml --dry-run --tutor.period 7", "not a multiple", id="dry run of what is refused"),
        pytest.param("train point.yaml --with no.yaml", "no.yaml: no such file", id="missing layer"),
        pytest.param(
            "train --resume run --with point.yaml", "--with: a resumed run keeps", id="layer on a resumed run"
        ),
        pytest.param("train point.yaml --comander.period 5", "commander?", id="misspelt section"),
        pytest.param("train point.yaml --tutor.period ten", "tutor.period: 'ten' is not allowed", id="wrong type"),
        pytest.param("train point.yaml --tutor.ppo 5", "tutor.ppo: 5 is not allowed", id="section as a value"),
        pytest.param("train point.yaml --commander.learning_rate nan", "finite", id="not a number"),
        pytest.param("train point.yaml --trainer.num_envs true", "trainer.num_envs: true", id="boolean as a number"),
        pytest.param("train point.yaml --commander.discount -1", "commander.discount: -1", id="out of range"),
        pytest.param("train point.yaml --seeds 0", "trainer.num_seeds: 0", id="no seeds"),
        pytest.param("train point.yaml --tutor.period 7", "not a multiple", id="periods that do not fit"),
        pytest.param("train point.yaml --tutor.period", "--tutor.period: needs a value", id="no value"),
        pytest.param("train point.yaml --trainer.sinks tensorboard", "should be a list", id="sinks not a list"),
        pytest.param("train point.yaml --trainer.sinks [mlflow]", "'tensorboard' or 'wandb'", id="unknown sink"),
        pytest.param("train point.yaml --trainer.sinks [wandb,wandb]", "sinks: wandb is given twice", id="sink twice"),
        pytest.param("train point.yaml --profile 0", "--profile: '0' is not a whole number from 1", id="profile none"),
        pytest.param("train --profile point.yaml", "--profile: 'point.yaml' is not a whole", id="profile a file"),
        pytest.param("train point.yml", "did you mean point.yaml?", id="missing config"),
        pytest.param("train broken.yaml", "broken.yaml: line 3", id="broken config"),
        pytest.param("train point.yaml --bogus", "--bogus: unknown argument", id="unknown flag"),
        pytest.param("train point.yaml --tutor 5", "--tutor: unknown argument", id="flag without a dot"),
        pytest.param("train point.yaml --run_dir new", "(did you mean --run-dir?)", id="misspelt flag"),
        pytest.param("train point.yaml --trainer.seed --quiet", "--trainer.seed: needs a value", id="no value"),
        pytest.param("train point.yaml more", "more: unknown argument", id="too many arguments"),
        pytest.param("train", "either a config file or --resume", id="neither config nor resume"),
        pytest.param("train point.yaml --resume runs/old", "either a config file or --resume", id="both"),
        pytest.param("train --resume runs/new", "runs/new: is not a run directory", id="resume of a non-run"),
        pytest.param("train --resume runs/old --run-dir a", "--run-dir", id="resume elsewhere"),
        pytest.param("evaluate runs/new", "runs/new: is not a run directory", id="evaluate a non-run"),
        pytest.param("evaluate runs/old", "runs/old: holds no checkpoint", id="evaluate without checkpoint"),
        pytest.param("evaluate", "give a RUN, or --group", id="evaluate nothing"),
        pytest.param("evaluate runs", "runs: is not a run directory, it holds no config", id="evaluate a folder"),
        pytest.param("evaluate runs/old/checkpoints/5", "runs/old: holds no checkpoint", id="evaluate no such steps"),
        pytest.param("evaluate runs/old --group a=", "--group: 'a=' is not of the form", id="empty group"),
        pytest.param("evaluate --group a=runs/old --group b=runs/old", "both in a and in b", id="two groups"),
        pytest.param("evaluate --group a=runs/old --group a=runs/x", "--group: a is given twice", id="group twice"),
        pytest.param("evaluate --group a=runs/x", "runs/x: is not a run directory", id="group of a non-run"),
        pytest.param("evaluate runs/old --grid 4", "--grid: needs --goals grid", id="grid without goals"),
        pytest.param("evaluate runs/old --goals grid --grid 65", "from 1 to 64", id="huge grid"),
        pytest.param("evaluate runs/old --out old.png", "old.png is a file, not a folder", id="evaluate into a file"),
        pytest.param("evaluate runs/old --episodes x", "trainer.eval_episodes: 'x'", id="episodes not a number"),
        pytest.param("evaluate runs/old --evaluation-seed x", "--evaluation-seed", id="seed not a number"),
        pytest.param("render", "required: --out", id="render nothing"),
        pytest.param("render --out a.png", "give a task, or --run RUN", id="render neither task nor run"),
        pytest.param("render point_maze --out a.avi", "a.avi: cannot tell what to write", id="render an odd ending"),
        pytest.param("render point_maze --out a/b.png", "there is no folder a", id="render into no folder"),
        pytest.param("render point_maze --out runs", "runs: is a folder", id="render over a folder"),
        pytest.param("render point_maze --out old.png", "old.png: exists; replace it with --force", id="render over"),
        pytest.param("render point_maze --out a.png --seed 1", "--seed: needs --run", id="render seed without run"),
        pytest.param("render point_maze --out a.png --checkpoint best", "--checkpoint: needs --run", id="no run"),
        pytest.param("render point_maze --out a.png --episode 1", "--episode: needs --run", id="episode of no run"),
        pytest.param("render point_maze --out a.png --goals grid", "--goals: grid needs --run", id="grid of no run"),
        pytest.param("render --run runs/old --out a.png --goals grid", "need --episode K", id="render only a grid"),
        pytest.param("render --run runs/old --out a.png --episode 1 --envs 2", "so --envs", id="episodes of one"),
        pytest.param("render point_maze --out a.png --tutor.period 5", "--tutor.period: random", id="render settings"),
        pytest.param("render point_maze --out a.gif --envs 26", "from 1 to 25", id="render too many"),
        pytest.param("render point_maze --out a.gif --every 0", "from 1 to", id="render every 0th"),
        pytest.param("render point_maze --out a.gif --camera folow", "choose from", id="render unknown camera"),
        pytest.param("render --run runs/new --out a.gif", "runs/new: is not a run directory", id="render a non-run"),
        pytest.param("record runs/old", "required: --out", id="record into nothing"),
        pytest.param("record --out a.npz", "required: run", id="record nothing"),
        pytest.param("record runs/new --out a.npz", "runs/new: is not a run directory", id="record a non-run"),
        pytest.param("record runs/old --out a.npz", "runs/old: holds no checkpoint", id="record without checkpoint"),
        pytest.param("record runs/old --out a.csv", "a.csv: cannot tell what to write", id="record an odd ending"),
        pytest.param("record runs/old --out a/b.npz", "there is no folder a", id="record into no folder"),
        pytest.param("record runs/old --out old.npz", "old.npz: exists; replace it with --force", id="record over"),
        pytest.param("record runs/old --out a.npz --episodes 0", "from 1 to 10000", id="record no episode"),
        pytest.param("report runs/old", "required: --out", id="report into nothing"),
        pytest.param("report --out a.html", "star report: give a RUN, or --group", id="report nothing"),
        pytest.param("report runs/new --out a.html", "runs/new: is not a run directory", id="report a non-run"),
        pytest.param("report runs/old --out a.html", "runs/old: its metrics.jsonl holds no", id="report an empty run"),
        pytest.param("report runs/old runs/../runs/old --out a.html", "is given twice", id="report a run twice"),
        pytest.param("report runs/old --out a.pdf", "a.pdf: cannot tell what to write", id="report an odd ending"),
        pytest.param("report runs/old --out a/b.html", "there is no folder a", id="report into no folder"),
        pytest.param("report runs/old --out old.html", "old.html: exists; replace it with --force", id="report over"),
        pytest.param("report runs/old --out a.html --tutor.period 5", "takes no settings", id="report with a setting"),
        pytest.param(
            "settings tutr",
            "tutr: no setting has this in its key or its text (did you mean tutor?)",
            id="unknown setting",
        ),
        pytest.param("settings --tutor.period=5", "takes no settings", id="settings with a setting"),
        pytest.param("envs --tutor.period 5", "takes no settings", id="envs with a setting"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(capsys, folder, arguments, said):
    assert said in refusal(capsys, folder, arguments.split())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        pytest.param("train ant.yaml --env.engine warp", 'pip install "star-rl[warp]"', id="engine"),
        pytest.param(
            "train point.yaml --env.engine native", 'engine "native" is not one of point_maze', id="no engine"
        ),
        pytest.param("train point.yaml --trainer.device gpu", 'pip install "star-rl[cuda,warp]"', id="device"),
        pytest.param("train point.yaml --env.name point_mase", 'did you mean "point_maze"?', id="task"),
        pytest.param("train point.yaml --env.options.presett fast", 'option "presett"', id="option"),
        pytest.param("train point.yaml --env.options.episode_length -5", "episode_length", id="value of an option"),
        pytest.param("train point.yaml --abstraction.cuts [[50],[8]]", "abstraction.cuts: [50.0]", id="cuts"),
        pytest.param("train point.yaml --tutor.unroll 7", "tutor.unroll: 7 does not divide", id="unroll"),
    ],
)
def test_what_machine_or_task_cannot_do_is_one_line_and_nothing_is_written(capsys, folder, bare, arguments, said):
    assert said in refusal(capsys, folder, [*arguments.split(), "--run-dir", "new"])


def test_a_run_never_writes_over_another(capsys, folder):
    (folder / "full").mkdir()
    (folder / "full" / "thesis.txt").write_text("ten years of work")
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
    (folder / "calm.yaml").write_text("commander: {practice: 0}")
    assert main("train point.yaml --with calm.yaml --commander.period 60".split()) == 0
    config, run_dir = calls[0]["config"], calls[0]["run_dir"]
    assert (config.commander.practice, config.commander.period) == (0, 60)
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
    assert "3 8 0.500 [0.250, 0.750] 0.500 [0.250, 0.750] 7.0 7.0 - 7.00 7.00 2 5 6 ..." in " ".join(out.split())
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
        ("TILT", ["controller.tilt_penalty", "controller.tilt_start", "controller.tilt_steps", "controller.frame"]),
        ("checksum", ["sgim.teachers[].sha256"]),
        ("wandb", ["trainer.sinks"]),
    ],
)
def test_settings_are_found_by_a_part_of_key_or_text(word, keys, capsys):
    assert main(["settings", word]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == keys


def test_envs_lists_every_task(capsys):
    assert main(["envs"]) == 0
    assert capsys.readouterr().out.split() == list(envs.names())


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
