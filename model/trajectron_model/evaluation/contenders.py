"""From a name to what is judged under it: a bundled model, a checkpoint, a baseline.

``NAME@VARIANT`` asks for the same model otherwise: ``@z_best`` forecasts its most probable mode
alone, ``@stratified`` draws stratified samples, and ``paper-leaky@seed-2`` is of another training.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from trajectron_model import registry
from trajectron_model.baselines import registry as baselines
from trajectron_model.data.eth_ucy import TEST_SETS
from trajectron_model.data.recording import Recording
from trajectron_model.predictor import Predictor, TrajectronPredictor

LEAVE_ONE_OUT = "leave-one-out"
"""On each test set of ETH/UCY, the bundled model that was trained without it."""

FAMILY = "eth_ucy-without-{test_set}"

PAPER_LEAKY = "paper-leaky"
"""The paper's model under the paper's conditions, inputs that contain the future included."""

Z_BEST, STRATIFIED = "z_best", "stratified"


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
        independent: whether its samples are, so that some of them are what asking for fewer
            would have given.
    """

    predictor: Predictor
    sha256: str = ""
    seen: tuple[Mapping[str, str], ...] | None = ()
    independent: bool = True

    @classmethod
    def of_model(
        cls,
        predictor: Predictor,
        sha256: str,
        provenance: Mapping[str, object],
        *,
        independent: bool = True,
    ) -> Contender:
        """A trained model, with what its checkpoint says it was trained and selected on.

        Args:
            predictor: the model's.
            sha256: of the checkpoint.
            provenance: the checkpoint's; ``training`` and ``validation`` hold ``recordings``.
            independent: see the class.
        """
        return cls(predictor, sha256, _recordings_seen(provenance), independent)

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


def resolve(name: str, test_set: str, recordings: Sequence[Recording] = ()) -> Contender:
    """What an entry of a plan stands for on a test set.

    Args:
        name: ``leave-one-out``, a baseline (`baselines.registry.NAMES`; the learned ones as
            trained without the set), a bundled model, the path of a checkpoint, or
            ``paper-leaky``; with a variant, as the module says.
        test_set: of ETH/UCY, or the name of a file's set, for which learned baselines are
            those trained on all recordings.
        recordings: the set's; only ``paper-leaky`` looks at them, which is why it is fenced.

    Raises:
        ContenderError: no such thing, or not for this set.
        CheckpointError: a model that cannot be loaded.
    """
    base, _, variant = name.partition("@")
    if base == PAPER_LEAKY:
        return _paper_leaky(test_set, recordings, variant)
    if base in baselines.NAMES:
        if variant:
            raise ContenderError(f"{name}: baselines have no variants")
        return _baseline(base, test_set if test_set in TEST_SETS else None)
    if base != LEAVE_ONE_OUT:
        return _model(base, variant)
    if test_set not in TEST_SETS:
        raise ContenderError(
            f"{LEAVE_ONE_OUT} has a model for each of {', '.join(TEST_SETS)}, "
            f"not for {test_set}; name a model"
        )
    return _model(FAMILY.format(test_set=test_set), variant)


def _model(name: str, variant: str) -> Contender:
    if variant not in ("", Z_BEST, STRATIFIED):
        raise ContenderError(f"{name}@{variant}: the variants are {Z_BEST} and {STRATIFIED}")
    checkpoint = registry.load(name)
    predictor = TrajectronPredictor(
        checkpoint.model,
        f"{checkpoint.name}@{variant}" if variant else checkpoint.name,
        mode="z_best" if variant == Z_BEST else "full",
        sampling="stratified" if variant == STRATIFIED else "iid",
    )
    return Contender.of_model(
        predictor,
        checkpoint.sha256,
        checkpoint.provenance,
        independent=variant != STRATIFIED,
    )


def _baseline(name: str, test_set: str | None) -> Contender:
    predictor = baselines.baseline(name, test_set)
    if name not in baselines.LEARNED:
        return Contender(predictor)
    sha256, provenance = baselines.sha256(name, test_set), baselines.provenance(name, test_set)
    return Contender.of_model(predictor, sha256, provenance)


def _paper_leaky(test_set: str, recordings: Sequence[Recording], variant: str) -> Contender:
    if test_set not in TEST_SETS:
        raise ContenderError(
            f"{PAPER_LEAKY} reproduces the paper's table on {', '.join(TEST_SETS)} alone, "
            f"not on {test_set}"
        )
    seed = variant.removeprefix("seed-") if variant else "0"
    if not seed.isdecimal() or variant not in ("", f"seed-{seed}"):
        raise ContenderError(f"{PAPER_LEAKY}@{variant}: its variants are @seed-0, @seed-1, ...")
    # Imported here alone: nothing else of ours loads it, least of all what serves.
    from trajectron_model.paper_leaky.predictor import bundled  # noqa: PLC0415

    found = bundled(test_set, recordings, seed=int(seed))
    return Contender.of_model(found.predictor, found.sha256, found.provenance)


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
