"""docs/results.md, its charts and the README's table say what the JSON files in results/ hold."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from scripts.pages import charts
from scripts.results import digest, page, tutoring
from star.config.loading import load

ROOT = Path(__file__).parents[1]
RENEW = "run `python scripts/results/page.py`"
DIGEST = {"settings": "a1", "moved": {"controller": 1.25, "tutor": 0.5}}


@pytest.fixture(scope="module")
def rows():
    return page.read()


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
    (tmp_path / page.DIGESTS.name).write_text(json.dumps(kept), encoding="utf-8")
    found = page.read(tmp_path)
    assert [row.today for row in found.values()] == [current]
    (line,) = page.table(found).splitlines()[2:]
    task = "Ant Maze" if current else f"Ant Maze {page.MARK}"
    assert line.startswith(f"| {task} | **.95** [") and line.endswith("] | .84 | 12 s | H100, 2 seeds |")


def test_who_is_ahead_is_told_only_where_the_interval_leaves_out_zero():
    def row(*success, today=True):
        return page.Row("", report(success), today)

    wide = {"ant_maze/star": row(0.9, 0.95, 0.9), "ant_maze/gara": row(0.2, 1.0, 0.9), "ant_maze/flat": row(0, 0.01, 0)}
    gara, flat = page.verdicts(wide)
    assert "| not told apart | +0.22 [" in gara and "| ahead | +0.91 [" in flat
    assert gara.endswith("] | 3x16.4/3x16.4 |")
    assert "| behind | " in page.verdicts({"ant_maze/star": wide["ant_maze/flat"], "ant_maze/gara": row(1, 1, 1)})[0]
    for ours, theirs in ((True, True), (True, False), (False, True)):
        rows = {"ant_maze/star": row(1, 1, today=ours), "ant_maze/gara": row(0, 0, today=theirs)}
        assert page.verdicts(rows)[0].startswith("| GARA, " if ours and theirs else f"| GARA {page.MARK}, ")
    assert page.unmeasured(wide).startswith("STAR on Ant Maze Cam, Ant Fall, labyrinth; GARA on ")


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
