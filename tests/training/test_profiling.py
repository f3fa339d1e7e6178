import jax
import pytest

from envs.common.errors import UserError
from star.training.profiling import Profile, plan


@pytest.mark.parametrize(
    ("done", "eval_every", "epochs", "first"),
    [
        (0, 10, 3, 1),  # epochs 2 to 4
        (0, 1, 3, 1),  # the first evaluation compiles after epoch 1
        (0, 2, 1, 1),  # ... after epoch 2, the last that is traced
        (0, 2, 2, 2),  # ... would fall into the trace, which waits for it
        (0, 3, 5, 3),
        (4, 10, 3, 5),  # of a run that goes on
        (5, 3, 5, 6),
        (0, 30, 18, 1),  # of 20 epochs the last one evaluates
    ],
)
def test_a_trace_begins_where_nothing_compiles_any_more(done, eval_every, epochs, first):
    assert plan(done=done, total=20, eval_every=eval_every, epochs=epochs) == first


@pytest.mark.parametrize(("done", "eval_every", "epochs"), [(0, 5, 20), (19, 5, 1), (20, 5, 1), (15, 18, 4)])
def test_a_run_too_short_for_the_trace_is_refused(done, eval_every, epochs):
    with pytest.raises(UserError, match=f"^--profile: {epochs} epochs cannot be traced .* {20 - done} are left"):
        plan(done=done, total=20, eval_every=eval_every, epochs=epochs)


def traced(tmp_path, monkeypatch, *, epochs, until, start=lambda folder: None):
    """(epochs over when the trace began and ended, what was said, what was warned of)."""
    marks, said, warned = [], [], []
    monkeypatch.setattr(jax.profiler, "start_trace", lambda folder: (start(folder), marks.append(done)))
    monkeypatch.setattr(jax.profiler, "stop_trace", lambda: marks.append(done))
    (tmp_path / "vm.trace.json.gz").touch()
    with Profile(tmp_path, first=2, epochs=epochs, say=said.append, warn=warned.append) as profile:
        for done in range(until):
            profile.before(done)
            done += 1
            profile.after(done)
    return marks, said, warned


@pytest.mark.parametrize(("epochs", "until", "marks"), [(3, 9, [2, 5]), (3, 4, [2, 4]), (3, 2, []), (0, 9, [])])
def test_the_epochs_asked_for_are_traced_or_as_many_as_there_are(tmp_path, monkeypatch, epochs, until, marks):
    found, said, warned = traced(tmp_path, monkeypatch, epochs=epochs, until=until)
    assert found == marks and warned == []
    assert len(said) == (1 if marks else 0) and all(f"open {tmp_path}/vm.trace.json.gz" in line for line in said)


def test_a_profiler_that_fails_is_warned_of_in_one_line(tmp_path, monkeypatch):
    def fail(folder):
        raise RuntimeError("only one\nat a time")

    marks, said, warned = traced(tmp_path, monkeypatch, epochs=3, until=9, start=fail)
    assert (marks, said) == ([], [])
    assert warned == ["--profile: only one at a time; training goes on without a trace"]
