"""What a plan calls the models that lie beside it, and what clients call them.

A bundled model or a baseline of the same name would win over a bare name; it does not win over
a path.
"""

from __future__ import annotations

from dataclasses import replace

from trajectron_model.evaluation.results import Comparison, Evaluation, Row

_BESIDE = "./"


def beside(name: str) -> str:
    """The entry of a model, or a variant of one, that lies beside the plan."""
    return _BESIDE + name


def asked(entry: str) -> str:
    """The name that was asked for, of any entry; no such name begins as a path does."""
    return entry.removeprefix(_BESIDE)


def as_asked(evaluation: Evaluation) -> Evaluation:
    """The evaluation with every entry under the name that was asked for."""
    fingerprint = evaluation.fingerprint
    plan = replace(fingerprint.plan, entries=tuple(map(asked, fingerprint.plan.entries)))
    return Evaluation(
        replace(fingerprint, plan=plan),
        tuple(_row_as_asked(row) for row in evaluation.rows),
        tuple(_comparison_as_asked(one) for one in evaluation.comparisons),
    )


def _row_as_asked(row: Row) -> Row:
    return replace(row, name=asked(row.name))


def _comparison_as_asked(one: Comparison) -> Comparison:
    return replace(one, first=asked(one.first), second=asked(one.second))
