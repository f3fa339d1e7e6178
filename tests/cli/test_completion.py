"""`star completion`: the scripts complete what they should in the shells themselves."""

import shutil
import subprocess
from pathlib import Path

import pytest

from star.cli import completion

EXPECTED = {
    "star tr": ["train"],
    "star train poi": ["point_labyrinth", "point_maze"],
    "star train m": ["mine.yaml"],
    "star train point_maze --with agents/h": ["agents/hiro", "agents/hrac"],
    "star train point_maze --res": ["--resume"],
    "star train point_maze --commander.epsilon_s": [
        "--commander.epsilon_spread",
        "--commander.epsilon_start",
        "--commander.epsilon_steps",
    ],
    "star train point_maze --trainer.device ": ["auto", "cpu", "gpu"],
    "star train point_maze --tutor.straight ": ["false", "true"],
    "star train --resume runs/": ["runs/a", "runs/b"],
    "star sweep sweeps/t": ["sweeps/three_values"],
    "star evaluate runs/": ["runs/a", "runs/b"],
    "star render --run runs/": ["runs/a", "runs/b"],
}
BASH = """
source ./script
COMP_WORDS=({words}); COMP_CWORD={last}; COMPREPLY=()
_shtab_star star "${{COMP_WORDS[{last}]}}" "${{COMP_WORDS[{last} - 1]}}"
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a config and two runs."""
    folder = tmp_path_factory.mktemp("here")
    (folder / "mine.yaml").write_text("")
    for name in ("a", "b"):
        (folder / "runs" / name).mkdir(parents=True)
    return folder


def completed(shell, line, place):
    """What the shell offers at the end of the line."""
    (place / "script").write_text(completion.script(shell))
    if shell == "bash":
        words = line.split(" ")
        code = BASH.format(words=" ".join(f"'{word}'" for word in words), last=len(words) - 1)
    else:
        code = f"source ./script; complete -C '{line}'"
    out = subprocess.run([shell, "-c", code], cwd=place, capture_output=True, text=True, check=True).stdout
    return sorted({one.split("\t")[0].rstrip("/") for one in out.splitlines() if one})


@pytest.mark.parametrize("line", EXPECTED)
@pytest.mark.parametrize("shell", ["bash", "fish"])
def test_a_shell_completes_commands_configs_runs_and_settings(shell, line, place):
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    assert completed(shell, line, place) == EXPECTED[line]


def test_the_script_for_zsh_is_one_that_zsh_reads(tmp_path):
    script = completion.script("zsh")
    assert script.startswith("#compdef star\n") and "'--tutor.period" in script.replace('"', "'")
    if shutil.which("zsh") is None:
        pytest.skip("zsh is not installed")
    (tmp_path / "_star").write_text(script)
    subprocess.run(["zsh", "-n", str(tmp_path / "_star")], check=True)


def test_the_command_itself_is_offered_with_all_others(place):
    offered = completed("bash", "star ", place)
    assert {"train", "settings", "completion"} <= set(offered) and not Path(place, "star").exists()
