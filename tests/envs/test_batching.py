"""What is shared out to the devices of a mesh, and what is not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType

import envs
from envs.common.batching import AXIS, flattened, shared_out
from envs.vector import VectorEnv

NOTHING = jnp.zeros((0, 3))


def mesh():
    return jax.make_mesh((1,), (AXIS,), axis_types=(AxisType.Auto,))


def shared(jaxpr):
    """The arrays that go into and come out of `jax.shard_map`, however deep it is."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "shard_map":
            yield from (variable.aval for variable in (*equation.invars, *equation.outvars))
        for part in jax.tree.leaves(equation.params, is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")):
            if hasattr(part, "eqns") or hasattr(part, "jaxpr"):
                yield from shared(getattr(part, "jaxpr", part))


def under_vmap(function, *args):
    """The operations of `function` under a vmap on a mesh of one device, for arguments [S, n, ...]."""
    with jax.sharding.use_abstract_mesh(mesh().abstract_mesh):
        return jax.make_jaxpr(jax.vmap(function))(*args)


@flattened
def walk(state, step):
    at, none, unknown = state
    assert at.ndim == 2, "one flat batch"
    return at + step + (NOTHING * at[0, 0]).sum(), none + 1, unknown


def test_a_flattened_function_gives_the_same_on_a_mesh():
    state = (jnp.arange(12.0).reshape(2, 3, 2), jnp.zeros((2, 3, 0, 4)), None)
    step = jnp.arange(6.0).reshape(2, 3, 1)
    alone = jax.vmap(walk)(state, step)

    def run(state, step):
        with jax.sharding.use_abstract_mesh(mesh().abstract_mesh):
            return jax.vmap(shared_out(walk))(state, step)

    place = jax.sharding.NamedSharding(mesh(), jax.sharding.PartitionSpec())
    together = jax.jit(run, out_shardings=place)(state, step)
    np.testing.assert_array_equal(together[0], alone[0])
    assert together[1].shape == alone[1].shape == (2, 3, 0, 4) and together[2] is None


@pytest.mark.parametrize("empty", [False, True])
def test_arrays_without_elements_are_not_shared_out(empty):
    state = (jnp.zeros((2, 3, 2)), jnp.zeros((2, 3, 0 if empty else 1, 4)), None)
    seen = list(shared(under_vmap(shared_out(walk), state, jnp.zeros((2, 3, 1))).jaxpr))
    assert len(seen) == (3 if empty else 5)
    assert all(array.size for array in seen)


def test_an_empty_result_must_be_like_the_argument():
    cut = shared_out(flattened(lambda state: (state[0][:, :0],)))
    with pytest.raises(AssertionError, match="an empty result is unlike the argument"):
        under_vmap(cut, (jnp.zeros((2, 3, 4)),))


def test_environments_share_out_nothing_without_elements():
    env = envs.make("ant_maze", engine="native")
    batch = VectorEnv(env, 2, auto_reset=False)
    state = jax.eval_shape(jax.vmap(batch.reset), jax.random.split(jax.random.key(0), 2))
    assert any(leaf.size == 0 for leaf in jax.tree.leaves(state)), "else there is nothing to see"
    seen = list(shared(under_vmap(batch.step, state, jnp.zeros((2, 2, env.action_size))).jaxpr))
    assert len(seen) > 20 and all(array.size for array in seen)
