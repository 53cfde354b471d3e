"""What a request for an evaluation leaves open, chosen; what it asks for, checked."""

from __future__ import annotations

import dataclasses
import hashlib
import re
import secrets
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import orjson

from trajectron_model import registry
from trajectron_model.baselines.registry import NAMES as BASELINES
from trajectron_model.data.errors import DataError
from trajectron_model.data.eth_ucy import TEST_SETS, EthUcy
from trajectron_model.evaluation.contenders import LEAVE_ONE_OUT, STRATIFIED, Z_BEST
from trajectron_model.evaluation.plan import EvaluationPlan
from trajectron_service.errors import ErrorKind, FieldViolation, ServiceError, invalid
from trajectron_service.evaluations import entries
from trajectron_service.evaluations.folders import MODEL_SUFFIXES, RECORDINGS
from trajectron_service.evaluations.messages import EvaluationConfig, RecordingFile
from trajectron_service.settings import Settings
from trajectron_service.validation import quoted

DATASET = "eth_ucy"
"""The one data set that a server knows, where it has been given its folder."""

VARIANTS = (Z_BEST, STRATIFIED)
"""Of a model, asked for as ``NAME@VARIANT``; baselines have none."""

MAX_MODELS = 32
MAX_FILES = 16
MAX_WINDOWS = 10**9
MAX_FRAMES_PER_STEP = 10_000
SEED_BOUND = 2**63
DEFAULT_SAMPLES = 100
DEFAULT_FRAMES_PER_STEP = 10

_ID = re.compile(r"[A-Za-z0-9._-]{1,128}")
# The suffix keeps what clients send from ever being taken for anything but data.
_FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,59}\.(csv|txt)")


class EvaluationChoices:
    """Resolves requests against the settings and the models at hand.

    Args:
        settings: the limits, and where the data set is.
        served: the files of the served models by name, without their suffixes.
    """

    def __init__(self, settings: Settings, served: Mapping[str, Path]) -> None:
        self._settings = settings
        self._bundled = registry.names()
        self._served = {
            name: stem
            for name, stem in served.items()
            if name not in self._bundled or stem != registry.locate(name)
        }

    @property
    def models(self) -> tuple[str, ...]:
        """Every name that can be judged, without variants."""
        names = (*self._served, *self._bundled, LEAVE_ONE_OUT, *BASELINES)
        return tuple(dict.fromkeys(names))

    @property
    def data_folder(self) -> Path:
        """The data set's folder.

        Raises:
            ServiceError: ``DATASET_UNAVAILABLE``.
        """
        return self._benchmark().folder.resolve()

    def resolve(self, config: EvaluationConfig, files: Sequence[RecordingFile]) -> EvaluationConfig:
        """The configuration with every field set.

        Raises:
            ServiceError: ``INVALID_ARGUMENT`` naming the field, ``UNKNOWN_MODEL``, or
                ``DATASET_UNAVAILABLE``.
        """
        self._check_models(config.models)
        sets = self._sets(config, files)
        _check_family(config.models, sets)
        if config.max_windows is not None:
            _whole("max_windows", config.max_windows, 1, 1, MAX_WINDOWS)
        return dataclasses.replace(
            config,
            sets=sets,
            num_samples=_whole(
                "num_samples", config.num_samples, DEFAULT_SAMPLES, 1, self._settings.max_samples
            ),
            seed=_whole("seed", config.seed, 0, 0, SEED_BOUND - 1),
            frames_per_step=_whole(
                "frames_per_step",
                config.frames_per_step,
                DEFAULT_FRAMES_PER_STEP,
                1,
                MAX_FRAMES_PER_STEP,
            ),
        )

    def plan(self, config: EvaluationConfig, files: Iterable[str]) -> EvaluationPlan:
        """A resolved configuration as the harness takes it, relative to the plan's folder."""
        assert config.num_samples is not None and config.seed is not None  # resolved
        assert config.frames_per_step is not None
        return EvaluationPlan(
            entries=tuple(self._entry(name) for name in config.models),
            sets=config.sets if config.dataset else (),
            files=tuple(f"{RECORDINGS}/{name}" for name in files),
            protocol=config.protocol.value,
            samples=config.num_samples,
            seed=config.seed,
            in_sample=config.in_sample,
            max_windows=config.max_windows,
            frames_per_step=config.frames_per_step,
        )

    def model_files(self, config: EvaluationConfig) -> dict[str, Path]:
        """The models that have to lie beside the plan, as ``served`` of the constructor."""
        bases = dict.fromkeys(name.partition("@")[0] for name in config.models)
        return {base: self._served[base] for base in bases if base in self._served}

    def _entry(self, name: str) -> str:
        return entries.beside(name) if name.partition("@")[0] in self._served else name

    def _knows(self, name: str) -> bool:
        base, at, variant = name.partition("@")
        return base in self.models and (not at or (variant in VARIANTS and base not in BASELINES))

    def _check_models(self, models: Sequence[str]) -> None:
        if not 1 <= len(models) <= MAX_MODELS:
            raise invalid("models", f"has {len(models)} names; must be 1 to {MAX_MODELS}")
        for place, name in enumerate(models):
            field = f"models[{place}]"
            if name in models[:place]:
                raise invalid(field, f"{quoted(name)} is also models[{models.index(name)}]")
            if not self._knows(name):
                names = ", ".join(map(quoted, self.models))
                raise ServiceError(
                    ErrorKind.UNKNOWN_MODEL,
                    f"{field}: {quoted(name)} is unknown; this server has {names}",
                    violations=(FieldViolation(field, f"must be one of {names}"),),
                )

    def _sets(self, config: EvaluationConfig, files: Sequence[RecordingFile]) -> tuple[str, ...]:
        if not files:
            return self._sets_of_dataset(config)
        if config.dataset:
            raise invalid("dataset", "is given, and recordings are sent along; one of them is it")
        if config.sets:
            raise invalid("sets", "are of a data set; recordings sent along are sets by themselves")
        return _sets_of_files(files)

    def _sets_of_dataset(self, config: EvaluationConfig) -> tuple[str, ...]:
        if not config.dataset:
            raise invalid("dataset", "is missing; name one, or send recordings along")
        if config.dataset != DATASET:
            raise invalid("dataset", f"{quoted(config.dataset)} is unknown; must be {DATASET}")
        known = tuple(self._benchmark().test_sets)
        for place, name in enumerate(config.sets):
            field = f"sets[{place}]"
            if name not in known:
                raise invalid(
                    field, f"{quoted(name)} is unknown; must be one of {', '.join(known)}"
                )
            if name in config.sets[:place]:
                raise invalid(field, f"{quoted(name)} is also sets[{config.sets.index(name)}]")
        return config.sets or known

    def _benchmark(self) -> EthUcy:
        if self._settings.data is None:
            raise _unavailable("it was started without the data folder")
        try:
            return EthUcy(self._settings.data)
        except DataError as error:
            # The place is the operator's to know, not the client's.
            raise _unavailable(error.reason) from error


def digest(evaluation_id: str, config: EvaluationConfig, files: Iterable[RecordingFile]) -> str:
    """The sha256 of a request's content: equal for requests that ask for the same."""
    content = hashlib.sha256()
    content.update(orjson.dumps([evaluation_id, dataclasses.asdict(config)]))
    for file in files:
        content.update(orjson.dumps([file.name, len(file.content)]))
        content.update(file.content)
    return content.hexdigest()


def _sets_of_files(files: Sequence[RecordingFile]) -> tuple[str, ...]:
    if len(files) > MAX_FILES:
        raise invalid("files", f"has {len(files)} files; may have at most {MAX_FILES}")
    sets: list[str] = []
    for place, file in enumerate(files):
        field = f"files[{place}]"
        if not _FILE_NAME.fullmatch(file.name):
            raise invalid(
                f"{field}.name",
                f"{quoted(file.name)} is not up to 64 of letters, digits, '.', '_', '-' that end "
                "in .csv or .txt",
            )
        name = file.name[: -len(".csv")]
        if name in sets:
            raise invalid(f"{field}.name", f"{name} is the set of files[{sets.index(name)}] too")
        sets.append(name)
    return tuple(sets)


def _check_family(models: Sequence[str], sets: Sequence[str]) -> None:
    """A family has no member for a recording that was sent along."""
    foreign = [name for name in sets if name not in TEST_SETS]
    family = [place for place, name in enumerate(models) if name.startswith(LEAVE_ONE_OUT)]
    if family and foreign:
        raise invalid(
            f"models[{family[0]}]",
            f"{LEAVE_ONE_OUT} has a model for each of {', '.join(TEST_SETS)}, none for "
            f"{foreign[0]}; name a model",
        )


def _whole(field: str, value: int | None, default: int, least: int, most: int) -> int:
    """A number of a request, or its default; raises for one out of its bounds."""
    if value is None:
        return min(default, most)
    if not least <= value <= most:
        raise invalid(field, f"is {value}; must be {least} to {most}")
    return value


def _unavailable(reason: str) -> ServiceError:
    return ServiceError(
        ErrorKind.DATASET_UNAVAILABLE,
        f"dataset: this server has not got {DATASET} ({reason}); set TRAJECTRON_DATA to the "
        "folder of its recordings, or send recordings along",
        violations=(FieldViolation("dataset", f"{DATASET} is not at hand: {reason}"),),
    )


def evaluation_id(wanted: str) -> str:
    """A valid id: the one wanted, or a new one for an empty one."""
    if not wanted:
        return secrets.token_hex(12)
    if not _ID.fullmatch(wanted):
        raise invalid(
            "evaluation_id", f"{quoted(wanted)} is not 1 to 128 of letters, digits, '.', '_', '-'"
        )
    return wanted


def served_files(settings: Settings) -> dict[str, Path]:
    """Where the files of the served models are, by name, without their suffixes.

    Raises:
        CheckpointError: a model that is not there.
    """
    found = {}
    for given in settings.models:
        path = registry.locate(given).resolve()
        if path.is_dir():
            path /= "model"
        elif path.suffix in MODEL_SUFFIXES:
            path = path.with_suffix("")
        found[registry.describe(given).name] = path
    return found
