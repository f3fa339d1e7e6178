import io

from rich.console import Console

from star.metrics import Display


def shown(*seeds, **row):
    console = Console(file=io.StringIO(), force_terminal=False, width=200)
    with Display(console, total_env_steps=100, done_env_steps=0) as display:
        plain = {"env_steps_per_s": 10, "abstraction/regions": 4, "eval/success_final": 0.5}
        rows = [plain | one for one in (seeds or (row,))]
        display.update(50, rows, left_s=5.0)
    return console.file.getvalue()


def test_faults_of_the_simulator_are_shown_where_there_are_any():
    assert "simulator faults 5" in shown(**{"env/non_finite": 2.0, "env/overflow": 3.0})
    assert "simulator faults 1" in shown({"env/overflow": 1.0}, {}, {}, {})
    assert "faults" not in shown(**{"env/non_finite": 0.0, "env/overflow": 0.0})
