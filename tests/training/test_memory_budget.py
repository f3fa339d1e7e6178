import pytest

from envs.common.errors import UserError
from star.config.loading import parse
from star.training import memory_budget, trainer
from star.training import program as programs
from tests.small import RUN


def needed(**overrides):
    return memory_budget.needed(programs.build(parse(RUN, {key.replace("__", "."): x for key, x in overrides.items()})))


def test_twice_the_seeds_need_twice_the_memory():
    one, two = needed(), needed(trainer__num_seeds=2)
    assert {name: 2 * count for name, count in one.items()} == two


def test_a_larger_buffer_needs_as_many_more_transitions():
    sizes = {"controller__learner": "td3", "controller__td3__buffer_size": 1000}
    transition = (4 + 2 + 4 + 4) * 4  # observation, action, next observation and four numbers
    more = needed(**sizes | {"controller__td3__buffer_size": 3000})["controller"] - needed(**sizes)["controller"]
    assert more == 2000 * transition


@pytest.mark.parametrize(
    "overrides",
    [
        {"controller.learner": "td3", "controller.td3.buffer_size": 2**31 - 1, "trainer.num_seeds": 1024},
        {"trainer.num_envs": 2**20, "trainer.num_seeds": 1024},
        {"controller.ppo.hidden": [2**14] * 16, "trainer.num_seeds": 64},
    ],
)
def test_a_run_that_cannot_fit_is_refused_before_anything_is_written(tmp_path, overrides):
    with pytest.raises(
        UserError, match=r"needs at least [\d,.]+ GiB of memory, .* for .*controller.*; there are"
    ) as caught:
        trainer.train(parse(RUN, overrides), tmp_path / "run", quiet=True)
    assert "\n" not in str(caught.value) and not list(tmp_path.iterdir())
