#!/usr/bin/env python
"""See that tests hold what was mended: each mend is taken back in a copy of the tree, and its test must then fail.

    python scripts/checks/mends.py [--jobs 2] [--only WORD ...]

Prints a line for each mend. The exit code is 1 if a test passes without its mend, or fails with it.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from scripts.processes import importing

ROOT = Path(__file__).parents[2]
LIMIT = 300  # s, of one test: some faults are that something hangs


@dataclass(frozen=True)
class Mend:
    """A fault, the test that holds its mend, and the change of `now` in `file` back to `before`."""

    fault: str
    test: str
    file: str
    now: str
    before: str


def _use(test: str) -> str:
    return f"tests/test_compatibility.py::test_{test}"


_VARIABLE = "tests/cli/test_mistakes.py::test_a_wrong_variable_is_told_in_one_line_and_nothing_is_written"


MENDS = (
    Mend(
        "the box around a goal is larger than the ball of success",
        "tests/agent/test_tutor.py::test_whoever_is_in_the_box_around_a_goal_has_reached_it",
        "star/agent/task.py",
        "jnp.minimum(config.commander.goal_margin, INSIDE * spec.cube)",
        "config.commander.goal_margin",
    ),
    Mend(
        "a goal whose box is higher than subgoals reach is never close, so that agents on Ant Fall leave it",
        "tests/agent/test_tutor.py::test_a_box_higher_than_the_reach_is_close_to_who_is_between_its_bounds",
        "star/agent/tutor.py",
        " | (distance <= half)",
        "",
    ),
    Mend(
        "a greedy agent comes to rest short of its goal",
        "tests/agent/test_acting.py::test_the_seed_of_an_episode_decides_between_commands_of_equal_worth_and_how_to_move_on",
        "star/agent/hierarchy.py",
        " or agent.commander.standing(task, memory, scene)",
        "",
    ),
    Mend(
        "a fast greedy agent runs on by a command of a region that it has left behind",
        "tests/agent/test_commander.py::test_a_greedy_plan_is_asked_again_where_the_agent_has_come_to_a_better_region",
        "star/agent/commander.py",
        "    return begins | (value > best), ",
        "    return begins, ",
    ),
    Mend(
        "a greedy agent walks in a circle or presses against a wall: it is given the same target over and over",
        "tests/agent/test_commander.py::test_a_target_that_was_given_in_vain_is_not_given_again_at_once_unless_the_goal_is_here",
        "star/agent/commander.py",
        "        vain=vain,\n",
        "",
    ),
    Mend(
        "greedy agents are sent by a cut that nobody has walked with yet, and fall into the gap of Ant Fall",
        "tests/agent/test_epoch.py::test_cuts_wait_for_the_next_epoch",
        "star/agent/between_episodes.py",
        "    return state.replace(upcoming=Upcoming.of(later.replace(commander=planned))), metrics",
        "    later = later.replace(commander=planned)\n    return later.replace(upcoming=Upcoming.of(later)), metrics",
    ),
    Mend(
        "feet of JaxGCRL's ant begin in the floor, and MuJoCo throws it up",
        "tests/envs/test_tasks.py::test_the_heavy_ant_begins_with_no_foot_in_the_floor_and_else_as_the_other",
        "envs/ant.py",
        "        if self._raised:",
        "        if False:",
    ),
    Mend(
        "the hinges of JaxGCRL's heavy ant stop at their limits, and those of spring yield",
        "tests/envs/test_tasks.py::test_limits_of_the_heavy_ant_are_springs_of_1000_newton_metres_and_its_hinges_are_damped_by_10",
        "envs/ant.py",
        "        hinge.solimp_limit = SPRING_SOLIMP",
        "        hinge.solimp_limit = MUJOCO_SOLIMP",
    ),
    Mend(
        "the page of star watch loses its place when the run writes twice within a moment",
        "tests/report/test_watching.py::test_in_a_browser_it_renews_itself_and_keeps_what_was_chosen",
        "star/assets/report.js",
        "place ?? scrollY",
        "scrollY",
    ),
    Mend(
        "Q-learning learns nothing from periods that the task ended",
        "tests/agent/test_commander.py::test_q_learning_averages_the_errors_of_each_cell",
        "star/agent/q_learning.py",
        "weight=jnp.maximum(batch.weight, batch.lost) * (1 - batch.aside)",
        "weight=batch.weight * (1 - batch.aside)",
    ),
    Mend(
        "an end looks like a way out of negative rewards",
        "tests/agent/test_commander.py::test_who_loses_the_task_at_a_distance_does_no_better_than_who_waits_there",
        "star/agent/commander.py",
        "last / (1.0 - section.discount)",
        "reward",
    ),
    Mend(
        "agents stay in a sliver of the goal's region, on the wrong side of a wall",
        "tests/abstraction/test_passages.py::test_where_no_goal_is_on_their_side_it_counts_what_agents_reach_elsewhere",
        "star/abstraction/passages.py",
        "jnp.where(tries.beside < TRIES, able, tries.met >= ABLE * tries.beside)",
        "tries.met >= ABLE * jnp.maximum(tries.beside, TRIES)",
    ),
    Mend(
        "intervals over seeds are too narrow",
        "tests/report/test_statistics.py::test_of_normal_seeds_intervals_hold_the_truth_as_often_as_they_say",
        "star/report/statistics.py",
        "half = quantile * np.sqrt(variance)",
        "half = 1.96 * np.sqrt(variance)",
    ),
    Mend(
        "seeds that agree give an interval of width 0",
        "tests/report/test_statistics.py::test_seeds_that_agree_leave_open_what_their_episodes_leave_open",
        "star/report/statistics.py",
        "return np.maximum(spread, share * (1 - share) / (n * episodes))",
        "return spread",
    ),
    Mend(
        "JAX_ENABLE_X64 ends in a traceback",
        _VARIABLE + "[JAX_ENABLE_X64=1 star train point.yaml]",
        "envs/common/modes.py",
        "if config.jax_enable_x64:",
        "if False:",
    ),
    Mend(
        "JAX_NUMPY_DTYPE_PROMOTION=strict ends in a traceback",
        _use("goal_selection_alone_refuses_the_modes_that_environments_refuse"),
        "envs/common/modes.py",
        'if config.jax_numpy_dtype_promotion != "standard":',
        "if False:",
    ),
    Mend(
        "a device that is not there ends in a traceback",
        _VARIABLE + "[JAX_PLATFORMS=abacus star train point.yaml]",
        "star/cli/command.py",
        "        line = modes.missing_device()\n",
        "        line = None\n",
    ),
    Mend(
        "the step of a batch has no gradient",
        "tests/envs/test_vector.py::test_the_derivative_of_a_batch_is_that_of_each_environment",
        "envs/common/batching.py",
        "    return outer\n",
        "    return inner\n",
    ),
    Mend(
        "an engine without derivatives fails in words of JAX",
        "tests/envs/test_vector.py::test_an_engine_without_derivatives_says_so_in_one_line",
        "envs/physics.py",
        'flattened(step if self.engine == "jax" else _without_derivatives(step, self.engine))',
        "flattened(step)",
    ),
    Mend(
        "a batch takes one key alone",
        "tests/envs/test_vector.py::test_a_key_for_each_environment_begins_the_episode_of_that_environment_alone",
        "envs/vector.py",
        "        if shape == ():\n",
        "        if True:\n",
    ),
    Mend(
        "a batch of 0 is accepted",
        _use("a_batch_of_none_is_refused"),
        "envs/vector.py",
        "if num_envs < 1:",
        "if False:",
    ),
    Mend(
        "actions of a wrong shape give JAX's own error",
        _use("actions_of_another_shape_are_named"),
        "envs/vector.py",
        "if jnp.shape(action) != expected:",
        "if False:",
    ),
    Mend(
        "a Gymnasium environment does not go through pickle",
        _use("an_environment_that_travels_goes_on_where_it_was"),
        "envs/gym.py",
        "    def __getstate__(self)",
        "    def getstate(self)",
    ),
    Mend(
        "a batch does not go through pickle",
        _use("a_batch_of_environments_travels_too"),
        "envs/vector.py",
        "    def __reduce__(self)",
        "    def reduce(self)",
    ),
    Mend(
        "a list of seeds is refused",
        "tests/envs/test_gym.py::test_a_list_of_seeds_gives_each_environment_the_episodes_of_its_seed_alone",
        "envs/gym.py",
        "        if isinstance(seed, list):\n",
        "        if False:\n",
    ),
    Mend(
        "numbers of NumPy are refused as options",
        _use("options_take_what_their_plain_twins_take"),
        "envs/common/plainly.py",
        'if hasattr(value, "__array__"):',
        "if False:",
    ),
    Mend(
        "paths are refused as settings",
        _use("settings_take_numbers_of_numpy_and_paths"),
        "envs/common/plainly.py",
        "if isinstance(value, PurePath):",
        "if False:",
    ),
    Mend(
        "a plain map with a byte order mark is refused",
        _use("a_map_may_begin_with_a_byte_order_mark"),
        "envs/common/reading.py",
        'encoding="utf-8-sig"',
        'encoding="utf-8"',
    ),
    Mend(
        "a room that nobody reaches holds goals and starts",
        "tests/envs/test_maps.py::test_cells_that_nobody_reaches_are_told_of_and_hold_neither_goals_nor_starts",
        "envs/arena.py",
        "written = walled(arena, sealed)",
        "written = arena",
    ),
    Mend(
        "a room that nobody reaches is told of by no command",
        _use("cells_that_nobody_reaches_are_told_of_in_one_line_of_a_command"),
        "star/cli/command.py",
        "        with _notices():\n",
        "        with suppress():\n",
    ),
    Mend(
        "a name that is not UTF-8 is found out at the first checkpoint",
        _use("a_name_that_is_not_utf8_is_refused_before_anything_is_made"),
        "envs/common/files.py",
        "        os.fspath(path.absolute()).encode()\n",
        "        pass\n",
    ),
    Mend(
        "printed commands are not quoted",
        _use("printed_commands_can_be_typed"),
        "star/config/command_line.py",
        'return shlex.join(["star", *map(str, words), *imports])',
        'return " ".join(["star", *map(str, words), *imports])',
    ),
    Mend(
        "python -m star is unknown",
        "tests/cli/test_cli.py::test_the_program_itself_prints_help_and_no_warnings",
        "star/__main__.py",
        "    sys.exit(main())",
        "    pass",
    ),
    Mend(
        "a number that float32 makes 0 is accepted",
        _use("a_number_that_float32_makes_0_is_refused"),
        "star/config/section.py",
        "if isinstance(value, float) and 0 < abs(value) < _SMALLEST:",
        "if False:",
    ),
    Mend(
        "checkpoints in a folder with [x] cannot be read",
        _use("a_folder_that_orbax_takes_for_a_pattern_is_refused"),
        "star/training/run_folder.py",
        'if re.search(r"\\[.*\\]|\\\\", os.fspath(run_dir.absolute())):',
        "if False:",
    ),
    Mend(
        "output that goes nowhere ends a command",
        _use("a_command_goes_on_when_nobody_sees_its_output"),
        "star/cli/streams.py",
        "        except OSError as error:\n            self.error = error\n",
        "        except OSError as error:\n            self.error = error\n            raise\n",
    ),
    Mend(
        "a closed terminal ends a run without a checkpoint",
        _use("a_closed_terminal_stops_a_run_as_sigterm_does_unless_it_is_ignored"),
        "star/training/signals.py",
        "(signal.SIGINT, signal.SIGTERM, signal.SIGHUP)",
        "(signal.SIGINT, signal.SIGTERM)",
    ),
    Mend(
        "training outside of the main thread ends in a traceback",
        _use("signals_are_the_callers_outside_of_the_main_thread"),
        "star/training/signals.py",
        "if threading.current_thread() is not threading.main_thread():",
        "if False:",
    ),
    Mend(
        "010 is eight",
        _use("numbers_are_those_that_people_mean"),
        "envs/common/reading.py",
        "_Plain.add_constructor(_INTEGER[0], _whole)\n",
        "",
    ),
    Mend(
        "text that looks like a number is written without quotes",
        _use("numbers_are_those_that_people_mean"),
        "envs/common/reading.py",
        "yaml.dump(values, Dumper=_Writer, sort_keys=False)",
        "yaml.safe_dump(values, sort_keys=False)",
    ),
    Mend(
        "a second thread cannot draw",
        _use("pictures_may_be_drawn_in_any_thread"),
        "envs/opengl.py",
        "        finally:\n            _let_go(context)\n",
        "        finally:\n            pass\n",
    ),
    Mend(
        "a run goes on with another file of its teacher",
        _use("a_run_knows_its_teachers_file_by_its_checksum"),
        "star/sgim/teachers.py",
        "if sha256 is not None and files.sha256(path) != sha256:",
        "if False:",
    ),
    Mend(
        "a run draws other numbers where JAX makes other keys",
        _use("runs_draw_the_same_whatever_keys_jax_makes"),
        "envs/common/modes.py",
        "return jax.random.key(seed, impl=KEYS)",
        "return jax.random.key(seed)",
    ),
    Mend(
        "a run draws other numbers under JAX_THREEFRY_PARTITIONABLE=0",
        _use("a_run_refuses_to_draw_other_numbers_than_it_did"),
        "envs/common/modes.py",
        "if not config.jax_threefry_partitionable:",
        "if False:",
    ),
    Mend(
        "JAX_DEBUG_INFS ends training in a traceback",
        _use("what_learns_refuses_the_modes_that_it_does_not_run_in"),
        "envs/common/modes.py",
        "if config.jax_debug_infs:",
        "if False:",
    ),
    Mend(
        "JAX_NUMPY_RANK_PROMOTION=raise ends training in a traceback",
        _use("what_learns_refuses_the_modes_that_it_does_not_run_in"),
        "envs/common/modes.py",
        'if config.jax_numpy_rank_promotion == "raise":',
        "if False:",
    ),
    Mend(
        "JAX_DEBUG_NANS stops goal selection",
        _use("goal_selection_makes_no_number_that_is_none"),
        "star/sgim/selection.py",
        "mean=jnp.full(capacity, jnp.inf, jnp.float32)",
        "mean=jnp.full(capacity, jnp.nan, jnp.float32)",
    ),
    Mend(
        "names that begin with _ are missing from legends",
        _use("a_name_with_an_underscore_in_front_is_in_the_legend"),
        "star/training/figures.py",
        '" " * text.startswith("_") + ',
        "",
    ),
    Mend(
        "of two commands that start in one second one is lost",
        _use("two_commands_in_one_second_get_a_place_each"),
        "envs/common/files.py",
        "            place.mkdir(parents=True)\n",
        "            pass\n",
    ),
    Mend(
        "a refused command leaves its folder behind",
        _use("what_is_refused_leaves_no_place_behind"),
        "envs/common/files.py",
        "            place.rmdir()\n",
        "            pass\n",
    ),
    Mend(
        "a process forked from one that runs JAX hangs",
        _use("a_process_forked_from_one_that_runs_jax_is_told_so_instead_of_hanging"),
        "envs/gym_program.py",
        "    if _begun[0] != os.getpid():\n",
        "    if False:\n",
    ),
    Mend(
        "a sweep in a folder with ? or % has its database elsewhere",
        _use("a_sweep_keeps_its_database_in_a_folder_of_any_name"),
        "star/sweeps/ledger.py",
        "quote(str(path.absolute()))",
        "str(path.absolute())",
    ),
    Mend(
        "importing leaves a handler on the root logger",
        _use("what_is_imported_leaves_the_loggers_of_the_user_alone"),
        "star/_quiet.py",
        "logging.root.handlers[:] = _handlers\n",
        "",
    ),
)


def outcome(mend: Mend) -> str:
    """The result of the test of `mend` in a copy of the tree, with the mend and without."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        copy(tree)
        if not passes(mend.test, tree):
            return "the test fails as it is"
        text = (tree / mend.file).read_text(encoding="utf-8")
        (tree / mend.file).write_text(text.replace(mend.now, mend.before), encoding="utf-8")
        return "the test passes without the mend" if passes(mend.test, tree) else "held"


def copy(tree: Path) -> None:
    """Fill `tree` with all that tests need: what git knows or could add, but for results."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    for name in listed.stdout.splitlines():
        if not name.startswith("results/"):
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, tree / name)


def passes(test: str, tree: Path) -> bool:
    """True if pytest passes there: no less than one test, and none fails. A test that hangs fails."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist", test]
    environment = {
        **os.environ,
        **importing(tree),
        "PYTHONDONTWRITEBYTECODE": "1",
        "MUJOCO_GL": "",  # EGL where there is one: with OSMesa any thread can draw at any time
    }
    try:
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, timeout=LIMIT, check=False)
    except subprocess.TimeoutExpired:
        return False
    if done.returncode > 1:  # below 0: a signal ended it
        raise SystemExit(f"{test}: pytest ended with {done.returncode}: {done.stdout.decode()[-500:]}")
    return done.returncode == 0


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=2, help="mends tried at once")
    parser.add_argument("--only", nargs="*", default=[], help="words of which a fault must have one")
    options = parser.parse_args(arguments)
    chosen = [mend for mend in MENDS if not options.only or any(word in mend.fault for word in options.only)]
    found = []
    with ThreadPoolExecutor(options.jobs) as pool:
        for mend, line in zip(chosen, pool.map(outcome, chosen), strict=True):
            print(f"{line:35} {mend.fault}", flush=True)
            found.append(line)
    held = found.count("held")
    print(f"{held} of {len(found)} mends are held by their tests")
    return int(held < len(found))


if __name__ == "__main__":
    sys.exit(main())
