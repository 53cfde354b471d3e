"""The configuration of a Trajectron: every size and every choice, stored in its checkpoint."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, cast

# The fastest a person has run (Graubner & Nixdorf 2011; paper, section "The Trajectron").
PEDESTRIAN_SPEED_LIMIT_MPS = 12.42
MAX_HORIZON = 60
MAX_SAMPLES = 2000
# Analytic forecasts leave out the latent values that are less probable than this.
MODE_PROBABILITY_FLOOR = 0.002

# Bounds far beyond any use: a damaged file cannot ask for gigabytes.
_LARGEST = {
    "horizon": MAX_HORIZON,
    "observed_steps": 1000,
    "history_size": 1024,
    "edge_size": 1024,
    "attention_size": 1024,
    "future_size": 1024,
    "latent_values": 1024,
    "latent_hidden_size": 1024,
    "decoder_size": 2048,
    "mixture_components": 256,
}
_RANGES = {
    "dt_s": (1e-3, 60.0),
    "radius_m": (1e-3, 1e4),
    "heading_smoothing": (1e-3, 1.0),
    "heading_min_speed_mps": (0.0, 1e3),
    "sigma_min_mps": (1e-6, 1e3),
    "sigma_max_mps": (1e-6, 1e3),
}


def _check_count(name: str, value: object, most: int) -> None:
    if type(value) is not int or not 1 <= value <= most:
        raise ValueError(f"{name} is {value!r}; it must be a whole number from 1 to {most}")


def _check_number(name: str, value: object, least: float, most: float) -> None:
    number = type(value) in (int, float)
    if not number or not least <= cast("float", value) <= most:
        raise ValueError(f"{name} is {value!r}; it must be a number from {least:g} to {most:g}")


class Dispersion(NamedTuple):
    """How the standard deviations of analytic modes are corrected at one step.

    See ``dispersion.disperse``; (1, 0) leaves them as they are.
    """

    factor: float
    contrast: float


@dataclass(frozen=True)
class NodeType:
    """A type of agent.

    Attributes:
        name: as clients write it.
        speed_limit_mps: bound on sampled speeds; 0 makes the type stationary (an obstacle):
            it influences others and is never forecast to move.
        speed_scale_mps: the unit of speed inside the network, about the type's usual speed.
        dispersion: of analytic modes, at each step, fitted on validation data; the last holds
            beyond. Empty before it is fitted.
    """

    name: str
    speed_limit_mps: float = PEDESTRIAN_SPEED_LIMIT_MPS
    speed_scale_mps: float = 1.0
    dispersion: tuple[Dispersion, ...] = ()

    def __post_init__(self) -> None:
        if type(self.name) is not str or not self.name:
            raise ValueError("a node type needs a name, a text")
        _check_number(f"speed_limit_mps of {self.name!r}", self.speed_limit_mps, 0.0, 1e4)
        _check_number(f"speed_scale_mps of {self.name!r}", self.speed_scale_mps, 1e-3, 1e4)
        for factor, contrast in self.dispersion:
            _check_number(f"a factor of dispersion of {self.name!r}", factor, 1e-2, 1e2)
            _check_number(f"a contrast of dispersion of {self.name!r}", contrast, -5.0, 5.0)

    @property
    def stationary(self) -> bool:
        """Whether agents of this type never move."""
        return self.speed_limit_mps == 0.0


@dataclass(frozen=True)
class EdgeRadius:
    """The distance within which two types influence each other: an undirected edge."""

    first: str
    second: str
    radius_m: float


@dataclass(frozen=True)
class ModelConfig:
    """Sizes and choices of a model. Units are metres, seconds and steps of ``dt_s``.

    Edge types are directed, one for each ordered pair (receiver type, sender type): the
    edge encoder reads [receiver's state; sum of senders' states], so what a vehicle means
    to a pedestrian is not what a pedestrian means to a vehicle. Whether an edge exists is
    symmetric.

    Attributes:
        types: node types; their order is the order of indices.
        radius_m: default distance of an edge; ``radii`` overrides it for pairs of types.
        addition_filter: A, the modulation factor at an edge's first, second, ... step;
            the last value, which must be 1, holds from then on.
        removal_filter: R, the share left at the first, second, ... step after an edge has
            gone; 0 afterwards.
        features: ``heading``: each agent's own smoothed heading frame, neighbours relative
            (shift-invariant, rotation-equivariant). ``world``: the paper's raw positions,
            velocities and accelerations, standardised on the training data.
        heading_smoothing: weight of the newest velocity in the running mean whose
            direction is the heading.
        heading_min_speed_mps: below this smoothed speed the heading stays as it was.
        sigma_min_mps, sigma_max_mps: bounds of a mixture component's standard deviations,
            for a type whose speed scale is 1.
    """

    types: tuple[NodeType, ...] = (NodeType("pedestrian"),)
    dt_s: float = 0.4
    horizon: int = 12
    observed_steps: int = 8
    radius_m: float = 3.0
    radii: tuple[EdgeRadius, ...] = ()
    addition_filter: tuple[float, ...] = (0.25, 0.5, 0.75, 1.0)
    removal_filter: tuple[float, ...] = ()
    features: Literal["heading", "world"] = "heading"
    heading_smoothing: float = 0.5
    heading_min_speed_mps: float = 0.05
    history_size: int = 32
    edge_size: int = 8
    attention_size: int = 20
    future_size: int = 32
    latent_values: int = 25
    latent_hidden_size: int = 32
    decoder_size: int = 128
    mixture_components: int = 16
    sigma_min_mps: float = 0.05
    sigma_max_mps: float = 7.0

    def __post_init__(self) -> None:
        names = self.node_types
        if not names or len(set(names)) != len(names):
            raise ValueError("types must be one or more distinct node types")
        for name, most in _LARGEST.items():
            _check_count(name, getattr(self, name), most)
        for name, (least, largest) in _RANGES.items():
            _check_number(name, getattr(self, name), least, largest)
        if self.sigma_min_mps >= self.sigma_max_mps:
            raise ValueError("sigma_min_mps must be below sigma_max_mps")
        for value in (*self.addition_filter, *self.removal_filter):
            _check_number("a filter's value", value, 0.0, 1.0)
        if not self.addition_filter or self.addition_filter[-1] != 1.0:
            raise ValueError("addition_filter must end at 1")
        pairs = [frozenset((edge.first, edge.second)) for edge in self.radii]
        if len(set(pairs)) != len(pairs):
            raise ValueError("radii name a pair of types twice")
        for edge in self.radii:
            unknown = {edge.first, edge.second} - set(names)
            if unknown:
                raise ValueError(f"radii name unknown types: {sorted(unknown)}")
            _check_number("radii", edge.radius_m, *_RANGES["radius_m"])
        if self.features not in ("heading", "world"):
            raise ValueError("features must be 'heading' or 'world'")

    @property
    def node_types(self) -> tuple[str, ...]:
        """Names of the types, in the order of their indices."""
        return tuple(t.name for t in self.types)

    def type_index(self, name: str) -> int:
        """The index of a type; raises ValueError for an unknown one."""
        try:
            return self.node_types.index(name)
        except ValueError:
            known = ", ".join(self.node_types)
            raise ValueError(f"unknown agent type {name!r}; this model knows {known}") from None

    def speed_limit_mps(self, name: str) -> float:
        """The speed limit of a type in m/s; raises ValueError for an unknown one."""
        return self.types[self.type_index(name)].speed_limit_mps

    def radius_between_m(self, first: str, second: str) -> float:
        """The distance within which two types influence each other, the same both ways."""
        for edge in self.radii:
            if {edge.first, edge.second} == {first, second}:
                return edge.radius_m
        return self.radius_m

    def to_json(self) -> dict[str, Any]:
        """As JSON values; the inverse of ``from_json``."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> ModelConfig:
        """Reads ``to_json``'s values; raises ValueError for unknown, missing or mistyped ones."""
        known = {f.name for f in dataclasses.fields(cls)}
        if unknown := sorted(set(values) - known):
            raise ValueError(f"unknown model settings: {', '.join(unknown)}")
        fields = dict(values)
        try:
            fields["types"] = tuple(_node_type(t) for t in values["types"])
            fields["radii"] = tuple(EdgeRadius(**r) for r in values.get("radii", ()))
            for name in ("addition_filter", "removal_filter"):
                if name in fields:
                    fields[name] = tuple(float(v) for v in fields[name])
            return cls(**fields)
        except (KeyError, TypeError) as error:
            raise ValueError(f"model settings do not fit: {error}") from error


def _node_type(values: object) -> NodeType:
    if not isinstance(values, Mapping):
        raise TypeError(f"a type is {type(values).__name__}, not an object")
    dispersion = tuple(Dispersion(*step) for step in values.get("dispersion", ()))
    return NodeType(**{**values, "dispersion": dispersion})
