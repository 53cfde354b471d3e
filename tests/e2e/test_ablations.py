"""The ablations: each variant differs in one thing; the table's changes are paired by seed."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

import pytest

from benchmarks import ablations
from trajectron_model.data.eth_ucy import EthUcy

DATA = Path(os.environ.get("TRAJECTRON_DATA", Path(__file__).parents[2] / "../shared/data"))


def flat(value: Any, name: str = "") -> dict[str, Any]:
    if not isinstance(value, dict):
        return {name: value}
    return {k: v for key, part in value.items() for k, v in flat(part, f"{name}.{key}").items()}


def test_every_variant_differs_from_the_default_in_one_thing() -> None:
    presets = ablations.variants()
    base = flat(dataclasses.asdict(presets.pop("default")))
    changed = {
        name: {key for key, value in flat(dataclasses.asdict(preset)).items() if base[key] != value}
        for name, preset in presets.items()
    }
    assert all(len({key.rpartition(".")[0] for key in keys}) == 1 for keys in changed.values())
    assert changed["no changing pace"] == {".train.examples.pace"}
    assert len(changed) == 9


def run(variant: str, seed: int, ade: float) -> ablations.Run:
    names = [name for pair in ablations.SHOWN.values() for name in pair]
    figures = {group: dict.fromkeys(names, ade) for group in ("known", *ablations.UNSEEN)}
    return ablations.Run(variant, seed, 10, "key", figures)


def test_changes_are_means_over_seeds_that_both_have() -> None:
    runs = [run("default", 0, 1.0), run("default", 1, 2.0), run("default", 2, 9.0)]
    runs += [run("no dropout", 0, 1.1), run("no dropout", 1, 2.6)]
    rows = [line for line in ablations.table(runs).splitlines() if line.startswith("| no dropout")]
    # +10% and +30%: 20% with a standard error of 10%.
    assert rows[0].startswith("| no dropout | 2 | 1.850/1.850 |")
    assert rows[0].count("+20.0 ± 10.0 %") == 3


@pytest.mark.timeout(600)
@pytest.mark.skipif(not (DATA / "eth_ucy").is_dir(), reason="no ETH/UCY data")
def test_another_training_never_stands_in_for_a_variant(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ablations, "JUDGED_AGENTS", 10)
    data, preset = EthUcy(DATA), ablations.variants()["no dropout"]
    done = ablations.measure("no dropout", preset, 0, 1, data, tmp_path / "run")
    assert done.key == ablations.key_of(preset, 0, 1, data)
    keys = {
        ablations.key_of(preset, seed, steps, data) for seed, steps in ((0, 1), (1, 1), (0, 2))
    } | {ablations.key_of(ablations.variants()["default"], 0, 1, data)}
    assert len(keys) == 4
    assert set(done.figures) == {"known", "ETH", "Univ"}
