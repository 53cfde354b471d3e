"""From a name to what is judged under it: a bundled model, a checkpoint, a baseline."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from trajectron_model import registry
from trajectron_model.baselines.constant_velocity import ConstantVelocity
from trajectron_model.data.eth_ucy import TEST_SETS
from trajectron_model.data.recording import Recording
from trajectron_model.predictor import Predictor, TrajectronPredictor

LEAVE_ONE_OUT = "leave-one-out"
"""On each test set of ETH/UCY, the bundled model that was trained without it."""

FAMILY = "eth_ucy-without-{test_set}"


class ContenderError(ValueError):
    """A name that stands for nothing which can be judged on the set."""


class InSampleError(ValueError):
    """A model would be judged on a recording that it was trained or selected on."""


@dataclass(frozen=True)
class Contender:
    """One predictor to be judged.

    Attributes:
        predictor: makes the forecasts.
        sha256: of the model's file; empty for a baseline without one.
        seen: the recordings it was trained and selected on, as `Recording.provenance` has
            them; empty for a baseline that learns nothing, None where a model does not say.
    """

    predictor: Predictor
    sha256: str = ""
    seen: tuple[Mapping[str, str], ...] | None = ()

    @classmethod
    def of_model(
        cls, predictor: Predictor, sha256: str, provenance: Mapping[str, object]
    ) -> Contender:
        """A trained model, with what its checkpoint says it was trained and selected on.

        Args:
            predictor: the model's.
            sha256: of the checkpoint.
            provenance: the checkpoint's; ``training`` and ``validation`` hold ``recordings``.
        """
        return cls(predictor, sha256, _recordings_seen(provenance))

    def seen_of(self, recordings: Iterable[Recording]) -> tuple[str, ...]:
        """The names of those recordings that it has seen; all where it does not say."""
        if self.seen is None:
            return tuple(recording.name for recording in recordings)
        names = {recording["name"] for recording in self.seen}
        files = {recording.get("sha256", "") for recording in self.seen} - {""}
        return tuple(
            recording.name
            for recording in recordings
            if recording.name in names or recording.source_sha256 in files
        )

    def refuse_in_sample(self, test_set: str, recordings: Iterable[Recording]) -> None:
        """Raises InSampleError where judging it on these recordings would be in sample."""
        seen = self.seen_of(recordings)
        if not seen:
            return
        name = self.predictor.name
        why = (
            f"{name} does not say what it was trained on"
            if self.seen is None
            else f"{name} was trained or selected on {', '.join(seen)}"
        )
        raise InSampleError(
            f"{why}, so judging it on {test_set} would be in sample; "
            "judge a model trained without it, or ask for an in-sample evaluation"
        )


def resolve(name: str, test_set: str) -> Contender:
    """What an entry of a plan stands for on a test set.

    Args:
        name: ``leave-one-out``, a baseline (`baselines.NAMES`; the learned ones as trained
            without the set), a bundled model, or the path of a checkpoint.
        test_set: of ETH/UCY, or the name of a file's set, for which learned baselines are
            those trained on all recordings.

    Raises:
        ContenderError: no such thing, or not for this set.
        CheckpointError: a model that cannot be loaded.
    """
    if name == LEAVE_ONE_OUT:
        if test_set not in TEST_SETS:
            raise ContenderError(
                f"{LEAVE_ONE_OUT} has a model for each of {', '.join(TEST_SETS)}, "
                f"not for {test_set}; name a model"
            )
        return _model(FAMILY.format(test_set=test_set))
    if name == "constant-velocity":
        return Contender(ConstantVelocity())
    if name == "constant-velocity-noise":
        return Contender(ConstantVelocity(heading_noise_deg=25.0))
    return _model(name)


def _model(name: str) -> Contender:
    checkpoint = registry.load(name)
    predictor = TrajectronPredictor(checkpoint.model, checkpoint.name)
    return Contender.of_model(predictor, checkpoint.sha256, checkpoint.provenance)


def _recordings_seen(provenance: Mapping[str, object]) -> tuple[Mapping[str, str], ...] | None:
    """The recordings in a checkpoint's provenance; None where it does not say."""
    seen: list[Mapping[str, str]] = []
    for role in ("training", "validation"):
        content = provenance.get(role)
        recordings = content.get("recordings") if isinstance(content, Mapping) else None
        if not isinstance(recordings, Sequence):
            return None
        if not all(isinstance(one, Mapping) and "name" in one for one in recordings):
            return None
        seen += recordings
    return tuple(seen)
