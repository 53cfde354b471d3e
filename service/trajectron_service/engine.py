"""The model behind the queue: the only module of the service that imports torch.

Jobs of many scenes run together: all steps that are ready as one batch, round by round, then
all forecasts as another. Everything here runs on the inference thread but loading.
"""

from __future__ import annotations

import struct
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Protocol, cast

import numpy as np
import torch

from trajectron_model import kernels, online, packed, registry
from trajectron_model.packed import Layout, PackedScene
from trajectron_model.state import SceneFrame
from trajectron_model.trajectron import Trajectron
from trajectron_service.draws import forecast_all
from trajectron_service.messages import (
    AgentForecast,
    ForecastMode,
    GraphEdge,
    GraphNode,
    ModelInfo,
    Sampling,
    SceneGraph,
)
from trajectron_service.metrics import Stage
from trajectron_service.scenes import (
    ForecastTask,
    ModelFacts,
    SceneJob,
    SceneResult,
    State,
    States,
)
from trajectron_service.settings import Settings, SettingsError
from trajectron_service.timebase import Grid, Head, Observation, Step, Timeline, advance, head

_LENGTH = struct.Struct("<Q")


class LoadedModel(Protocol):
    """What the engine serves: a checkpoint read from its file (``registry.load``)."""

    @property
    def model(self) -> Trajectron:
        """The network."""
        ...

    @property
    def name(self) -> str:
        """As clients write it."""
        ...

    @property
    def sha256(self) -> str:
        """Of the weights, hexadecimal."""
        ...

    @property
    def provenance(self) -> Mapping[str, object]:
        """Where the weights come from, as JSON values."""
        ...


class Engine:
    """Runs scene jobs on loaded models.

    Args:
        models: the first is the default.
        observe: told the seconds of each stage of each batch, on the inference thread.
    """

    def __init__(
        self,
        models: Sequence[LoadedModel],
        *,
        observe: Callable[[Stage, float], None] = lambda _stage, _seconds: None,
    ) -> None:
        if not models:
            raise ValueError("an engine needs at least one model")
        self._networks = {loaded.name: loaded.model.eval() for loaded in models}
        self._layouts = {n: Layout.of(network.config) for n, network in self._networks.items()}
        self._default = models[0].name
        self._facts = {loaded.name: _facts(loaded, loaded is models[0]) for loaded in models}
        self._observe = observe

    @property
    def models(self) -> Mapping[str, ModelFacts]:
        """The loaded models by name."""
        return self._facts

    @property
    def default_model(self) -> str:
        """The model of requests that name none."""
        return self._default

    def warm_up(self) -> None:
        """Runs every model once in every mode."""
        for name, facts in self._facts.items():
            kind = facts.info.agent_types[0]
            timeline = Timeline(Grid.of(facts.info.dt_s, None, 1e3))
            steps: list[Step] = []
            for k in range(3):
                places = np.array([[0.0, 0.1 * k], [1.0, 0.1 * k]])
                frame = Observation(k * facts.info.dt_s, ("a", "b"), (kind, kind), places)
                taken = advance(timeline, frame)
                timeline = taken.timeline
                steps.extend(taken.steps)
            tasks = tuple(
                ForecastTask(head(timeline), mode, 20, facts.info.horizon, 0, 0, None, False, how)
                for mode in ForecastMode
                for how in Sampling
            )
            self.run([SceneJob(name, (), (), tuple(steps), (), tasks)])

    @torch.inference_mode()
    def run(self, jobs: Sequence[SceneJob]) -> list[SceneResult]:
        """Does all jobs together, in the order given; one fault fails all."""
        tables = [_table(job, self._networks[job.model]) for job in jobs]
        forecasts: list[list[tuple[AgentForecast, ...]]] = [[] for _ in jobs]
        graphs: dict[int, SceneGraph] = {}
        of_model: dict[str, list[int]] = defaultdict(list)
        for index, job in enumerate(jobs):
            of_model[job.model].append(index)
        for name, indices in of_model.items():
            network = self._networks[name]
            start = time.perf_counter()
            _step_all(network, [(jobs[i], tables[i]) for i in indices])
            asked = [(i, task) for i in indices for task in jobs[i].forecasts]
            shown = [(i, jobs[i].graph) for i in indices]
            heads = [(i, task.head) for i, task in asked]
            heads += [(i, seen) for i, seen in shown if seen is not None]
            states = _at_heads(network, [(tables[i], where) for i, where in heads])
            stepped = time.perf_counter()
            if any(jobs[i].steps for i in indices):
                self._observe("encode", stepped - start)
            for (i, _), scene in zip(heads[len(asked) :], states[len(asked) :], strict=True):
                graphs[i] = _graph(network, scene)
            if asked:
                tasks = [task for _, task in asked]
                drawn = forecast_all(network, tasks, states[: len(asked)])
                for (i, _), agents in zip(asked, drawn, strict=True):
                    forecasts[i].append(agents)
                self._observe("sample", time.perf_counter() - stepped)
        return [
            _result(job, table, tuple(forecasts[i]), graphs.get(i), self._layouts[job.model])
            for i, (job, table) in enumerate(zip(jobs, tables, strict=True))
        ]


def load(
    settings: Settings, observe: Callable[[Stage, float], None] = lambda _stage, _seconds: None
) -> Engine:
    """The engine with the models of the settings; sets torch's thread count, once.

    Raises:
        SettingsError: a model cannot be found or read, or two have one name.
    """
    torch.set_num_threads(settings.torch_threads)
    wanted = settings.models or (registry.DEFAULT,)
    first = settings.default_model or wanted[0]
    loaded = []
    for source in (first, *(name for name in wanted if name != first)):
        try:
            loaded.append(registry.load(source))
        except (OSError, ValueError, KeyError) as error:
            raise SettingsError(f"models: cannot load {source!r}: {error}") from error
    names = Counter(checkpoint.name for checkpoint in loaded)
    for name, count in names.items():
        if count > 1:
            raise SettingsError(f"models: {count} models are called {name!r}; rename a file")
    return Engine(loaded, observe=observe)


def pack(scenes: Iterable[PackedScene], layout: Layout) -> bytes:
    """States as bytes: each with its length before it."""
    chunks = [scene.to_bytes(layout) for scene in scenes]
    return b"".join(part for chunk in chunks for part in (_LENGTH.pack(len(chunk)), chunk))


def unpack(data: bytes, layout: Layout) -> tuple[PackedScene, ...]:
    """The inverse of ``pack``; raises ValueError for bytes that are damaged."""
    states = []
    start = 0
    while start < len(data):
        if start + _LENGTH.size > len(data):
            raise ValueError("packed states end within a length")
        (size,) = _LENGTH.unpack_from(data, start)
        start += _LENGTH.size
        if start + size > len(data):
            raise ValueError("packed states end within a state")
        states.append(PackedScene.from_bytes(data[start : start + size], layout))
        start += size
    return tuple(states)


def _facts(loaded: LoadedModel, is_default: bool) -> ModelFacts:
    config = loaded.model.config
    info = ModelInfo(
        name=loaded.name,
        hash=loaded.sha256,
        agent_types=config.node_types,
        dt_s=config.dt_s,
        horizon=config.horizon,
        latent_values=config.latent_values,
        is_default=is_default,
        provenance=loaded.provenance,
        kernels=kernels.in_use(),
    )
    names = config.node_types
    return ModelFacts(
        info,
        {name: config.speed_limit_mps(name) for name in names},
        {(a, b): config.radius_between_m(a, b) for a in names for b in names},
    )


def _live(states: States, network: Trajectron) -> tuple[PackedScene, ...]:
    if isinstance(states, bytes):
        return unpack(states, Layout.of(network.config))
    return tuple(cast("PackedScene", state) for state in states)


def _table(job: SceneJob, network: Trajectron) -> dict[int, PackedScene]:
    """The job's states by serial number."""
    return dict(zip(job.serials, _live(job.states, network), strict=True))


def _source(
    network: Trajectron, table: Mapping[int, PackedScene], source: int | None, drop: frozenset[str]
) -> PackedScene:
    if source is None:
        return packed.blank_scene()
    return packed.without(table[source], drop, network.config) if drop else table[source]


def _frame(observation: Observation) -> SceneFrame:
    return SceneFrame(observation.time_s, observation.ids, observation.types, observation.positions)


def _step_all(network: Trajectron, work: Sequence[tuple[SceneJob, dict[int, PackedScene]]]) -> None:
    """Makes all steps of all jobs, as many at once as are ready; fills the tables."""
    position = [0] * len(work)
    # States that nothing needs any more are let go: a long history would keep hundreds.
    uses = [Counter(step.source for step in job.steps) for job, _ in work]
    for (job, _), counts in zip(work, uses, strict=True):
        counts.update(job.keep)
        counts.update(task.head.source for task in job.forecasts)
        counts.update([job.graph.source] if job.graph else [])
    while True:
        ready: list[tuple[int, Step]] = []
        for index, (job, table) in enumerate(work):
            rest = job.steps[position[index] :]
            for step in rest:
                if step.source is not None and step.source not in table:
                    break
                ready.append((index, step))
                position[index] += 1
        if not ready:
            return
        sources = [_source(network, work[i][1], s.source, s.drop) for i, s in ready]
        states = online.step(network, sources, [_frame(step.frame) for _, step in ready])
        for (index, step), state in zip(ready, states, strict=True):
            table = work[index][1]
            table[step.result] = state
            uses[index][step.source] -= 1
            if step.source is not None and uses[index][step.source] == 0:
                del table[step.source]


def _at_heads(
    network: Trajectron, heads: Sequence[tuple[Mapping[int, PackedScene], Head]]
) -> list[PackedScene]:
    """The state at each head, after its provisional step where it has one."""
    states = [_source(network, table, where.source, where.drop) for table, where in heads]
    provisional = [i for i, (_, where) in enumerate(heads) if where.frame is not None]
    frames = [_frame(where.frame) for _, where in heads if where.frame is not None]
    if provisional:
        stepped = online.step(network, [states[i] for i in provisional], frames)
        for i, state in zip(provisional, stepped, strict=True):
            states[i] = state
    return states


def _graph(network: Trajectron, scene: PackedScene) -> SceneGraph:
    names = network.config.node_types
    records = np.frombuffer(scene.nodes, dtype=Layout.of(network.config).node)
    rows = zip(
        scene.ids,
        records["type"].tolist(),
        records["position"].tolist(),
        records["observations"].tolist(),
        records["last_seen_s"].tolist(),
        strict=True,
    )
    nodes = tuple(GraphNode(i, names[t], x, y, n, s) for i, t, (x, y), n, s in rows)
    edges = tuple(
        GraphEdge(e.receiver_id, e.sender_id, e.age_steps, e.gone_steps, e.modulation)
        for e in packed.edges_of(scene, network.config)
    )
    return SceneGraph(nodes, edges)


def _result(
    job: SceneJob,
    table: Mapping[int, PackedScene],
    forecasts: tuple[tuple[AgentForecast, ...], ...],
    graph: SceneGraph | None,
    layout: Layout,
) -> SceneResult:
    kept = [table[serial] for serial in job.keep]
    return SceneResult(
        states=tuple(State(state) for state in kept),
        packed=pack(kept, layout) if job.pack else None,
        forecasts=forecasts,
        graph=graph,
        edge_count=kept[-1].edge_count if kept else 0,
    )
