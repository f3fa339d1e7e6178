"""Whole runs in the world of docs/worlds.md, a cart that rings a bell: what they learn, leave, resume and refuse."""

import json
import re
import shutil
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
import yaml

from star.cli import main
from star.config.loading import parse
from star.saht import strategies, teachers
from star.saht.memory import scale_of
from star.saht.proposals import Dice, Order
from star.training import program as programs
from star.training.journal import JsonLines
from tests.small import arrays, assert_the_same, killed

PAGE = Path(__file__).parents[2] / "docs" / "worlds.md"
CONFIG = {
    "experiment": "saht",
    "world": {"name": "cart:make", "options": {"goals": 20}},
    "saht": {
        "strategies": ["actions", "procedures"],
        "teachers": [{"kind": "action"}, {"kind": "procedure"}],
        "epoch": 50,
        "memory": 400,
        "choice": {"regions": 4},
    },
    "trainer": {"total_env_steps": 200, "num_seeds": 3, "eval_every": 1, "checkpoint_every": 1, "keep_checkpoints": 9},
}


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with the page's world, which is trusted, a config and a run of it."""
    folder = tmp_path_factory.mktemp("saht")
    (folder / "cart.py").write_text(
        re.search(r'title="cart.py"\n(.*?)```', PAGE.read_text(encoding="utf-8"), re.DOTALL)[1]
    )
    (folder / "cart.yaml").write_text(yaml.safe_dump(CONFIG))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "path", [*sys.path])
        patch.setenv("STAR_IMPORT", "cart")
        patch.delitem(sys.modules, "cart", raising=False)
        assert main(["train", "cart.yaml", "--run-dir", "whole", "--quiet"]) == 0
        yield folder
    sys.modules.pop("cart", None)


@pytest.fixture(autouse=True)
def here(place, monkeypatch):
    monkeypatch.chdir(place)
    monkeypatch.setenv("STAR_IMPORT", "cart")


def test_a_run_learns_and_leaves_what_other_runs_do(capsys):
    rows = JsonLines(Path("whole/metrics.jsonl")).read()
    assert len(rows) == 4 * 3 and not any(row["saht/refused"] for row in rows)
    first, last = rows[:3], rows[-3:]
    mean = lambda rows: np.mean([row["eval/error"] for row in rows])  # noqa: E731
    assert mean(last) < mean(first) and max(row["eval/error_place"] for row in last) < 0.1
    tables = JsonLines(Path("whole/practice.jsonl")).read()
    assert np.sum(tables[-1]["chosen"]) == np.sum(tables[-1]["played"]) == 200
    shown = {path.stem for path in Path("whole/figures").glob("*.png")}
    assert shown == {"summary", "curriculum", "strategies", "lengths", "interest", "hierarchy"}
    assert main(["ls", "."]) == 0 and "SGIM-PB" in capsys.readouterr().out
    assert main(["evaluate", "whole", "--json"]) == 0
    (row,) = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert row["error"] == pytest.approx(mean(last), rel=1e-5)
    assert main(["report", "whole", "--out", "page.html"]) == 0
    page = Path("page.html").read_text(encoding="utf-8")
    assert '"unit":"iterations"' in page and page.count('"name":"hierarchy"') == 1


def test_a_run_whose_regions_were_cut_is_shown_too():
    shutil.copytree("whole", "cut")
    tables = Path("cut/practice.jsonl")
    rows = [json.loads(line) for line in tables.read_text().splitlines()]
    for row in rows:
        row |= {key: [*row[key], row[key][-1]] for key in ("lower", "upper", "interest")}
    tables.write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert main(["report", "cut", "--out", "cut.html"]) == 0


def test_every_metric_is_explained_and_every_explained_metric_exists():
    row = JsonLines(Path("whole/metrics.jsonl")).read()[-1]
    ours = {key for key in row if key.startswith(("saht/", "eval/"))}
    text = PAGE.with_name("saht.md").read_text(encoding="utf-8")
    explained = set(re.findall(r"^\| `((?:saht|eval)/\w+)`", text, re.MULTILINE)) - {"eval/executed"}
    names = {"TASK": ("place", "bell"), "NAME": ("actions", "procedures", "action_place", "procedure_bell")}
    found = {key.replace(mark, name) for key in explained for mark in names if mark in key for name in names[mark]}
    assert found | {key for key in explained if not key.endswith(tuple(names))} == ours


def test_a_run_that_was_killed_goes_on_bit_for_bit(undrawn):
    killed("whole", "killed", steps=(150, 200))
    assert main(["train", "--resume", "killed", "--quiet"]) == 0
    assert_the_same("killed", "whole", 200)


def test_a_learner_alone_chooses_as_it_does_among_others_and_nothing_is_compiled_twice():
    program = programs.build(parse(CONFIG, {"trainer.num_seeds": 1, "trainer.seed": 1}))
    state = program.init(program.seed_keys())
    for epoch in (1, 2, 3):
        state, _ = program.epoch(state)
        among, alone = arrays("whole", 50 * epoch), jax.device_get((state.tallies.chosen, state.memory.outcomes))
        np.testing.assert_array_equal(alone[0][0], among["tallies/chosen"][1])
        np.testing.assert_allclose(alone[1][0], among["memory/outcomes"][1], atol=1e-4)
    assert program.functions.epoch._cache_size() == 1


def test_a_run_is_made_longer_as_far_as_its_memory_goes(capsys):
    assert main(["train", "--resume", "whole", "--total-env-steps", "450", "--quiet"]) == 2
    assert "450, in whole epochs of 50, is more than saht.memory 400" in capsys.readouterr().err
    programs.build(parse(CONFIG, {"trainer.total_env_steps": 400}))
    for rows, total in ((410, 401), (399, 399)):
        with pytest.raises(ValueError, match=f"more than saht.memory {rows}"):
            programs.build(parse(CONFIG, {"trainer.total_env_steps": total, "saht.memory": rows}))


def test_a_world_that_needs_a_program_for_its_goals_is_evaluated_and_noise_adds_what_is_executed_anew():
    values = {"experiment": "saht", "world": {"name": "throw", "noise": 0.02}, "trainer": {"num_seeds": 1}}
    program = programs.build(parse(values))
    keys = program.evaluation_keys(0)
    shapes = jax.eval_shape(program.evaluate, jax.eval_shape(program.init, program.seed_keys()), keys)
    assert set(shapes) == {"error", "executed", *(f"{x}_{y}" for x in ("error", "area") for y in ("thrown", "placed"))}


def test_what_a_learner_can_do_is_recorded_and_teaches_others(capsys):
    assert main(["record", "whole", "--out", "demos.npz", "--episodes", "30"]) == 0
    assert "place" in capsys.readouterr().out
    experiment = programs.build(parse(CONFIG)).experiment
    world = experiment.world
    demos = teachers.load(Path("demos.npz"), world, "bell")
    found = world.execute(demos.sequences, demos.lengths)
    np.testing.assert_allclose(found.value[:, 1], demos.outcomes, atol=1e-5)
    file = [{"kind": "outcome", "task": "bell", "source": "demos.npz"}]
    taught = programs.build(parse(CONFIG, {"saht.teachers": file})).experiment
    assert taught.config.saht.teachers[0].name == "outcome_bell" and len(taught.config.saht.teachers[0].sha256) == 64
    scale = scale_of(world)
    shown = taught.data()
    np.testing.assert_allclose(shown.outcomes[0] * scale.width[1] + scale.lower[1], demos.outcomes, atol=1e-5)


def test_procedures_that_a_learner_has_found_are_recorded_and_shown_to_others():
    assert main(["record", "whole", "--seed", "1", "--out", "procedures.npz", "--episodes", "30"]) == 0
    experiment = programs.build(parse(CONFIG)).experiment
    world, scale = experiment.world, experiment.scale
    demos = teachers.load(Path("procedures.npz"), world, "bell")
    made = demos.pairs[:, 0] >= 0
    assert made.any() and not demos.subgoals[~made].any()
    file = [{"kind": "procedure", "task": "bell", "source": "procedures.npz"}]
    taught = programs.build(parse(CONFIG, {"saht.teachers": file})).experiment
    shown, setting = taught.data(), taught.setting(taught.data())
    (way,) = (number for number, way in enumerate(taught.ways) if way.kind == "procedure")
    n = int(made.sum()) - 1
    order = Order(np.int32(1), shown.outcomes[0, n], np.int32(way), np.asarray(True))
    two = strategies.taught(setting, order, Dice.thrown(world, setting.generation, key=jax.random.key(0)))
    number = np.flatnonzero((shown.outcomes[0] == shown.outcomes[0, n]).all(axis=1))[0]
    np.testing.assert_array_equal(two.tasks, demos.pairs[made][number])
    wanted = demos.subgoals[made][number]
    found = two.goals[0] * scale.width[two.tasks] + scale.lower[two.tasks]
    np.testing.assert_allclose(found, wanted, atol=1e-5)
    with pytest.raises(ValueError, match="shows no procedure of place"):
        plain = teachers.Demonstrations.plain(demos.sequences[:1], demos.lengths[:1], demos.outcomes[:1])
        teachers.save(Path("plain.npz"), world, ["place"], plain)
        file = [{"kind": "procedure", "task": "place", "source": "plain.npz"}]
        programs.build(parse(CONFIG, {"saht.teachers": file})).experiment.data()


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda a: a | {"sequences": a["sequences"] * np.nan}, r"sequences\[0, 0, 0\] is nan; allowed: -1 to 1"),
        (
            lambda a: a | {"sequences": a["sequences"][:, :2]},
            r"sequences is float32\[.*, 2, 1\]; allowed: \[.*, 3, 1\]",
        ),
        (lambda a: a | {"lengths": a["lengths"] + 3}, r"lengths\[0\] is .; allowed: 1 to 3"),
        (lambda a: a | {"lengths": a["lengths"][1:]}, r"lengths is int32\[.*\]; allowed: \[.*\]"),
        (lambda a: a | {"world": "pen"}, "holds demonstrations in 'pen', not in 'cart'"),
        (lambda a: a | {"format": 2}, "format is not 1"),
        (lambda a: a | {"tasks": np.full_like(a["tasks"], "x")}, "shows nothing of bell; it holds x"),
        (lambda a: {k: v for k, v in a.items() if k != "outcomes"}, "holds no outcomes"),
        (lambda a: a | {"more": 1}, "holds an unknown array 'more'"),
        (lambda a: a | {"pairs": a["pairs"] + 3}, r"pairs\[0, 0\] is 2; allowed: -1 to 1"),
        (lambda a: {k: v for k, v in a.items() if k != "subgoals"}, "holds no subgoals"),
    ],
)
def test_a_file_that_is_no_file_of_this_world_is_refused(damage, said):
    world = programs.build(parse(CONFIG)).experiment.world
    sequences, lengths = world.demonstrate("place", world.benchmark("place")[:4])
    demos = teachers.Demonstrations.plain(
        np.asarray(sequences), np.asarray(lengths), np.asarray(world.benchmark("place")[:4])
    )
    teachers.save(Path("some.npz"), world, ["bell"] * 4, demos)
    with np.load("some.npz") as file:
        sound = dict(file)
    assert len(teachers.load(Path("some.npz"), world, "bell").lengths) == 4
    np.savez(Path("bad.npz"), **damage(sound))
    with pytest.raises(ValueError, match=said):
        teachers.load(Path("bad.npz"), world, "bell")


def test_budgets_availability_and_turns_say_which_strategies_there_are():
    budget = [{"kind": "action", "max_queries": 30}, {"kind": "procedure", "availability": 0}]
    program = programs.build(parse(CONFIG, {"saht.teachers": budget}))
    limited = program.experiment
    _, there = limited._begun(program.hyper, program.init(program.seed_keys()))
    assert there.tolist() == [[True, True, True, False]] * 3
    asked = np.array([0, 0, 30, 0])
    assert limited._available(np.array([True] * 4), asked, 0).tolist() == [True, True, False, True]
    turns = programs.build(parse(CONFIG, {"saht.ask_every": 5})).experiment
    free = [turns._available(np.ones(4, bool), np.zeros(4), number).tolist() for number in range(5)]
    assert free == [[True, True, False, False]] * 4 + [[False, False, True, True]]
    nobody = turns._available(np.array([True, True, False, False]), np.zeros(4), 4)
    assert nobody.tolist() == [True, True, False, False]


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (
            {"saht.teachers": [{"kind": "action", "task": "bell"}]},
            "nobody shows 'bell' as action in cart; allowed: place",
        ),
        ({"saht.teachers": [{"kind": "action"}, {"kind": "action"}]}, "saht.teachers: action_place is given twice"),
        ({"saht.teachers": [{"kind": "action", "name": "x"}]}, "needs its task"),
        ({"saht.strategies": ["dagger"]}, "dagger needs a teacher of every task; nobody demonstrates bell in cart"),
        (
            {"saht.strategies": ["cba"], "saht.block": 15, "saht.epoch": 60, "saht.generation": 15},
            "15 is odd; cba needs",
        ),
        ({"saht.strategies": [], "saht.teachers": []}, "there are none, and no teachers"),
        ({"saht.generation": 3}, "generation: 3 does not divide block 10"),
        ({"saht.epoch": 55}, "epoch: 55 is not a multiple of block 10"),
        ({"saht.ask_every": 2, "saht.teachers": []}, "ask_every: needs strategies and teachers"),
        ({"world.options": {"gaols": 3}}, 'option "gaols" is not one of cart:make'),
        ({"saht.teachers": [{"kind": "outcome", "task": "bell", "source": "none.npz"}]}, "none.npz: no such file"),
    ],
)
def test_what_cannot_be_is_said_in_one_line_and_nothing_is_written(capsys, settings, said):
    words = [word for key, value in settings.items() for word in (f"--{key}", json.dumps(value))]
    assert main(["train", "cart.yaml", "--run-dir", "new", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line and not Path("new").exists()


def test_pictures_show_a_world_and_a_goal_being_reached(capsys):
    assert main(["render", "bell", "--run", "whole", "--out", "bell.png", "--episode", "3"]) == 0
    assert main(["render", "throw", "--out", "throw.png"]) == 0
    out = capsys.readouterr().out
    assert "bell by whole" in out and "placed by its teacher" in out
    assert Path("bell.png").stat().st_size > 1000 and Path("throw.png").stat().st_size > 1000
    for words, said in (
        (["whistle"], "'whistle' is neither cart nor a task of it; allowed: place, bell"),
        (["bell", "--episode", "20"], "--episode: 20 is not one of the goals of bell; allowed: 0 to 19"),
        (["bell", "--camera", "top"], "--camera: is for tasks of experiment star"),
    ):
        assert main(["render", *words, "--run", "whole", "--out", "new.png"]) == 2
        assert said in capsys.readouterr().err
