"""Several devices: environments and replay are shared out among them, everything else is whole on each.

The devices form a mesh with one axis. The environments step inside `jax.shard_map`
(`envs.common.batching.shared_out`); the rest of an epoch is one program that JAX's partitioner cuts, told by `share`
and `whole` where data is to lie. Both do nothing where there is no mesh. Random numbers do not depend on how they are
cut, so that any number of devices computes the same but for the rounding of sums.

Several processes, each with devices of its own, run the same program in step. Only the `first` of them writes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec, SingleDeviceSharding

from envs.common.batching import AXIS
from star.config.section import ConfigError

_WHOLE = PartitionSpec()


def mesh(count: int) -> Mesh | None:
    """The first `count` devices of all processes, None for one; raises `UserError` if there are not so many.

    Several processes must use all their devices.
    """
    there, processes = jax.devices(), jax.process_count()
    if count > len(there):
        raise ConfigError(
            f"trainer.devices: {count} are not available, JAX sees {len(there)} ({jax.default_backend()}); "
            f"allowed: {'1 to ' * (len(there) > 1)}{len(there)}"
        )
    if processes > 1 and count != len(there):
        raise ConfigError(
            f"trainer.devices: {count}, but the {processes} processes have {len(there)} devices; allowed: {len(there)}"
        )
    if count == 1:
        return None
    return jax.make_mesh((count,), (AXIS,), axis_types=(AxisType.Auto,), devices=there[:count])


def on(mesh: Mesh | None, function: Callable[..., Any]) -> Callable[..., Any]:
    """`function`, to be jitted, with `share` and `whole` meaning `mesh`, on which some argument or result must lie."""
    if mesh is None:
        return function

    @wraps(function)
    def call(*args: Any) -> Any:
        with jax.sharding.use_abstract_mesh(mesh.abstract_mesh):
            return function(*args)

    return call


def everywhere(mesh: Mesh | None) -> jax.sharding.Sharding:
    """Sharding of arrays that are whole on each device of `mesh`; without one on the first device."""
    return SingleDeviceSharding(jax.devices()[0]) if mesh is None else NamedSharding(mesh, _WHOLE)


def in_shares(mesh: Mesh | None, *, axis: int = 0) -> jax.sharding.Sharding:
    """Sharding of arrays that are cut along `axis`; without a mesh on the first device."""
    return everywhere(mesh) if mesh is None else NamedSharding(mesh, _cut(axis))


def share(tree: Any, *, axis: int = 0) -> Any:
    """`tree`, cut along `axis` of all its leaves, whose size the number of devices divides."""
    return _constrained(tree, _cut(axis))


def whole(tree: Any) -> Any:
    """`tree`, with all of it on each device."""
    return _constrained(tree, _WHOLE)


def as_on_first(tree: Any) -> Any:
    """`tree`, whole on each device, with the values of the first device.

    Copies that each device computes for itself can drift apart by rounding: additions into a table are in no fixed
    order on a GPU.
    """
    if not _on_mesh():
        return tree

    def copied(leaf: jax.Array) -> jax.Array:
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return leaf  # made of integers alone, so that copies cannot differ
        ours = jnp.where(jax.lax.axis_index(AXIS) == 0, leaf, jnp.zeros_like(leaf))
        return (
            jax.lax.psum(ours.astype(jnp.int8), AXIS).astype(bool) if leaf.dtype == bool else jax.lax.psum(ours, AXIS)
        )

    return jax.shard_map(lambda tree: jax.tree.map(copied, tree), in_specs=_WHOLE, out_specs=_WHOLE, check_vma=False)(
        tree
    )


def join(cluster: str) -> None:
    """Become one of several processes, before JAX looks for devices; raises `UserError`.

    `cluster` is HOST:PORT,NUMBER,COUNT: where the first process listens, the number of this one from 0, and how many
    there are; or "auto" for what SLURM, Open MPI and the like say of themselves.
    """
    known: dict[str, Any] = {}
    if cluster != "auto":
        address, *numbers = cluster.split(",")
        if ":" not in address or len(numbers) != 2 or not all(number.isdecimal() for number in numbers):
            raise ConfigError(f"--distributed: {cluster!r} is neither auto nor of the form HOST:PORT,NUMBER,COUNT")
        number, count = map(int, numbers)
        if number >= count:
            raise ConfigError(f"--distributed: process {number} is not among those of {count}: 0 to {count - 1}")
        known = {"coordinator_address": address, "process_id": number, "num_processes": count}
    jax.config.update("jax_enable_preemption_service", False)  # SIGTERM is heard by `star.training.signals`
    try:
        jax.distributed.initialize(**known)
    except (RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())[:160]
        if cluster == "auto":
            raise ConfigError(
                f"--distributed: auto knows no cluster here ({reason}); "
                "start with srun or mpirun, or give HOST:PORT,I,N"
            ) from None
        raise ConfigError(f"--distributed: {cluster}: {reason}") from None


def first() -> bool:
    """True if this process is the one that writes."""
    return jax.process_index() == 0


def wait(name: str) -> None:
    """Until all processes have come to the place `name`."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(name)


def anywhere(flag: bool) -> bool:
    """True if `flag` is set in any process; all of them must ask."""
    return flag if jax.process_count() == 1 else bool(np.any(multihost_utils.process_allgather(np.asarray(flag))))


def _cut(axis: int) -> PartitionSpec:
    return PartitionSpec(*[None] * axis, AXIS)


def _on_mesh() -> bool:
    return AXIS in jax.sharding.get_abstract_mesh().axis_names


def _constrained(tree: Any, spec: PartitionSpec) -> Any:
    return jax.lax.with_sharding_constraint(tree, spec) if _on_mesh() else tree
