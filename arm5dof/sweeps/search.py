"""Search: Optuna chooses the next configuration on a sweep's axes, and says which trials fall behind.

A trial is one configuration, trained with every seed one after the other. Its study is a file of the sweep's folder,
which the driver and all workers read and write.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from arm5dof.errors import UserError
from arm5dof.sweeps.folder import Sweep
from arm5dof.sweeps.groups import shape
from arm5dof.sweeps.spec import SEED, Member, Search, Spec
from arm5dof.sweeps.summary import Headline, estimate
from arm5dof.sweeps.worker import DONE, PRUNED, Job, ended
from arm5dof.training.run import Run

try:
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend
    from optuna.trial import Trial, TrialState
except ImportError:
    raise UserError("a search takes Optuna: pip install 'arm5dof[sweep]'") from None

STUDY = "study.journal"
REDUCTION = 3
"""At each rung of successive halving one of so many trials goes on."""


def _study(path: Path, asked: Search | None = None, higher: bool = False, seed: int = 0) -> optuna.Study:
    """The study in a file, made if there is none."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        sampler: optuna.samplers.BaseSampler = (
            optuna.samplers.TPESampler(seed=seed, constant_liar=True)
            if asked is not None and asked.method == "tpe"
            else optuna.samplers.RandomSampler(seed=seed)
        )
        return optuna.create_study(
            study_name="sweep",
            storage=JournalStorage(JournalFileBackend(str(path))),
            sampler=sampler,
            pruner=optuna.pruners.SuccessiveHalvingPruner(min_resource=1, reduction_factor=REDUCTION),
            direction="maximize" if higher else "minimize",
            load_if_exists=True,
        )


class Trials:
    """The jobs of a search: those of trials that were begun, then new ones."""

    def __init__(self, current: Sweep, loggers: tuple[str, ...] = ()) -> None:
        self._current, self._asked, self._loggers = current, current.spec, loggers
        assert self._asked.search is not None
        self._search = self._asked.search
        path = current.folder / STUDY
        higher = current.headline.metric.higher_is_better
        # Samples after a resumption are others than before it.
        begun = len(_study(path, higher=higher).trials) if path.exists() else 0
        self._study = _study(path, self._search, higher, self._asked.sample_seed + begun)
        running = self._study.get_trials(deepcopy=False, states=[TrialState.RUNNING])
        self._again = [Trial(self._study, trial._trial_id) for trial in running]
        self._shapes: list[Any] = []

    def next(self, group: int | None) -> Job | None:
        """See `Jobs`."""
        if self._again:
            trial = self._again.pop(0)
        elif len(self._study.get_trials(deepcopy=False)) < self._search.trials:
            trial = self._study.ask()
        else:
            return None
        found = _members(self._asked, trial.number, _suggest(trial, self._asked))
        wanted = shape(found[0].config)
        if wanted not in self._shapes:
            self._shapes.append(wanted)
        pruned = (str((self._current.folder / STUDY).absolute()), trial.number) if self._search.prune else None
        return Job.of(
            self._current.members_folder, found, group=self._shapes.index(wanted), trial=pruned, loggers=self._loggers
        )

    def ended(self, job: Job) -> None:
        """Tell Optuna how a trial ended."""
        folder, headline = self._current.members_folder, self._current.headline
        number = int(job.members[0][0].partition("-")[0][1:])
        states = [ending.status if (ending := ended(folder, name)) else "" for name, _ in job.members]
        if all(state == DONE for state in states):
            finals = [Run.open(folder / name).evaluations[-1][headline.name] for name, _ in job.members]
            self._study.tell(number, estimate(map(headline.metric.number, finals)).value)
        else:
            lost = [state for state in states if state != DONE]
            self._study.tell(number, state=TrialState.PRUNED if lost[0] == PRUNED else TrialState.FAIL)


def members(asked: Spec, folder: Path) -> list[Member]:
    """The members of all trials so far."""
    path = folder / STUDY
    if not path.exists():
        return []
    names = [name for name in asked.axes if name != SEED]
    trials = [trial for trial in _study(path).get_trials(deepcopy=False) if set(names) <= set(trial.params)]
    return [m for t in trials for m in _members(asked, t.number, _values(asked, t.params))]


def _members(asked: Spec, number: int, values: dict[str, Any]) -> list[Member]:
    """The members of one trial."""
    several = len(asked.seeds) > 1
    return [
        asked.member(f"t{number:04}" + (f"-{i}" if several else ""), {**values, SEED: seed})
        for i, seed in enumerate(asked.seeds)
    ]


def _suggest(trial: Trial, asked: Spec) -> dict[str, Any]:
    for name, axis in asked.axes.items():
        if name != SEED and axis.values:
            trial.suggest_categorical(name, list(range(len(axis.values))))  # Optuna has no tuples: by number.
        elif name != SEED:
            trial.suggest_float(name, axis.low, axis.high, log=axis.log)
    return _values(asked, trial.params)


def _values(asked: Spec, params: dict[str, Any]) -> dict[str, Any]:
    return {
        name: asked.axes[name].values[value] if asked.axes[name].values else value for name, value in params.items()
    }


def should_stop(path: str, number: int, position: int) -> Callable[[Run], bool]:
    """Asks, after an evaluation, whether a trial is to end.

    Args:
        path: The study's file.
        number: The trial's number.
        position: Which of its seeds is being trained.
    """

    @functools.cache
    def made() -> tuple[Trial, optuna.Study]:
        study = _study(Path(path))
        (found,) = [t for t in study.get_trials(deepcopy=False) if t.number == number]
        return Trial(study, found._trial_id), study

    def ask(run: Run) -> bool:
        trial, _ = made()
        headline, evaluations = Headline.of(run.config), run.evaluations
        if not evaluations:
            return False
        budget = run.config.train
        each = -(-budget.episodes // budget.evaluate_every)
        with warnings.catch_warnings():  # A resumed run reports anew.
            warnings.simplefilter("ignore")
            trial.report(headline.metric.number(evaluations[-1][headline.name]), position * each + len(evaluations))
        return trial.should_prune()

    return ask
