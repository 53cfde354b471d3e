"""Checkpoints: what was saved comes back, and anything else is refused with its reason."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import safetensors.torch
import torch

from trajectron_model import registry
from trajectron_model.checkpoint import Checkpoint, CheckpointError, describe, save
from trajectron_model.config import Dispersion, EdgeRadius, ModelConfig, NodeType
from trajectron_model.forecast import ForecastRequest
from trajectron_model.state import SceneFrame
from trajectron_model.trajectron import Trajectron

PROVENANCE = {"task": "test", "metrics": {"ade": 0.5}}


@pytest.fixture
def saved(tmp_path: Path, model: Trajectron) -> Path:
    save(tmp_path / "small.v1", model, PROVENANCE)
    return tmp_path / "small.v1"


def beside(stem: Path, suffix: str) -> Path:
    return stem.with_name(stem.name + suffix)


def test_a_loaded_model_forecasts_as_the_saved_one(
    saved: Path,
    model: Trajectron,
    crowd: Callable[..., list[SceneFrame]],
    fold: Callable[..., object],
) -> None:
    loaded = Checkpoint.load(saved)
    assert loaded.provenance == PROVENANCE and loaded.model.config == model.config
    states = [fold(network, crowd()) for network in (model, loaded.model)]
    one, other = (
        network.forecast([state], [ForecastRequest(seed=5)])[0]  # type: ignore[list-item]
        for network, state in zip((model, loaded.model), states, strict=True)
    )
    assert one.samples is not None and (one.samples == other.samples).all()


def test_any_of_the_files_names_the_checkpoint(saved: Path) -> None:
    hashes = {
        Checkpoint.load(path).sha256
        for path in (saved, beside(saved, ".json"), str(beside(saved, ".safetensors")))
    }
    assert len(hashes) == 1


def test_a_folder_is_its_model(tmp_path: Path, model: Trajectron) -> None:
    """And bears its name, so that two trainings can be served side by side."""
    for name in ("street", "square"):
        (tmp_path / name).mkdir()
        save(tmp_path / name / "model", model, PROVENANCE)
        assert registry.load(tmp_path / name).name == name
        assert registry.load(tmp_path / name / "model.json").name == name


@pytest.mark.parametrize("suffix", [".json", ".safetensors"])
def test_a_missing_file_is_named(saved: Path, suffix: str) -> None:
    beside(saved, suffix).unlink()
    with pytest.raises(CheckpointError, match=rf"small\.v1\{suffix}: No such file"):
        Checkpoint.load(saved)


@pytest.mark.parametrize("keep", [0, 7, 1000, -1])
def test_truncated_weights_are_refused(saved: Path, keep: int) -> None:
    file = beside(saved, ".safetensors")
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(CheckpointError, match="damaged, truncated"):
        Checkpoint.load(saved)


def test_a_flipped_bit_is_noticed(saved: Path) -> None:
    file = beside(saved, ".safetensors")
    content = bytearray(file.read_bytes())
    content[-5] ^= 1
    file.write_bytes(bytes(content))
    with pytest.raises(CheckpointError, match="sha256"):
        Checkpoint.load(saved)


def rewrite(stem: Path, **changes: object) -> None:
    file = beside(stem, ".json")
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))


def test_weights_of_another_configuration_are_refused(saved: Path, model: Trajectron) -> None:
    rewrite(saved, model={**model.config.to_json(), "history_size": 16})
    with pytest.raises(CheckpointError, match="do not fit the configuration"):
        Checkpoint.load(saved)


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "null", '{"format": 1}', '{"format": 1, "sha256": "", "provenance": {}}'],
)
def test_json_that_is_no_description_is_refused(saved: Path, text: str) -> None:
    beside(saved, ".json").write_text(text)
    with pytest.raises(CheckpointError, match="not the JSON of a checkpoint"):
        describe(saved)


def test_unknown_settings_and_formats_are_refused(saved: Path, model: Trajectron) -> None:
    rewrite(saved, model={**model.config.to_json(), "layers": 3})
    with pytest.raises(CheckpointError, match="unknown model settings: layers"):
        describe(saved)
    rewrite(saved, format=99)
    with pytest.raises(CheckpointError, match="format 99"):
        describe(saved)


@pytest.mark.parametrize(
    ("setting", "value"), [("history_size", "32"), ("edge_size", None), ("decoder_size", 10**9)]
)
def test_settings_that_cannot_be_are_refused_before_anything_is_built(
    saved: Path, model: Trajectron, setting: str, value: object
) -> None:
    rewrite(saved, model={**model.config.to_json(), setting: value})
    with pytest.raises(CheckpointError, match=f"{setting} is "):
        Checkpoint.load(saved)


@pytest.mark.parametrize("types", [["pedestrian"], [["pedestrian"]], [None], [3], "pedestrian", {}])
def test_types_that_are_no_types_are_refused(saved: Path, model: Trajectron, types: object) -> None:
    rewrite(saved, model={**model.config.to_json(), "types": types})
    with pytest.raises(CheckpointError):
        describe(saved)


def test_bottomless_json_is_refused(saved: Path) -> None:
    beside(saved, ".json").write_text("[" * 200_000)
    with pytest.raises(CheckpointError, match="not the JSON of a checkpoint"):
        describe(saved)


def test_weights_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    broken = Trajectron(ModelConfig())
    with torch.no_grad():
        broken.node_model(0).decoder.head.bias[3] = float("nan")
    save(tmp_path / "model", broken, {})
    with pytest.raises(CheckpointError, match=r"head\.bias holds values that are not finite"):
        Checkpoint.load(tmp_path / "model")


def test_a_pickle_is_never_opened(tmp_path: Path, saved: Path) -> None:
    witness = tmp_path / "ran"

    class Bomb:
        def __reduce__(self) -> tuple[object, tuple[object, ...]]:
            return (Path.touch, (witness,))

    for content in (pickle.dumps(Bomb()), b"PK\x03\x04" + pickle.dumps(Bomb())):
        beside(saved, ".safetensors").write_bytes(content)
        with pytest.raises(CheckpointError):
            Checkpoint.load(saved)
        assert not witness.exists()


def test_saving_replaces_whole_files(saved: Path, model: Trajectron) -> None:
    save(saved, model, {"task": "again"})
    assert describe(saved).provenance == {"task": "again"}
    assert not list(saved.parent.glob("*.partial"))


def test_configurations_survive_json() -> None:
    config = ModelConfig(
        types=(NodeType("pedestrian"), NodeType("tree", speed_limit_mps=0.0)),
        radii=(EdgeRadius("pedestrian", "tree", 1.0),),
        removal_filter=(0.5,),
    )
    assert ModelConfig.from_json(json.loads(json.dumps(config.to_json()))) == config


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"types": ()}, "types"),
        ({"types": (NodeType("a"), NodeType("a"))}, "distinct"),
        ({"dt_s": 0.0}, "dt_s"),
        ({"horizon": 61}, "horizon"),
        ({"addition_filter": (0.5,)}, "end at 1"),
        ({"removal_filter": (1.5,)}, "from 0 to 1"),
        ({"radius_m": float("inf")}, "radius_m"),
        ({"history_size": -4}, "history_size is -4"),
        ({"history_size": "32"}, "history_size is '32'"),
        ({"edge_size": None}, "edge_size is None"),
        ({"decoder_size": 2_000_000}, "from 1 to 2048"),
        ({"horizon": True}, "horizon is True"),
        ({"heading_smoothing": "a"}, "heading_smoothing is 'a'"),
        ({"sigma_min_mps": 0}, "sigma_min_mps"),
        ({"sigma_min_mps": 8.0}, "below sigma_max_mps"),
        ({"radii": (EdgeRadius("pedestrian", "pedestrian", 1.0),) * 2}, "twice"),
        ({"radii": (EdgeRadius("pedestrian", "dog", 1.0),)}, "dog"),
        ({"features": "polar"}, "features"),
    ],
)
def test_configurations_that_do_not_hold_together_are_refused(
    settings: dict[str, object], reason: str
) -> None:
    with pytest.raises(ValueError, match=reason):
        ModelConfig(**settings)  # type: ignore[arg-type]


def test_bundled_models_are_small_complete_and_describe_themselves() -> None:
    names = registry.names()
    assert names[0] == registry.DEFAULT
    assert {f"eth_ucy-without-{s}" for s in ("eth", "hotel", "univ", "zara1", "zara2")} <= set(
        names
    )
    for name in names:
        found = registry.load(name)
        size = len(safetensors.torch.save(dict(found.model.state_dict())))
        parameters = sum(p.numel() for p in found.model.parameters())
        assert size < 1_000_000 and parameters <= 200_000
        recordings = found.provenance["training"]["recordings"]
        assert recordings and all(len(r["sha256"]) == 64 for r in recordings)
        assert {"task", "licence", "settings", "selected"} <= set(found.provenance)
        trained_on = {r["name"] for r in recordings}
        if name == "eth_ucy-without-univ":
            assert not trained_on & {"students001", "students003"}


def test_an_unknown_model_is_answered_with_the_known_ones() -> None:
    with pytest.raises(CheckpointError, match=r"nothing: neither a bundled model .*eth_ucy"):
        registry.load("nothing")


def test_the_hash_names_the_configuration_too(tmp_path: Path) -> None:
    # Forecasts follow from both: calibrated anew, a model is another model.
    model = Trajectron(ModelConfig())
    save(tmp_path / "a", model, {})
    calibrated = (NodeType("pedestrian", dispersion=(Dispersion(0.5, 0.0),)),)
    model.config = replace(model.config, types=calibrated)
    save(tmp_path / "b", model, {})
    first, second = describe(tmp_path / "a"), describe(tmp_path / "b")
    assert first.weights_sha256 == second.weights_sha256
    assert first.sha256 != second.sha256
