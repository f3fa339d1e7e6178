"""Sweeps: the file, the trials side by side, and workers that share a study."""

from __future__ import annotations

import collections
import contextlib
import csv
import io
import json
import os
import pickle
import pwd
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import optuna
import pytest
import yaml
from optuna._transform import _SearchSpaceTransform
from optuna.distributions import FloatDistribution, IntDistribution
from rich.console import Console

from envs.common.errors import UserError
from star import cli
from star.agent.sections import Config
from star.config.kinds import Measure
from star.config.loading import fields, load, parse, type_of
from star.sweeps import results
from star.sweeps import work as working
from star.sweeps.ledger import Cmaes, Ledger, reason
from star.sweeps.plan import plan
from star.sweeps.work import open_ledger, work
from star.training import program as programs
from tests.small import EPOCH, RUN

ROOT = Path(__file__).parents[2]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working directory with a config file."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(RUN))
    return tmp_path


def written(**fields):
    """A sweep file, three learning rates as a grid unless said otherwise."""
    values = {"config": "tiny.yaml", "parameters": {"controller.ppo.learning_rate": [1e-4, 1e-3, 1e-2]}}
    path = Path("three.yaml")
    path.write_text(yaml.safe_dump(values | {"sampler": "grid"} | fields))
    return path


@pytest.fixture(autouse=True)
def closed(monkeypatch):
    """Databases are let go of at the end of each test."""
    ledgers = []

    class Closing(Ledger):
        def __init__(self, *arguments, **settings):
            super().__init__(*arguments, **settings)
            ledgers.append(self)

    monkeypatch.setattr(working, "Ledger", Closing)
    yield
    for ledger in ledgers:
        ledger.close()


class Stub:
    """Trains nothing: an epoch takes `wait_s`, and a trial is as good as its `controller.ppo.learning_rate` is high."""

    epochs, steps_per_epoch = 4, EPOCH

    def __init__(self, config, slots, *, wait_s=0.0):
        self.slots, self.wait_s = slots, wait_s
        self.runs, self.done = {}, dict.fromkeys(range(slots), 0)

    def put(self, runs):
        self.runs |= runs
        self.done |= dict.fromkeys(runs, 0)

    def advance(self):
        time.sleep(self.wait_s)
        return [self.rows(slot) for slot in range(self.slots)]

    def rows(self, slot):
        self.done[slot] += 1
        ppo = self.runs[slot].controller.ppo
        row = {"seed": 0, "env_steps": self.done[slot] * EPOCH, "controller/actor_loss": self.loss(ppo)}
        if self.done[slot] % 2 == 0:
            success = min(100 * ppo.learning_rate, 1.0)
            row |= {"eval/success_any": success, "eval/success_final": success * self.done[slot] / 4}
        return [row]

    def loss(self, ppo):
        return float("nan") if ppo.discount == 0 else 0.5


def finished(path, make=Stub, *, out="out", **changes):
    """A sweep in which nothing is trained: its plan and its ledger, at the end."""
    found = plan(path, **changes)
    Path(out).mkdir(exist_ok=True)
    ledger = open_ledger(found, f"sqlite:///{out}/sweep.db")
    assert work(found, ledger, make=make)
    return found, ledger


def test_every_float_of_the_agent_may_differ_side_by_side_and_nothing_else():
    """What `structure` takes for equal is one jitted function; whatever else changes is another."""
    base = parse(RUN)
    for key, _, _ in fields(Config):
        if type_of(key, Config) is float:
            other = parse(RUN, {key: 0.5 if key != "commander.goal_margin" else 2.0})
            assert programs.structure(other) == programs.structure(base), key
        elif type_of(key, Config) is bool:
            values = base.model_dump(mode="json")
            for part in key.split(".")[:-1]:
                values = values[part]
            with contextlib.suppress(UserError):  # some need others
                flipped = parse(RUN, {key: not values[key.split(".")[-1]]})
                assert programs.structure(flipped) != programs.structure(base), key
    assert programs.structure(parse(RUN, {"trainer.seed": 7})) == programs.structure(base)
    assert programs.structure(parse(RUN, {"trainer.num_seeds": 7})) != programs.structure(base)


def test_a_grid_tries_every_point_once_and_writes_down_which_is_best(folder, capsys, monkeypatch):
    monkeypatch.setattr(working.work, "__kwdefaults__", working.work.__kwdefaults__ | {"make": Stub})
    parameters = {"controller.ppo.learning_rate": [1e-4, 1e-3], "tutor.ppo.hidden": [[8], [4, 4]]}
    path = written(parameters=parameters)
    assert cli.main(["sweep", str(path), "--out", "out"]) == 0
    with open("out/trials.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4 and [float(row["value"]) for row in rows] == [0.1, 0.1, 0.01, 0.01]
    assert {(row["controller.ppo.learning_rate"], row["tutor.ppo.hidden"]) for row in rows} == {
        (rate, hidden) for rate in ("0.0001", "0.001") for hidden in ("[8]", "[4, 4]")
    }
    best = load("out/best.yaml")
    assert best.controller.ppo.learning_rate == 1e-3 and best.trainer.num_envs == 4
    for name in ("values", "parallel", "importance"):
        assert Path(f"out/figures/{name}.png").read_bytes().startswith(b"\x89PNG")
    out = capsys.readouterr().out
    assert "4 trials by success_final" in out and "next:    star train out/best.yaml" in out


def test_settings_in_sections_are_laid_over_those_of_the_config_like_dotted_ones(folder):
    nested, dotted = ({"trainer": {"eval_episodes": 2}}, {"trainer.eval_episodes": 2})
    assert plan(written(settings=nested)).base == plan(written(settings=dotted)).base


@pytest.mark.parametrize("sampler", ["tpe", "cmaes"])
def test_samplers_stay_in_the_range_and_draw_no_trial_twice(folder, sampler):
    parameters = {
        "controller.ppo.learning_rate": {"low": 1e-4, "high": 1e-2, "log": True},
        "tutor.ppo.passes": {"low": 1, "high": 3},
    }
    _, ledger = finished(written(parameters=parameters, sampler=sampler, trials=7, batch=3))
    drawn = [trial.params for trial in ledger.trials()]
    rates = [one["controller.ppo.learning_rate"] for one in drawn]
    assert len(set(rates)) == 7 and all(1e-4 <= rate <= 1e-2 for rate in rates)
    assert all(one["tutor.ppo.passes"] in (1, 2, 3) for one in drawn)


def test_nothing_in_the_database_of_a_sweep_is_run(folder, monkeypatch):
    """Optuna's CMA-ES would unpickle what it finds there."""
    parameters = {
        "controller.ppo.learning_rate": {"low": 1e-4, "high": 1e-2},
        "tutor.ppo.passes": {"low": 1, "high": 3},
    }
    found, ledger = finished(written(parameters=parameters, sampler="cmaes", trials=3, batch=3))
    ledger.close()
    with contextlib.closing(sqlite3.connect("out/sweep.db")) as database, database:
        row = (1, "cma:optimizer:0", json.dumps(pickle.dumps(print).hex()))
        database.execute("INSERT INTO trial_system_attributes (trial_id, key, value_json) VALUES (?, ?, ?)", row)
    ledger = open_ledger(found, "sqlite:///out/sweep.db")
    assert "cma:optimizer:0" in ledger.trials()[0].system_attrs
    monkeypatch.setattr(pickle, "loads", lambda _: pytest.fail("was unpickled"))
    assert len(ledger.take(found.distributions, 2, limit=5, worker="me")) == 2


def test_cmaes_worked_out_from_the_trials_is_the_one_that_optuna_keeps():
    space = {"a": FloatDistribution(1e-4, 1, log=True), "b": IntDistribution(1, 9)}
    study = optuna.create_study(direction="maximize")
    for seed in range(20):
        study.sampler = optuna.samplers.CmaEsSampler(seed=seed)
        trial = study.ask(space)
        study.tell(trial, -((trial.params["a"] - 0.1) ** 2) - (trial.params["b"] - 4) ** 2)
    kept = optuna.samplers.CmaEsSampler()._restore_optimizer(study.trials)
    ours = Cmaes()
    ours._restore_optimizer(study.trials)
    again = ours._init_optimizer(_SearchSpaceTransform(space, transform_0_1=True), study.direction)
    assert again.generation == kept.generation >= 2
    np.testing.assert_allclose(again._mean, kept._mean)
    np.testing.assert_allclose(again._C, kept._C)


def test_names_and_values_reach_table_and_figures_as_they_were_typed(tmp_path):
    odd = ["[red]a[/red]", ":smile:", "$\\frac", "<script>"]
    rows = [
        {"trial": i, "state": "complete", "value": 0.1 * i, "env.options.map": text, "reason": ""}
        for i, text in enumerate(odd)
    ]
    console = Console(width=200, file=io.StringIO())
    found = SimpleNamespace(distributions={"env.options.map": None}, objective="success", measure=Measure("success"))
    console.print(results.table(rows, found))
    assert all(text in console.file.getvalue() for text in odd)
    results.write(tmp_path, rows, found, shares={"env.options.map": 1.0})
    assert (tmp_path / "figures" / "parallel.png").exists()


@pytest.mark.parametrize(("summary", "value"), [("end", 1.0), ("mean", 0.75)])
def test_the_value_is_that_at_the_end_or_the_mean_of_all_evaluations(folder, summary, value):
    _, ledger = finished(written(summary=summary))
    assert max(trial.value for trial in ledger.trials()) == value


@pytest.mark.parametrize("pruner", ["asha", "hyperband", "median"])
def test_pruners_stop_what_is_worse_and_the_best_goes_on(folder, pruner):
    rates = [10 ** (-4 + index * 5 % 12 / 6) for index in range(12)]
    parameters = {"controller.ppo.learning_rate": rates}
    _, ledger = finished(written(parameters=parameters, pruner=pruner, batch=6))
    states = collections.Counter(trial.state.name for trial in ledger.trials())
    assert states["PRUNED"] > 0 and states["PRUNED"] + states["COMPLETE"] == 12
    assert ledger.study.best_params["controller.ppo.learning_rate"] == max(rates)


def test_a_broken_trial_is_recorded_with_its_reason_and_the_rest_goes_on(folder):
    """One has a loss that is no number, one a rollout that cannot be divided; one is too large for the device."""

    def make(config, slots):
        if config.tutor.ppo.hidden == (999,):
            raise RuntimeError("RESOURCE_EXHAUSTED: out of memory")
        return Stub(config, slots)

    parameters = {
        "controller.ppo.discount": [0.0, 0.9],
        "controller.ppo.minibatches": [1, 7],
        "tutor.ppo.hidden": [[8], [999]],
    }
    _, ledger = finished(written(parameters=parameters), make)
    reasons = sorted(reason(trial) for trial in ledger.trials())
    assert reasons[0] == "" and reasons[1] == "RuntimeError: RESOURCE_EXHAUSTED: out of memory"
    assert sum("controller/actor_loss is not finite at 240 env steps" in one for one in reasons) == 1
    assert sum("controller.ppo.minibatches: 7 does not divide" in one for one in reasons) == 4


def test_the_time_is_shown_while_a_program_compiles_and_not_while_trials_run(folder):
    class Slow(Stub):
        def put(self, runs):
            time.sleep(0.3)  # as long as the bar takes to be drawn again
            super().put(runs)

        def advance(self):
            time.sleep(0.15)
            return super().advance()

    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=120, color_system=None)
    found = plan(written())
    with contextlib.closing(open_ledger(found, "sqlite:///shown.db")) as ledger:
        assert work(found, ledger, make=Slow, quiet=False, console=console)
    assert re.search(r"compiling for \d+ trials side by side\s+0:0\d ", screen.getvalue())
    assert re.search(r"running  [\d,]+ env steps/s\s+-?[-\d]", screen.getvalue())


def test_an_interrupted_sweep_gives_its_trials_back_and_goes_on_where_it_was(folder, monkeypatch):
    class Pressing(Stub):
        def advance(self):
            signal.raise_signal(signal.SIGINT)
            return super().advance()

    found = plan(written())
    ledger = open_ledger(found, "sqlite:///sweep.db")
    assert not work(found, ledger, make=Pressing)
    assert [trial.state.name for trial in ledger.trials()] == ["WAITING"] * 3
    assert work(found, ledger, make=Stub)
    assert len({trial.params["controller.ppo.learning_rate"] for trial in ledger.trials()}) == 3
    assert all(trial.state.name == "COMPLETE" for trial in ledger.trials())


def test_more_trials_can_be_asked_for_later(folder):
    path = written(sampler="random", parameters={"controller.ppo.learning_rate": {"low": 1e-4, "high": 1e-2}})
    assert len(finished(path, trials=3)[1].trials()) == 3
    assert len(finished(path, trials=5)[1].trials()) == 5
    assert len(finished(path, trials=4)[1].trials()) == 5


@pytest.mark.parametrize("path", sorted(ROOT.glob("configs/sweeps/*.yaml")), ids=lambda path: path.stem)
def test_every_shipped_sweep_is_valid_and_trains_side_by_side(path):
    found = plan(path)
    ends = [{key: one.ends[end] for key, one in found.file.parameters.items()} for end in (0, -1)]
    assert len({programs.structure(found.config(values)) for values in ends}) == 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"parameters": {"controller.ppo.lerning_rate": [1, 2]}}, "did you mean controller.ppo.learning_rate?"),
        ({"parameters": {"controller.ppo.learning_rate": []}}, "has no values to choose from"),
        ({"parameters": {}}, "parameters"),
        (
            {"parameters": {"commander.discount": {"low": 0.5, "high": 1.5}}, "sampler": "tpe"},
            "commander.discount: 1.5",
        ),
        ({"parameters": {"commander.discount": {"low": 0.9, "high": 0.5}}, "sampler": "tpe"}, "low 0.9 is above high"),
        ({"parameters": {"commander.discount": {"low": 0.5, "high": 0.9}}}, "sampler grid needs choices"),
        ({"parameters": {"commander.discount": {"low": 0.5}}}, "both low and high"),
        ({"parameters": {"tutor.enabled": {"low": 0, "high": 1}}, "sampler": "tpe"}, "tutor.enabled"),
        ({"parameters": {"env.options.mapp": ["a"]}}, "mapp"),
        ({"sampler": "cmaes"}, "cmaes needs two or more"),
        ({"parameters": {"tutor.ppo.passes": {"low": 10**400, "high": 1}}}, "is above high 1"),
        (
            {"parameters": {f"refinement.{key}": {"low": 1, "high": 500} for key in ("min_visits", "min_transitions")}},
            "a grid of more than 100,000 points",
        ),
        ({"sampler": "best"}, "sampler: 'best' is not allowed"),
        ({"sampla": "grid"}, "sampla: unknown key (did you mean sampler?)"),
        ({"config": "no.yaml"}, "no.yaml: no such file"),
        ({"settings": {"tutor.perod": 5}}, "did you mean tutor.period?"),
    ],
)
def test_a_file_that_cannot_be_used_is_one_line_and_nothing_is_written(folder, capsys, change, said):
    path = written(**change)
    before = sorted(folder.iterdir())
    assert cli.main(["sweep", str(path)]) == 2
    out, err = capsys.readouterr()
    assert out == "" and said in err and err.count("\n") == 1
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("--storage postgresql://nobody@localhost:1/none", "the database cannot be used"),
        ("--storage mysql://a/b", "is not sqlite:///FILE or postgresql://"),
        ("--storage nonsense", "is not an address"),
        ("--out full", "full: is not empty and holds no sweep.db"),
        ("--trials 0", "--trials"),
    ],
)
def test_a_place_that_cannot_be_used_is_one_line_and_nothing_is_written(folder, capsys, arguments, said):
    (folder / "full").mkdir()
    (folder / "full" / "thesis.txt").write_text("ten years of work")
    path = written()
    before = sorted(folder.rglob("*"))
    if "postgresql" in arguments:
        pytest.importorskip("psycopg")
    assert cli.main(["sweep", str(path), *arguments.split()]) == 2
    out, err = capsys.readouterr()
    assert out == "" and said in err and err.count("\n") == 1
    assert sorted(folder.rglob("*")) == before


def test_the_study_of_another_sweep_is_refused(folder):
    finished(written())
    other = plan(written(), settings={"tutor.reward_scale": 0.7})
    with pytest.raises(UserError, match=r"study three: is of another sweep, with settings.tutor.reward_scale 0.3"):
        open_ledger(other, "sqlite:///out/sweep.db")
    before = {path: path.read_bytes() for path in Path("out").rglob("*") if path.is_file()}
    with pytest.raises(UserError, match="out: holds the results of the sweep three; choose another --out"):
        working.run(plan(written(study="four")), Path("out"), quiet=True)
    assert {path: path.read_bytes() for path in before} == before


WORKERS = """
import os, pickle, signal, sys
sys.path.insert(0, {tests!r})
from pathlib import Path
from types import SimpleNamespace
from star.sweeps.plan import plan
from star.sweeps.work import open_ledger, work
from test_sweep import Stub

def worker(found, url):
    signal.alarm(120)
    ledger = open_ledger(found, url, beat_s=1, grace_s=3)
    return 0 if work(found, ledger, make=lambda config, slots: Stub(config, slots, wait_s=0.15)) else 1

for line in sys.stdin:
    plan, url, count = line.split()
    found = pickle.loads(Path(plan).read_bytes())
    pids = []
    for _ in range(int(count)):  # forked, because importing JAX is what takes long
        pid = os.fork()
        if not pid:
            os._exit(worker(found, url))
        pids.append(pid)
    print(*pids, flush=True)
    print(*[os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) for pid in pids], flush=True)
"""


@pytest.fixture(scope="module")
def master():
    """A process that begins workers: for a line with a plan, a database and a number, their pids and exit codes."""
    where = {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-c", WORKERS.format(tests=str(ROOT / "tests/sweeps"))]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, **pipes, text=True, bufsize=1, env=os.environ | where) as process:
        yield process


def shared(master, url, *, workers):
    """Let workers share 8 trials and kill one in the middle of its own: the ledger, and the name of that one."""
    parameters = {"controller.ppo.learning_rate": {"low": 1e-4, "high": 1e-2}}
    path = written(sampler="random", parameters=parameters, trials=8, batch=2)
    found = plan(path)
    Path("plan").write_bytes(pickle.dumps(found))  # planning builds a program, which takes long
    ledger = open_ledger(found, url)
    print(Path("plan").resolve(), url, workers, file=master.stdin)
    pids = [int(pid) for pid in master.stdout.readline().split()]
    assert len(pids) == workers
    busy, late = [], time.monotonic() + 60
    while not busy:
        assert time.monotonic() < late, "no worker began a trial"
        running = [trial for trial in ledger.trials() if trial.state.name == "RUNNING"]
        busy = [trial.user_attrs["worker"] for trial in running if "worker" in trial.user_attrs]
    killed = int(busy[-1].rpartition(":")[2])  # the last to begin is the last to end by itself
    os.kill(killed, signal.SIGKILL)
    codes = [int(code) for code in master.stdout.readline().split()]
    assert codes == [-signal.SIGKILL if pid == killed else 0 for pid in pids]
    return ledger, busy[-1]


def check_shared(ledger, killed):
    trials = ledger.trials()
    assert [trial.state.name for trial in trials] == ["COMPLETE"] * 8
    assert len({trial.params["controller.ppo.learning_rate"] for trial in trials}) == 8
    everything = ledger.study.get_trials(deepcopy=False)
    given_back = [trial for trial in everything if trial.state.name == "FAIL"]
    assert given_back and len(everything) == 8 + len(given_back)
    assert {trial.user_attrs.get("worker", killed) for trial in given_back} == {killed}


def test_two_workers_on_one_sqlite_file_end_all_trials_though_one_is_killed(folder, master):
    check_shared(*shared(master, f"sqlite:///{folder}/sweep.db", workers=2))


def test_four_workers_on_postgresql_end_all_trials_though_one_is_killed(folder, master, postgresql):
    ledger, killed = shared(master, postgresql, workers=4)
    check_shared(ledger, killed)
    assert len({trial.user_attrs["worker"] for trial in ledger.trials()}) >= 3


@pytest.fixture
def postgresql(tmp_path_factory):
    """The address of an empty database; the server runs as another user if the tests run as root."""
    pytest.importorskip("psycopg", reason="psycopg is not installed")
    folders = [str(path) for path in Path("/usr/lib/postgresql").glob("*/bin")]
    path = os.pathsep.join([*folders, os.environ.get("PATH", "")])
    initdb, pg_ctl = shutil.which("initdb", path=path), shutil.which("pg_ctl", path=path)
    if initdb is None or pg_ctl is None:
        pytest.skip("PostgreSQL is not installed")
    where = Path(tempfile.mkdtemp(prefix="pg", dir="/tmp"))  # the path of a socket must be short
    user = {}
    if os.geteuid() == 0:
        account = pwd.getpwnam("nobody")
        os.chown(where, account.pw_uid, account.pw_gid)
        user = {"user": account.pw_uid, "group": account.pw_gid, "extra_groups": []}

    def run(*command):
        subprocess.run(command, check=True, capture_output=True, cwd=where, timeout=60, **user)

    options = f"-c listen_addresses='' -k {where} -c fsync=off"
    try:
        run(initdb, "-D", where / "data", "-U", "star", "-A", "trust", "--no-sync")
        run(pg_ctl, "-D", where / "data", "-l", where / "log", "-o", options, "-w", "start")
        yield f"postgresql://star@/postgres?host={where}"
        run(pg_ctl, "-D", where / "data", "-m", "immediate", "stop")
    finally:
        shutil.rmtree(where, ignore_errors=True)
