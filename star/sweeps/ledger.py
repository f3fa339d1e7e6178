"""The study of a sweep: trials in a database, which any number of workers share.

    take            under a lock: give back what dead workers held, then ask Optuna for trials
    Holding         while it lasts, a heartbeat says that the worker with these trials is alive
    end / fail / give_back

A trial that is given back fails, and a waiting copy with the same parameters takes its place: whoever asks next gets
it. `trials` leaves out those that were replaced, so that every trial is there once.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import threading
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.parse import quote

import numpy as np
import optuna
import sqlalchemy
from optuna.distributions import BaseDistribution
from optuna.samplers import BaseSampler, CmaEsSampler
from optuna.storages import RDBStorage, RetryHeartbeatStaleTrialCallback
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, Trial, TrialState
from sqlalchemy.pool import NullPool

from envs.common import extras
from star.config.section import ConfigError

RETRIES = 3
_DESCRIPTION = "sweep"  # user attribute of a study: what it searches and how
_WORKER = "worker"  # user attribute of a trial: who has it; not set before its first heartbeat
_REASON = "reason"
MEASURED = "measured"
_HISTORY = "retry_history"  # system attribute of a copy: the trials it replaces, as Optuna writes it

Distributions = Mapping[str, BaseDistribution]


class Ledger:
    """A study with what is needed to share it between workers."""

    def __init__(
        self,
        url: str,
        name: str,
        *,
        description: Mapping[str, Any],
        sampler: Callable[[int], BaseSampler],
        pruner: optuna.pruners.BasePruner,
        grid: Sequence[Mapping[str, Any]] | None = None,
        lower_is_better: bool = False,
        beat_s: int = 15,
        grace_s: int = 90,
    ) -> None:
        """Make the study `name` in the database at `url`, or join it if it is there.

        Args:
          url: of SQLAlchemy's kind, sqlite:///FILE or postgresql://...
          name: of the study
          description: what is searched and how; that of a study to join must be equal
          sampler: makes Optuna's sampler from a seed
          pruner: Optuna's
          grid: parameters of the trials, one after another, instead of those the sampler would draw
          lower_is_better: whether the least value is the best, not the greatest
          beat_s: seconds between heartbeats
          grace_s: seconds without one after which a worker counts as dead

        Raises:
          ConfigError: if the database cannot be used or the study is another one

        """
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self._url = sqlalchemy_url(url)
        self._name = name
        self._sampler = sampler
        self._grid = grid
        self.beat_s = beat_s
        with reachable(self._url), self._alone(), warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            local = self._url.get_backend_name() == "sqlite"
            self.storage = RDBStorage(
                self._url.render_as_string(hide_password=False),
                engine_kwargs={"connect_args": {"timeout": 60} if local else {"connect_timeout": 10}},
                heartbeat_interval=beat_s,
                grace_period=grace_s,
                heartbeat_stale_trial_callback=lambda study, trial: _replace(study, trial, retries=RETRIES),
            )
            if local:
                sqlalchemy.event.listen(self.storage.engine, "connect", _write_ahead)
                self.storage.engine.dispose()  # what is open already does not know
            direction = StudyDirection.MINIMIZE if lower_is_better else StudyDirection.MAXIMIZE
            self.study = optuna.create_study(
                storage=self.storage, study_name=name, pruner=pruner, direction=direction, load_if_exists=True
            )
            saved = self.study.user_attrs.get(_DESCRIPTION)
            if saved is None and not self.study.get_trials(deepcopy=False):
                self.study.set_user_attr(_DESCRIPTION, dict(description))
            elif saved != description:
                raise ConfigError(f"study {name}: {_difference(saved or {}, description)}")

    def take(self, distributions: Distributions, count: int, *, limit: int, worker: str) -> list[Trial]:
        """Up to `count` trials to run, as long as the study has fewer than `limit`; those given back come first."""
        with self._alone(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that heartbeats are experimental, and meant for `optimize`
            self._retrieve()
            found = self.trials()
            waiting = sum(trial.state == TrialState.WAITING for trial in found)
            if self._grid is not None:
                limit = min(limit, len(self._grid))
            asked = []
            # All workers have the seed of the file, so what they draw has to depend on what there is already.
            seed, drawn = zlib.crc32(self._name.encode()), len(self.study.get_trials(deepcopy=False))
            self.study.sampler = self._sampler(int(np.random.SeedSequence([seed, drawn]).generate_state(1)[0]))
            for number in range(min(count, limit - (len(found) - waiting))):
                if self._grid is not None and number >= waiting:
                    # Optuna's grid sampler ends a study by `Study.stop`, which is refused outside of `optimize`.
                    self.study.enqueue_trial(dict(self._grid[len(found) - waiting + number]))
                trial = self.study.ask(dict(distributions))
                self.storage.record_heartbeat(trial._trial_id)
                trial.set_user_attr(_WORKER, worker)
                asked.append(trial)
        return asked

    def trials(self) -> list[FrozenTrial]:
        """All trials but those that were given back and have a copy."""
        found = self.study.get_trials(deepcopy=False)
        replaced = {number for trial in found for number in trial.system_attrs.get(_HISTORY, [])}
        return [trial for trial in found if trial.number not in replaced]

    def report(self, trial: Trial, value: float, step: int) -> None:
        """Record an intermediate value."""
        with _unless_replaced():
            trial.report(value, step)

    def end(
        self,
        trial: Trial,
        value: float | None,
        *,
        pruned: bool = False,
        reason: str | None = None,
        measured: Mapping[str, Any] | None = None,
    ) -> None:
        """End a trial: with its value, pruned, or, if there is no value, as failed for a reason.

        What belongs to somebody else by now, because this worker was taken for dead, is left alone.
        """
        with _unless_replaced():
            if reason is not None:
                trial.set_user_attr(_REASON, reason)
            if measured:
                trial.set_user_attr(MEASURED, dict(measured))
            state = TrialState.PRUNED if pruned else TrialState.FAIL if value is None else TrialState.COMPLETE
            self.study.tell(trial, value if state == TrialState.COMPLETE else None, state)

    def give_back(self, trials: Sequence[Trial], reason: str) -> None:
        """Let somebody else run these trials from their beginning."""
        with self._alone():
            for trial in trials:
                self._give_back(trial._trial_id, reason)

    def close(self) -> None:
        """Let go of the database."""
        self.storage.remove_session()
        self.storage.engine.dispose()

    def holding(self) -> Holding:
        """Heartbeats of trials."""
        return Holding(self.storage, self.beat_s)

    def _retrieve(self) -> None:
        """Give back the trials of dead workers."""
        optuna.storages.fail_stale_trials(self.study)
        for trial in self.study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            if _WORKER not in trial.user_attrs:  # died between asking and the first heartbeat, both under the lock
                self._give_back(trial._trial_id, "its worker died")

    def _give_back(self, trial_id: int, reason: str) -> None:
        with _unless_replaced():
            self.storage.set_trial_user_attr(trial_id, _REASON, reason)
            if self.storage.set_trial_state_values(trial_id, TrialState.FAIL):
                _replace(self.study, self.storage.get_trial(trial_id))

    @contextlib.contextmanager
    def _alone(self) -> Iterator[None]:
        """Nobody else makes, asks or gives back while this lasts; a worker that dies lets go."""
        if self._url.get_backend_name() == "sqlite":
            with Path(f"{self._url.database}.lock").open("w") as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                yield
            return
        engine = sqlalchemy.create_engine(self._url, poolclass=NullPool, connect_args={"connect_timeout": 10})
        with engine.connect() as connection:
            connection.execute(
                sqlalchemy.text("SELECT pg_advisory_lock(:key)"), {"key": zlib.crc32(self._name.encode())}
            )
            yield


class Holding:
    """A thread that records heartbeats of the trials that are held. Compiling can take longer than the grace period."""

    def __init__(self, storage: RDBStorage, beat_s: int) -> None:
        self.trials: dict[int, Trial] = {}
        self._storage = storage
        self._beat_s = beat_s
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()

    def add(self, trials: Sequence[Trial]) -> None:
        """Hold these too."""
        self.trials = self.trials | {trial.number: trial for trial in trials}

    def drop(self, trial: Trial) -> None:
        """Hold this one no longer."""
        self.trials = {number: held for number, held in self.trials.items() if number != trial.number}

    def _run(self) -> None:
        while not self._over.wait(self._beat_s):
            for trial in self.trials.values():
                # a database that cannot be reached for a moment is for the main thread to notice
                with contextlib.suppress(Exception):
                    self._storage.record_heartbeat(trial._trial_id)
        self._storage.remove_session()  # that of this thread


class Cmaes(CmaEsSampler):
    """CMA-ES whose state is worked out anew from the trials.

    Optuna's keeps it pickled in the database, so that whoever can write there could run code here.
    """

    _completed: Sequence[FrozenTrial] = ()

    def _restore_optimizer(self, completed_trials: list[FrozenTrial]) -> None:
        self._completed = completed_trials

    def _init_optimizer(self, trans: Any, direction: StudyDirection) -> Any:
        """The optimiser, told of all whole generations. Optuna's next number for it is then one too few."""
        optimizer = super()._init_optimizer(trans, direction)
        sign = 1 if direction == StudyDirection.MINIMIZE else -1
        size = optimizer.population_size
        while len(told := self._get_solution_trials(list(self._completed), optimizer.generation)) >= size:
            optimizer.tell([(trans.transform(one.params), sign * (one.value or 0.0)) for one in told[:size]])
        return optimizer


def reason(trial: FrozenTrial) -> str:
    """Why a trial failed, or nothing."""
    if trial.state != TrialState.FAIL:
        return ""
    return str(trial.user_attrs.get(_REASON, f"its worker died {RETRIES + 1} times"))


def sqlite_url(path: Path) -> str:
    """The address of the SQLite database in that file."""
    return f"sqlite:///{quote(str(path.absolute()))}"


def sqlalchemy_url(url: str) -> sqlalchemy.URL:
    """The address of a database; raises `UserError` if it is none of SQLite or PostgreSQL."""
    try:
        read = sqlalchemy.make_url(url)
    except sqlalchemy.exc.ArgumentError:
        raise ConfigError(f"--storage: {url!r} is not an address such as postgresql://user@host/database") from None
    if read.get_backend_name() not in ("sqlite", "postgresql") or (read.drivername != "sqlite" and not read.database):
        shown = read.render_as_string()
        raise ConfigError(f"--storage: {shown!r} is not sqlite:///FILE or postgresql://[USER@]HOST/DATABASE")
    if read.get_backend_name() == "sqlite" and not read.database:
        raise ConfigError("--storage: sqlite:// needs a file, sqlite:///FILE")
    return read.set(drivername="postgresql+psycopg") if read.get_backend_name() == "postgresql" else read


@contextlib.contextmanager
def reachable(url: sqlalchemy.URL | str) -> Iterator[None]:
    """Turn what a database refuses into a `UserError` of one line."""
    shown = (url if isinstance(url, sqlalchemy.URL) else sqlalchemy_url(url)).render_as_string()
    try:
        yield
    except ModuleNotFoundError as error:
        raise ConfigError(f"{shown}: needs {error.name}; install it with {extras.install('postgres')}") from None
    except (sqlalchemy.exc.SQLAlchemyError, optuna.exceptions.StorageInternalError, RuntimeError) as error:
        cause = getattr(error, "orig", None) or error.__cause__ or error
        message = " ".join(str(getattr(cause, "orig", cause)).split())
        raise ConfigError(f"{shown}: the database cannot be used: {message[:200]}") from None
    except OSError as error:
        raise ConfigError(f"{shown}: the database cannot be used: {error.strerror}") from None


def product(choices: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """Every combination, the last parameter fastest."""
    return [dict(zip(choices, values, strict=True)) for values in itertools.product(*choices.values())]


def _write_ahead(connection: Any, record: Any) -> None:
    """Readers need not wait for writers, and a commit not for the disk: only a power cut can lose the last ones."""
    connection.execute("PRAGMA journal_mode=WAL")
    connection.execute("PRAGMA synchronous=NORMAL")


def _replace(study: optuna.Study, trial: FrozenTrial, *, retries: int | None = None) -> None:
    """Add a waiting copy of a failed trial, unless it has had its `retries`."""
    trial.user_attrs = {}  # neither its worker nor its reason
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        RetryHeartbeatStaleTrialCallback(max_retry=retries)(study, trial)


@contextlib.contextmanager
def _unless_replaced() -> Iterator[None]:
    """Ignore that a trial has ended already: this worker was taken for dead and somebody else has the trial."""
    with contextlib.suppress(optuna.exceptions.UpdateFinishedTrialError):
        yield


def _difference(saved: Mapping[str, Any], wanted: Mapping[str, Any], prefix: str = "") -> str:
    for key in dict.fromkeys((*wanted, *saved)):
        old, new = saved.get(key), wanted.get(key)
        if isinstance(old, Mapping) and isinstance(new, Mapping) and old != new:
            return _difference(old, new, f"{prefix}{key}.")
        if old != new:
            return f"is of another sweep, with {prefix}{key} {old}, not {new}; choose another --study or --out"
    return "is of another sweep; choose another --study or --out"
