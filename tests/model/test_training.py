"""Training: it learns, it is reproducible, it resumes, it takes any types, it refuses bad data."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from trajectron_model.checkpoint import Checkpoint, CheckpointError, write_atomically
from trajectron_model.config import ModelConfig, NodeType
from trajectron_model.data.readers import read_apolloscape
from trajectron_model.data.recording import Recording
from trajectron_model.forecast import ForecastRequest
from trajectron_model.training import resuming
from trajectron_model.training.averaging import Average
from trajectron_model.training.examples import Examples, ExampleSettings
from trajectron_model.training.settings import TrainSettings, presets
from trajectron_model.training.trainer import Progress, train
from trajectron_model.trajectron import Trajectron

SMALL = ModelConfig(
    latent_values=4, mixture_components=3, decoder_size=24, horizon=5, observed_steps=4
)
QUICK = TrainSettings(
    steps=12, validate_every=4, threads=1, examples=ExampleSettings(agents=16, agents_per_scene=4)
)


def recording(
    name: str = "made", types: tuple[str, ...] = ("pedestrian",), seed: int = 0, dt_s: float = 0.4
) -> Recording:
    """Agents on gentle curves, each there for a while; obstacles stand still."""
    random = np.random.default_rng(seed)
    rows = []
    for agent in range(12):
        kind = types[agent % len(types)]
        first = int(random.integers(0, 10))
        heading = random.uniform(0.0, 2.0 * np.pi) + 0.05 * np.arange(14)
        speed = 0.0 if kind == "obstacle" else random.uniform(0.8, 1.5)
        step = dt_s * speed * np.stack([np.cos(heading), np.sin(heading)], axis=1)
        track = random.uniform(0.0, 6.0, 2) + step.cumsum(axis=0)
        rows += [(first + t, agent, *place) for t, place in enumerate(track)]
    table = np.array(rows)
    return Recording.from_rows(
        name=name,
        dt_s=dt_s,
        start_time_s=0.0,
        ids=[str(i) for i in range(12)],
        types=[types[i % len(types)] for i in range(12)],
        step=table[:, 0].astype(np.int64),
        agent=table[:, 1].astype(np.int64),
        position=table[:, 2:],
        source_sha256="0" * 64,
    )


def run(folder: Path, settings: TrainSettings = QUICK, **options: object) -> list[Progress]:
    seen: list[Progress] = []
    train(
        SMALL,
        settings,
        [recording()],
        [recording("judge", seed=1)],
        folder,
        provenance={"task": "test"},
        observe=seen.append,
        **options,  # type: ignore[arg-type]
    )
    return seen


def test_the_loss_falls(tmp_path: Path) -> None:
    seen = run(tmp_path, replace(QUICK, steps=60, learning_rate=1e-2, validate_every=60))
    first, last = (np.mean([float(p.terms.nll) for p in part]) for part in (seen[:10], seen[-10:]))
    assert last < first - 3.0


def test_the_same_seed_gives_the_same_weights(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        run(tmp_path / folder)
    run(tmp_path / "c", replace(QUICK, seed=1))
    hashes = [Checkpoint.load(tmp_path / f).sha256 for f in "abc"]
    assert hashes[0] == hashes[1] != hashes[2]


def test_an_interrupted_training_ends_where_an_uninterrupted_one_does(tmp_path: Path) -> None:
    run(tmp_path / "whole")

    class Stop(Exception):
        pass

    def stop_at_six(progress: Progress) -> None:
        if progress.step == 6:
            raise Stop

    with pytest.raises(Stop):
        train(
            SMALL,
            QUICK,
            [recording()],
            [recording("judge", seed=1)],
            tmp_path / "cut",
            provenance={"task": "test"},
            observe=stop_at_six,
        )
    rest = run(tmp_path / "cut", resume=True)
    assert rest[0].step == 5, "it goes on after the last validation, at step 4"
    assert Checkpoint.load(tmp_path / "cut").sha256 == Checkpoint.load(tmp_path / "whole").sha256


def test_a_save_that_is_cut_off_leaves_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(tmp_path / "whole")
    written: list[Path] = []

    def fail_the_second_time(file: Path, content: bytes) -> None:
        written.append(file)
        if len(written) == 2:
            file.with_name(file.name + ".partial").write_bytes(content[: len(content) // 2])
            raise OSError("no space left on device")
        write_atomically(file, content)

    with monkeypatch.context() as patch:
        patch.setattr(resuming, "write_atomically", fail_the_second_time)
        with pytest.raises(OSError, match="no space"):
            run(tmp_path / "cut")
    rest = run(tmp_path / "cut", resume=True)
    assert rest[0].step == 5
    assert Checkpoint.load(tmp_path / "cut").sha256 == Checkpoint.load(tmp_path / "whole").sha256


def test_averaged_weights_are_kept_and_resumed(tmp_path: Path) -> None:
    averaged = replace(QUICK, average_steps=5, calibrate=False)
    run(tmp_path / "whole", averaged)

    def stop_at_six(progress: Progress) -> None:
        if progress.step == 6:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        train(
            SMALL,
            averaged,
            [recording()],
            [recording("judge", seed=1)],
            tmp_path / "cut",
            provenance={"task": "test"},
            observe=stop_at_six,
        )
    run(tmp_path / "cut", averaged, resume=True)
    run(tmp_path / "newest", replace(averaged, average_steps=0))
    hashes = [Checkpoint.load(tmp_path / f).sha256 for f in ("whole", "cut", "newest")]
    assert hashes[0] == hashes[1] != hashes[2]


def test_an_average_is_the_plain_mean_at_first_and_forgets_then() -> None:
    model = Trajectron(SMALL)
    average = Average(model, 3)
    weights = (6.0, 0.0, 3.0, 9.0)
    expected = (6.0, 3.0, 3.0, 3.0 + (9.0 - 3.0) / 3.0)
    for seen, (value, mean) in enumerate(zip(weights, expected, strict=True)):
        with torch.no_grad():
            for parameter in model.parameters():
                parameter.fill_(value)
        average.update(seen)
        for parameter in average.model.parameters():
            torch.testing.assert_close(parameter, torch.full_like(parameter, mean))


def test_a_training_goes_on_from_given_weights_and_never_keeps_worse(tmp_path: Path) -> None:
    bare = replace(QUICK, calibrate=False)
    run(tmp_path / "first", bare)
    start = Checkpoint.load(tmp_path / "first")
    run(tmp_path / "hopeless", replace(bare, learning_rate=5.0), start=start)
    kept = Checkpoint.load(tmp_path / "hopeless")
    assert kept.description.weights_sha256 == start.description.weights_sha256
    assert kept.provenance["selected"]["step"] == 0
    assert kept.provenance["start"]["weights_sha256"] == start.description.weights_sha256
    assert kept.provenance["start"]["settings"] == bare.to_json()


def test_a_start_that_has_seen_other_recordings_is_refused(tmp_path: Path) -> None:
    run(tmp_path / "first", replace(QUICK, steps=1, calibrate=False))
    start = Checkpoint.load(tmp_path / "first")
    with pytest.raises(ValueError, match="trained on other recordings: made"):
        train(
            SMALL,
            QUICK,
            [recording("secret")],
            [recording("judge", seed=1)],
            tmp_path / "second",
            provenance={},
            start=start,
        )
    with pytest.raises(ValueError, match="another configuration"):
        train(
            replace(SMALL, decoder_size=20),
            QUICK,
            [recording()],
            [recording("judge", seed=1)],
            tmp_path / "second",
            provenance={},
            start=start,
        )


def test_a_training_on_other_data_is_not_resumed(tmp_path: Path) -> None:
    run(tmp_path)
    with pytest.raises(ValueError, match="other settings or data"):
        train(
            SMALL,
            QUICK,
            [recording("secret")],
            [recording("judge", seed=1)],
            tmp_path,
            provenance={},
            resume=True,
        )


def test_a_training_of_other_settings_is_not_resumed(tmp_path: Path) -> None:
    run(tmp_path)
    with pytest.raises(ValueError, match="begun with other settings"):
        run(tmp_path, replace(QUICK, learning_rate=0.5), resume=True)
    with pytest.raises(CheckpointError, match="no training to resume"):
        run(tmp_path / "empty", resume=True)


def test_the_best_weights_by_validation_are_kept(tmp_path: Path) -> None:
    seen = run(tmp_path)
    judged = [p for p in seen if p.figures is not None]
    assert [p.step for p in judged] == [4, 8, 12]
    best = min(judged, key=lambda p: p.figures.score)  # type: ignore[union-attr]
    selected = Checkpoint.load(tmp_path).provenance["selected"]
    assert selected["step"] == best.step == judged[-1].best_step
    assert best.figures is not None
    assert selected["validation_figures"]["min_ade_20"] == pytest.approx(best.figures.min_ade_20)


def test_provenance_names_data_settings_and_figures(tmp_path: Path) -> None:
    run(tmp_path)
    facts = json.loads((tmp_path / "model.json").read_text())["provenance"]
    assert facts["task"] == "test"
    assert facts["training"]["recordings"] == [recording().provenance]
    assert facts["validation"]["recordings"][0]["name"] == "judge"
    assert facts["settings"]["seed"] == 0


def test_the_spread_is_fitted_at_the_end_unless_declined(tmp_path: Path) -> None:
    run(tmp_path / "plain", replace(QUICK, calibrate=False))
    run(tmp_path / "fitted")
    plain, fitted = (
        Checkpoint.load(tmp_path / name / "model").model for name in ("plain", "fitted")
    )
    assert plain.config.types[0].dispersion == ()
    assert len(fitted.config.types[0].dispersion) == SMALL.horizon
    for name, weight in plain.state_dict().items():
        torch.testing.assert_close(weight, fitted.state_dict()[name], rtol=0.0, atol=0.0)


def test_batches_follow_from_their_number() -> None:
    examples = Examples([recording()], SMALL, QUICK.examples, seed=3)
    fifth, again, sixth = (examples.batch(number).future for number in (5, 5, 6))
    np.testing.assert_array_equal(fifth, again)
    assert not np.array_equal(fifth, sixth)


def test_examples_are_true_stretches_of_the_recording() -> None:
    made = recording()
    plain = replace(QUICK.examples, mirror=False, scale=0.0, input_noise_m=0.0, pace=0.0)
    batch = Examples([made], SMALL, plain, seed=0).batch(0)
    steps = np.diff(batch.future, axis=1)
    step_of = {
        tuple(np.round(made.position[b] - made.position[a], 9))
        for a in range(len(made.step))
        for b in range(len(made.step))
        if made.agent[a] == made.agent[b] and made.step[b] == made.step[a] + 1
    }
    both = batch.known[:, 1:] & batch.known[:, :-1]
    assert both.any()
    assert {tuple(np.round(s, 9)) for s in steps[both]} <= step_of
    assert batch.known[:, 0].all() and batch.past.present[-1, batch.rows].all()


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_inputs_of_an_example_are_causal(preset: str) -> None:
    """What comes after the newest observed step changes nothing of what is observed."""
    made, now = recording(), 9
    later = made.position.copy()
    later[made.step > now] += 3.0
    config = replace(presets()[preset].model, horizon=5, observed_steps=4)
    scenes = []
    for version in (made, replace(made, position=later)):
        examples = Examples([version], config, QUICK.examples, 0)
        examples._starts = np.array([[0, now]])
        scenes.append(examples._scene(np.random.default_rng(1), 4))
    np.testing.assert_array_equal(scenes[0].past.position, scenes[1].past.position)
    assert (scenes[0].future != scenes[1].future).any()


def test_a_changing_pace_leaves_the_newest_places_and_changes_the_futures() -> None:
    made = recording()
    plain = replace(QUICK.examples, mirror=False, scale=0.0, input_noise_m=0.0)
    usual, paced = (
        Examples([made], SMALL, replace(plain, pace=share), seed=0).batch(0) for share in (0.0, 1.0)
    )
    here = np.flatnonzero(paced.past.present[-1])
    first, second = (index.ravel() for index in np.meshgrid(here, here))
    together = paced.past.scene[first] == paced.past.scene[second]
    newest = paced.past.position[-1]
    between = (newest[first] - newest[second])[together]
    true = (made.position[:, None] - made.position[None]).reshape(-1, 2)
    assert np.abs(between[:, None] - true).max(axis=-1).min(axis=-1).max() < 1e-9
    ratios = []
    for batch in (usual, paced):
        step = np.linalg.norm(np.diff(batch.future[batch.known.all(axis=1)], axis=1), axis=-1)
        ratios.append(step[:, -1] / step[:, 0])
    np.testing.assert_allclose(ratios[0], 1.0)  # they walk at one speed each
    assert ratios[1].min() < 0.9 and np.ptp(ratios[1]) > 0.1


def test_the_papers_inputs_are_places_in_the_world() -> None:
    config = replace(presets()["paper"].model, horizon=5, observed_steps=4)
    settings = replace(QUICK.examples, input_noise_m=0.0)
    made = recording()
    batch = Examples([made], config, settings, 0).batch(0)
    places = {tuple(p) for p in made.position}
    assert {tuple(p) for p in batch.past.position[-1, batch.rows]} <= places


@pytest.mark.parametrize(
    ("broken", "reason"),
    [
        (recording(dt_s=0.5), "steps of 0.5 s, the model 0.4 s"),
        (recording(types=("dog",)), "unknown agent type 'dog'"),
        (recording(types=("pedestrian",)).between(0, 1), "two consecutive steps"),
    ],
)
def test_data_that_do_not_fit_are_refused(tmp_path: Path, broken: Recording, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        train(SMALL, QUICK, [broken], [recording()], tmp_path, provenance={})


def test_the_papers_inputs_train_too(tmp_path: Path) -> None:
    config = replace(presets()["paper"].model, decoder_size=24, horizon=5, observed_steps=4)
    settings = replace(presets()["paper"].train, steps=3, validate_every=3, threads=1)
    settings = replace(settings, examples=replace(settings.examples, agents=16))
    checkpoint = train(
        config, settings, [recording()], [recording("judge")], tmp_path, provenance={}
    )
    scale = checkpoint.model.state_dict()["features.std"]
    assert (scale[0, :2] > 0.5).all() and scale[0, :2].max() != 1.0


def test_obstacles_are_context_and_never_targets(tmp_path: Path) -> None:
    config = replace(
        SMALL, types=(NodeType("pedestrian"), NodeType("obstacle", speed_limit_mps=0.0))
    )
    made = recording(types=("pedestrian", "obstacle"))
    batch = Examples([made], config, QUICK.examples, 0).batch(0)
    assert (batch.past.node_type[batch.rows] == 0).all() and (batch.past.node_type == 1).any()
    judge = recording("judge", types=("pedestrian", "obstacle"), seed=1)
    checkpoint = train(config, QUICK, [made], [judge], tmp_path, provenance={})
    torch.manual_seed(QUICK.seed)
    before = Trajectron(config).state_dict()
    after = checkpoint.model.state_dict()
    key = "nodes.0.history.edges.1.weight_ih"
    assert not torch.equal(before[key], after[key]), "what obstacles mean to pedestrians is learnt"


def test_three_types_train_predict_save_and_load_on_real_traffic(
    tmp_path: Path, data_folder: Path
) -> None:
    files = sorted((data_folder / "apolloscape").glob("*.txt"))[:4]
    if not files:
        pytest.skip("no ApolloScape recordings in TRAJECTRON_DATA")
    recordings = [read_apolloscape(f) for f in files]
    preset = presets()["traffic"]
    config = replace(preset.model, decoder_size=32, latent_values=5, mixture_components=4)
    settings = replace(preset.train, steps=30, validate_every=15, threads=1)
    settings = replace(settings, examples=replace(settings.examples, agents=48))
    seen: list[Progress] = []
    checkpoint = train(
        config,
        settings,
        recordings[:3],
        recordings[3:],
        tmp_path,
        provenance={},
        observe=seen.append,
    )
    early, late = (np.mean([float(p.terms.nll) for p in s]) for s in (seen[:5], seen[-5:]))
    assert late < early - 3.0
    model = checkpoint.model
    assert len(model.node_model(0).history.edges) == 3, "nine directed edge types in all"
    state = model.initial_state()
    for step in range(recordings[3].num_steps):
        (state,) = model.step([state], [recordings[3].frame(step)])
    found = model.forecast([state], [ForecastRequest(num_samples=10, include_modes=True)])[0]
    assert set(found.types) == {"pedestrian", "vehicle", "cyclist"}
    assert found.samples is not None and np.isfinite(found.samples).all()
    again = Checkpoint.load(tmp_path).model.forecast([state], [ForecastRequest(num_samples=10)])
    assert again[0].samples is not None and (again[0].samples == found.samples).all()
