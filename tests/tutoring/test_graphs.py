"""Graphs as matrices, beside plain Python that walks along edges."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax import random

from star.tutoring import graphs
from tests.tutoring.slow import reachable

N = 5
draw = jax.jit(lambda key: graphs.draw(N, key=key))
closed, reduced, deep = jax.jit(graphs.ancestors), jax.jit(graphs.reduced), jax.jit(graphs.depth)
acyclic, quality = jax.jit(graphs.acyclic), jax.jit(graphs.quality)
strengths = st.lists(st.sampled_from([0.0, 0.1, 0.2, 0.5, 0.9]), min_size=N * N, max_size=N * N)


@given(st.integers(0, 2**31 - 1))
def test_a_graph_drawn_has_no_cycle_and_no_edge_that_others_imply(seed):
    parents = np.asarray(draw(random.key(seed)))
    above = reachable(parents)
    np.testing.assert_array_equal(closed(parents), above)
    assert not above.diagonal().any()
    for child, parent in np.argwhere(parents):
        without = parents.copy()
        without[child, parent] = False
        assert not reachable(without)[child, parent]
    np.testing.assert_array_equal(reachable(np.asarray(reduced(above))), above)
    depths = np.asarray(deep(parents))
    assert all(depths[i] == max([depths[j] + 1 for j in np.flatnonzero(parents[i])], default=0) for i in range(N))


@given(strengths)
def test_edges_are_taken_from_the_strongest_down_but_for_cycles(values):
    strength = np.asarray(values, np.float32).reshape(N, N)
    taken = np.zeros((N, N), bool)
    for place in np.argsort(-np.where(np.eye(N), -np.inf, strength).ravel(), kind="stable"):
        child, parent = divmod(int(place), N)
        if child != parent and strength[child, parent] > 0.15 and not reachable(taken)[parent, child]:
            taken[child, parent] = True
    found = np.asarray(acyclic(strength, 0.15))
    np.testing.assert_array_equal(reachable(found), reachable(taken))
    assert not (found & ~taken).any()


def test_precision_recall_and_auc_are_those_of_all_ordered_pairs():
    rng = np.random.default_rng(0)
    true, found = (np.asarray(draw(random.key(seed))) for seed in (3, 4))
    strength = rng.integers(0, 4, (N, N)) / 4
    pairs = [(i, j) for i, j in itertools.product(range(N), repeat=2) if i != j]
    edges, rest = ([strength[p] for p in pairs if true[p] == kind] for kind in (True, False))
    wins = [(a > b) + 0.5 * (a == b) for a in edges for b in rest]
    got = quality(true, found, jnp.asarray(strength))
    assert got["auc"] == pytest.approx(np.mean(wins), abs=1e-6)
    assert got["precision"] == pytest.approx((true & found).sum() / found.sum())
    assert got["recall"] == pytest.approx((true & found).sum() / true.sum())
