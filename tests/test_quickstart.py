"""The figure of `make quickstart`, and its commands."""

import json
import re
import shlex
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.patches import Circle, Rectangle

import envs
from star.config.loading import load, parse
from tests.scripts import load as script

ROOT = Path(__file__).parents[1]
BOX = {"seed": 3, "lower": [[-4.0, -4.0], [8.0, -4.0]], "upper": [[8.0, 20.0], [20.0, 20.0]], "chosen": [0.25, 0.75]}


def recorded(success):
    """An episode of four env steps that goes east."""
    obs = np.zeros((5, 1, 6))
    obs[:, 0, 0], obs[:, 0, 4:] = np.arange(5), (0, 16)
    env = SimpleNamespace(walls=[(0.0, 4.0, 12.0, 12.0)], state_dim=4, dt=0.5, success_radius=3.5)
    return SimpleNamespace(moments=SimpleNamespace(obs=obs, success=np.array(success, float)[:, None]), env=env)


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """Two runs of two seeds; the agent of the first arrives after 2 env steps, that of the other never."""
    module = script("quickstart")
    for name, success in (("refined", 1.0), ("unrefined", 0.5)):
        folder = tmp_path / name
        folder.mkdir()
        config = load("configs/point_maze.yaml", layers=["configs/ablations/wrong_boxes.yaml"])
        (folder / "config.yaml").write_text(config.to_yaml(), encoding="utf-8")
        rows = [{"seed": s, "env_steps": n, "eval/success_any": success * (s - 3)} for n in (10, 20) for s in (3, 4)]
        rows.append({"seed": 3, "env_steps": 25})
        regions = [BOX | {"env_steps": n, "seed": s} for n in (10, 20) for s in (3, 4)]
        for file, lines in (("metrics", rows), ("regions", regions)):
            text = "".join(json.dumps(line) + "\n" for line in lines)
            (folder / f"{file}.jsonl").write_text(text, encoding="utf-8")
    moves = {"refined": recorded([0, 0, 1, 1, 1]), "unrefined": recorded([0] * 5)}
    monkeypatch.setattr(module.films, "record_run", lambda config, run, **_: moves[run.name])
    return module, [tmp_path / "refined", tmp_path / "unrefined"]


def test_the_figure_shows_start_goal_and_way_of_both_runs_and_the_success_of_all_seeds(runs, capsys):
    module, folders = runs
    drawn = module.figure([module.read(folder) for folder in folders])
    refined, other, curves = drawn.axes
    assert refined.get_title() == "refined, seed 3: 2 regions\narrives after 1 s of simulated time"
    assert other.get_title() == "not refined, seed 3: 2 regions\ndoes not arrive"
    way, start, goal = refined.lines
    assert way.get_xdata().tolist() == [0, 1, 2] and other.lines[0].get_xdata().tolist() == [0, 1, 2, 3, 4]
    assert start.get_xydata().tolist() == [[0, 0]] and goal.get_xydata().tolist() == [[0, 16]]
    assert [line.get_xydata().tolist() for line in curves.lines] == [[[10, 0.5], [20, 0.5]], [[10, 0.25], [20, 0.25]]]
    assert curves.get_title() == "success: mean and range\nof 2 seeds"
    assert module.main([*map(str, folders)]) == 0
    out = folders[0] / "figures" / "worth.png"
    assert out.exists()
    told = capsys.readouterr().out
    assert told == f"1 of 2 seeds reach the goal with refinement, 0 of 2 without: {out}\n"


def test_the_last_evaluation_of_each_seed_says_whether_it_reaches_the_goal(runs):
    module, folders = runs
    shown = module.read(folders[0])
    shares = [(0, 10, 1.0), (1, 10, 0.0), (0, 20, 0.5), (1, 20, 0.75)]
    rows = [{"seed": s, "env_steps": n, "eval/success_any": share} for s, n, share in shares]
    assert shown._replace(rows=rows).reached == [False, True]


def test_the_maps_show_the_radius_of_success_and_regions_without_values(runs):
    module, folders = runs
    for axis in module.figure([module.read(folder) for folder in folders]).axes[:2]:
        (disc,) = (patch for patch in axis.patches if isinstance(patch, Circle))
        assert (tuple(disc.center), disc.radius) == ((0, 16), 3.5)
        labels = {text.get_text() for text in axis.get_legend().get_texts()}
        assert labels >= {"success: within 3.5 m", "region", "wall"}
        boxes = [patch for patch in axis.patches if isinstance(patch, Rectangle)]
        assert [box.get_fill() for box in boxes] == [False, False, True]  # two regions, a wall


def test_no_legend_covers_what_is_drawn(runs):
    module, folders = runs
    drawn = module.figure([module.read(folder) for folder in folders])
    drawn.draw_without_rendering()
    for axis in drawn.axes:
        assert not axis.get_legend().get_window_extent().overlaps(axis.get_window_extent())


def test_the_title_tells_of_the_wrong_boxes_of_runs_that_begin_with_them_alone(runs):
    module, folders = runs
    shown = [module.read(folder) for folder in folders]
    assert "follow no wall of the U-maze, on purpose: configs/ablations/wrong" in module.figure(shown).get_suptitle()
    plain = parse({"env": {"name": "point_maze"}})
    (folders[1] / "config.yaml").write_text(plain.to_yaml(), encoding="utf-8")
    assert module.figure([shown[0], module.read(folders[1])]).get_suptitle() == ""


def test_a_run_without_evaluations_is_refused_in_one_line(runs, capsys):
    module, folders = runs
    (folders[1] / "regions.jsonl").write_text("", encoding="utf-8")
    with pytest.raises(SystemExit):
        module.main([*map(str, folders)])
    assert capsys.readouterr().err == f"error: {folders[1]}: is no run with evaluations and regions\n"


def test_make_quickstart_trains_from_boxes_that_follow_no_wall_and_evaluates_each_epoch():
    text = (ROOT / "Makefile").read_text(encoding="utf-8")
    config, quick = (re.search(rf"^{name} \?= (.*)$", text, re.MULTILINE)[1] for name in ("CONFIG", "QUICK"))
    words = shlex.split(quick)
    layers = [words[i + 1] for i, word in enumerate(words) if word == "--with"]
    found = load(config, layers=layers)
    assert words[words.index("--trainer.eval_every") + 1] == "1"
    walls = np.asarray(envs.make(found.env.name).walls)
    for axis, cuts in enumerate(found.abstraction.cuts):
        assert not np.isin(cuts, walls[:, [axis, axis + 2]]).any()
    assert "--with ablations/no_refinement" in text
