"""The script that measures the claims: what it makes of runs, and that a claim that fails is told as failed."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from scripts.results import claims as claims_of
from tests.scripts import load

ROOT = Path(__file__).parents[2]
TASKS = ("tip", "pen", "line", "joystick_1", "joystick_2", "character")


def algorithm(error, *, procedures=0.1, asked=(0.8, 0.2), tip=(0.4, 0.1), length=3):
    """Four seeds of an algorithm with these numbers."""
    chosen = np.full((4, 6, 2), 100 * np.array([1 - procedures, procedures]))
    chosen[:, -1] = [40, 60]
    played = np.zeros((4, 6, 4))
    played[:, :-1, 0] = played[:, -1, length - 1] = 1
    errors = [[[x * level for x in (0.99, 1.0, 1.0, 1.01)] for level in (2 * error, error)]]
    return {
        "steps": [12_500, 25_000],
        "wall_s": 1.0,
        "errors": dict.fromkeys(("mean", *TASKS), errors[0]),
        "ways": ["actions", "procedures"],
        "chosen": chosen.tolist(),
        "played": played.tolist(),
        "requests": np.linspace([asked[0]] * 4, [asked[1]] * 4, 10).tolist(),
        "tasks": {"tip": np.linspace([tip[0]] * 4, [tip[1]] * 4, 10).tolist()},
    }


def without_draws(samples, statistic):
    """Seeds of one algorithm hardly differ here."""
    value = statistic(*samples)
    return value, value - 1e-3, value + 1e-3


def verdicts(claims, row):
    return [claim.holds for claim in claims if claim.row == row]


def test_claims_hold_or_fail_as_the_numbers_say(monkeypatch):
    script = load("results/saht")
    monkeypatch.setattr(claims_of, "stratified", without_draws)
    good = {
        "sgim_pb": algorithm(0.1, asked=(0.5, 0.1)),
        "sgim_acts": algorithm(0.12),
        "im_pb": algorithm(0.15),
        "sagg_riac": algorithm(0.4),
        "sgim_pb_even": algorithm(0.13),
    }
    claims = script.claims_of_pen(good)
    assert all(claim.holds for claim in claims) and {claim.row for claim in claims} == {*"efghij", "even"}
    bad = {
        "sgim_pb": algorithm(0.12, procedures=0.3, asked=(0.5, 0.5), tip=(0.1, 0.1)),
        "sgim_acts": algorithm(0.12),
        "im_pb": algorithm(0.4, length=1),
        "sagg_riac": algorithm(0.4),
        "sgim_pb_even": algorithm(0.12),
    }
    failed = script.claims_of_pen(bad)
    assert verdicts(failed, "f") == [False] * 3 and not any(verdicts(failed, "e") + verdicts(failed, "even"))
    assert verdicts(failed, "g") == [True, False, False, False]  # the character's procedures are as before
    assert [verdicts(failed, row) for row in "hij"] == [[False]] * 3
    told = script.table(bad, failed)
    assert told.count("**failed**") == sum(not claim.holds for claim in failed) and "| sgim_pb | 0.120 [" in told


def imitator(error, asked):
    """Four seeds whose error falls evenly to a half while a teacher is asked."""
    errors = [[x * level for x in (0.99, 1.0, 1.0, 1.01)] for level in (error, 0.75 * error, 0.5 * error)]
    return {"errors": {"mean": errors}, "asked": [[share * asked] * 4 for share in (0.0, 0.5, 1.0)]}


def test_imitators_are_compared_where_all_have_asked_as_much(monkeypatch):
    script = load("results/saht")
    monkeypatch.setattr(claims_of, "stratified", without_draws)
    found = {"sgim_acts": imitator(0.2, 1000), "dagger": imitator(0.2, 2000), "cba": imitator(0.1, 500)}
    claims = {claim.text: claim for claim in script.at_equal_cost(found)}
    (dagger, cba) = claims.values()
    assert all("after 500 requests" in text for text in claims)
    assert dagger.value == pytest.approx(0.15 - 0.175) and dagger.holds
    assert cba.value == pytest.approx(0.15 - 0.05) and not cba.holds
    assert script.draw_taught(found).axes[0].get_legend().get_texts()[1].get_text() == "dagger"
    assert script.at_equal_cost({"sgim_acts": imitator(0.2, 9), "throw": {"asked": []}}) == []


def test_claims_about_fishing_and_the_table_hold_or_fail_as_the_numbers_say(monkeypatch):
    script = load("results/saht")
    monkeypatch.setattr(claims_of, "stratified", without_draws)

    def fishing(error, area):
        return algorithm(error) | {"areas": [[area] * 4]}

    found = {"sgim_d_wide": fishing(0.1, 0.6), "mimicry_wide": fishing(0.2, 0.4), "sagg_riac_wide": fishing(0.1, 0.7)}
    found |= {"sgim_d_human": algorithm(0.1), "sgim_d_robot": algorithm(0.12)}
    claims = script.claims_of_fishing(found)
    assert verdicts(claims, "a") == [True, True, False, False] and verdicts(claims, "b") == [True]

    def at_table(error, tune, **changes):
        made = algorithm(error, **changes)
        made["errors"] |= {"tune": [[x * tune for x in (2.0, 2.0, 2.02, 1.98)]] * 2, "burst": [[error] * 4] * 2}
        made["tasks"]["touch"] = made["tasks"]["tip"]
        return made | {"steps": [10_000, 25_000]}

    found = {"sgim_pb": at_table(0.1, 0.1), "sgim_acts": at_table(0.12, 0.05), "im_pb_small": at_table(0.2, 0.4)}
    found["im_pb_taught"] = at_table(0.2, 0.2)
    claims = script.claims_of_table(found)
    assert verdicts(claims, "f") == [True, False] and verdicts(claims, "transfer") == [True]
    assert {claim.row for claim in claims} == {*"fghij", "transfer"} and "at 10,000" in claims[-1].text


def test_what_a_learner_can_do_becomes_a_teacher_of_others(tmp_path, monkeypatch):
    script = load("results/saht")
    made = []
    monkeypatch.setattr(script, "trained", lambda world, name, options: made.append(name))

    def record(command, **_):
        pairs = np.array([[-1, -1], [0, 1], [1, 1]] * 20)
        tasks = np.array(["blue", "tune", "blue"] * 20)
        np.savez(command[command.index("--out") + 1], format=1, tasks=tasks, pairs=pairs, sequences=np.arange(60.0))

    monkeypatch.setattr(script.subprocess, "run", record)
    options = SimpleNamespace(runs=tmp_path, noise=0.0)
    (tmp_path / "table").mkdir()
    teachers = script.learnt("table", "im_pb_taught", options)
    assert made == ["sgim_pb"] and [(one["kind"], one["task"]) for one in teachers] == [
        ("procedure", "tune"),
        ("procedure", "blue"),
    ]
    with np.load(teachers[0]["source"]) as kept:
        assert (kept["pairs"] >= 0).all() and len(kept["tasks"]) == 40 and kept["format"] == 1
    assert len(script.learnt("table", "sgim_d_robot", options)) == 4
    with np.load(tmp_path / "table" / "sgim_d_robot.npz") as kept:
        assert len(kept["tasks"]) == 25


def test_an_interval_that_reaches_zero_is_no_difference():
    one, other = np.array([0.1, 0.3, 0.2, 0.2]), np.array([0.3, 0.2, 0.2, 0.2])
    claim = claims_of.less("f", "", one, other)
    assert claim.value < 0 < claim.high and not claim.holds


def test_a_name_that_is_no_algorithm_is_refused(tmp_path):
    script = load("results/saht")
    with pytest.raises(SystemExit, match="sgim_bp: no such algorithm; known are random, sagg_riac"):
        script.main(["pen", "sgim_bp", "--out", str(tmp_path)])


def test_what_runs_have_left_becomes_tables_and_a_picture(tmp_path, monkeypatch):
    """Of a run of throw, whose rows are made here."""
    script = load("results/saht")
    run = tmp_path / "runs" / "throw" / "sgim_acts"

    def train(command, **_):
        run.mkdir(parents=True)
        assert command[3:] == [
            "train", "saht/sgim_acts", "--world.name", "throw", "--seeds", "2", "--total-env-steps", "1000",
            "--trainer.checkpoint_every", "1000", "--trainer.eval_every", "1", "--run-dir", str(run), "--quiet",
        ]  # fmt: skip
        teachers = "[{kind: action, task: placed, name: action_placed}]"
        text = f"experiment: saht\nworld: {{name: throw}}\nsaht: {{teachers: {teachers}}}\n"
        (run / "config.yaml").write_text(text)
        names = ("actions", "action_placed")
        rows = [
            {"seed": seed, "env_steps": step, "wall_s": 1.0, "env_steps_per_s": 9, "eval/error": 0.2 + 0.1 * seed}
            | {f"eval/{key}_{task}": 0.2 for task in ("thrown", "placed") for key in ("error", "area")}
            | {"saht/asked": 100 * (1 + seed)}
            | {f"saht/task_{task}": 0.5 for task in ("thrown", "placed")}
            | {f"saht/strategy_{name}": 0.25 + 0.5 * i for i, name in enumerate(names)}
            for step in (500, 1000)
            for seed in (0, 1)
        ]
        tables = [
            {"seed": seed, "env_steps": 1000, "chosen": [[9, 1], [4, 6]], "played": [[10], [10]]} for seed in (0, 1)
        ]
        start = [{"commit": "abc", "device": "CPU", "python": "3", "versions": {}}]
        for name, lines in (("metrics", rows), ("practice", tables), ("provenance", start)):
            (run / f"{name}.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))

    monkeypatch.setattr(script.subprocess, "run", train)
    words = ["throw", "sgim_acts", "--seeds", "2", "--total", "1000", "--runs", str(tmp_path / "runs")]
    script.main([*words, "--out", str(tmp_path)])
    told = json.loads((tmp_path / "throw.json").read_text())
    found = told["algorithms"]["sgim_acts"]
    assert found["errors"]["mean"][-1] == [0.2, 0.3] and found["requests"][0] == [0.75, 0.75]
    assert found["asked"] == [[100, 200], [200, 400]] and found["areas"][0] == [0.2, 0.2]
    assert found["ways"] == ["actions", "action_placed"] and found["commit"] == "abc"
    own = [claim["value"] for claim in told["claims"] if claim["row"] == "c"]
    assert own == [0.0, 1.0]  # thrown has no teacher
    assert (tmp_path / "throw.png").stat().st_size > 1000
    monkeypatch.setattr(script.subprocess, "run", lambda *_, **__: pytest.fail("it was made already"))
    script.main([*words, "--out", str(tmp_path)])
    shutil.rmtree(Path(run))


@pytest.mark.parametrize(
    "world", sorted(path.stem for path in (ROOT / "results" / "saht").glob("*.md") if "noise" not in path.stem)
)
def test_the_page_shows_the_tables_that_were_measured(world):
    page = (ROOT / "docs" / "saht.md").read_text(encoding="utf-8")
    lines = (ROOT / "results" / "saht" / f"{world}.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) > 10 and [line for line in lines if line not in page] == []


def robots(distance, *, on, late):
    """Four learners of CHIME: all have had a model of an object by an object since `late`, `on` have it still."""
    births = [["robot", "action", 200], ["object_1", "robot", 400], ["object_2", "object_1", late]]
    last = [{"outcome": outcome, "control": control, "on": True} for outcome, control, _ in births]
    off = [*last[:2], last[2] | {"on": False}]
    kinds = ("position", "wall", "push")
    return {
        "tests": {f"{what}_{kind}": [[distance] * 4] for what in ("distance", "success") for kind in kinds},
        "practice": {"robot": [[0.9] * 4, [0.3] * 4]},
        "births": [births] * 4,
        "models": [last] * on + [off] * (4 - on),
        "wall_s": 9.0,
        "timed_s": 1201.0,
    }


def test_learners_of_two_machines_get_one_table_and_none_is_trained(tmp_path, monkeypatch):
    script = load("results/chime")
    monkeypatch.setattr(script.subprocess, "run", lambda *_, **__: pytest.fail("nothing is to be trained"))
    for name, learner in (("random", robots(100.0, on=0, late=1)), ("room", robots(10.0, on=1, late=6000))):
        (tmp_path / name).write_text(json.dumps({"claims": [], "learners": {name: learner}}))
    script.main(["--add", str(tmp_path / "random"), str(tmp_path / "room"), "--out", str(tmp_path / "out")])
    made = json.loads((tmp_path / "out" / "room.json").read_text())
    assert list(made["learners"]) == ["room", "random"]
    assert [claim["holds"] for claim in made["claims"]] == [True, True, False, False, True, True, True, True, False]
    assert [claim["value"] for claim in made["claims"][:4]] == [1.0, 1.0, 0.0, 0.25]
    assert (tmp_path / "out" / "room.md").read_text().count("**failed**") == 3
