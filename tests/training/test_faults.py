"""Numbers that are not finite are found in the epoch they come up in, and named."""

import io
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float, TypeCheckError, jaxtyped
from rich.console import Console

import envs
from star import cli, debugging
from star.agent import epoch as learning
from star.agent import levels
from star.agent.kind import STAR
from star.agent.play import Episode
from star.config.loading import parse
from star.spec import Spec
from star.training import checkpoint, faults, trainer
from star.training import program as programs
from star.training.journal import Journal, of_epoch
from star.training.program import Functions
from tests.small import EPOCH, RUN

pytestmark = pytest.mark.usefixtures("undrawn")

TD3 = {"hidden": [8], "batch_size": 8, "buffer_size": 64, "min_transitions": 1, "updates_per_rollout": 1}
ALL_LEVELS = parse(
    RUN,
    {
        "env.options": {"episode_length": 60},
        "tutor.learner": "td3",
        "tutor.td3": TD3,
        "refinement.enabled": False,  # it learns nothing that could be lost
        "tutor.adjacency": {"enabled": True, "hidden": [8], "cell": 4, "batch_size": 8, "updates_per_epoch": 1},
    },
)
PUSHED = 1e6
SEEDS = [5, 6]

counted = partial(faults.count, may_be_nan=STAR.may_be_nan)
counted_of_seeds = jax.jit(jax.vmap(counted))
copied = jax.jit(partial(jax.tree.map, jnp.copy))


class Fragile(envs.VectorEnv):
    """Shows NaN, without telling that anything is wrong, to whoever pushes with more than `PUSHED`."""

    def step(self, state, action):
        after = super().step(state, action)
        hard = (action > PUSHED).any(axis=-1)
        return after.replace(obs=after.obs.at[:, 0].set(jnp.where(hard, jnp.nan, after.obs[:, 0])))


@pytest.fixture(scope="module")
def epoch():
    """An epoch of two seeds from a state that something was done to: what is found in it, and what comes after."""
    env = envs.make("point_maze", engine="jax", episode_length=60)
    agent, spec = ALL_LEVELS.hyper(), Spec.of(env)
    batch = Fragile(env, ALL_LEVELS.trainer.num_envs, auto_reset=False)
    init = jax.jit(jax.vmap(lambda key: levels.init(agent, spec, key=key)))

    def learnt(state):
        state, metrics = learning.epoch(agent, spec, batch, state, teachers=())
        return state, metrics | counted(state)

    one = jax.jit(jax.vmap(learnt))
    fresh, _ = one(init(jax.random.split(jax.random.key(0), len(SEEDS))))  # with something in its rings

    def run(change=lambda state: state):
        state, metrics = one(change(fresh))
        return faults.find(of_epoch(metrics, SEEDS), state, env_steps=480, may_be_nan=STAR.may_be_nan)

    return run


def poisoned(tensor, number=np.nan):
    """Puts one bad number into the first place of `tensor` of the second seed."""

    def change(state):
        def put(path, leaf):
            name = jax.tree_util.keystr(path, simple=True, separator="/")
            return leaf.at[(1,) + (0,) * (leaf.ndim - 1)].set(number) if name == tensor else leaf

        changed = jax.tree_util.tree_map_with_path(put, state)
        assert jax.tree.structure(changed) == jax.tree.structure(state)
        return changed

    return change


def test_nothing_is_found_where_all_is_well(epoch):
    assert epoch() is None


@pytest.mark.parametrize(
    "tensor",
    [
        "upcoming/commander/model/led",
        "upcoming/commander/q",
        "tutor/params/actor/params/Dense_0/kernel",
        "tutor/params/critic/params/Dense_1/bias",
        "tutor/target/critic/params/Dense_0/kernel",
        "tutor/actor_optimizer/mu/params/Dense_0/bias",
        "tutor/ring/experience/reward",
        "adjacency/params/params/Dense_0/kernel",
        "controller/params/actor/params/Dense_1/kernel",
        "controller/params/critic/params/Dense_0/bias",
        "controller/params/log_std",
        "controller/optimizer/1/nu/critic/params/Dense_0/bias",
        "controller/normalizer/mean",
        "controller/learning_rate",
        "forward_model/params/params/Dense_1/kernel",
        "forward_model/ring/experience/end",
    ],
)
def test_a_number_that_is_none_is_found_within_the_epoch_and_named(epoch, tensor):
    found = epoch(poisoned(tensor)).found
    assert list(found) == [6], "the other seed has nothing to do with it"
    assert tensor in found[6]


@pytest.mark.parametrize("number", [np.inf, -np.inf])
def test_infinite_numbers_are_found_too(epoch, number):
    assert "forward_model/ring/experience/end" in epoch(poisoned("forward_model/ring/experience/end", number)).found[6]


def test_a_bad_observation_is_found_within_the_epoch_and_named_before_what_it_spoils(epoch):
    def push(state):
        bias = state.controller.params["actor"]["params"]["Dense_1"]["bias"]
        params = {**state.controller.params}
        params["actor"] = {"params": {**params["actor"]["params"]}}
        params["actor"]["params"]["Dense_1"] = {
            **params["actor"]["params"]["Dense_1"],
            "bias": bias.at[0].set(10 * PUSHED),
        }
        return state.replace(controller=state.controller.replace(params=params))

    fault = epoch(push)
    assert list(fault.found) == [5]
    assert next(iter(fault.found[5])) == "env/obs" and fault.found[5]["env/obs"] > 0
    assert str(fault).startswith("not finite after 480 env steps: seed 5: env/obs, ")


def test_what_the_environment_has_repaired_is_no_fault_but_losses_and_counts_are():
    row = {"seed": 5, "env/non_finite": 3.0, "controller/non_finite": 0, "controller/actor_loss": 0.1}
    assert not faults.broken(row, may_be_nan=STAR.may_be_nan)
    worse = row | {"controller/non_finite": 7, "controller/actor_loss": float("nan")}
    assert list(faults.broken(worse, may_be_nan=STAR.may_be_nan).values()) == [
        "controller/actor_loss is not finite",
        "controller/non_finite is 7",
    ]


class Rehearsal:
    """A run whose epochs train nothing: seed 6 loses a number in epoch `broken` unless its rate is below `safe`.

    As on a device, an epoch uses its state up.
    """

    def __init__(self, monkeypatch, run_dir, *, broken, safe=0.0, **trainer_settings):
        settings = {"checkpoint_every": 2, "num_seeds": 2, "seed": 5} | trainer_settings
        self.config = parse(RUN, {f"trainer.{key}": value for key, value in settings.items()})
        self.run_dir, self.broken, self.safe = run_dir, broken, safe
        self.epochs, self.rates, self.pressed = [], [], ()
        build = programs.build

        def rehearsed(config):
            program = build(config)
            return replace(program, functions=Functions(program.functions.init, self.epoch, _nothing))

        monkeypatch.setattr(programs, "build", rehearsed)

    def epoch(self, hyper, data, state):
        number = int(state.epoch[0]) + 1
        self.epochs.append(number)
        if number in self.pressed:
            signal.raise_signal(signal.SIGINT)
        rate = np.broadcast_to(hyper.controller.ppo.max_learning_rate, 2) / 1e-3
        self.rates.append((*rate.tolist(), *(np.asarray(state.controller.learning_rate) / 5e-4).tolist()))
        after = copied(state).replace(epoch=state.epoch + 1)
        if number == self.broken and rate[1] > self.safe:
            after = poisoned("controller/params/log_std")(after)
        jax.tree.map(lambda leaf: leaf.delete(), state)
        return after, counted_of_seeds(after)

    def train(self, **how):
        said = io.StringIO()
        result = trainer.train(self.config, self.run_dir, quiet=True, console=Console(file=said, width=500), **how)
        self.said = said.getvalue().splitlines()
        return result

    def checkpoints(self):
        """Env steps of the checkpoints, all of which are finite, in epochs."""
        program = programs.build(self.config)
        with checkpoint.opened(self.run_dir) as saved:
            for step in saved.steps():
                state = checkpoint.restore(program, saved, step, source=self.run_dir)
                assert not any(int(x.sum()) for x in counted_of_seeds(state).values())
            return [step // EPOCH for step in saved.steps()]

    def journal(self, name):
        return getattr(Journal.of(self.run_dir, tables="regions"), name).read()


def _nothing(agent, state, keys):
    return Episode(*(jnp.zeros((2, 3)) for _ in range(8)))


LOST = "controller/params/log_std"


@pytest.mark.parametrize("pressed", [(), (3,)], ids=["by itself", "as Ctrl-C comes"])
def test_a_run_stops_where_a_number_is_lost_and_keeps_the_last_sound_checkpoint(tmp_path, monkeypatch, pressed):
    run = Rehearsal(monkeypatch, tmp_path / "run", broken=3)
    run.pressed = pressed
    result = run.train()
    assert run.epochs == [1, 2, 3]
    assert str(result.fault) == f"not finite after {3 * EPOCH} env steps: seed 6: {LOST}"
    assert run.checkpoints() == [2] and result.saved == 2 * EPOCH
    assert run.journal("faults") == [{"env_steps": 3 * EPOCH, "seed": 6, "back_to": None, "found": {LOST: 1}}]
    run.broken, run.pressed = None, ()
    assert run.train(resume=True).fault is None
    assert run.epochs == [1, 2, 3, 3, 4]
    assert [row["env_steps"] // EPOCH for row in run.journal("metrics")] == [1, 1, 2, 2, 3, 3, 4, 4]


def test_a_run_that_loses_a_number_before_its_first_checkpoint_leaves_none(tmp_path, monkeypatch):
    run = Rehearsal(monkeypatch, tmp_path / "run", broken=1)
    assert run.train().saved is None and run.checkpoints() == []


def test_a_run_rolls_back_with_smaller_steps_for_that_seed_until_it_comes_through(tmp_path, monkeypatch):
    run = Rehearsal(monkeypatch, tmp_path / "run", broken=3, safe=0.3, on_non_finite="rollback")
    result = run.train()
    assert result.fault is None and result.env_steps == 4 * EPOCH
    assert run.epochs == [1, 2, 3, 3, 3, 4]
    halves = [(1, n, 1, n) for n in (1, 1, 1, 0.5, 0.25, 0.25)]  # of the settings of seeds 5 and 6, of their states
    np.testing.assert_allclose(run.rates, halves, rtol=1e-6)
    assert [row["env_steps"] // EPOCH for row in run.journal("metrics")] == [1, 1, 2, 2, 3, 3, 4, 4]
    assert [row["back_to"] // EPOCH for row in run.journal("faults")] == [2, 2]
    assert run.checkpoints() == [0, 2, 4]
    assert len(run.said) == 2 and run.said[1].startswith("warning: ")
    assert run.said[1].endswith(f"{LOST}; back to {2 * EPOCH} env steps, learning rates times 0.25 for seed 6 (2 of 3)")


def test_a_run_goes_back_to_its_start_and_stops_after_so_many_rollbacks(tmp_path, monkeypatch):
    run = Rehearsal(monkeypatch, tmp_path / "run", broken=1, on_non_finite="rollback", rollbacks=2)
    result = run.train()
    assert result.fault is not None and run.epochs == [1, 1, 1]
    assert [row["back_to"] for row in run.journal("faults")] == [0, 0, None]
    assert run.checkpoints() == [0]


def test_a_run_interrupted_while_it_rolls_back_goes_on_with_the_smaller_steps(tmp_path, monkeypatch):
    run = Rehearsal(monkeypatch, tmp_path / "run", broken=3, safe=0.5, on_non_finite="rollback")
    run.pressed = (3,)
    result = run.train()
    assert result.interrupted and result.fault is None and result.env_steps == 2 * EPOCH
    run.pressed = ()
    assert run.train(resume=True).env_steps == 4 * EPOCH
    np.testing.assert_allclose(run.rates[-2:], [(1, 0.5, 1, 0.5)] * 2, rtol=1e-6)


@pytest.mark.parametrize(
    ("saved", "policy", "told"),
    [
        (240, {}, "the checkpoint of 240 env steps is sound; go on with: star train --resume RUN "
         "--trainer.on_non_finite rollback"),
        (0, {"trainer.on_non_finite": "rollback"}, "--trainer.on_non_finite rollback --trainer.rollbacks 6"),
        (None, {}, "there is no checkpoint from before; begin anew with --trainer.on_non_finite rollback"),
    ],
)  # fmt: skip
def test_the_command_says_in_one_line_what_was_lost_and_how_to_go_on(
    tmp_path, monkeypatch, capsys, saved, policy, told
):
    fault = faults.Fault(480, {6: {"tutor/params/a": 1, "tutor/params/b": 2, "controller/q": 1}})
    result = trainer.Result(tmp_path / "run", 480, False, None, fault=fault, saved=saved)
    monkeypatch.setattr(trainer, "train", lambda *args, **kwargs: result)
    monkeypatch.chdir(tmp_path)
    Path("config.yaml").write_text("{}")
    flags = [word for key, value in policy.items() for word in (f"--{key}", value)]
    assert cli.main(["train", "config.yaml", *flags]) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(
        "stopped: not finite after 480 env steps: seed 6: tutor/params/a and 1 more of it, controller/q; "
    )
    assert line.endswith(told.replace("RUN", str(tmp_path / "run")))


def test_debug_turns_the_checks_on_with_and_without_goal_selection(tmp_path, monkeypatch):
    turned_on = []
    monkeypatch.setattr(debugging, "turn_on", lambda: turned_on.append(True))
    monkeypatch.setattr(trainer, "train", lambda config, run_dir, **_: trainer.Result(run_dir, 0, False, None))
    monkeypatch.chdir(tmp_path)
    Path("config.yaml").write_text("{}")
    command = ["train", "config.yaml", "--debug"]
    assert cli.main(command) == 0 and turned_on == [True]
    assert cli.main([*command, "--sgim.goals", "true"]) == 0 and turned_on == [True, True]


def test_arrays_of_another_shape_or_type_than_said_are_refused():
    @jaxtyped(typechecker=debugging.shapes)
    def scaled(x: Float[Array, "n d"], by: Float[Array, "d"] | float) -> Float[Array, "n d"]:  # noqa: F821
        return x * by

    x = jnp.zeros((3, 2))
    assert scaled(x, jnp.ones(2)).shape == scaled(x, 2.0).shape == (3, 2)
    for wrong in ((x, jnp.ones(3)), (x[0], 2.0), (x.astype(int), 2.0)):
        with pytest.raises(TypeCheckError, match="scaled"):
            scaled(*wrong)


def test_every_shape_of_an_epoch_is_as_said():
    """In a process of its own, as modules are checked only if they are imported after that was turned on."""
    code = """
from star import debugging
debugging.turn_on()
import jax
assert jax.config.jax_debug_nans
from star.training import program
from star.abstraction import refinement
from star.config.loading import parse
from tests.small import RUN
assert hasattr(refinement.refine, "__wrapped__")
built = program.build(parse(RUN))
state = jax.eval_shape(built.init, built.seed_keys())
jax.eval_shape(built.epoch, state)
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])
