"""What a run lacks: each line where it is due, and no line where it is not."""

import pytest

from star.agent.kind import STAR
from star.agent.notices import PATIENCE, notices


def rows(*, ground, success=0.0, full=0, count=30):
    """An epoch for each of `count`, evaluated every other one; `ground` gives each its share."""
    return [
        {"env_steps": 1000 * (i + 1), "commander/ground": ground(i), "refinement/table_full": int(full and i >= full)}
        | ({"eval/success_final": success} if i % 2 else {})
        for i in range(count)
    ]


def test_a_full_table_is_told_with_since_when():
    found = notices(rows(ground=lambda i: 0.1 * i, full=7))
    assert set(found) == {"room"}
    assert "full since env step 8,000" in found["room"] and "abstraction.max_regions" in found["room"]


@pytest.mark.parametrize(("success", "told"), [(0.0, True), (0.49, True), (0.5, False), (1.0, False)])
def test_a_frontier_that_stands_still_is_told_of_agents_that_do_not_succeed(success, told):
    found = notices(rows(ground=lambda i: min(i, 5) / 10, success=success))
    assert ("frontier" in found) == told
    assert not told or "since env step 6,000" in found["frontier"]


def test_a_frontier_that_moves_or_has_stood_for_a_short_time_is_not_told():
    assert not notices(rows(ground=lambda i: i / 100))
    assert not notices(rows(ground=lambda i: min(i, 5) / 10, count=5 + PATIENCE))
    assert notices(rows(ground=lambda i: min(i, 5) / 10, count=6 + PATIENCE))


def test_luck_is_no_new_ground():
    assert "since env step 6,000" in notices(rows(ground=lambda i: min(i, 5) / 10 + 0.001 * (i % 7)))["frontier"]


def test_runs_that_are_older_than_the_metric_say_nothing_of_it():
    old = [{k: v for k, v in row.items() if k != "commander/ground"} for row in rows(ground=lambda i: 0.0, full=3)]
    assert set(notices(old)) == {"room"} and not notices([])


def test_of_a_row_only_the_keys_are_read_that_the_kind_names():
    whole = rows(ground=lambda i: min(i, 5) / 10, full=7)
    kept = [{key: row[key] for key in ("env_steps", *STAR.notices.keys) if key in row} for row in whole]
    assert STAR.notices.lines(kept) == notices(whole) and len(notices(whole)) == 2
