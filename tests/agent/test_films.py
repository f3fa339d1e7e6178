"""Pictures of episodes: what is recorded is what happened, and what is asked for is drawn."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

import envs
from envs import EnvError, opengl, video
from envs.common.errors import UserError
from star import cli
from star.agent import exams, films
from star.agent.exams import Exam, Target
from star.agent.films import Moments, Show
from star.config.loading import load, parse
from tests.scripts import load as load_script

ROOT = Path(__file__).parents[2]
EPISODE = 40


@pytest.fixture(scope="module")
def recorded(run):
    """Three environments of the second agent, and what is said of the same episodes in an evaluation."""
    config, exam = load(run / "config.yaml"), Exam(seed=1)
    recording = films.record_run(config, run, checkpoint="last", agent=6, envs=3, steps=None, exam=exam)
    (row,) = exams.evaluate([Target(run, "last", config)], exam)
    return SimpleNamespace(recording=recording, row=row["seeds"][1])


def random_actions(*, seed):
    config = parse({"env": {"name": "point_maze"}})
    return films.record_random(config, envs=6, steps=4, seed=seed)


@pytest.fixture(scope="module")
def wander():
    """Four env steps of random actions in six environments."""
    return random_actions(seed=3)


def first(recording, count):
    """Only the first `count` environments."""
    kept = {name: leaf[:, :count] for name, leaf in vars(recording.moments).items() if leaf is not None}
    return films.Recording(recording.env, Moments(**kept), recording.regions)


def test_the_recorded_episodes_are_those_that_are_evaluated(recorded):
    moments = recorded.recording.moments
    assert recorded.row["seed"] == 6
    assert moments.distance[-1].mean() == pytest.approx(recorded.row["distance"], rel=1e-5)
    assert (moments.success.max(axis=0) > 0).mean() == recorded.row["success_any"]


def test_an_episode_is_recorded_from_its_start_to_its_end(recorded):
    moments = recorded.recording.moments
    assert moments.obs.shape[:2] == moments.qpos.shape[:2] == (EPISODE + 1, 3)
    np.testing.assert_array_equal(moments.qpos, moments.obs[..., :2])
    assert (np.abs(moments.obs[0, :, :2]) <= 0.1).all()
    goal = moments.obs[..., 4:]
    np.testing.assert_array_equal(goal, np.broadcast_to([0.0, 16.0], goal.shape))
    np.testing.assert_allclose(moments.distance, np.linalg.norm(moments.obs[..., :2] - goal, axis=-1), rtol=1e-5)


def test_a_subgoal_stays_where_it_is_until_the_next_decision(recorded):
    subgoal = recorded.recording.moments.subgoal
    period = 10
    for t in range(EPISODE):
        if t % period:
            np.testing.assert_allclose(subgoal[t], subgoal[t - 1], atol=1e-4)
    assert (np.abs(subgoal[period] - subgoal[period - 1]) > 1e-3).any()


def test_the_target_is_a_region_or_the_surroundings_of_the_goal(recorded):
    recording = recorded.recording
    known = {tuple(np.concatenate(box)) for box in zip(*recording.regions, strict=True)} | {(-1.0, 15.0, 1.0, 17.0)}
    boxes = np.concatenate([recording.moments.lower, recording.moments.upper], axis=-1)
    assert {tuple(box) for box in boxes.reshape(-1, 4)} <= known


def test_random_actions_differ_between_seeds_and_environments(wander):
    obs = wander.moments.obs
    assert obs.shape[:2] == (5, 6)
    assert (obs != random_actions(seed=4).moments.obs).any() and (obs[:, 0] != obs[:, 1]).any()


def test_after_its_end_an_environment_stays_as_it_was():
    qpos = np.arange(12.0).reshape(6, 2, 1)
    qpos[3:, 0] = np.nan  # the simulation of the first breaks
    done = np.zeros((6, 2))
    done[3:, 0] = 1.0
    done[2:, 1] = 1.0  # the second turns over
    leaves = {name: qpos for name in ("mocap_pos", "obs", "distance", "success")}
    whole = Moments(qpos=qpos, done=done, **leaves)
    parts = [Moments(**{k: v[i] for k, v in vars(whole).items() if v is not None}) for i in (slice(5), 5)]
    joined = films._joined(*parts)
    np.testing.assert_array_equal(joined.qpos[:, 0, 0], [0, 2, 4, 4, 4, 4])
    np.testing.assert_array_equal(joined.qpos[:, 1, 0], [1, 3, 5, 5, 5, 5])


def arriving(*success):
    """A recording of environments that are at their goals at the moments with a 1, half a second apart."""
    success = np.array(success, float).T
    leaves = {name: np.zeros_like(success) for name in ("qpos", "mocap_pos", "obs", "distance", "done")}
    return films.Recording(SimpleNamespace(dt=0.5), Moments(success=success, **leaves))


@pytest.mark.parametrize(
    ("success", "moments"),
    [
        ([[0, 0, 1, 1, 1, 1, 1, 1, 1, 1]], 7),  # 2 s after the arrival
        ([[0, 1, 1, 0, 1, 1, 1, 1, 1, 1]], 9),  # it had left again
        ([[0, 0, 0, 0, 0, 0, 0, 1, 1, 1]], 10),  # it arrives near the end
        ([[0, 0, 1, 1, 1, 1, 1, 1, 1, 0]], 10),  # it does not stay
        ([[0] * 10], 10),
        ([[1] * 10], 5),
        ([[0, 1, 1, 1, 1, 1, 1, 1, 1, 1], [0, 0, 0, 0, 1, 1, 1, 1, 1, 1]], 9),  # both have come
        ([[0, 1, 1, 1, 1, 1, 1, 1, 1, 1], [0] * 10], 10),
    ],
)
def test_a_film_ends_two_seconds_after_all_have_come_to_their_goals_to_stay(success, moments):
    recording = arriving(*success)
    settled = films.until_settled(recording).moments
    assert len(settled.success) == len(settled.obs) == moments
    np.testing.assert_array_equal(settled.success, recording.moments.success[:moments])


@pytest.mark.parametrize(
    ("name", "steps", "moments"), [("a.gif", None, 6), ("a.gif", 9, 10), ("a.png", None, 10), ("a.png", 9, 10)]
)
def test_stills_and_films_of_so_many_env_steps_do_not_end_early(name, steps, moments, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(films, "record_run", lambda *_, **__: arriving([0, *[1] * 9]))
    monkeypatch.setattr(films, "draw", lambda recording, show, times: seen.append((recording, times)) or iter([]))
    monkeypatch.setattr(films.video, "write", lambda out, pictures, fps: len(list(pictures)))
    show = Show(out=tmp_path / name, steps=steps, every=1)
    assert films.render(parse({}), show, run_dir=tmp_path, quiet=True).endswith("; the goal is reached")
    ((recording, times),) = seen
    assert len(recording.moments.obs) == moments and times[-1] == moments - 1


@pytest.mark.parametrize(
    ("out", "every", "total", "shown"),
    [
        ("a.png", 2, 11, [10]),
        ("a.gif", 1, 4, [0, 1, 2, 3]),
        ("a.gif", 3, 10, [0, 3, 6, 9]),
        ("a.html", 4, 11, [0, 4, 8, 10]),
        ("a.mp4", 100, 11, [0, 10]),
    ],
)
def test_a_still_shows_the_end_and_a_film_every_nth_moment_and_the_end(out, every, total, shown):
    assert video.moments(Path(out), total, every=every) == shown


@pytest.mark.parametrize(("count", "across", "down"), [(1, 1, 1), (2, 1, 2), (4, 2, 2), (6, 3, 2)])
def test_environments_stand_side_by_side(can_draw, wander, count, across, down):
    show = Show(out=Path("a.gif"), height=60)
    one, many = (next(films.draw(first(wander, n), show, [4])) for n in (1, count))
    assert many.shape == (down * one.shape[0], across * one.shape[1], 3)
    if count == 2:
        above, below = np.split(many, 2)
        assert (above != below).any()


def test_a_film_of_an_agent_shows_that_it_moves_and_where_it_is_going(can_draw, run, recorded):
    recording = recorded.recording
    show = Show(out=Path("a.gif"), height=100)
    start, end = films.draw(recording, show, [0, EPISODE])
    assert (start != end).any()
    without = films.Recording(recording.env, recording.moments.replace(subgoal=None, lower=None, upper=None))
    assert (next(films.draw(without, show, [EPISODE])) != end).any()


def test_the_command_draws_a_task_and_the_same_picture_again(can_draw, tmp_path, capsys):
    out = tmp_path / "maze.png"
    arguments = "render ant_maze --height 120 --env.engine native".split()
    assert cli.main([*arguments, "--out", str(out)]) == 0
    said, errors = capsys.readouterr()
    assert said == f"{out}: 1 picture\n" and errors == ""
    before = out.read_bytes()
    assert cli.main([*arguments, "--out", str(out)]) == 2
    assert "exists; replace it with --force" in capsys.readouterr().err
    assert cli.main([*arguments, "--out", str(out), "--force"]) == 0
    assert out.read_bytes() == before
    assert np.asarray(Image.open(out).convert("RGB")).std() > 10


@pytest.mark.parametrize(
    ("name", "words", "moments", "on_test_goal"),
    [
        ("a.png", {}, 1, True),
        ("a.png", {"steps": 2}, 3, True),
        ("a.png", {"goals": "train"}, 1, False),
        ("a.gif", {"steps": 2}, 3, True),
    ],
)
def test_a_picture_of_a_task_shows_its_start_and_a_test_goal(name, words, moments, on_test_goal, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(films, "draw", lambda recording, show, times: seen.append(recording.moments) or iter([]))
    monkeypatch.setattr(films.video, "write", lambda out, pictures, fps: len(list(pictures)))
    options = {key: words[key] for key in words if key == "goals"}
    config = parse({"env": {"name": "point_maze", "options": options}})
    films.render(config, Show(out=tmp_path / name, steps=words.get("steps")), quiet=True)
    goals = np.asarray(seen[0].obs)[:, 0, -2:]
    assert len(goals) == moments and (goals.tolist() == [[0.0, 16.0]] * moments) == on_test_goal


@pytest.mark.parametrize("given", ["--run RUN", "RUN"])
def test_the_command_draws_an_agent(given, can_draw, run, recorded, tmp_path, monkeypatch, capsys):
    asked = []

    def record(config, run_dir, **how):
        asked.append((config.env.name, run_dir, how))
        return first(recorded.recording, how["envs"])

    monkeypatch.setattr(films, "record_run", record)
    out = tmp_path / "agent.gif"
    arguments = f"render {given} --out {out} --seed 6 --checkpoint 160 --evaluation-seed 9 --envs 2 --every 10"
    arguments = arguments.replace("RUN", str(run))
    assert cli.main([*arguments.split(), "--height", "60"]) == 0
    how = {"checkpoint": "160", "agent": 6, "envs": 2, "steps": None, "exam": Exam(seed=9), "number": None}
    assert asked == [("point_maze", run, how)]
    assert capsys.readouterr().out.startswith(f"{out}: 5 pictures; ")
    with Image.open(out) as film:
        assert film.n_frames == 5


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("point_mase", 'env: task "point_mase" is unknown'),
        ("point_maze --env.options.gaols test", 'option "gaols"'),
        ("point_maze --steps 501", "--steps: 501 is more than the 500 env steps of an episode"),
        ("--run RUN --seed 7", "--seed: 7 is not among those of"),
        ("--run RUN --checkpoint 7", "--checkpoint: '7' is not among last, best, 160"),
        ("ant_maze --run RUN", "its agent was trained on point_maze, not on ant_maze"),
        ("--run RUN --tutor.ppo.hidden [16]", "its checkpoint was made with tutor.ppo.hidden"),
        ("--run RUN --episode 3", "--episode: 3 is not among 0 to 2"),
        ("--run RUN --env.name ant_maze", "env: ant_maze has a state of 30 numbers"),
        ("--run RUN --steps 41", "--steps: 41 is more than the 40 env steps"),
    ],
)
def test_what_cannot_be_drawn_is_told_in_one_line_and_nothing_is_written(
    run, tmp_path, monkeypatch, capsys, arguments, said
):
    monkeypatch.setattr(opengl, "backend", lambda: None)
    words = ["render", *arguments.replace("RUN", str(run)).split(), "--out", str(tmp_path / "a.png")]
    assert cli.main(words) == 2
    out, err = capsys.readouterr()
    assert said in err and err.count("\n") == 1 and out == "" and not list(tmp_path.iterdir())


def test_a_bar_moves_while_pictures_are_drawn(tmp_path, monkeypatch):
    screen, blank = io.StringIO(), np.zeros((2, 2, 3), np.uint8)

    def draw(recording, show, times):
        for _ in times:
            time.sleep(0.15)  # longer than the bar takes to be drawn again
            yield blank

    recording = SimpleNamespace(moments=SimpleNamespace(obs=np.zeros((9, 1)), success=np.zeros((9, 1))))
    terminal = Console(file=screen, force_terminal=True, width=100, color_system=None)
    monkeypatch.setattr(films, "Console", lambda stderr: terminal)
    monkeypatch.setattr(films, "record_random", lambda *_, **__: time.sleep(0.3) or recording)
    monkeypatch.setattr(films, "draw", draw)
    films.render(parse({}), Show(out=tmp_path / "a.gif"))
    assert re.search(r"recording .* 0:00", screen.getvalue())
    shares = [int(share) for share in re.findall(r"drawing .*?(\d+)%", screen.getvalue())]
    assert shares == sorted(shares) and len(set(shares)) >= 4


def test_without_opengl_the_command_says_so_before_anything_is_recorded(tmp_path, monkeypatch, capsys):
    def nothing_works():
        raise EnvError("pictures need OpenGL")

    monkeypatch.setattr(opengl, "backend", nothing_works)
    monkeypatch.setattr(films, "record_random", None)
    assert cli.main(["render", "point_maze", "--out", str(tmp_path / "a.png")]) == 2
    assert capsys.readouterr().err == "error: pictures need OpenGL\n"


def test_a_broken_driver_does_not_end_in_a_traceback(tmp_path):
    environment = os.environ | {"MUJOCO_GL": "osmesa", "PYOPENGL_PLATFORM": "egl", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "star", "render", "point_maze", "--out", str(tmp_path / "a.png")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: pictures need OpenGL") and done.stderr.count("\n") == 1


def test_an_error_while_recording_becomes_one_of_the_configuration(tmp_path):
    with pytest.raises(UserError, match="unknown"):
        films.render(parse({"env": {"name": "nowhere"}}), Show(out=tmp_path / "a.png"), quiet=True)


def test_the_gallery_shows_every_task_and_is_small():
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    images = ROOT / "docs" / "images"
    for name in load_script("pages/gallery").by_maze(envs.names()):
        assert f"](images/{name}.jpg)" in page and (images / f"{name}.jpg").is_file(), "run scripts/pages/gallery.py"
    for name in envs.names():
        assert f"`{name}`" in page
    assert sum(path.stat().st_size for path in images.iterdir()) < 2e6
