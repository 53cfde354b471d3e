"""What deploys the service names things that exist, and ports and paths that agree."""

from __future__ import annotations

import fnmatch
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from trajectron_service.settings import Settings

ROOT = Path(__file__).resolve().parents[2]
DOCKERFILE = (ROOT / "Dockerfile").read_text(encoding="utf-8")


def read_yaml(name: str) -> Any:
    return yaml.safe_load((ROOT / name).read_text(encoding="utf-8"))


def instructions(kind: str) -> list[str]:
    """The arguments of one kind of instruction of the Dockerfile, lines joined."""
    joined = DOCKERFILE.replace("\\\n", " ")
    return re.findall(rf"^{kind} +(.+)$", joined, re.MULTILINE)


@pytest.fixture(scope="module")
def compose() -> Any:
    return read_yaml("deploy/compose.yaml")


@pytest.fixture(scope="module")
def environment() -> dict[str, str]:
    """The variables that the image sets."""
    return dict(pair.split("=", 1) for line in instructions("ENV") for pair in shlex.split(line))


def test_every_path_that_compose_names_exists(compose: Any) -> None:
    folder = ROOT / "deploy"
    services = compose["services"]
    context = folder / services["trajectron"]["build"]["context"]
    assert (context / "Dockerfile").is_file()
    mounts = [v.split(":")[0] for s in services.values() for v in s.get("volumes", [])]
    paths = [m for m in mounts if m.startswith(".")]
    assert "./prometheus/prometheus.yml" in paths
    assert "./grafana/trajectron.json" in paths
    assert all((folder / path).exists() for path in paths)
    assert all(m in compose["volumes"] for m in mounts if not m.startswith("."))


def test_compose_publishes_on_the_loopback_address_only(compose: Any) -> None:
    ports = [port for service in compose["services"].values() for port in service["ports"]]
    assert len(ports) == 4
    assert all(port.startswith("127.0.0.1:") for port in ports)


def test_compose_publishes_the_ports_that_the_image_serves(
    compose: Any, environment: dict[str, str]
) -> None:
    served = {environment["TRAJECTRON_HTTP_PORT"], environment["TRAJECTRON_GRPC_PORT"]}
    published = {port.split(":")[-1] for port in compose["services"]["trajectron"]["ports"]}
    assert served == published == set(instructions("EXPOSE")[0].split())


def test_prometheus_scrapes_the_metrics_of_the_service_by_its_name_and_port(
    compose: Any, environment: dict[str, str]
) -> None:
    (job,) = read_yaml("deploy/prometheus/prometheus.yml")["scrape_configs"]
    host, port = job["static_configs"][0]["targets"][0].split(":")
    assert host in compose["services"]
    assert port == environment["TRAJECTRON_HTTP_PORT"]
    assert job["metrics_path"] == "/metrics"


def test_the_image_sets_only_settings_that_exist(environment: dict[str, str]) -> None:
    names = [n for n in environment if n.startswith("TRAJECTRON_")]
    assert "TRAJECTRON_HOST" in names
    assert {n.removeprefix("TRAJECTRON_").lower() for n in names} <= set(Settings.model_fields)


def test_a_container_gets_longer_to_stop_than_the_service_takes(compose: Any) -> None:
    grace = compose["services"]["trajectron"]["stop_grace_period"]
    assert int(grace.removesuffix("s")) > Settings.model_fields["drain_grace_s"].default


def test_everything_the_image_copies_exists_and_reaches_the_build() -> None:
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    kept = {line[1:] for line in ignored if line.startswith("!")}
    copies = [line.split()[:-1] for line in instructions("COPY") if "--from" not in line]
    names = {name.removeprefix("./") for sources in copies for name in sources}
    assert names
    assert names == kept
    assert all((ROOT / name).exists() for name in names)


def test_the_image_holds_every_package_of_the_distribution() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    packages = project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    copied = [line.split()[0] for line in instructions("COPY")]
    assert all(any(fnmatch.fnmatch(p, f"{c}/*") for c in copied) for p in packages)


def test_the_image_installs_what_the_service_extra_names() -> None:
    script = re.search(r"RUN python -c '(.+?)' > requirements", DOCKERFILE, re.DOTALL)
    assert script
    code = script.group(1).replace("\\\n", "")
    ran = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    listed = ran.stdout.splitlines()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert listed == project["dependencies"] + project["optional-dependencies"]["service"]


def test_the_image_runs_without_privileges_and_says_whether_it_is_ready() -> None:
    assert instructions("USER") == ["10001"]
    (check,) = instructions("HEALTHCHECK")
    assert "/readyz" in check


def test_every_dependency_has_an_exact_version() -> None:
    def name_of(requirement: str) -> str:
        return re.split(r"[<>=!~\[; ]", requirement, maxsplit=1)[0].lower().replace("_", "-")

    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    exact = [line for line in lines if line and not line.startswith("#")]
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[0-9][A-Za-z0-9.]*", line) for line in exact)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"].values()
    wanted = {name_of(r) for group in (project["dependencies"], *extras) for r in group}
    assert wanted <= {name_of(line) for line in exact}
