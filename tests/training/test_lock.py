import errno
import fcntl
import os
import threading

import pytest

from envs.common.errors import UserError
from star.training.lock import held, locked


def unexpected(line):
    raise AssertionError(line)


def test_a_run_directory_in_use_is_refused_with_the_name_of_who_uses_it(tmp_path):
    with locked(tmp_path, warn=unexpected):
        with pytest.raises(UserError, match=f"^{tmp_path}: is in use by process {os.getpid()} on "):
            with locked(tmp_path, warn=unexpected):
                raise AssertionError
    with locked(tmp_path, warn=unexpected):
        pass


def test_who_only_looks_does_not_keep_a_run_from_beginning(tmp_path):
    (tmp_path / ".lock").touch()
    with (tmp_path / ".lock").open() as looking:
        fcntl.flock(looking, fcntl.LOCK_SH)
        threading.Timer(0.03, fcntl.flock, (looking, fcntl.LOCK_UN)).start()
        with locked(tmp_path, warn=unexpected):
            assert held(tmp_path)
    assert not held(tmp_path)


def test_a_file_system_that_cannot_lock_is_told_of_and_used_all_the_same(tmp_path, monkeypatch):
    def cannot(file, how):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", cannot)
    told = []
    with locked(tmp_path, warn=told.append):
        pass
    assert len(told) == 1 and "cannot lock (No locks available)" in told[0]


def test_a_folder_that_cannot_be_written_is_told_in_one_line(tmp_path):
    with pytest.raises(UserError, match="none: cannot be written: No such file or directory"):
        with locked(tmp_path / "none", warn=unexpected):
            raise AssertionError


def test_a_refusal_leaves_no_lock_behind(tmp_path):
    for kept in (False, True):
        if kept:
            (tmp_path / ".lock").touch()
        with pytest.raises(UserError, match="no"), locked(tmp_path, warn=unexpected):
            raise UserError("no")
        assert (tmp_path / ".lock").exists() == kept
