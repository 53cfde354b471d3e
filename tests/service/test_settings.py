"""Flags over environment over file over defaults; what is unknown or out of range is told."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from trajectron_service.settings import Settings, SettingsError, load


@pytest.fixture(autouse=True)
def _bare_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("CONFIG", "HTTP_PORT", "GRPC_PORT", "MODELS", "HOST", "LOG_LEVEL"):
        monkeypatch.delenv(f"TRAJECTRON_{name}", raising=False)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "service.toml"
    path.write_text('http_port = 1\ngrpc_port = 2\nmax_sessions = 3\nmodels = ["a", "b"]\n')
    return path


def test_by_default_only_this_machine_is_served() -> None:
    settings = load()
    assert (settings.host, settings.http_port, settings.grpc_port) == ("127.0.0.1", 8000, 50051)


def test_flags_win_over_environment_over_file_over_defaults(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TRAJECTRON_HTTP_PORT", "10")
    monkeypatch.setenv("TRAJECTRON_GRPC_PORT", "20")
    settings = load(config=file, http_port=100)
    assert settings.http_port == 100
    assert settings.grpc_port == 20
    assert settings.max_sessions == 3
    assert settings.queue_size == Settings().queue_size


def test_the_environment_can_name_the_file(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRAJECTRON_CONFIG", str(file))
    assert load().max_sessions == 3


def test_a_flag_that_was_not_given_does_not_count(file: Path) -> None:
    assert load(config=file, http_port=None).http_port == 1


def test_lists_are_separated_by_commas_outside_the_file(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert load(config=file).models == ("a", "b")
    monkeypatch.setenv("TRAJECTRON_MODELS", "one, models/two")
    assert load(config=file).models == ("one", "models/two")
    assert load(config=file, models=("x",)).models == ("x",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("htp_port = 1", "htp_port: unknown setting"),
        ("http_port = 70000", "http_port: .* 65535"),
        ("max_samples = 2001", "max_samples: .* 2000"),
        ("max_horizon = 61", "max_horizon: .* 60"),
        ('log_level = "loud"', "log_level: "),
        ("request_timeout_s = inf", "request_timeout_s: "),
        ("http_port = = 1", "cannot read the settings file"),
        ('config = "other.toml"', "cannot name another"),
    ],
)
def test_a_bad_file_is_told_what_is_wrong(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "service.toml"
    path.write_text(text)
    with pytest.raises(SettingsError, match=message):
        load(config=path)


def test_a_file_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"nowhere\.toml"):
        load(config=tmp_path / "nowhere.toml")


def test_settings_do_not_change_after_the_start() -> None:
    with pytest.raises(ValidationError):
        load().http_port = 1  # type: ignore[misc] # what must not be possible
