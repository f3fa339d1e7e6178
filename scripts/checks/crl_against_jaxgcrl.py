"""Compare contrastive RL with JaxGCRL's own, and how long the ants of both live; write a JSON file.

    python scripts/checks/crl_against_jaxgcrl.py JaxGCRL --engines jax --out results/physics/jaxgcrl_crl.json

The first row tells losses and gradients of both at the same parameters, batch and noise; the worst of BATCHES:

    critic, actor  relative difference of the loss
    gradient       largest difference of a gradient's number, in shares of the largest number of its array
    right          True if both critics find equally many goals of a batch

Then a row for each ant, JaxGCRL's `ant` by backend and its presets here by engine, and for actions that are `uniform`
in [-1, 1] or those of the `initial` actor, which has not learnt:

    mass       kg of the ant
    env_steps  of ENVS ants together until their episodes end, at most STEPS of each
    ends       episodes that have ended by then
    high       those of them that have ended above 1 m; the others are below .2 m
    speed      m/s along the ground, mean over these env steps
    hinges     rad/s of the hinges, root of the mean square over these env steps
    hip        rad from its middle that no hip went beyond; its limit is .52
"""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from flax.training.train_state import TrainState

import envs
from envs.ant import HEALTHY, QPOS, QVEL
from envs.options import JAXGCRL
from scripts.checks.against_jaxgcrl import loaded, theirs
from star.learners import crl
from star.learners.futures import ReplayState, Step
from star.learners.replay import Track, Transition
from star.learners.sections import CRLConfig

STATE, ACTION, GOAL, BATCHES = 29, 8, 2, 10
LEAP = 1e6  # step size from which a gradient is told without loss of digits
ENVS, STEPS = 32, 300
HEIGHT, HIPS, TURNING = 2, slice(7, QPOS, 2), slice(QPOS + 6, QPOS + QVEL)  # in an observation


class Parts(struct.PyTreeNode):
    """The parts of JaxGCRL's state that its updates read and write."""

    actor_state: TrainState
    critic_state: TrainState
    alpha_state: TrainState


class Batch(NamedTuple):
    """The parts of a batch that JaxGCRL's losses read."""

    observation: jax.Array
    action: jax.Array
    extras: dict[str, jax.Array]


def learner() -> tuple[CRLConfig, ReplayState]:
    """Ours before it has learnt."""
    config, zero = CRLConfig(buffer_size=256), jnp.zeros(())
    seen, track = jnp.zeros(STATE + GOAL), Track(jnp.zeros(GOAL), zero, zero)
    example = Transition(seen, jnp.zeros(ACTION), zero, seen, zero, zero, zero, extras=track)
    return config, crl.init(jax.random.key(0), config, example=example)


def as_theirs(actor: Any) -> dict[str, Any]:
    """Parameters of our actor, or their gradient, for JaxGCRL's: its last layer is two, of means and of deviations."""
    *hidden, last = (actor["params"][f"Dense_{i}"] for i in range(len(actor["params"])))
    halves = [jax.tree.map(lambda x, side=side: jnp.split(x, 2, axis=-1)[side], last) for side in range(2)]
    return {"params": {f"Dense_{i}": layer for i, layer in enumerate([*hidden, *halves])}}


def their_gradients(clone: Path, config: CRLConfig) -> Callable[..., tuple[Any, dict[str, jax.Array]]]:
    """(params of actor, critic and alpha, states, actions, goals, key) -> their gradients, and metrics; its source."""
    networks, losses = (loaded(clone, name, folder="agents/crl") for name in ("networks", "losses"))
    depth = {"network_depth": len(config.hidden), "skip_connections": 4}  # its defaults
    half = networks.Encoder(**depth)
    parts = {"actor": networks.Actor(action_size=ACTION, **depth), "sa_encoder": half, "g_encoder": half}
    told = {"state_size": STATE, "goal_indices": jnp.arange(GOAL), "target_entropy": -0.5 * ACTION}
    told |= {"energy_fn": "norm", "contrastive_loss_fn": "fwd_infonce", "logsumexp_penalty_coeff": 0.1}

    def gradients(params: Any, state: jax.Array, action: jax.Array, goal: jax.Array, key: jax.Array) -> Any:
        train = [TrainState.create(apply_fn=None, params=one, tx=optax.sgd(LEAP)) for one in params]
        later = jnp.concatenate([goal, state[:, GOAL:]], axis=1)
        batch = Batch(jnp.concatenate([state, goal], axis=1), action, {"future_state": later})
        after, metrics = losses.update_actor_and_alpha(told, parts, batch, Parts(*train), key)
        after, more = losses.update_critic(told, parts, batch, after, key)
        stepped = after.actor_state.params, after.critic_state.params, after.alpha_state.params
        return jax.tree.map(lambda old, new: (old - new) / LEAP, params, stepped), metrics | more

    return gradients


def our_gradients(config: CRLConfig, params: Any, batch: Step, goal: jax.Array, key: jax.Array) -> Any:
    """The gradients of our actor and critic, and the metrics of both."""
    actor, critic, log_alpha = params
    slope, told = jax.grad(partial(crl._actor_loss, config, None), has_aux=True)(
        actor, critic, log_alpha, batch, goal, key
    )
    critic_slope, more = jax.grad(partial(crl._critic_loss, config), has_aux=True)(critic, batch, goal)
    return (slope, critic_slope), told | more


def compared(clone: Path) -> dict[str, Any]:
    """The row of losses and gradients."""
    config, state = learner()
    actor, critic = state.params["actor"], state.params["critic"]
    halves = {"sa_encoder": critic["action"], "g_encoder": critic["goal"]}
    given = as_theirs(actor), halves, {"log_alpha": state.log_alpha}
    own, ours = jax.jit(their_gradients(clone, config)), jax.jit(partial(our_gradients, config))
    rng, gaps, right = np.random.default_rng(0), [], []
    for number in range(BATCHES):
        draw = [jnp.asarray(rng.normal(size=(256, n)), jnp.float32) for n in (STATE, ACTION, GOAL)]
        seen, action, goal = 3 * draw[0], jnp.tanh(draw[1]), 5 * draw[2]
        key, none = jax.random.key(number), jnp.zeros(256)
        track = Track(0 * goal, none, none)
        batch = Step(jnp.concatenate([seen, 0 * goal], axis=1), action, none + 1, track)
        (wanted_actor, wanted_critic, _), wanted = own(given, seen, action, goal, key)
        (slope, critic_slope), found = ours((actor, critic, state.log_alpha), batch, goal, key)
        wanted_critic = {"action": wanted_critic["sa_encoder"], "goal": wanted_critic["g_encoder"]}
        apart = jax.tree.map(_apart, (wanted_actor, wanted_critic), (as_theirs(slope), critic_slope))
        losses = [_apart(wanted[name], found[name]) for name in ("critic_loss", "actor_loss")]
        gaps.append([*losses, max(jax.tree.leaves(apart))])
        right.append(float(wanted["categorical_accuracy"]) == float(found["critic_right"]))
    worst = np.max(gaps, axis=0).tolist()
    return (
        {"what": "losses", "batches": BATCHES}
        | dict(zip(("critic", "actor", "gradient"), worst, strict=True))
        | {"right": all(right)}
    )


def _apart(wanted: jax.Array, found: jax.Array) -> float:
    return float(jnp.abs(wanted - found).max() / jnp.abs(wanted).max())


def lives(env: Any, actions: Callable[[jax.Array, jax.Array], jax.Array]) -> dict[str, float]:
    """Counts of ants that begin together and act by `actions(observations, key)`, and speed; none begins anew."""

    def step(carry: Any, key: jax.Array) -> tuple[Any, Any]:
        state, alive = carry
        before, state = state, jax.vmap(env.step)(state, actions(state.obs, key))
        height, over = state.obs[:, HEIGHT], alive & (state.done > 0)
        way = alive * jnp.linalg.norm(state.obs[:, :2] - before.obs[:, :2], axis=-1)
        turning = alive * jnp.square(state.obs[:, TURNING]).mean(axis=-1)
        hip = (alive[:, None] * jnp.abs(state.obs[:, HIPS])).max()
        return (state, alive & ~over), ((alive, over, over & (height > HEALTHY[1]), way, turning), hip)

    @jax.jit
    def run(key: jax.Array) -> Any:
        start = jax.vmap(env.reset)(jax.random.split(key, ENVS))
        return jax.lax.scan(step, (start, jnp.ones(ENVS, bool)), jax.random.split(key, STEPS))[1]

    sums, hip = run(jax.random.key(0, impl="threefry2x32"))
    *counts, way, turning = map(jnp.sum, sums)
    told: dict[str, float] = dict(zip(("env_steps", "ends", "high"), map(int, counts), strict=True))
    told["speed"] = round(float(way / env.dt) / told["env_steps"], 3)
    told["hinges"] = round(float(turning / told["env_steps"]) ** 0.5, 2)
    return told | {"hip": round(float(hip.max()), 2)}


def rows(clone: Path, backends: list[str], engines: list[str]) -> list[dict[str, Any]]:
    """The rows of all ants."""
    config, state = learner()
    kinds = {
        "uniform": lambda obs, key: jax.random.uniform(key, (ENVS, ACTION), minval=-1.0, maxval=1.0),
        "initial": lambda obs, key: crl.act(config, state, obs, key=key),
    }
    told = []
    ours = [(preset, name) for preset in JAXGCRL for name in engines]
    for whose, name in [("JaxGCRL", name) for name in backends] + ours:
        if whose == "JaxGCRL":
            env = theirs(clone, "ant", backend=name)[0]
            masses = env.sys.link.inertia.mass[:-1]  # the last is that of the goal
            mass = (masses ** (1 - env.sys.spring_mass_scale) if name == "spring" else masses).sum()
        else:
            env = envs.make("ant_open", preset=whose, engine=name)
            mass = env.body.physics.model.body_mass.sum()
        for kind, actions in kinds.items():
            told.append(
                {"what": f"{whose} {name}", "actions": kind, "mass": round(float(mass), 2)} | lives(env, actions)
            )
            print(json.dumps(told[-1]), flush=True)
    return told


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clone", type=Path, help="folder of JaxGCRL's source")
    parser.add_argument("--backends", nargs="*", default=["spring", "mjx"])
    parser.add_argument("--engines", nargs="*", default=["jax"])
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    warnings.simplefilter("ignore")  # brax's notice about its own pipelines
    jax.config.update("jax_default_matmul_precision", "highest")
    first = compared(options.clone)
    print(json.dumps(first), flush=True)
    found = [first, *rows(options.clone, options.backends, options.engines)]
    if options.out:
        options.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
