"""The report, from the values in it to what a browser makes of it. The runs are written by hand: nothing is trained."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from envs.common.errors import UserError
from star.agent.growth_map import growth_map
from star.agent.kind import STAR
from star.cli import main
from star.config.loading import load, load_run, parse
from star.report import history, page
from tests.report.by_hand import metrics, strip


def grown(run, most=page.MAX_BOXES):
    return growth_map(run.config, run.tables, run.seeds, most=most)


def read(folder):
    return history.read(folder, load_run(folder, {}), name=folder.name)


def test_a_curve_is_the_mean_over_seeds_between_the_two_where_there_are_two(make):
    run = read(make(rows=metrics(4, (0, 1), success=lambda seed, epoch: (0.2, 0.6)[seed] + epoch / 100)))
    found = page.evaluation_curves(run.evaluations, STAR.measures, run.config)
    assert (found["env_steps"], found["wall_s"]) == ([200, 400], [4, 8])
    success = found["eval/success_final"]
    assert success == {
        "mean": [0.42, 0.44],
        "low": [0.0, 0.0],  # with two seeds nearly nothing is known
        "high": [1.0, 1.0],
        "seeds": [[0.22, 0.24], [0.62, 0.64]],
    }
    assert page.epoch_curves(run.epochs)["controller/actor_loss"] == [1.5, 2.5, 3.5, 4.5]
    assert page.facts(run)["measured"]["eval/success_final"] == [0.44, 0.0, 1.0]


def test_the_interval_narrows_with_the_number_of_seeds(make):
    widths = []
    for count in (16, 64):
        rows = metrics(2, range(count), success=lambda seed, epoch: seed % 2)
        success = page.facts(read(make(f"run{count}", seeds=range(count), rows=rows)))["measured"]["eval/success_final"]
        widths.append(success[2] - success[1])
    assert widths == pytest.approx([2 * 1.96 * 0.5 / 4, 2 * 1.96 * 0.5 / 8], rel=0.15)


def test_a_long_curve_is_thinned_to_means_of_neighbours(make):
    run = read(make(rows=metrics(1000, (0, 1))))
    found = page.epoch_curves(run.epochs)
    assert {len(curve) for curve in found.values()} == {page.MAX_POINTS}
    steps = np.asarray(found["env_steps"])
    np.testing.assert_allclose(found["controller/actor_loss"], steps / 100 + 0.5, rtol=1e-3)
    assert (np.diff(steps) > 0).all() and steps[0] > 100 and steps[-1] < 100_000


def test_numbers_that_were_not_finite_are_gaps(make):
    run = read(make(rows=metrics(4, (0, 1), **{"tutor/kl": None})))
    assert page.epoch_curves(run.epochs)["tutor/kl"] == [None] * 4


def test_of_a_run_that_goes_on_only_what_is_complete_is_shown(make):
    folder = make(rows=[*metrics(3, (0, 1)), metrics(4, (0,))[-1]])
    with (folder / "metrics.jsonl").open("a") as file:
        file.write('{"seed": 1, "env_st')
    facts = page.facts(read(folder))
    assert (facts["env_steps"], facts["total_env_steps"], facts["wall_s"]) == (300, 400, 6.0)


def test_what_there_is_to_note_of_a_seed_is_among_the_facts(make):
    full = [
        row | {"refinement/table_full": int(row["seed"] == 1 and row["env_steps"] >= 200)} for row in metrics(4, (0, 1))
    ]
    found = page.facts(read(make(rows=full)))["notices"]
    assert len(found) == 1 and found[0].startswith("seed 1: the table of regions is full since env step 200")
    assert page.facts(read(make("other")))["notices"] == []


def test_regions_that_only_some_seeds_have_written_yet_are_left_out(make):
    rows = [{"seed": seed, "env_steps": n} | strip(1) for n, seed in ((200, 0), (200, 1), (400, 0))]
    assert [row["env_steps"] for row in read(make("a", regions=rows)).tables] == [200, 200]
    assert page.content([read(make("b", regions=rows[:1]))])["runs"][0]["map"] is None


def test_before_the_first_evaluation_there_is_a_report_without_success(make):
    shown = page.content([read(make(rows=metrics(1, (0, 1)), regions=[]))])["runs"][0]
    assert (shown["facts"]["measured"]["eval/success_final"], shown["map"]) == (None, None)
    assert shown["evaluations"]["env_steps"] == [] and shown["epochs"]["env_steps"] == [100]


@pytest.mark.parametrize("old", [False, True])
def test_the_regions_of_every_moment_are_those_of_the_run(make, old):
    rows = [{"seed": seed, "env_steps": 200 * n} | strip(n, old=old) for n in (1, 2) for seed in (0, 1)]
    found = grown(read(make(regions=rows)))
    assert found["axes"] == ["x", "y"] and found["start"] == [0, 0] and len(found["walls"]) > 4
    for i, row in enumerate(rows):
        frame = found["frames"][row["seed"]]["moments"][i // 2]
        corners = [[*low, *high] for low, high in zip(row["lower"], row["upper"], strict=True)]
        assert [list(found["boxes"][i]) for i in frame["box"]] == corners
        assert sum(frame["chosen"]) == pytest.approx(100, abs=0.1)
        assert frame.get("reaches") == row.get("reaches") and ("value" in frame) == (not old)


def test_many_moments_are_thinned_evenly_and_keep_the_first_and_the_last(make):
    rows = [{"seed": seed, "env_steps": n} | strip(4) for n in range(1, 101) for seed in (0, 1)]
    frames = grown(read(make(regions=rows)), most=5 * 2 * 12)["frames"]
    for one in frames:
        steps = [frame["env_steps"] for frame in one["moments"]]
        assert len(steps) == 12 and steps[0] == 1 and steps[-1] == 100 and set(np.diff(steps)) == {9}


def test_only_settings_that_differ_are_listed():
    one, other = parse({}), parse({"tutor": {"period": 5}, "env": {"options": {"cell": 4.0}}})
    one, other = history.words(one), history.words(other)
    differ = history.differences([one, other, one])
    assert {row["key"]: row["values"] for row in differ} == {
        "tutor.period": ["10", "5", "10"],
        "env.options.cell": ["null", "4.0", "null"],
    }
    assert [row["values"] for row in history.differences([other])] == [["4.0", "null"], ["5", "10"]]
    assert history.differences([one]) == []


def test_runs_of_the_same_name_are_told_apart_by_their_paths(make):
    paths = [make("a/run"), make("b/run"), make("c")]
    assert history.labels(paths) == [str(paths[0]), str(paths[1]), "c"]


OTHER = {"settings": {"commander.epsilon_end": 0.0}}
LONGER = {"settings": {"trainer.total_env_steps": 800}}
BOTH = {"settings": OTHER["settings"] | LONGER["settings"]}
AS_BEFORE = {"settings": {}}
FIRST, THEN = "star train run/config.yaml --run-dir run-again", "star train --resume run-again"
RANDOM, TOTAL = "--commander.epsilon_end", "--trainer.total_env_steps"


@pytest.mark.parametrize(
    ("resumed", "total", "changed", "again"),
    [
        ([], 400, [], FIRST),
        ([(200, {})], 400, [], FIRST),  # by an older version
        ([(200, AS_BEFORE)], 400, [], FIRST),
        ([(200, AS_BEFORE), (400, LONGER)], 800, [(400, TOTAL, "800")], f"{FIRST} {TOTAL} 800"),
        ([(400, LONGER), (800, AS_BEFORE)], 800, [(400, TOTAL, "800")], f"{FIRST} {TOTAL} 800"),  # was over already
        (
            [(400, BOTH)],
            800,
            [(400, RANDOM, "0.0"), (400, TOTAL, "800")],
            f"{FIRST} && {THEN} {RANDOM} 0.0 {TOTAL} 800",
        ),
        (
            [(200, OTHER), (300, AS_BEFORE)],
            400,
            [(200, RANDOM, "0.0"), (300, RANDOM, "0.5")],
            f"{FIRST} {TOTAL} 200 && {THEN} {RANDOM} 0.0 {TOTAL} 300 && {THEN} {TOTAL} 400",
        ),
        ([(200, OTHER), (200, AS_BEFORE)], 400, [], FIRST),  # killed before a checkpoint
        ([(0, OTHER)], 400, [(0, RANDOM, "0.0")], f"{FIRST} {RANDOM} 0.0"),
    ],
)
def test_settings_changed_on_resume_are_told_and_trained_again(make, monkeypatch, resumed, total, changed, again):
    monkeypatch.chdir(make(settings={"commander.epsilon_end": 0.5}, resumed=resumed).parent)
    facts = page.facts(read(Path("run")))
    assert facts["total_env_steps"] == total
    assert [(row["env_steps"], f"--{row['key']}", row["value"]) for row in facts["changes"]] == changed
    assert facts["command"] == again


def test_a_run_that_is_older_than_a_setting_is_trained_again_as_it_was(make, monkeypatch):
    path = make() / "config.yaml"
    noted = path.read_text(encoding="utf-8")
    path.write_text(noted.replace("  straight: true\n", ""), encoding="utf-8")
    monkeypatch.chdir(path.parent.parent)
    assert page.facts(read(Path("run")))["command"] == f"{FIRST} --tutor.straight false"


def test_settings_changed_on_resume_are_among_those_that_differ(make):
    first, second = read(make("first", resumed=[(400, BOTH)])), read(make("second"))
    before = history.words(second.config)["commander.epsilon_end"]
    assert page.content([first, second])["settings"] == [
        {"key": "commander.epsilon_end", "values": [f"{before}, 0.0 from 400 env steps", before]},
        {"key": "trainer.total_env_steps", "values": ["800", "400"]},
    ]


def test_seeds_that_went_on_with_other_settings_are_not_those_of_one_run(make):
    paths = [alone(make, name, seed, resumed=[(200, LONGER)]) for seed, name in enumerate("ab")]
    both = history.together("both", [read(path) for path in paths])
    assert [(row["env_steps"], row["key"]) for row in history.changes(both)] == [(200, "trainer.total_env_steps")]
    assert "trainer.seed" not in page.facts(both)["command"]
    other = read(alone(make, "other", 2, resumed=[(200, BOTH)]))
    with pytest.raises(UserError, match="differ in commander.epsilon_end; "):
        history.together("all", [both, other])


def alone(make, name, *seeds, resumed=(), **settings):
    settings = {f"trainer.{key}": value for key, value in settings.items()} | {"trainer.seed": seeds[0]}
    return make(name, seeds=seeds, settings=settings, resumed=resumed)


def test_seeds_that_were_trained_one_by_one_are_shown_like_seeds_side_by_side(make, tmp_path):
    apart = [read(alone(make, name, *seeds)) for name, seeds in (("b", [2]), ("a", [0, 1]))]
    shown, expected = (
        page.content([run])["runs"][0] for run in (history.together("all", apart), read(make(seeds=[0, 1, 2])))
    )
    for part in ("seeds", "evaluations", "epochs", "map"):
        assert shown[part] == expected[part], part
    assert shown["facts"]["path"] == f"{tmp_path / 'b'}, {tmp_path / 'a'}" and len(shown["facts"]["starts"]) == 2


def test_together_runs_are_shown_as_far_as_all_have_come(make):
    first = make("first", seeds=[0], rows=metrics(3, [0]))
    both = history.together("both", [read(first), read(alone(make, "second", 1))])
    assert [rows[0]["env_steps"] for rows in both.epochs] == [100, 200, 300]
    assert {row["env_steps"] for row in both.tables} == {200}


def test_groups_come_before_other_runs(make, tmp_path, capsys):
    first, second, third = alone(make, "first", 0), alone(make, "second", 1), make("third")
    out = tmp_path / "report.html"
    assert main(["report", str(third), "--group", f"star={first},{second}", "--out", str(out)]) == 0
    assert capsys.readouterr().out.startswith(f"{out}: 3 runs, ")
    shown = json.loads(Parts(out.read_text()).scripts[0])["runs"]
    assert [(run["name"], run["seeds"]) for run in shown] == [("star", [0, 1]), ("third", [0, 1])]


@pytest.mark.parametrize(
    ("groups", "said"),
    [
        (["both=first,longer"], "--group: both: first and longer differ in trainer.total_env_steps; allowed: the same"),
        (["both=first,again"], "--group: both: seed 0 is in several of its runs; allowed: once"),
        (["both=first,late"], "--group: both: its runs have no epoch in common, so there is nothing to show yet"),
        (["both=first", "others=first"], "first: is given twice"),
        (["both=first", "both=second"], "--group: both is given twice"),
        (["both"], "--group: 'both' is not of the form NAME=RUN,RUN"),
        ([], "star report: give a RUN, or --group NAME=RUN,RUN"),
    ],
)
def test_what_cannot_be_shown_together_is_refused_in_one_line(make, tmp_path, monkeypatch, capsys, groups, said):
    monkeypatch.chdir(tmp_path)
    alone(make, "first", 0), alone(make, "second", 1), alone(make, "again", 0)
    alone(make, "longer", 1, total_env_steps=800)
    late = make(
        "late", seeds=[1], settings={"trainer.seed": 1}, rows=[row | {"env_steps": 7} for row in metrics(1, [1])]
    )
    assert late.is_dir()
    options = [word for group in groups for word in ("--group", group)]
    assert main(["report", *options, "--out", "report.html"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {said}") and error.count("\n") == 1
    assert not (tmp_path / "report.html").exists()


def test_the_newest_small_film_is_shown_and_else_how_to_make_one(make, monkeypatch):
    folder = make("my run")
    assert "--run '" in page.film(folder)["command"] and page.film(folder)["large"] == []
    (folder / "figures").mkdir()
    page.write({folder: load(folder / "config.yaml")}, folder / "figures" / "report.html")
    assert "command" in page.film(folder)  # a report is no film
    (folder / "figures" / "a.gif").write_bytes(b"GIF89a")
    assert page.film(folder) == {"name": "a.gif", "kind": "gif", "data": "R0lGODlh"}
    monkeypatch.setattr(page, "MAX_FILM", 5)
    assert "a.gif" in page.film(folder)["large"]


START = '{"env_steps": 0, "time": "", "device": "", "python": "", "versions": {}, "settings": %s}\n'


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("metrics", "", "run: its metrics.jsonl holds no complete epoch"),
        ("metrics", "{]\n", "metrics.jsonl: line 1 is not a JSON object"),
        ("metrics", "\xff\n", "metrics.jsonl: line 1 is not a JSON object"),
        ("metrics", "[1]\n", "metrics.jsonl: line 1 is not a JSON object"),
        ("metrics", '{"seed": 0}\n', "metrics.jsonl: line 1: env_steps is null"),
        ("regions", '{"seed": 0, "env_steps": "many"}\n', "regions.jsonl: line 1: env_steps is many"),
        (
            "regions",
            '{"seed": 0, "env_steps": 1, "lower": [], "upper": [[0]], "chosen": []}\n',
            "regions.jsonl: line 1: its lists differ in length",
        ),
        ("provenance", "{}\n", "provenance.jsonl: line 1: env_steps is null"),
        ("provenance", START % "[1]", "provenance.jsonl: line 1: settings is [1], which no run writes"),
        ("provenance", START % '{"tutor.speed": 1}', "provenance.jsonl: tutor.speed: unknown key"),
    ],
)
def test_a_file_that_no_run_writes_is_refused_in_one_line_that_says_where(make, name, text, said):
    folder = make("run")
    (folder / f"{name}.jsonl").write_text(text, encoding="latin-1")
    with pytest.raises(UserError) as error:
        read(folder)
    assert said in str(error.value) and "\n" not in str(error.value)


class Parts(HTMLParser):
    """The texts of the script elements of a page."""

    def __init__(self, text):
        super().__init__()
        self.scripts, self._inside = [], False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self._inside = tag == "script"
        self.scripts += [""] if self._inside else []

    def handle_endtag(self, tag):
        self._inside &= tag != "script"

    def handle_data(self, data):
        if self._inside:
            self.scripts[-1] += data


def test_what_a_user_named_stays_inside_the_data_and_comes_out_unchanged():
    nasty = {"a": "</script><script>pwned = 1</script>", "b": "%js% <!-- \\ \u2028 ü"}
    data, script = Parts(page.html(nasty)).scripts
    assert json.loads(data) == nasty
    assert "%js%" not in script and "use strict" in script


def test_the_page_of_an_ordinary_run_is_below_two_megabytes(make, tmp_path):
    seeds = range(5)
    many = {f"tutor/metric_{i}": i / 7 for i in range(50)}
    rows = metrics(500, seeds, **many)
    grown = [{"seed": seed, "env_steps": 1000 * n} | strip(4) for n in range(1, 101) for seed in seeds]
    for row in grown:  # as many regions as there may be
        row |= {key: 13 * row[key] for key in ("lower", "upper", "chosen", "value", "target")}
    folder = make(seeds=seeds, rows=rows, regions=grown)
    said = page.write({folder: load(folder / "config.yaml")}, tmp_path / "report.html")
    assert 0.3e6 < (tmp_path / "report.html").stat().st_size < 2e6
    assert said.endswith("MB; open it in a browser")


NAME = "<img src=x onerror=pwned=1>"


@pytest.fixture
def two(make, tmp_path):
    """The report of two runs whose names and settings are out for trouble."""
    teacher = {"name": "guide", "kind": "decomposition", "source": "</script><script>pwned=1</script>"}
    shares = {"sgim/share_autonomous": 0.25, "sgim/share_guide": 0.75}
    rows = metrics(4, (0, 1), success=lambda seed, epoch: (seed + epoch) / 6, **shares)
    first, second = make(NAME, rows=rows, settings={"sgim.teachers": [teacher]}), make("second")
    assert main(["report", str(first), str(second), "--out", str(tmp_path / "report.html")]) == 0
    return tmp_path / "report.html"


def text(browser, selector):
    return browser.run(f"document.querySelector({json.dumps(selector)}).textContent")


def count(browser, selector):
    return browser.run(f"document.querySelectorAll({json.dumps(selector)}).length")


def choose(browser, selector, value, event):
    """Give an input a value, as a user does."""
    found = f"const input = document.querySelector({json.dumps(selector)})"
    browser.run(f"{{ {found}; input.value = {json.dumps(value)}; input.dispatchEvent(new Event('{event}')); 0 }}")


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("width", [1360, 390])
def test_the_page_opens_from_disk_without_errors_or_requests_and_fits(browser, two, width, dark):
    browser.open(two, width=width, dark=dark)
    browser.run("document.querySelectorAll('details').forEach(fold => fold.open = true)")
    browser.run("new Promise(done => setTimeout(done, 100))")
    assert (browser.problems, browser.requests) == ([], [two.absolute().as_uri()])
    assert browser.run("Math.max(document.documentElement.scrollWidth, innerWidth)") <= width
    assert browser.run("[...document.querySelectorAll('section')].map(section => section.id)") == [
        "evaluations", "abstraction", "strategies", "throughput", "levels", "films", "settings", "provenance",
    ]  # fmt: skip
    background = browser.run("getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, re.findall(r"\d+", background)[:3])) < 384) == dark


def test_names_and_settings_are_shown_as_they_are_and_never_run(browser, two):
    browser.open(two)
    assert browser.run("typeof pwned") == "undefined"
    assert NAME in text(browser, "h1") and "</script><script>pwned=1" in text(browser, "#settings")


MAP = "#abstraction figure:first-child"


def test_the_slider_shows_the_regions_of_its_moment(browser, two):
    browser.open(two)
    assert (count(browser, f"{MAP} .region"), text(browser, "#abstraction output")) == (3, "400 env steps")
    choose(browser, "#moment", "0", "input")
    assert (count(browser, f"{MAP} .region"), text(browser, "#abstraction output")) == (2, "200 env steps")
    assert text(browser, f"{MAP} figcaption") == "2 regions at 200 env steps"


def test_edges_can_be_shown_and_a_region_tells_its_values(browser, two):
    browser.open(two)
    assert count(browser, f"{MAP} .edge") == 0
    choose(browser, "select[aria-label=arrows]", "reaches", "change")
    assert count(browser, f"{MAP} .edge") == 2 and text(browser, f"{MAP} figcaption").endswith("2 edges")
    fill = f"document.querySelector('{MAP} .region').getAttribute('fill')"
    before = browser.run(fill)
    choose(browser, "select[aria-label=colour]", "value", "change")
    assert browser.run(fill) == "rgb(68,1,84)" != before
    event = "new PointerEvent('pointermove', { bubbles: true })"
    browser.run(f"document.querySelector('{MAP} .region').dispatchEvent({event})")
    assert text(browser, f"{MAP} figcaption") == (
        "Region 0: x −4 to 20, y −4 to 0; chosen 16.7 %, value 0, plan: region 1."
    )


def test_success_can_be_seen_over_the_wall_clock(browser, two):
    browser.open(two)
    assert "env steps" in text(browser, "#evaluations svg") and "wall-clock" not in text(browser, "#evaluations svg")
    browser.run("document.querySelector('#evaluations input[value=wall_s]').click()")
    assert "wall-clock, s" in text(browser, "#evaluations svg") and count(browser, "#evaluations .band") == 2


def test_the_table_of_provenance_says_what_was_changed_on_resume(browser, make, tmp_path):
    folders = make("one", resumed=[(200, AS_BEFORE), (300, OTHER)]), make("two", resumed=[(200, AS_BEFORE)])
    page.write({folder: load(folder / "config.yaml") for folder in folders}, tmp_path / "report.html")
    browser.open(tmp_path / "report.html")
    row = "changed on resumecommander.epsilon_end 0.0 from 300 env stepsnothing"
    assert row in text(browser, "#provenance") and browser.problems == []


def test_a_single_run_has_its_value_map_with_the_plan_beside_what_was_chosen(browser, make, tmp_path):
    folder = make()
    page.write({folder: load(folder / "config.yaml")}, tmp_path / "report.html")
    browser.open(tmp_path / "report.html")
    assert count(browser, "#abstraction .grid:not(.stills) > figure") == 2
    assert count(browser, "#abstraction figure:nth-child(2) .plan .edge") == 2
    assert count(browser, "#abstraction .stills figure") == 2 and browser.problems == []
