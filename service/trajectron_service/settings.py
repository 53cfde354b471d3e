"""The settings of the service: one frozen object, read once at start and passed down.

Precedence: flags over environment (``TRAJECTRON_<NAME>``) over the TOML file that
``--config`` or ``TRAJECTRON_CONFIG`` names over defaults. Names are the fields below.
"""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator
from pydantic_settings import (
    BaseSettings,
    InitSettingsSource,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
)

ENV_PREFIX = "TRAJECTRON_"
# The model's own bounds: no setting goes beyond them.
SAMPLES_BOUND = 2000
HORIZON_BOUND = 60

Port = Annotated[int, Field(ge=0, le=65535)]
Count = Annotated[int, Field(ge=1)]
Seconds = Annotated[float, Field(gt=0.0, le=1e7, allow_inf_nan=False)]


class SettingsError(ValueError):
    """The settings are wrong: the message names the setting and where it came from."""


class Settings(BaseSettings):
    """Everything an operator can choose. Seconds, bytes, counts; see each description."""

    model_config = SettingsConfigDict(env_prefix=ENV_PREFIX, frozen=True, extra="forbid")

    config: Path | None = Field(None, description="TOML file with any of these settings.")

    host: str = Field("127.0.0.1", description="Address that both servers bind.")
    http_port: Port = Field(8000, description="HTTP port; 0 picks a free one.")
    grpc_port: Port = Field(50051, description="gRPC port; 0 picks a free one.")

    metrics_port: Port | None = Field(
        None,
        description="Port of `/metrics`, `/healthz` and `/readyz` alone, in plain text and without "
        "tokens; 0 picks a free one. Unset: metrics are on the HTTP port.",
    )
    metrics_host: str = Field(
        "127.0.0.1", description="Address that `metrics_port` binds; loopback unless told."
    )

    models: Annotated[tuple[str, ...], NoDecode] = Field(
        (), description="Models to load: bundled names or paths; none loads the default model."
    )
    default_model: str | None = Field(
        None, description="Model of requests that name none; the first of `models` if unset."
    )
    torch_threads: Count = Field(1, description="Threads of one tensor operation.")
    warm_up: bool = Field(True, description="Run every model once before reporting ready.")

    max_agents_per_frame: Count = Field(2000, description="Agents in one frame.")
    max_agents_per_scene: Count = Field(
        4000, description="Agents in a scene, those missing but not timed out included."
    )
    max_edges_per_frame: Count = Field(
        500_000, description="Pairs of agents in one frame that are near each other, counted twice."
    )
    max_frames_per_request: Count = Field(1000, description="Frames in one request.")
    max_samples: int = Field(SAMPLES_BOUND, ge=1, le=SAMPLES_BOUND, description="Samples asked.")
    max_horizon: int = Field(HORIZON_BOUND, ge=1, le=HORIZON_BOUND, description="Steps asked.")
    max_forecast_points: Count = Field(
        5_000_000, description="Agents x samples x steps of one request."
    )
    default_samples: Count = Field(20, description="Samples when a request does not say.")
    max_sessions: Count = Field(10_000, description="Open sessions.")
    max_message_bytes: Count = Field(
        16 * 2**20, description="Size of an HTTP body and of a gRPC message received."
    )
    max_reply_bytes: Count = Field(256 * 2**20, description="Size of a gRPC message sent.")
    max_connections: Count = Field(
        1000, description="HTTP connections at once; more are told 503 and closed."
    )
    max_calls: Count = Field(
        4096, description="gRPC calls at once, streams included; more are refused."
    )
    max_arriving_bytes: Count = Field(
        256 * 2**20, description="HTTP bodies being received, all together; more are refused."
    )
    receive_timeout_s: Seconds = Field(
        30.0,
        description="Time for an HTTP request to arrive whole, and for an answer to move at all.",
    )

    queue_size: Count = Field(1024, description="Work waiting for the model; more is refused.")
    max_batch_points: Count = Field(
        1_000_000, description="Agents x samples x steps that one batch takes together."
    )
    request_timeout_s: Seconds = Field(30.0, description="Time for one request or frame.")
    stream_window: Count = Field(16, description="Replies with forecasts that wait for a reader.")

    agent_timeout_s: Seconds = Field(2.0, description="An agent unseen for longer is dropped.")
    max_agent_timeout_s: Seconds = Field(60.0, description="The longest agent timeout to ask for.")
    speed_tolerance: float = Field(
        1.5, ge=1.0, description="Factor on a type's speed limit beyond which a frame is refused."
    )
    idle_timeout_s: Seconds = Field(600.0, description="A session unused for longer is closed.")
    max_idle_timeout_s: Seconds = Field(86_400.0, description="The longest idle timeout.")
    park_after_s: Seconds = Field(
        30.0, description="A session unused for longer is kept as bytes in the store."
    )
    store: str | None = Field(
        None,
        pattern=r"^(memory|sqlite(:.+)?|(redis|rediss|unix)://.+)$",
        description="Where sessions are kept: `memory`, `sqlite:PATH` or `redis://HOST:PORT/DB`. "
        "Unset: SQLite in `state_dir`, memory where there is none.",
    )
    store_durability: Literal["disk", "os", "none"] = Field(
        "disk",
        description="What an acknowledged frame survives at least: a loss of power, the end of any "
        "process, or only the end of this one.",
    )
    store_timeout_s: Seconds = Field(5.0, description="Time for one operation of the store.")
    drain_grace_s: Seconds = Field(20.0, description="Time for work in hand after SIGTERM.")

    live_accuracy: bool = Field(
        True, description="Score forecasts of sessions when their future arrives."
    )
    live_accuracy_budget: float = Field(
        0.03,
        gt=0.0,
        le=1000.0,
        description="Share of inference time that this may take; of forecasts beyond it none is "
        "scored. Far more than 1: all are.",
    )
    live_accuracy_pending: Count = Field(
        2048, description="Agents whose forecasts may wait for their future, about 12 kB each."
    )
    tls_certificate: Path | None = Field(
        None, description="Certificate chain of both ports, PEM; plain text where unset."
    )
    tls_key: Path | None = Field(None, description="Its private key, PEM, unencrypted.")
    tls_client_ca: Path | None = Field(
        None, description="Authorities, PEM, one of which must have signed a client's certificate."
    )
    tokens: Path | None = Field(
        None,
        description="TOML file of tokens (`trajectron token new`); calls need one where it is set.",
    )
    insecure: bool = Field(
        False,
        description="Serve other machines without TLS, or without tokens or client certificates.",
    )

    data: Path | None = Field(
        None,
        description="Folder of the ETH/UCY recordings with their `splits.json`, or its parent; "
        "evaluations of `eth_ucy` need it.",
    )
    state_dir: Path | None = Field(
        None,
        description="Folder of what outlives the process: evaluations with their results. Unset: "
        "a temporary one, gone at the end.",
    )
    max_evaluations: Count = Field(1000, description="Evaluations kept; more are refused.")
    evaluation_queue_size: Count = Field(16, description="Evaluations that wait for their turn.")
    evaluations_at_once: Count = Field(1, description="Evaluations that run at the same time.")
    evaluation_threads: Count = Field(1, description="Threads of one evaluation.")
    evaluation_priority: Literal["idle", "low", "normal"] = Field(
        "idle",
        description="Of evaluations beside forecasts. `idle`: they run where nothing else wants "
        "to; `low`: at the lowest nice value.",
    )

    tracing: Literal["off", "otlp"] = Field(
        "off", description="Where spans of requests go; `otlp` needs the extra `tracing`."
    )
    tracing_endpoint: str = Field(
        "http://127.0.0.1:4318", description="Collector of spans: OTLP over HTTP."
    )
    tracing_share: float = Field(
        1.0, ge=0.0, le=1.0, description="Share of traces kept where the client does not say."
    )

    log_level: Literal["debug", "info", "warning", "error"] = Field("info", description="Level.")
    log_format: Literal["console", "json"] = Field("console", description="Form of log lines.")

    @field_validator("models", mode="before")
    @classmethod
    def _split_names(cls, value: object) -> object:
        """Environment and flags write a list as names separated by commas."""
        if isinstance(value, str):
            return tuple(name.strip() for name in value.split(",") if name.strip())
        return value

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Flags, then the environment, then the file."""
        flags = init_settings()
        path = flags.get("config") or os.environ.get(f"{ENV_PREFIX}CONFIG")
        if not path:
            return init_settings, env_settings
        table = _read_table(Path(path))
        return init_settings, env_settings, InitSettingsSource(settings_cls, table)


def load(**flags: Any) -> Settings:
    """The settings in force; flags that are None count as not given.

    Raises:
        SettingsError: a setting is unknown or out of range, or the file cannot be read.
    """
    try:
        return Settings(**{name: value for name, value in flags.items() if value is not None})
    except ValidationError as error:
        raise SettingsError("; ".join(map(explained, error.errors()))) from error


def explained(fault: Any) -> str:
    """A fault that pydantic found, in the words of our messages."""
    name = ".".join(map(str, fault["loc"]))
    if fault["type"] == "extra_forbidden":
        return f"{name}: unknown setting"
    return f"{name}: {fault['msg']} (given: {fault['input']!r})"


def _read_table(path: Path) -> dict[str, Any]:
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SettingsError(f"cannot read the settings file {path}: {error}") from error
    if "config" in table:
        raise SettingsError(f"{path}: config: a settings file cannot name another")
    return table
