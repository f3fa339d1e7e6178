import importlib
import importlib.util
import itertools
import json
import operator
import re
import shlex
import shutil
import sys
import tomllib
from pathlib import Path

import jax
import pytest
import yaml

import envs
from envs import opengl
from envs.tasks import TASKS
from star.agent import commands as star_commands
from star.agent import demonstrations, exam_results, exam_tables, exams, films
from star.agent.sections import Config
from star.cli import main
from star.config.loading import fields, load, parse
from star.saht.chime.sections import Config as ChimeConfig
from star.saht.sections import Config as SahtConfig
from star.sweeps import work
from star.training import program as programs
from star.training import trainer
from star.tutoring import discover
from tests import small as smaller
from tests.scripts import load as load_script

ROOT = Path(__file__).parents[1]
PAGES = {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in sorted(ROOT.glob("docs/*.md"))}
PAGES["README.md"] = (ROOT / "README.md").read_text(encoding="utf-8")
DEFAULTS = {key: default for key, default, _ in fields(Config)}
WRITTEN_BY_THE_TRAINER = {"seed", "env_steps", "wall_s", "env_steps_per_s"} | {
    f"eval/{name}" for name in ("success_any", "success_final", "distance", "return", "flipped", "time_at_goal")
}


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", PAGES[page], re.DOTALL | re.MULTILINE)


def inline(text):
    """Inline code outside of fenced blocks."""
    return re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE))


def rows(page):
    """Cells of the table rows whose first cell is inline code: [[code, cell, ...], ...]."""
    found = re.findall(r"^\| `([^`]+)`[^|]*\|(.*)\|$", PAGES[page], re.MULTILINE)
    return [[first, *(cell.strip() for cell in rest.split("|"))] for first, rest in found]


def files(page):
    """The files that a page tells to write: {name: text}."""
    return dict(re.findall(r'^```\w+ title="([^"]+)"\n(.*?)^```', PAGES[page], re.DOTALL | re.MULTILINE))


def commands():
    """Every command line that begins with `star` or `make`, as (page, words); not the bare names of commands."""
    for page, text in PAGES.items():
        lines = [line for block in blocks(page, "bash") for line in block.replace("\\\n", " ").splitlines()]
        for line in lines + [code for code in inline(text) if code not in ("star train", "star evaluate")]:
            line = line.removeprefix(".venv/bin/")
            if re.match(r"(star|make) \S", line):
                yield page, shlex.split(line.replace("$SLURM_ARRAY_TASK_ID", "3"), comments=True)


COMMANDS = [pytest.param(words, id=" ".join([page, *words])[:90]) for page, words in commands()]
STAR = [one for one in COMMANDS if one.values[0][0] == "star"]
MAKE = [one for one in COMMANDS if one.values[0][0] == "make"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working directory with the shipped config files and those of the tutorial, where no command really trains."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    told = [f"docs/{page}.md" for page in ("tutorial", "howto", "experiments", "your_robot", "worlds", "saht")]
    for page in ("README.md", *told):
        for name, text in files(page).items():
            (tmp_path / name).write_text(text)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(trainer, "train", lambda config, run_dir, **_: trainer.Result(run_dir, 0, False, None))
    monkeypatch.setattr("star.debugging.turn_on", lambda: None)
    monkeypatch.setattr("star.devices.join", lambda cluster: None)
    monkeypatch.setattr(exams, "evaluate", lambda targets, exam, **_: [])
    monkeypatch.setattr(exam_results, "check_groups", lambda groups, configs: None)
    monkeypatch.setattr("star.report.watching.serve", lambda run_dir, config, **_: None)
    monkeypatch.setattr(exam_results, "compare", lambda rows, groups: None)
    monkeypatch.setattr(exam_tables, "show", lambda rows, comparison, **_: None)
    monkeypatch.setattr(star_commands, "check_output", lambda out, force: None)  # pictures need OpenGL, films ffmpeg
    monkeypatch.setattr(films, "render", lambda config, show, **_: "")
    for name in ("render", "record"):
        monkeypatch.setattr(f"star.saht.commands.{name}", lambda options, overrides: 0)
        monkeypatch.setattr(f"star.saht.chime.commands.{name}", lambda options, overrides: 0)
    monkeypatch.setattr("star.report.evaluations.evaluate", lambda config, run_dir, **_: [])
    monkeypatch.setattr("star.report.page.write", lambda runs, out, **_: "")
    monkeypatch.setattr(work, "run", lambda found, out, **_: work.Summary([], True, {"trial": 0}))
    monkeypatch.setattr(demonstrations, "record", lambda config, run_dir, out, **_: "")
    monkeypatch.setattr(discover, "discover", lambda options, overrides: 0)
    return tmp_path


@pytest.mark.parametrize("words", STAR)
def test_every_command_line_of_the_pages_is_accepted(words, folder):
    for run in {run for word in words for run in re.findall(r"\bruns/[\w-]+", word)}:
        (folder / run).mkdir(parents=True)
        config = {"saht": SahtConfig, "chime": ChimeConfig}.get(re.split("[/-]", run)[1], Config)()
        (folder / run / "config.yaml").write_text(config.to_yaml())
    assert main(words[1:]) == 0


@pytest.mark.parametrize("page", PAGES)
def test_modules_that_a_page_names_are_where_it_says(page):
    text = PAGES[page]
    for path in re.findall(r"\b(?:star|envs|scripts|tests)/[\w/*]+\.py\b", text):
        assert list(ROOT.glob(path)), path
    for module in re.findall(r"^::: (\S+)$|`((?:star|envs)(?:\.[a-z_]\w*)+)`", text, re.MULTILINE):
        exists(next(filter(None, module)))
    for module in re.findall(r"api\.md#([\w.]+)", text):
        assert f"::: {module}\n" in PAGES["docs/api.md"], module


def exists(name):
    """Find what `name` stands for: a module of ours, or something in one."""
    parts, found = name.split("."), None
    for length in range(1, len(parts) + 1):
        try:
            found = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            return operator.attrgetter(".".join(parts[length - 1 :]))(found)
    return found


SMALL = {  # the Controller alone, for the sake of compilation
    "train": """--trainer.num_envs 4 --trainer.eval_episodes 3 --trainer.eval_every 2 --env.options.episode_length 60
        --tutor.unroll 2 --controller.ppo.hidden [8] --commander.enabled false --tutor.enabled false --quiet
        --total-env-steps 480""",
    "evaluate": "--episodes 3",
    "render": "--height 40 --steps 1",
    "report": "",
}


def test_the_commands_of_the_tutorial_work_as_they_are_but_smaller(run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(run, tmp_path / "runs" / "quickstart")  # of step 1
    for name, text in files("docs/tutorial.md").items():
        (tmp_path / name).write_text(text)
    try:
        opengl.backend()
        drawn = ()
    except envs.EnvError:
        drawn = ("render",)
    lines = [line for block in blocks("docs/tutorial.md", "bash") for line in block.splitlines()]
    done = [shlex.split(line) for line in lines if line.startswith("star ") and line.split()[1] not in drawn]
    assert len(done) == 7 - len(drawn)
    for _, command, *words in done:
        more = SMALL[command].split()
        if "--resume" in words:
            more = ["--quiet", "--total-env-steps", "960"]
        assert main([command, *words, *more]) == 0, capsys.readouterr().err
    steps = [json.loads(line)["env_steps"] for line in (tmp_path / "runs/mine/metrics.jsonl").read_text().splitlines()]
    assert steps == [240, 480, 720, 960]
    assert capsys.readouterr().out.count("test goals, 3 episodes a seed, 95 %") == 2
    assert "runs/mine-flat" in (tmp_path / "mine.html").read_text(encoding="utf-8")


def test_the_pages_show_how_to_train_resume_evaluate_and_look_things_up():
    shown = {tuple(one.values[0][1:3]) for one in STAR}
    assert ("train", "configs/point_maze.yaml") in shown and ("train", "--resume") in shown
    words = {
        "train",
        "sweep",
        "ls",
        "evaluate",
        "render",
        "record",
        "report",
        "watch",
        "tutor",
        "settings",
        "configs",
        "envs",
        "completion",
    }
    assert words == {words[0] for words in shown}


@pytest.mark.parametrize("words", MAKE)
def test_every_make_target_of_the_pages_exists(words):
    targets = re.findall(r"^([a-z]+):.*## ", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert words[1] in targets


def test_the_readme_begins_with_a_clone_and_two_commands_and_stays_short():
    first = [line.split("#")[0].split() for line in blocks("README.md", "bash")[0].splitlines()]
    assert [words[:2] for words in first] == [["git", "clone"], ["make", "quickstart"], [".venv/bin/star", "render"]]
    assert len(PAGES["README.md"].splitlines()) <= 120


def slug(heading):
    """The anchor of a heading, on the site and on GitHub."""
    return re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower())


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_to_files_and_headings(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", PAGES[page]):
        if re.match(r"https?:", target):
            continue
        name, _, anchor = target.partition("#")
        path = ((ROOT / page).parent / name).resolve() if name else ROOT / page
        assert path.exists(), target
        if anchor:
            text = path.read_text(encoding="utf-8")
            headings = {slug(h) for h in re.findall(r"^#+ (.*)$", text, re.MULTILINE)}
            assert anchor in headings | set(re.findall(r"^::: (\S+)$", text, re.MULTILINE)), target


def test_the_navigation_lists_every_page():
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    for page in PAGES:
        assert page == "README.md" or re.search(rf": {Path(page).name}$", navigation, re.MULTILINE), page


@pytest.mark.parametrize("page", PAGES)
def test_settings_named_on_a_page_exist(page):
    settings = set(DEFAULTS) | {key for key, *_ in fields(SahtConfig)}
    sections = set(Config.model_fields) | set(SahtConfig.model_fields)
    known = settings | {key.rsplit(".", 1)[0] for key in settings} | sections
    pattern = rf"(?:--)?((?:{'|'.join(sections)})\.[a-z0-9_.]+)"
    for code in inline(PAGES[page]):
        named = re.fullmatch(pattern, code.split(" ")[0])
        if named and not named[1].endswith(".py"):
            assert named[1] in known or named[1].startswith(("env.options.", "env.training.")), code


def test_the_list_of_settings_is_what_the_command_prints(capsys):
    assert main(["settings"]) == 0
    printed = capsys.readouterr().out.splitlines()
    (listed,) = (block.splitlines() for block in blocks("docs/configuration.md", "text"))
    for shown, real in itertools.zip_longest(listed, printed):
        assert shown == real, "put the output of `star settings` into docs/configuration.md"


def test_departures_name_the_settings_and_their_defaults():
    table = [row for row in rows("docs/departures.md") if len(row) == 4]
    assert len(table) >= 20
    for key, published, ours, _ in table:
        if key.startswith("env.options."):
            default = TASKS["ant_maze"].options()[key.removeprefix("env.options.")].default
        else:
            default = DEFAULTS[key]
        assert ours == f"`{json.dumps(default)}`", key
        assert published not in (ours, ""), key


def test_the_papers_config_has_the_published_values():
    paper = load(ROOT / "configs/paper/ant_maze.yaml")
    other = {"forward_model.boxes", "refinement.min_transitions"}  # as departures.md says
    seen = 0
    for key, published, *_ in (row for row in rows("docs/departures.md") if len(row) == 4):
        literal = re.match(r"`([^`]+)`", published)
        if literal is None or key in other:
            continue
        options = key.startswith("env.options.")
        value = paper.env.options[key.split(".")[-1]] if options else operator.attrgetter(key)(paper)
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        assert (value == float(literal[1])) if number else (str(value).lower() == literal[1]), key
        seen += 1
    assert seen > 20


@pytest.mark.parametrize(
    "overrides",
    [
        pytest.param({}, id="ppo"),
        pytest.param(
            {
                "tutor.learner": "td3",
                "controller.learner": "td3",
                "tutor.adjacency.enabled": True,
                "sgim.teachers": [{"name": "guide", "kind": "decomposition"}],
            },
            id="td3, adjacency, sgim",
        ),
    ],
)
def test_every_metric_is_explained_and_every_explained_metric_exists(overrides):
    program = programs.build(parse({"env": {"name": "point_maze"}, "trainer": {"num_envs": 8}}, overrides))
    state = jax.eval_shape(program.init, program.seed_keys())
    metrics = set(jax.eval_shape(program.epoch, state)[1])
    learner = {"PPO", "both"} if not overrides else {"TD3", "both"}
    explained = {
        key
        for key, second, *_ in rows("docs/metrics.md")
        if not key.startswith(("tutor/", "controller/")) or second in learner
        if overrides or not key.startswith(("adjacency/", "sgim/"))
    }
    names = {"share": ("autonomous", "guide"), "queries": ("guide",)}
    for each in [key for key in explained if key.endswith("_NAME")]:
        kind = each.removeprefix("sgim/").removesuffix("_NAME")
        explained = explained - {each} | {f"sgim/{kind}_{name}" for name in names[kind]}
    assert explained == metrics | WRITTEN_BY_THE_TRAINER


def test_the_example_of_the_metrics_page_runs(folder):
    (folder / "runs" / "quickstart").mkdir(parents=True)
    lines = [{"env_steps": 1}, {"env_steps": 2, "eval/success_final": 0.5}]
    (folder / "runs/quickstart/metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (example,) = blocks("docs/metrics.md", "python")
    names: dict = {}
    exec(example, names)
    assert names["curve"] == [(2, 0.5)]


def test_the_example_of_the_evaluation_page_finds_the_worst_goal(folder):
    (folder / "runs" / "quickstart" / "map").mkdir(parents=True)
    goals = [{"cell": [0, 0, 4, 4], "success_any": 1.0}, {"cell": [4, 0, 8, 4], "success_any": 0.25}]
    line = json.dumps({"per_goal": goals}) + "\n"
    (folder / "runs/quickstart/map/evaluation.jsonl").write_text(line + "{}\n")
    (example,) = blocks("docs/evaluation.md", "python")
    names: dict = {}
    exec(example, names)
    assert names["worst"]["cell"] == [4, 0, 8, 4]


def test_the_example_of_the_how_to_page_plays_a_trained_agent(run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "NAME").symlink_to(run)
    (example,) = blocks("docs/howto.md", "python")
    names: dict = {}
    exec(example, names)
    path, end = names["path"], names["end"]
    assert path.shape == (40, 16, 2)
    assert abs(path[0]).max() <= 0.1 and abs(path[-1]).max() > 1  # the task's start, and the agents move
    last = jax.numpy.linalg.norm(path[-1] - names["spec"].goal_point(end.env.obs), axis=-1)
    assert abs(last - end.episode.distance).max() < 1  # an env step later
    said, *_ = capsys.readouterr().out.splitlines()
    assert said == f"success at any step: {end.episode.success_any.mean()} at the last: 0.0"


def test_the_examples_of_the_python_page_act_train_evaluate_and_export(run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "NAME").symlink_to(run)
    (tmp_path / "point_maze").write_text(
        json.dumps(smaller.ALONE | {"trainer": smaller.ALONE["trainer"] | {"total_env_steps": 240}})
    )
    act, train, export, read = blocks("docs/python.md", "python")
    names: dict = {}
    exec(act.replace('goals="test"', 'goals="test", episode_length=40'), names)
    assert names["truncated"] and names["agent"].env_steps == 160
    exec(train.replace("200", "4"), names)
    assert (names["result"]["env_steps"], len(names["row"]["seeds"]), names["row"]["episodes"]) == (240, 2, 8)
    assert capsys.readouterr().out.startswith("reached: False at [")
    exec(export, names)
    exec(read, names)
    assert names["action"].shape == (16, 2)


def test_the_example_of_the_sgim_page_learns_all_three_exercises_and_asks_the_teacher():
    example, *_ = blocks("docs/sgim.md", "python")
    names: dict = {}
    exec(example, names)
    assert (names["skill"] > 0.7).all()
    assert names["state"].episodes.sum() == 1000 and names["state"].episodes.sum(axis=0)[1] > 300


def test_the_teacher_of_the_sgim_page_shows_the_way_over_the_gap():
    *_, example = blocks("docs/sgim.md", "python")
    names: dict = {}
    exec(example, names)
    assert names["route"].tolist() == [[8, 0, 4.5], [8, 24, 4.5], [0, 24, 4.5], [0, 24, 4.5]]


SCRIPTS = sorted({(page, line) for page in PAGES for block in blocks(page, "bash")
                  for line in block.replace("\\\n", " ").splitlines() if line.startswith("python ")})  # fmt: skip


@pytest.mark.parametrize(("page", "line"), SCRIPTS)
def test_every_script_of_the_pages_is_there_and_has_the_flags_that_it_is_given(page, line):
    _, script, *words = shlex.split(line, comments=True)
    if script == "-m":
        assert importlib.util.find_spec(words[0])
        return
    text = (ROOT / script).read_text(encoding="utf-8")
    own = words[: words.index("--")] if "--" in words else words
    for flag in (word for word in own if word.startswith("--") and "." not in word):
        assert f'"{flag.partition("=")[0]}"' in text, flag


def test_the_dockerfile_copies_what_the_wheel_is_made_of_and_installs_the_extras_for_a_gpu():
    lines = re.sub(r"\\\n\s*", "", (ROOT / "Dockerfile").read_text(encoding="utf-8")).splitlines()
    told = [line.split(" ", 1) for line in lines if line and not line.startswith("#")]
    assert {word for word, _ in told} == {"FROM", "RUN", "WORKDIR", "COPY", "ENV", "ENTRYPOINT", "CMD"}
    copied = [word for name, rest in told if name == "COPY" for word in rest.split()[:-1]]
    assert all((ROOT / name).exists() for name in copied)
    built = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    wheel = built["tool"]["hatch"]["build"]["targets"]["wheel"]
    project = built["project"]
    assert {*wheel["packages"], *wheel["force-include"], project["readme"], *project["license-files"]} <= set(copied)
    (extras,) = re.findall(r"'\.\[([\w,]+)\]'", "\n".join(lines))
    assert set(extras.split(",")) <= project["optional-dependencies"].keys()
    assert re.match(r"python:3\.1[12]-", told[0][1])


def test_the_citation_names_the_paper_of_the_readme():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    paper = cited["preferred-citation"]
    assert {"cff-version", "message", "title", "authors"} <= cited.keys()
    for told in (paper["title"], str(paper["year"]), *(one["family-names"] for one in paper["authors"])):
        assert told in blocks("README.md", "bibtex")[0]
    built = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert cited["version"] == built["project"]["version"] and cited["license"] == built["project"]["license"]


def test_the_pictures_of_the_pages_are_used_and_small():
    images = sorted((ROOT / "docs" / "images").iterdir())
    assert sum(image.stat().st_size for image in images) < 2_000_000
    assert [image.name for image in images if not any(f"images/{image.name})" in text for text in PAGES.values())] == []


def test_the_film_ends_on_the_goal():
    told = load_script("pages/film").ending()
    assert told["success"] and told["distance"] < 5 and PAGES["README.md"].count("film.gif") == 1


FOR_A_GPU = {path.stem for path in ROOT.glob("configs/*.yaml") if "NVIDIA GPU" in path.read_text().splitlines()[0]}
FOR_A_GPU |= {"paper/many"}
SHELL = [
    (page, line) for page in PAGES for block in blocks(page, "bash") for line in block.replace("\\\n", " ").splitlines()
]


def wants_a_gpu(words):
    """Whether a command line trains on a config that is made for a GPU."""
    names = {re.sub(r"^configs/|\.yaml$", "", word).split("/one_by_one")[0] for word in words}
    trains = words[1:2] == ["train"] or words[0] == "python"
    return trains and bool(names & FOR_A_GPU) and not {"--dry-run", "native"} & set(words)


@pytest.mark.parametrize(("page", "line"), [one for one in SHELL if re.match(r"star |python ", one[1])])
def test_a_command_that_wants_a_gpu_carries_its_mark(page, line):
    command, _, comment = line.partition(" #")
    assert not wants_a_gpu(shlex.split(command)) or "GPU" in comment, f"{page}: add # GPU to: {line}"


def test_commands_for_a_gpu_are_told_from_others():
    assert wants_a_gpu(["star", "train", "ant_maze"]) and wants_a_gpu(
        ["star", "train", "configs/ant_fall.yaml", "--seeds", "5"]
    )
    assert not wants_a_gpu(["star", "train", "ant_maze_cpu"]) and not wants_a_gpu(["star", "render", "ant_maze"])
    assert not wants_a_gpu(["star", "train", "ant_maze", "--dry-run"]) and wants_a_gpu(["python", "x.py", "ant_maze"])
