"""Evaluation of several checkpoints and runs: what is played, what is said of it, and what is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from star import cli
from star.agent import episodes, exam_results, exam_tables, exams, films
from star.agent.exams import Exam, Target
from star.agent.play import MISHAPS, Episode
from star.config import loading
from star.report import history
from star.training import checkpoint
from star.training import program as programs
from star.training.checkpoint import Checkpoints, load_state

GRID = Exam(grid=2, seed=1)
EPISODES = 5


def config_of(run):
    return loading.load(run / "config.yaml", {"trainer.eval_episodes": EPISODES})


@pytest.fixture(scope="module")
def still(run, tmp_path_factory):
    """A copy of the run with another discount, other seeds and a second checkpoint, whose agents do not move."""
    copy = tmp_path_factory.mktemp("runs") / "still"
    copy.mkdir()
    overrides = {"trainer.seed": 8, "commander.discount": 0.5, "trainer.eval_episodes": EPISODES}
    program = programs.build(loading.load(run / "config.yaml", overrides))
    (copy / "config.yaml").write_text(program.config.to_yaml())
    state = load_state(programs.build(loading.load(run / "config.yaml")), run, "last")[1]
    checkpoints = Checkpoints(copy)
    checkpoints.save(160, state, program.config, score=1.0)
    weak = jax.tree.map(lambda x: 0 * x, state.controller.params)
    still = state.replace(controller=state.controller.replace(params=weak))
    checkpoints.save(320, still, program.config, score=0.5)
    checkpoints.close()
    return copy


@pytest.fixture(scope="module")
def evaluated(run, still):
    """The rows of both runs on a grid of goals, how often the episode was traced, and the trials of every row."""
    traced, play, trials, row = [], exams.greedy, [], exams._row

    def kept(entry, exam, played, shortest):
        trials.append(played)
        return row(entry, exam, played, shortest)

    def counted(*arguments, **how):
        traced.append(1)
        return play(*arguments, **how)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exams, "greedy", counted)
        patch.setattr(exams, "_row", kept)
        targets = [Target(run, "last", config_of(run)), Target(still, "all", config_of(still))]
        rows = exams.evaluate([*targets, Target(still, "best", config_of(still))], GRID)
    return rows, len(traced), trials


def test_all_checkpoints_of_runs_that_differ_in_numbers_and_seeds_share_one_program(evaluated, run, still):
    rows, traced, _ = evaluated
    assert traced == 1
    assert [(row["run"], row["env_steps"]) for row in rows] == [(str(run), 160), (str(still), 160), (str(still), 320)]
    assert [[seed["seed"] for seed in row["seeds"]] for row in rows] == [[5, 6], [8, 9], [8, 9]]


def test_checkpoints_are_those_that_are_asked_for(evaluated):
    (moving, same, still), *_ = evaluated
    assert still["return"] != same["return"] != moving["return"]  # other seeds have other starts
    assert still["distance"] > 10 and still["path_length"] == pytest.approx(0.0, abs=0.5)


def test_a_grid_gives_each_goal_as_many_episodes_as_it_can_and_tells_its_success(evaluated):
    (row, *_), *_ = evaluated
    goals = row["per_goal"]
    assert [goal["cell"] for goal in goals] == [
        [-4, -4, 8, 8], [8, -4, 20, 8], [-4, 8, 8, 20], [8, 8, 20, 20]
    ]  # fmt: skip
    assert [goal["episodes"] for goal in goals] == [4, 2, 2, 2]
    assert goals[0]["success_any"] == 1.0  # where the agent starts
    total = sum(goal["episodes"] * goal["success_any"] for goal in goals)
    assert total == pytest.approx(row["success_any"] * row["episodes"])


def test_intervals_are_over_episodes_for_a_seed_and_over_seeds_besides(evaluated):
    (_, _, row), *_ = evaluated
    assert row["episodes"] == 2 * EPISODES
    for name in ("success_any", "success_final"):
        low, high = row[f"{name}_seeds_interval"]
        assert low <= row[name] <= high and low < high
        learnt = sum(seed[name] > 0.9 for seed in row["seeds"])
        assert (row[f"{name}_above"]["seeds"], row[f"{name}_above"]["of"]) == (learnt, 2)
        assert row["seeds"][0][f"{name}_interval"][0] < row["seeds"][0][name]
    for seed in row["seeds"]:
        assert len(seed["failed"]) == sum(seed["failures"].values()) == round(EPISODES * (1 - seed["success_any"])) > 0


def test_the_episode_of_a_number_is_recorded_as_it_was_evaluated(evaluated, still):
    rows, _, (_, trials, _) = evaluated
    recorded = films.record_run(
        config_of(still), still, checkpoint="160", agent=9, envs=1, steps=None, exam=GRID, number=1
    ).moments
    np.testing.assert_array_equal(recorded.obs[0, 0, 4:], [14, 2])
    np.testing.assert_array_equal(recorded.obs[0, 0, :2], trials.start[1, 1])
    assert recorded.distance[-1, 0] == trials.episode.distance[1, 1]
    assert bool(recorded.success[1:].any()) == (1 not in rows[1]["seeds"][1]["failed"])


def measured(ended, position, success, radius=1.0):
    """Trials with goals at the origin."""
    goal = jnp.zeros(position.shape[1:])
    return exams.measure(ended, jnp.asarray(position), jnp.asarray(success), goal=goal, radius=radius)


def test_the_reason_of_a_failure_is_the_first_that_holds():
    rng = np.random.default_rng(1)
    position = rng.normal(size=(9, 60, 2)).cumsum(axis=0)
    success_any, *mishaps = (rng.random((4, 60)) < [[0.2], [0.3], [0.3], [0.1]]).astype(float)
    holds = dict(zip(MISHAPS, mishaps, strict=True))
    happened = jax.tree.map(jnp.asarray, {"success_any": success_any, **holds})
    ended = Episode.start(jnp.zeros(60)).replace(**happened)
    found = measured(ended, position, np.zeros((9, 60)), radius=2.5)

    def slow(e):
        if success_any[e]:
            return -1
        still = all(np.hypot(*(position[t, e] - position[8, e])) <= 2.5 for t in range(4, 9))
        reasons = [*(mishap[e] for mishap in mishaps), still, True]
        return next(number for number, reason in enumerate(reasons) if reason)

    assert found.failure.tolist() == [slow(e) for e in range(60)] and set(found.failure.tolist()) == {*range(-1, 5)}
    counted = episodes.failures(found)
    assert sum(counted.values()) == (success_any == 0).sum()
    assert counted["flipped"] == ((1 - success_any) * holds["flipped"]).sum()


def test_time_and_way_count_until_the_goal_is_first_reached():
    rng = np.random.default_rng(0)
    position = rng.normal(size=(7, 40, 2)).cumsum(axis=0)
    success = (rng.random((7, 40)) < 0.15).astype(float)
    ended = Episode.start(jnp.zeros(40))
    found = measured(ended, position, success)
    for e in range(40):
        steps, path = 0, 0.0
        for t in range(1, 7):
            steps, path = t, path + float(np.hypot(*(position[t, e] - position[t - 1, e])))
            if success[t, e]:
                break
        assert found.steps[e] == steps and found.path[e] == pytest.approx(path, rel=1e-5)
    np.testing.assert_allclose(found.start, position[0])


def test_the_shortest_way_ends_where_the_goal_counts_as_reached(run):
    course = exams.prepare(config_of(run), Exam(), episodes=1, source=run)
    trials = measured(Episode.start(jnp.zeros(2)), np.zeros((2, 2, 2)), np.zeros((2, 2)))
    trials = trials.replace(goal=np.array([[0.0, 16.0], [3.0, 0.0]]))
    np.testing.assert_allclose(exams.shortest_ways(course, trials), [2 * np.hypot(12, 4) + 8 - 5, 0.0])


def test_a_goal_is_behind_a_wall_unless_who_goes_straight_on_comes_within_its_reach(run):
    course = exams.prepare(config_of(run), Exam(), episodes=1, source=run)
    goals = np.array([[0.0, 16.0], [3.0, 0.0], [0.0, 8.9], [0.0, 9.1], [16.0, 0.0]])
    trials = measured(Episode.start(jnp.zeros(5)), np.zeros((2, 5, 2)), np.zeros((2, 5))).replace(goal=goals)
    behind = exams.behind_walls(course, trials)
    assert behind.tolist() == [True, False, False, True, False]  # the wall begins at y = 4, success 5 m before a goal
    reached = trials.episode.replace(success_any=np.array([1.0, 1.0, 0.0, 0.0, 0.0]))
    told = {"episodes_behind_walls": 2, "success_behind_walls": 0.5}
    assert episodes.success_behind(reached, behind) == told
    assert set(episodes.success_behind(reached, None).values()) == {0, None}


def test_training_goals_are_those_that_training_draws_by_the_rules_of_tests(run):
    training = {"env.training": {"goals": "free", "position_noise": 0.5}}
    config = loading.load(run / "config.yaml", training)
    env = exams.prepare(config, Exam(training=True), episodes=1, source=run).env
    usual = envs.make("point_maze", goals="free")
    drawn = (jax.vmap(one.draw_goal)(jax.random.split(jax.random.key(0), 50)) for one in (env, usual))
    np.testing.assert_array_equal(*drawn)
    assert env._position_noise == 0.0 and Exam(training=True).goals == "train"


def test_in_another_task_an_agent_keeps_its_regions_and_meets_other_goals_and_clocks(run):
    task = {"env.name": "point_4rooms", "env.options.episode_length": 60}
    course = exams.prepare(config_of(run), Exam(task=task), episodes=1, source=run)
    assert (course.env.name, course.spec.episode_length, course.options) == ("point_4rooms", 60, {"episode_length": 60})
    assert course.spec.space == course.program.experiment.spec.space != tuple(tuple(x) for x in course.env.space)
    assert course.spec.success_radius == 2.5
    same = exams.elsewhere(config_of(run), {"env.options.reward": "sparse"})
    assert same.env.options == {"episode_length": 40, "reward": "sparse"}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("--env.name ant_maze", "env: ant_maze has a state of 30 numbers, the agent of RUN was trained with 4"),
        ("--env.name point_mase", 'task "point_mase" is unknown'),
        ("--env.options.episode_length 45", "env.options.episode_length: 45 is not a multiple of tutor.period 10"),
        ("--goals grid --grid 9 --episodes 20", "--grid: 9 makes 63 goals, more than the 20 episodes"),
        ("--goals grid --grid 1", "--grid: 1 puts no goal on a free floor"),
        ("--tutor.ppo.hidden [16]", "its checkpoint was made with tutor.ppo.hidden"),
        ("--checkpoint 7", "--checkpoint: '7' is not among last, best, 160"),
    ],
)
def test_what_cannot_be_evaluated_is_told_in_one_line_and_nothing_is_written(run, tmp_path, capsys, arguments, said):
    assert cli.main(["evaluate", str(run), *arguments.split(), "--out", str(tmp_path / "new")]) == 2
    out, err = capsys.readouterr()
    assert said.replace("RUN", str(run)) in err and err.count("\n") == 1 and out == "" and not list(tmp_path.iterdir())


def renumber(path, number):
    """Make of a checkpoint one of another format."""
    about = json.loads((path / "about.json").read_text())
    (path / "about.json").write_text(json.dumps(about | {"format": number}))
    (path / "SHA256SUMS").write_text(checkpoint._sums(path))


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda path: renumber(path, 99), "format 99 is newer than"),
        (lambda path: (path / "about.json").write_text("{"), "is damaged"),
        (lambda path: (path / "SHA256SUMS").unlink(), "is damaged"),
        (lambda path: shutil.rmtree(path / "state" / "d"), "is damaged"),
    ],
)
def test_a_damaged_checkpoint_is_told_in_one_line(run, tmp_path, capsys, damage, said):
    shutil.copytree(run, tmp_path / "run")
    damage(tmp_path / "run" / "checkpoints" / "160")
    assert cli.main(["evaluate", str(tmp_path / "run")]) == 2
    out, err = capsys.readouterr()
    assert said in err and "checkpoints/160" in err and err.count("\n") == 1 and out == ""


def test_the_folder_of_an_evaluation_holds_its_rows_and_a_figure_for_everything_in_them(evaluated, run, tmp_path):
    rows, *_ = evaluated
    groups = {"mo$\\frac$ing": [run], "still": [Path(rows[-1]["run"])]}
    comparison = exam_results.compare(rows, groups)
    assert comparison["groups"][1]["success_any"]["scores"] == {
        'point_maze {"episode_length": 40}': [seed["success_any"] for seed in rows[2]["seeds"]]
    }
    elsewhere = exam_results.compare([*rows[:-1], rows[-1] | {"env": "ant_maze"}], groups)
    captions = [exam_tables.improvements(found["improvement"]).caption for found in (comparison, elsewhere)]
    assert captions == [None, "-: no task in common"]
    (tmp_path / "goals-old.png").write_text("of an earlier evaluation")
    written = exam_results.write(tmp_path, rows, comparison)
    names = {"evaluation.jsonl", "goals-new.png", "goals-still.png", "curve.png", "profile.png"}
    assert {path.name for path in written} == {path.name for path in tmp_path.iterdir()} == names
    lines = (tmp_path / "evaluation.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines] == [*rows, comparison]


def test_runs_are_called_by_their_folders_unless_two_are_called_the_same():
    runs = [Path("a/x"), Path("b/x"), Path("c/y")]
    assert history.labels(runs) == ["a/x", "b/x", "y"]


def test_one_task_has_one_name_however_it_is_spelt():
    name = exam_results._task
    assert name("maze", {"cell": 4.0, "map": "111\n1r1\n"}) == name("maze", {"map": "111\n1r1\n\n", "cell": 4})
    assert name("maze", {"cell": 4.5}) != name("maze", {"cell": 4}) != name("maze", {})
