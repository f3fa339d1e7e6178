"""Environments, and their functions, which are compiled once for all tests of a process."""

from functools import cache

import jax

import envs

jitted = cache(jax.jit)


@cache
def made(name, **options):
    """What `envs.make` makes; an ant is simulated by MuJoCo in C unless `options` say otherwise."""
    return envs.make(name, **({"engine": "native"} if name.lower().startswith("ant") else {}) | options)
