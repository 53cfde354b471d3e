"""A bad frame is refused whole, and told which field is at fault and why."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from tests.service.building import frame, observation

from trajectron_model.graph import find_edges
from trajectron_service.errors import FieldViolation
from trajectron_service.messages import Agent, Frame, UnknownTypes
from trajectron_service.timebase import Grid, Timeline, advance
from trajectron_service.validation import Checked, FrameLimits, TypeRules, check, quoted

EMPTY = Timeline(Grid.of(0.4, None, 2.0))
LIMITS = FrameLimits(
    max_agents_per_frame=2000,
    max_agents_per_scene=4000,
    max_edges_per_frame=500_000,
    speed_tolerance=1.5,
)
RADII_M = {
    ("pedestrian", "pedestrian"): 3.0,
    ("pedestrian", "pillar"): 2.0,
    ("pillar", "pedestrian"): 2.0,
    ("pillar", "pillar"): 1.0,
}


def rules(policy: UnknownTypes = UnknownTypes.REJECT, **type_map: str) -> TypeRules:
    return TypeRules({"pedestrian": 10.0, "pillar": 0.0}, RADII_M, policy, type_map)


def person(name: str = "7", x: float | None = 1.0, y: float | None = 2.0) -> Agent:
    return Agent(name, "pedestrian", x, y)


def test_long_text_is_shortened_legibly() -> None:
    assert quoted("x" * 64) == '"' + "x" * 64 + '"'
    assert quoted("x" * 65) == '"' + "x" * 64 + '..."'


def fault(one: Frame, timeline: Timeline = EMPTY, limits: FrameLimits = LIMITS) -> FieldViolation:
    found = check(one, timeline, rules(), limits)
    assert isinstance(found, FieldViolation)
    return found


def passed(one: Frame, timeline: Timeline = EMPTY, types: TypeRules | None = None) -> Checked:
    found = check(one, timeline, types or rules(), LIMITS)
    assert isinstance(found, Checked)
    return found


@pytest.mark.parametrize(
    ("bad", "field", "text"),
    [
        (Frame(None, ()), "time", "is missing"),
        (Frame(math.nan, ()), "time", "is NaN"),
        (Frame(math.inf, ()), "time", "is infinite"),
        (Frame(1.7e12, ()), "time", "not milliseconds"),
        (Frame(0.0, (person(), person("8", x=math.nan))), "agents[1].x", "is NaN; positions must"),
        (Frame(0.0, (person(y=-math.inf),)), "agents[0].y", "is infinite"),
        (Frame(0.0, (person(x=None),)), "agents[0].x", "is missing"),
        (Frame(0.0, (person(y=None),)), "agents[0].y", "is missing"),
        (Frame(0.0, (person(y=1e300),)), "agents[0].y", "metres within"),
        (Frame(0.0, (person(""),)), "agents[0].id", "is missing"),
        (Frame(0.0, (person("x" * 129),)), "agents[0].id", "129 characters"),
        (Frame(0.0, (person("\ud800"),)), "agents[0].id", "not valid Unicode"),
        (Frame(0.0, (person("a"), person("b"), person("a"))), "agents[2].id", "is also agents[0]"),
        (Frame(0.0, (Agent("a", "", 0.0, 0.0),)), "agents[0].type", "is missing"),
        (Frame(0.0, (Agent("a", "drone", 0.0, 0.0),)), "agents[0].type", '"drone" is unknown'),
    ],
)
def test_each_fault_is_named(bad: Frame, field: str, text: str) -> None:
    found = fault(bad)
    assert found.field == field
    assert text in found.description


def test_a_frame_of_ten_thousand_agents_is_told_how_many_there_may_be() -> None:
    crowd = Frame(0.0, tuple(person(str(i)) for i in range(10_000)))
    assert fault(crowd) == FieldViolation("agents", "10000 agents; a frame may have at most 2000")


def test_an_empty_frame_is_valid() -> None:
    assert passed(Frame(0.0, ())).observation.positions.shape == (0, 2)


def test_a_frame_keeps_doubles_far_from_the_origin() -> None:
    kept = passed(Frame(1.7e9, (person(x=4_512_345.123456, y=-1e6),))).observation
    assert kept.positions.tolist() == [[4_512_345.123456, -1e6]]
    assert kept.time_s == 1.7e9


def test_other_types_can_be_ignored_or_mapped() -> None:
    mixed = Frame(0.0, (Agent("a", "drone", 0.0, 0.0), person("b")))
    ignoring = passed(mixed, types=rules(UnknownTypes.IGNORE))
    assert (ignoring.observation.ids, ignoring.ignored) == (("b",), ("a",))
    mapping = passed(mixed, types=rules(UnknownTypes.MAP, drone="pedestrian"))
    assert mapping.observation.types == ("pedestrian", "pedestrian")
    unmapped = check(mixed, EMPTY, rules(UnknownTypes.MAP, car="pedestrian"), LIMITS)
    assert isinstance(unmapped, FieldViolation)
    assert (unmapped.field, "type_map" in unmapped.description) == ("agents[0].type", True)


def test_a_bad_position_is_refused_even_of_an_agent_that_is_ignored() -> None:
    bad = Frame(0.0, (Agent("a", "drone", math.nan, 0.0),))
    found = check(bad, EMPTY, rules(UnknownTypes.IGNORE), LIMITS)
    assert isinstance(found, FieldViolation)
    assert found.field == "agents[0].x"


def test_nobody_moves_faster_than_their_type_can() -> None:
    seen = advance(EMPTY, observation(0.0, ann=(0.0, 0.0), bob=(9.0, 9.0))).timeline
    # 10 m/s, times 1.5, for 0.4 s, and 1 m for noise: 7 m.
    passed(frame(0.4, ann=(6.9, 0.0)), seen)
    found = fault(frame(0.4, bob=(9.0, 9.0), ann=(7.1, 0.0)), seen)
    assert found.field == "agents[1]"
    assert '"ann" moved 7.1 m in 0.4 s' in found.description


def test_speed_counts_from_the_last_time_an_agent_was_seen() -> None:
    seen = advance(EMPTY, observation(0.0, ann=(0.0, 0.0))).timeline
    seen = advance(seen, observation(0.4)).timeline
    passed(frame(1.6, ann=(20.0, 0.0)), seen)
    # Unseen for longer than the agent timeout it starts anew, wherever it is.
    passed(frame(2.4, ann=(5000.0, 0.0)), seen)


def test_what_cannot_move_may_still_tremble() -> None:
    pillar = Agent("p", "pillar", 0.0, 0.0)
    first = passed(Frame(0.0, (pillar,))).observation
    seen = advance(EMPTY, first).timeline
    passed(Frame(0.4, (Agent("p", "pillar", 0.2, 0.0),)), seen)
    assert fault(Frame(0.4, (Agent("p", "pillar", 3.0, 0.0),)), seen).field == "agents[0]"


def test_a_scene_has_a_largest_size_though_each_frame_is_small() -> None:
    limits = dataclasses.replace(LIMITS, max_agents_per_frame=2, max_agents_per_scene=3)
    seen = advance(EMPTY, observation(0.0, a=(0.0, 0.0), b=(1.0, 0.0))).timeline
    assert isinstance(check(frame(0.4, b=(1.0, 0.0), c=(2.0, 0.0)), seen, rules(), limits), Checked)
    found = fault(frame(0.4, c=(2.0, 0.0), d=(3.0, 0.0)), seen, limits)
    assert (found.field, "4 agents" in found.description) == ("agents", True)


def crowd(size_m: float) -> Frame:
    places = np.random.default_rng(3).uniform(0.0, size_m, size=(60, 2)).tolist()
    kinds = ["pedestrian", "pillar"] * 30
    rows = zip(kinds, places, strict=True)
    return Frame(0.0, tuple(Agent(str(k), kind, x, y) for k, (kind, (x, y)) in enumerate(rows)))


@pytest.mark.parametrize("size_m", [0.5, 6.0, 20.0])
def test_a_frame_may_have_as_many_edges_as_its_limit_and_not_one_more(size_m: float) -> None:
    one = crowd(size_m)
    names = ("pedestrian", "pillar")
    receiver, _ = find_edges(
        passed(one).observation.positions,
        np.ones(60, dtype=bool),
        np.array([0, 1] * 30),
        np.zeros(60, dtype=np.int64),
        np.array([[RADII_M[a, b] for b in names] for a in names]),
    )
    edges = len(receiver)
    assert edges > 0
    just = dataclasses.replace(LIMITS, max_edges_per_frame=edges)
    assert isinstance(check(one, EMPTY, rules(), just), Checked)
    found = fault(one, limits=dataclasses.replace(LIMITS, max_edges_per_frame=edges - 1))
    assert found.field == "agents"
    assert f"make {edges} edges" in found.description


def test_two_thousand_agents_in_one_spot_are_refused() -> None:
    spot = Frame(0.0, tuple(Agent(str(k), "pedestrian", 0.0, 0.0) for k in range(2000)))
    assert "3998000 edges" in fault(spot).description


def test_messages_show_a_clients_text_escaped_and_short() -> None:
    nasty = Frame(0.0, (Agent("a", "\n\ud800" + "x" * 500, 0.0, 0.0),))
    description = fault(nasty).description
    assert "\n" not in description
    assert description.encode()
    assert len(description) < 300
