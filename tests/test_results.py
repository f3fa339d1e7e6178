"""docs/results.md, its charts and the README's table say what the JSON files in results/ hold."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from scripts.pages import charts
from scripts.results import digest, jaxgcrl, page, tutoring
from scripts.results.rows import DIGESTS, MARK, Row, read
from scripts.results.verdicts import standing, unmeasured, verdicts
from star.config.loading import load

ROOT = Path(__file__).parents[1]
RENEW = "run `python scripts/results/page.py`"
DIGEST = {"settings": "a1", "moved": {"controller": 1.25, "tutor": 0.5}}


@pytest.fixture(scope="module")
def rows():
    return read()


def test_the_page_and_the_tables_keep_step_with_the_json_files(rows):
    made = page.page(rows)
    assert (ROOT / "docs" / "results.md").read_text(encoding="utf-8") == made, RENEW
    for name, table in page.tables(rows).items():
        text = (ROOT / name).read_text(encoding="utf-8")
        assert page.with_table(text, table) == text, RENEW
    assert len(made.split()) < 600


def test_the_charts_keep_step_with_the_json_files(rows):
    of = page.sources(rows)
    assert {charts.shown(name) for name in re.findall(r"images/(results_\w+)\.png", page.page(rows))} == {of}, RENEW
    other = dict(rows) | {"ant_fall/gara": rows["ant_fall/star"]}
    assert page.sources(other) != of


def test_the_tables_of_the_tutor_keep_step_with_the_json_files():
    results, text = ROOT / "results" / "tutoring", (ROOT / "docs" / "tutoring.md").read_text(encoding="utf-8")
    made = tutoring.table(*(json.loads((results / f"{name}.json").read_text("utf-8")) for name in tutoring.FILES))
    assert (results / "table.md").read_text(encoding="utf-8") == made, "run `python scripts/results/tutoring.py`"
    missing = [block for block in made.strip().split("\n\n") if block not in text]
    assert not missing, "docs/tutoring.md has other tables than results/tutoring/table.md"


def report(success, *, digests=(), seconds=12.0):
    seeds = [
        {"seed": i, "episodes": 100, "success_any": one, "training_seconds_to_level": seconds}
        for i, one in enumerate(success)
    ]
    runs = [{"device": "NVIDIA H100 80GB HBM3", "command": "star train x", "digest": one} for one in digests or (None,)]
    told = {"task": "ant_maze", "name": "star", "level": 0.9, "env_steps_per_seed": 16_384_000}
    return told | {"seeds": seeds, "runs": runs}


@pytest.mark.parametrize(
    ("today", "digests", "current"),
    [
        (DIGEST, [DIGEST], True),
        (DIGEST, [DIGEST, DIGEST | {"moved": {"controller": 1.2505, "tutor": 0.4995}}], True),  # rounding of a machine
        (DIGEST, [DIGEST, DIGEST | {"moved": {"controller": 1.25, "tutor": 0.502}}], False),
        (DIGEST, [DIGEST | {"settings": "b2"}], False),
        (DIGEST, [None], False),
        (None, [DIGEST], False),
    ],
)
def test_a_row_is_marked_as_of_an_older_version_unless_all_its_digests_are_those_of_today(
    tmp_path, today, digests, current
):
    path = tmp_path / "ant_maze" / "one_by_one" / "star.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(report([0.9, 1.0], digests=digests)), encoding="utf-8")
    (tmp_path / "other.json").write_text("[]", encoding="utf-8")
    kept = {"commit": "c0ffee", "rows": {"ant_maze/one_by_one/star": today} if today else {}}
    (tmp_path / DIGESTS.name).write_text(json.dumps(kept), encoding="utf-8")
    found = read(tmp_path)
    assert [row.today for row in found.values()] == [current]
    (line,) = page.table(found).splitlines()[2:]
    task = "Ant Maze" if current else f"Ant Maze {MARK}"
    assert line.startswith(f"| {task} | **.95** [") and line.endswith("] | .84 | 12 s | H100, 2 seeds |")


def test_who_is_ahead_is_told_only_where_the_interval_leaves_out_zero():
    def row(*success, today=True):
        return Row("", report(success), today)

    wide = {"ant_maze/star": row(0.9, 0.95, 0.9), "ant_maze/gara": row(0.2, 1.0, 0.9), "ant_maze/flat": row(0, 0.01, 0)}
    found = verdicts(wide)
    gara, flat = (one.line for one in found)
    assert standing(found) == "**STAR is not ahead of** GARA: Ant Maze."
    assert standing(found[1:]) == "STAR is ahead of all agents that are measured, on every task."
    assert "| not told apart | +0.22 [" in gara and "| ahead | +0.91 [" in flat
    assert gara.endswith("] | 3x16.4/3x16.4 |")
    assert "| behind | " in verdicts({"ant_maze/star": wide["ant_maze/flat"], "ant_maze/gara": row(1, 1, 1)})[0].line
    for ours, theirs in ((True, True), (True, False), (False, True)):
        rows = {"ant_maze/star": row(1, 1, today=ours), "ant_maze/gara": row(0, 0, today=theirs)}
        assert verdicts(rows)[0].line.startswith("| GARA, " if ours and theirs else f"| GARA {MARK}, ")
    assert unmeasured(wide).startswith("STAR on Ant Maze Cam, Ant Fall, labyrinth; GARA on ")


def at_the_goal(steps, *, first, way):
    return {
        "success_any": 1.0,
        "time_at_goal": steps,
        "steps_to_goal": first,
        "seconds_to_goal": first and first / 20,
        "path_length": way,
    }


def test_the_part_on_jaxgcrl_tells_speed_way_and_the_most_that_an_agent_could_have(tmp_path):
    assert jaxgcrl.section({}) == "" and jaxgcrl.paths({}) == []
    seeds = [
        {"seed": 0} | at_the_goal(600, first=300, way=30.0) | {"train": at_the_goal(700, first=200, way=20.0)},
        {"seed": 1} | at_the_goal(650, first=300, way=30.0) | {"train": at_the_goal(800, first=100, way=20.0)},
    ]
    none = [{"seed": 0} | at_the_goal(0, first=None, way=None) | {"train": at_the_goal(0, first=None, way=None)}]
    runs = [{"seeds": [0, 1], "env_steps_per_s": 300_000, "digest": None}]
    told = {"env_steps_per_seed": 9_000_000, "seeds": seeds, "runs": runs}
    rows = {
        "jaxgcrl/ant_big_maze/frugal": Row("", told, today=True),
        "jaxgcrl/ant_hardest_maze/crl": Row("", told | {"seeds": none, "runs": [runs[0] | {"seeds": [0]}]}, False),
    }
    frugal, crl = [line for line in jaxgcrl.section(rows).splitlines() if line.startswith(("| big", "| hardest"))]
    # 2 x 9 M env steps in 60 s; 20 m in 10 s and in 5 s are 3 m/s, and 150 of 1,000 env steps
    assert frugal.startswith("| big maze, STAR, frugal | 9.0 | 60 | **750** [115, 1000] | **625** [307, 943] | ")
    assert frugal.endswith("| 20 | 3.0 | 850 |")
    assert crl == f"| hardest maze, CRL {MARK} | 9.0 | 30 | **0** | **0** |  |  |  |"
    folder = tmp_path / "jaxgcrl" / "ant_big_maze"
    folder.mkdir(parents=True)
    points = [
        {
            "name": "frugal",
            "seed": seed,
            "env_steps": 10**6 * at,
            "wall_s": 50.0 * at + seed,
            "eval/time_at_goal": 90.0 * at + seed,
        }
        for seed in (0, 2)
        for at in (1, 2)
    ]
    (folder / "curves.jsonl").write_text("".join(json.dumps(point) + "\n" for point in points), encoding="utf-8")
    over_steps, over_seconds, *_ = jaxgcrl.curves(tmp_path).axes
    line = next(line for line in over_steps.lines if line.get_label() == "STAR, frugal")
    assert line.get_xydata().tolist() == [[1, 91], [2, 181]]
    line = next(line for line in over_seconds.lines if line.get_label() == "STAR, frugal")
    assert line.get_xydata().tolist() == [[51, 91], [101, 181]]
    before = page.sources(rows, tmp_path)
    (folder / "curves.jsonl").write_text(json.dumps(points[0]) + "\n", encoding="utf-8")
    assert page.sources(rows, tmp_path) != before


@pytest.mark.parametrize("agent", sorted(path.stem for path in (ROOT / "configs" / "agents").glob("*.yaml")))
def test_every_agent_can_be_made_small_for_its_digest(agent):
    """And has transitions enough to learn from in its three epochs, if it has a replay buffer."""
    config = load(ROOT / "configs" / "ant_maze.yaml", {}, layers=[ROOT / "configs" / "agents" / f"{agent}.yaml"])
    small = digest.made_small(config)
    steps = small.env.options["episode_length"]
    assert small.trainer.num_envs == 32 and steps % small.tutor.period == 0
    learner = getattr(small.controller, small.controller.learner)
    assert getattr(learner, "min_transitions", 0) <= digest.EPOCHS * steps * small.trainer.num_envs


def test_a_digest_sees_a_weight_that_moved_and_neither_keys_nor_what_is_not_finite():
    def state(weight, key):
        tutor = {"weight": np.array([weight, np.nan]), "key": jax.random.key(key)}
        return SimpleNamespace(tutor=tutor, epoch=np.array(3))

    still = digest.moved(state(1.0, 0), state(1.0, 1))
    assert still == {"epoch": 0.0, "tutor": 0.0}
    far = digest.moved(state(1.0, 0), state(1.0 + np.e - 1, 1))
    assert far["tutor"] == pytest.approx(1.0) and not digest.same(
        {"settings": "", "moved": far}, {"settings": "", "moved": still}
    )
