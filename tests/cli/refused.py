"""Commands that are refused."""

from star.cli import main


def contents(folder):
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def refusal(capsys, folder, arguments):
    """What a command that fails says: exit code 2, one line on stderr, nothing on stdout, nothing written."""
    before = contents(folder)
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == "" and contents(folder) == before
    assert err.startswith("error: ") and err.endswith("\n") and err.count("\n") == 1
    return err
