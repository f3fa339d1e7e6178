"""What tutors choose, on a chain of three skills: 0 before 1 before 2."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax import random

from star.tutoring import tutors
from star.tutoring.sections import TeachingConfig

CHAIN = jnp.zeros((3, 3), bool).at[1, 0].set(True).at[2, 1].set(True)
NEEDS = jnp.asarray([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 0], [1, 0, 0]], bool)
PLAN = tutors.Plan(needs=NEEDS, parents=CHAIN)
MANY = random.split(random.key(0), 200)


def compiled(name):
    """(settings, memory at first, 200 choices of one memory, an update)"""
    config = TeachingConfig(tutor=name)
    choose = jax.jit(jax.vmap(lambda seen, key: tutors.choose(config, PLAN, seen, key=key), (None, 0)))
    update = jax.jit(lambda seen, exercise, score: tutors.update(config, PLAN, seen, exercise, score))
    return config, tutors.init(config, 3), choose, update


TUTORS = {name: compiled(name) for name in tutors.TUTORS}


@pytest.mark.parametrize("name", ["zpdes", "sgim_graph"])
@given(success=st.lists(st.floats(0, 1, width=32), min_size=3, max_size=3))
def test_with_a_graph_skills_wait_for_their_prerequisites_and_what_is_mastered_is_left(name, success):
    config, seen, choose, _ = TUTORS[name]
    seen = seen.replace(success=jnp.asarray(success, jnp.float32))
    locked = [False, not success[0] > config.validated, not success[1] > config.validated]
    open_ = [k for k in range(3) if not locked[k] and success[k] < config.mastered]
    chosen = np.unique(choose(seen, MANY[:50]))
    for needed in np.asarray(NEEDS)[chosen]:
        assert not (needed & locked).any()
        if open_:
            assert needed[open_].any()


def test_the_fixed_tutor_takes_one_skill_after_another_and_does_not_return():
    config, seen, choose, update = TUTORS["fixed"]
    for skill in range(3):
        assert np.asarray(NEEDS)[choose(seen, MANY), skill].all()
        for _ in range(20):
            seen = update(seen, skill, True)
            if seen.success[skill] > config.next:
                break
        for _ in range(3):
            seen = update(seen, skill, False)  # what was passed once counts
    assert len(np.unique(choose(seen, MANY))) == len(NEEDS)


@pytest.mark.parametrize("name", ["zpdes", "progress", "sgim_graph"])
def test_the_skill_with_more_progress_is_practised_more(name):
    """All three are open; success in 0 and 1 stays, that in 2 rises."""
    _, seen, choose, update = TUTORS[name]
    for past in range(16):
        seen = seen.replace(success=jnp.asarray([0.7, 0.7, past / 20]))
        for exercise in (0, 1):
            seen = update(seen, exercise, past % 2 == 0)
        seen = update(seen, 2, past >= 12)
    seen = seen.replace(success=jnp.asarray([0.7, 0.7, 0.7]))
    chosen = np.asarray(NEEDS)[choose(seen, MANY)]
    assert chosen[:, 2].mean() > 0.5


def test_the_random_tutor_chooses_all_exercises_evenly():
    _, seen, choose, _ = TUTORS["random"]
    counts = np.bincount(choose(seen, random.split(random.key(1), 3000)), minlength=len(NEEDS))
    assert abs(counts / 500 - 1).max() < 0.2


def test_running_success_follows_the_scores_of_the_skills_needed():
    _, seen, _, update = TUTORS["random"]
    seen = update(update(seen, 3, True), 0, False)
    assert np.asarray(seen.success) == pytest.approx([0.16, 0.0, 0.2])
