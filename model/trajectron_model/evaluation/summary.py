"""From the scores of all agents to the evaluation: rows, groups, comparisons."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from trajectron_model.evaluation import statistics
from trajectron_model.evaluation.contenders import Contender
from trajectron_model.evaluation.results import (
    Comparison,
    Evaluation,
    Fingerprint,
    GroupScores,
    Row,
    SetScores,
)
from trajectron_model.evaluation.scores import AgentScores, Float
from trajectron_model.evaluation.sets import TestSet
from trajectron_model.evaluation.statistics import Sample, Values

COMPARED = (
    "ade_mean", "fde_mean", "ade_sample", "fde_sample", "min_ade_20", "min_fde_20",
    "joint_ade_100", "joint_fde_100", "nll_kde",
)  # fmt: skip
"""Metrics that entries are compared by, where both have them."""

AT_LEAST = (1, 2, 4, 8)
"""Thresholds of observations seen that scores are broken down by."""

FEW = (1, 2, 3)
"""Observations seen that are shown by themselves."""

STEPS_IN_GROUPS = ("distance_mean", "distance_mode", "min_distance_20", "nll_kde", "nll_mixture")
"""Metrics whose horizon steps are shown for groups of agents too."""

_Key = tuple[str, str]  # what groups agents, and the group


def evaluation(
    fingerprint: Fingerprint,
    test_sets: Sequence[TestSet],
    contenders: Mapping[tuple[str, str], Contender],
    scores: Mapping[tuple[str, str], AgentScores],
) -> Evaluation:
    """The evaluation.

    Args:
        fingerprint: of it.
        test_sets: in order.
        contenders, scores: of every (entry, set).
    """
    plan = fingerprint.plan
    weights = {
        one.name: statistics.resample(len(one.windows), plan.bootstrap, plan.seed, one.name)
        for one in test_sets
    }
    rows = tuple(_row(entry, test_sets, contenders, scores, weights) for entry in plan.entries)
    return Evaluation(fingerprint, rows, tuple(_comparisons(plan.entries, test_sets, scores)))


def _row(
    entry: str,
    test_sets: Sequence[TestSet],
    contenders: Mapping[tuple[str, str], Contender],
    scores: Mapping[tuple[str, str], AgentScores],
    weights: Mapping[str, Float],
) -> Row:
    found: list[SetScores] = []
    samples: list[Sample] = []
    by_group: dict[_Key, list[Sample]] = {}
    for test_set in test_sets:
        name = test_set.name
        of, contender = scores[entry, name], contenders[entry, name]
        values = Values.of(of, len(test_set.windows))
        whole = Sample.of(values, weights[name])
        groups = {
            key: Sample.of(values.only(chosen, STEPS_IN_GROUPS), weights[name])
            for key, chosen in _groups(of)
        }
        samples.append(whole)
        for key, sample in groups.items():
            by_group.setdefault(key, []).append(sample)
        found.append(
            SetScores(
                name,
                contender.predictor.name,
                contender.sha256,
                bool(contender.seen_of(test_set.recordings)),
                "mixture" if "nll_mixture" in of.columns else "kde",
                whole.scores(),
                tuple(GroupScores(*key, sample.scores()) for key, sample in groups.items()),
            )
        )
    means = tuple(
        GroupScores(*key, statistics.mean_of_sets(parts)) for key, parts in by_group.items()
    )
    return Row(
        entry,
        any(one.in_sample for one in found),
        tuple(found),
        statistics.mean_of_sets(samples),
        statistics.pooled(samples),
        means,
    )


def _groups(scores: AgentScores) -> Iterator[tuple[_Key, NDArray[np.bool_]]]:
    """The groups that a set's agents fall into, where they are not all in one."""
    kinds = np.unique(scores.type).tolist()
    if len(kinds) > 1:
        for kind in kinds:
            yield ("type", kind), scores.type == kind
    seen = scores.observations
    if seen.min() == seen.max():
        return
    for few in FEW:
        if (seen == few).any():
            yield ("observations", f"{few}"), seen == few
    for least in AT_LEAST:
        if (seen >= least).any():
            yield ("observations", f"at least {least}"), seen >= least


def _comparisons(
    entries: Sequence[str],
    test_sets: Sequence[TestSet],
    scores: Mapping[tuple[str, str], AgentScores],
) -> Iterator[Comparison]:
    """Every pair of entries, on every set and over the windows of all."""
    for first, second in combinations(entries, 2):
        for metric in COMPARED:
            pairs: dict[str, tuple[Float, Float]] = {}
            for test_set in test_sets:
                of = [scores[entry, test_set.name] for entry in (first, second)]
                if all(metric in one.columns for one in of):
                    one, other = (
                        statistics.window_means(part, metric, len(test_set.windows)) for part in of
                    )
                    pairs[test_set.name] = one, other
            if len(pairs) == len(test_sets) > 1:
                one, other = (np.concatenate(side) for side in zip(*pairs.values(), strict=True))
                pairs[""] = one, other
            for name, sides in pairs.items():
                test = statistics.paired_t_test(*sides)
                if test is not None:
                    yield Comparison(first, second, metric, name, *_fields(test))


def _fields(test: statistics.PairedTest) -> tuple[int, float, float, float]:
    """Its numbers, in the order of a comparison's."""
    return test.pairs, test.difference, test.t, test.p
