"""What watches the service understands what it says: promtool, a real Prometheus, the dashboard."""

from __future__ import annotations

import json
import re
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml
from scripts import metrics_page
from tests.process import Served

from trajectron_service.errors import ErrorKind
from trajectron_service.metrics import CONTENT_TYPE

ROOT = Path(__file__).parents[2]
RULES = ROOT / "deploy" / "prometheus"
DASHBOARD = ROOT / "deploy" / "grafana" / "trajectron.json"
_DEADLINE_S = 60.0


def program(name: str) -> str:
    """The path of a program of Debian's package ``prometheus``."""
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not installed (Debian: apt-get install prometheus)")
    return path


@pytest.fixture(scope="module")
def used(served: Served) -> Served:
    """The service after some calls over HTTP, good and bad."""
    with httpx.Client(base_url=served.http_url) as client:
        client.post("/v1/sessions", json={"session_id": "watched"})
        for step in range(3):
            agent = {"id": "a", "type": "pedestrian", "x": 0.4 * step, "y": 0.0}
            body = {"frames": [{"time": 0.4 * step, "agents": [agent]}]}
            assert client.post("/v1/sessions/watched:observe", json=body).status_code == 200
            assert client.post("/v1/sessions/watched:predict", json={}).status_code == 200
        assert client.get("/v1/sessions/nobody").status_code == 404
    return served


def test_promtool_finds_nothing_to_say_about_the_exposition(used: Served) -> None:
    answer = httpx.get(f"{used.http_url}/metrics")
    assert answer.headers["content-type"] == CONTENT_TYPE
    ran = subprocess.run(
        [program("promtool"), "check", "metrics"],
        input=answer.content,
        capture_output=True,
        check=False,
    )
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, b"", b"")


@pytest.mark.parametrize(
    "check", [("check", "rules", "rules.yml"), ("test", "rules", "rules_test.yml")]
)
def test_promtool_accepts_the_rules_and_they_do_what_their_tests_say(
    check: tuple[str, ...],
) -> None:
    ran = subprocess.run(
        [program("promtool"), *check], cwd=RULES, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr


@pytest.fixture
def prometheus(used: Served, tmp_path: Path) -> Iterator[str]:
    """A Prometheus of our configuration and rules that scrapes the service; its URL."""
    config = yaml.safe_load((RULES / "prometheus.yml").read_text(encoding="utf-8"))
    config["global"] = {"scrape_interval": "1s", "evaluation_interval": "1s"}
    config["rule_files"] = [str(RULES / name) for name in config["rule_files"]]
    target = used.http_url.removeprefix("http://")
    config["scrape_configs"][0]["static_configs"] = [{"targets": [target]}]
    file = tmp_path / "prometheus.yml"
    file.write_text(yaml.safe_dump(config), encoding="utf-8")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    log = (tmp_path / "log").open("wb")
    process = subprocess.Popen(
        [
            program("prometheus"),
            f"--config.file={file}",
            f"--storage.tsdb.path={tmp_path / 'data'}",
            f"--web.listen-address=127.0.0.1:{port}",
        ],
        stdout=log,
        stderr=log,
    )
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        process.terminate()
        process.wait(timeout=30)
        log.close()


def query(url: str, expression: str) -> list[dict[str, Any]]:
    """An instant query's result; nothing while Prometheus is not up yet."""
    try:
        answer = httpx.get(f"{url}/api/v1/query", params={"query": expression})
    except httpx.TransportError:
        return []
    if answer.status_code != 200:
        return []
    found: list[dict[str, Any]] = answer.json()["data"]["result"]
    return found


def wait_for(url: str, expression: str) -> list[dict[str, Any]]:
    """The first result that is not empty."""
    deadline = time.monotonic() + _DEADLINE_S
    while time.monotonic() < deadline:
        if found := query(url, expression):
            return found
        time.sleep(0.2)
    raise AssertionError(f"{expression} had no result")


def test_a_real_prometheus_scrapes_the_service_and_evaluates_the_rules(prometheus: str) -> None:
    wait_for(prometheus, 'up{job="trajectron"} == 1')
    (frames,) = wait_for(prometheus, 'trajectron_frames_total{outcome="accepted"}')
    assert float(frames["value"][1]) >= 3
    stages = wait_for(prometheus, "trajectron_stage_duration_seconds_count > 0")
    names = {one["metric"]["stage"] for one in stages}
    assert {"decode", "queue", "encode", "sample", "serialise"} <= names
    wait_for(prometheus, "trajectron:requests:rate5m")
    down = query(prometheus, 'ALERTS{alertname="TrajectronDown"}')
    assert down == []


def exposed() -> set[str]:
    """Every name of a series that the service may give."""
    names = {"up", "process_resident_memory_bytes"}
    for one in metrics_page.instruments():
        family = next(iter(one.describe()))
        suffixes = {"counter": ["_total"], "gauge": [""]}.get(
            family.type, ["_bucket", "_sum", "_count"]
        )
        names |= {family.name + suffix for suffix in suffixes}
    return names


def rules() -> list[dict[str, Any]]:
    document = yaml.safe_load((RULES / "rules.yml").read_text(encoding="utf-8"))
    return [rule for group in document["groups"] for rule in group["rules"]]


def names_in(expression: str) -> set[str]:
    """The metrics that an expression reads."""
    found = re.findall(r"\b(?:trajectron[a-z0-9_:]*|process_\w+|up)\b(?!\")", expression)
    return {name for name in found if name != "trajectron"}


def panels() -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(DASHBOARD.read_text(encoding="utf-8"))["panels"]
    return found


def test_rules_and_dashboard_read_metrics_that_exist() -> None:
    recorded = {rule["record"] for rule in rules() if "record" in rule}
    expressions = [rule["expr"] for rule in rules()]
    expressions += [target["expr"] for one in panels() for target in one.get("targets", [])]
    assert len(expressions) > 40
    for expression in expressions:
        names = names_in(expression)
        assert names, expression
        assert names <= exposed() | recorded, expression


def test_rules_and_dashboard_read_labels_and_values_that_exist() -> None:
    known = {"job", "instance", "le"}
    known |= {label for one in metrics_page.instruments() for label in one._labelnames}
    kinds = {kind.value for kind in ErrorKind}
    expressions = [rule["expr"] for rule in rules()]
    expressions += [target["expr"] for one in panels() for target in one.get("targets", [])]
    for expression in expressions:
        for labels in re.findall(r"(?:by|on) \(([^)]*)\)", expression):
            assert {label.strip() for label in labels.split(",")} <= known, expression
        for label, value in re.findall(r"(\w+)!?=~?\"([^\"]*)\"", expression):
            assert label in known
            assert label != "kind" or value in kinds


def test_the_dashboard_is_sound() -> None:
    dashboard = json.loads(DASHBOARD.read_text(encoding="utf-8"))
    ids = [panel["id"] for panel in dashboard["panels"]]
    assert len(set(ids)) == len(ids) and dashboard["uid"] == "trajectron"
    source = yaml.safe_load(
        (ROOT / "deploy/grafana/provisioning/datasources/prometheus.yaml").read_text("utf-8")
    )["datasources"][0]["uid"]
    for panel in dashboard["panels"]:
        assert panel["type"] == "row" or panel["datasource"]["uid"] == source
        place = panel["gridPos"]
        assert place["x"] + place["w"] <= 24
