"""Whatever is known of reachability, the Commander never chooses a target that is not allowed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from star.abstraction.regions import Near
from star.agent import values
from star.agent.decisions import successors
from star.agent.values import CommanderState

R, B = 6, 64


def _choose(mode, q, reaches, misses, count, epsilon, key):
    active = jnp.arange(R) < count
    allowed = successors(mode, Near.every(R), reaches=reaches, misses=misses, active=active)
    where, goal = jax.random.randint(key, (2, B), 0, count)
    state = CommanderState(q=q, chosen=jnp.zeros(R))
    chosen = values.choose(state, allowed, where, goal, epsilon=epsilon, key=key)
    return allowed, where, goal, chosen


choose = jax.jit(_choose, static_argnums=0)


@pytest.mark.parametrize("mode", ["any", "possible", "known"])
@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, R),
    epsilon=st.sampled_from([0.0, 0.5, 1.0]),
    density=st.sampled_from([0.0, 0.3, 1.0]),
)
def test_targets_are_active_and_not_forbidden(mode, seed, count, epsilon, density):
    rng = np.random.default_rng(seed)
    verdict = np.where(rng.random((R, R)) < density, rng.integers(1, 3, (R, R)), 0)
    reaches, misses = verdict == 1, verdict == 2
    q = rng.normal(size=(R, R, R)).astype(np.float32) * rng.choice([0.0, 1.0, 1e6])
    allowed, *chosen = choose(mode, q, reaches, misses, count, epsilon, jax.random.key(seed))
    where, goal, targets = map(np.asarray, chosen)
    home = (targets == where) & (where == goal)
    assert (targets < count).all()
    either = np.asarray(allowed.greedy | allowed.explore)
    assert (either[where, targets] | home).all()
    if mode != "any" or epsilon == 1.0:
        assert not (misses[where, targets] & (where != targets)).any()
    if mode == "known":
        for i, j, at_home in zip(where, targets, home, strict=True):
            known = [k for k in range(count) if k != i and reaches[i, k]]
            assert not known or j in known or at_home
