"""Tokens: what a file may hold, who is found, when it is read again, how often one may call."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from trajectron_service import tenancy, tokens
from trajectron_service.admission import Admission
from trajectron_service.errors import ErrorKind, ServiceError
from trajectron_service.metrics import Metrics
from trajectron_service.protection import check_exposure, load_tls
from trajectron_service.quotas import Quotas, Usage, unlimited
from trajectron_service.settings import Settings, SettingsError
from trajectron_service.tenancy import Scope
from trajectron_service.tokens import Tokens, digest, entry, new_token

FLEET = new_token()


@pytest.fixture(autouse=True)
def _tenant_of_this_test_only() -> Iterator[None]:
    """Whoever is admitted here is not whom the tests after these work for."""
    before = tenancy._tenant.set(tenancy.current())
    yield
    tenancy._tenant.reset(before)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "tokens.toml"
    path.write_text(entry(FLEET, "fleet", [Scope.PREDICT, Scope.SESSIONS]))
    return path


def guarded(tokens: Tokens | None, metrics: Metrics | None = None) -> Admission:
    """The gate of a service whose tenants have no quotas."""
    metrics = metrics or Metrics()
    return Admission(tokens, metrics, unlimited(metrics))


def refusal(admission: Admission, authorization: str | None, scope: Scope) -> ErrorKind | None:
    try:
        admission.admit(authorization, scope)
    except ServiceError as error:
        return error.kind
    return None


def test_the_file_keeps_no_token(file: Path) -> None:
    assert FLEET not in file.read_text()
    assert digest(FLEET) in file.read_text()


def test_tokens_are_long_and_never_the_same() -> None:
    made = {new_token() for _ in range(100)}
    assert len(made) == 100
    assert min(map(len, made)) >= 43  # 256 bits in base64


def test_only_the_very_token_is_found(file: Path) -> None:
    found = Tokens(file).find(FLEET)
    assert found is not None
    assert found.tenant == "fleet"
    assert found.scopes == frozenset({Scope.PREDICT, Scope.SESSIONS})
    for wrong in ("", FLEET[:-1], FLEET + "x", digest(FLEET), "\udcff"):
        assert Tokens(file).find(wrong) is None


def test_an_expired_token_is_not_found(file: Path) -> None:
    file.write_text(file.read_text() + "expires = 2030-01-01T00:00:00Z\n")
    assert Tokens(file, clock=lambda: 1893455999.0).find(FLEET) is not None
    assert Tokens(file, clock=lambda: 1893456000.0).find(FLEET) is None


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """What the log of tokens is told: levels and events."""
    lines: list[tuple[str, str]] = []
    for level in ("info", "warning", "error"):

        def say(event: str, *, level: str = level, **_: object) -> None:
            lines.append((level, event))

        monkeypatch.setattr(tokens.log, level, say, raising=False)
    return lines


def looked(known: Tokens, times: int = 2) -> Tokens:
    for _ in range(times):
        known.look()
    return known


def test_a_changed_file_counts_once_it_stays_as_it_is(file: Path) -> None:
    known, other = Tokens(file), new_token()
    file.write_text("")  # an editor may empty a file before it writes it
    assert looked(known, 1).find(FLEET) is not None
    file.write_text(entry(other, "other", [Scope.ADMIN]))
    assert looked(known, 1).find(FLEET) is not None
    assert looked(known, 1).find(FLEET) is None
    assert known.find(other) is not None


@pytest.mark.parametrize("text", ["[[token]", "x = 1", None])
def test_a_file_that_cannot_be_used_leaves_things_as_they_were_and_says_so(
    file: Path, text: str | None, said: list[tuple[str, str]]
) -> None:
    known, metrics, before = Tokens(file), Metrics(), file.read_text()
    admission = guarded(known, metrics)
    if text is None:
        file.unlink()
    else:
        file.write_text(text)
    looked(known)
    assert known.find(FLEET) is not None
    assert b"trajectron_tokens_stale 1.0" in metrics.render()
    assert [level for level, event in said if "cannot be used" in event] == ["error"]
    file.write_text(before + "# mended\n")
    admission.reload()
    assert b"trajectron_tokens_stale 0.0" in metrics.render()


@pytest.mark.parametrize("text", ["", "# nobody any more\n", "token = []\n"])
def test_an_emptied_file_lets_nobody_in(file: Path, text: str, said: list[tuple[str, str]]) -> None:
    metrics = Metrics()
    admission = guarded(Tokens(file), metrics)
    assert b"trajectron_tokens 1.0" in metrics.render()
    file.write_text(text)
    admission.reload()
    for given in (None, f"Bearer {FLEET}"):
        assert refusal(admission, given, Scope.PREDICT) is ErrorKind.UNAUTHENTICATED
    assert b"trajectron_tokens 0.0" in metrics.render()
    assert [level for level, event in said if "nobody may call" in event] == ["warning"]
    assert refusal(guarded(Tokens(file)), None, Scope.PREDICT) is (ErrorKind.UNAUTHENTICATED)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1", "entries, "),
        ("[quotas]\nsession = 1", r"\[quotas\]: session: unknown"),
        ("[quotas]\nsessions = 0", r"\[quotas\]: sessions: .*greater than or equal to 1"),
        ("[quotas]\nframes_per_s = inf", r"\[quotas\]: frames_per_s: "),
        ("[quotas]\nsessions = true", r"\[quotas\]: sessions: "),
        ("[tenants]\nfleet = 1", r"\[tenants.fleet\]: "),
        ("[tenants.fleet]\nstreams = 1.5", r"\[tenants.fleet\]: streams: "),
        ("[[token]", "cannot read"),
        ('[[token]]\ntenant = "a"\nscope = ["predict"]', "may have"),
        ('[[token]]\ntenant = "../a"\nscopes = ["predict"]', "tenant must be"),
        ('[[token]]\ntenant = "a"\nsha256 = "ab"', "sha256 must be"),
        (f'[[token]]\ntenant = "a"\nsha256 = "{"0" * 64}"\nscopes = ["root"]', "scopes must"),
        (f'[[token]]\ntenant = "a"\nsha256 = "{"0" * 64}"\nscopes = ["admin"]\n' * 2, "twice"),
    ],
)
def test_a_wrong_file_is_told_what_is_wrong(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "tokens.toml"
    path.write_text(text)
    with pytest.raises(SettingsError, match=message):
        Tokens(path)


def test_without_tokens_everybody_comes_in_as_the_default_tenant() -> None:
    guarded(None).admit(None, Scope.ADMIN)
    assert tenancy.current() == tenancy.DEFAULT


def test_who_has_no_token_and_who_has_too_small_a_one_is_refused(file: Path) -> None:
    metrics = Metrics()
    admission = guarded(Tokens(file), metrics)
    for wrong in (None, "", "Bearer", "Bearer x", FLEET, f"Basic {FLEET}"):
        assert refusal(admission, wrong, Scope.PREDICT) is ErrorKind.UNAUTHENTICATED
    assert refusal(admission, f"Bearer {FLEET}", Scope.ADMIN) is ErrorKind.PERMISSION_DENIED
    assert refusal(admission, f"bearer {FLEET}", Scope.PREDICT) is None
    assert b'refusals_total{kind="UNAUTHENTICATED"} 6.0' in metrics.render()


def test_more_requests_than_the_rate_are_refused_until_time_has_passed(file: Path) -> None:
    file.write_text(file.read_text() + "[tenants.fleet]\nrequests_per_s = 2\n")
    now, known, metrics = 0.0, Tokens(file), Metrics()
    admission = Admission(known, metrics, Usage(known.quotas, metrics, lambda: now))
    answers = [refusal(admission, f"Bearer {FLEET}", Scope.PREDICT) for _ in range(3)]
    assert answers == [None, None, ErrorKind.RATE_LIMITED]
    with pytest.raises(ServiceError) as told:
        admission.admit(f"Bearer {FLEET}", Scope.PREDICT)
    assert told.value.retry_after_s == 0.5
    now = 0.5
    assert refusal(admission, f"Bearer {FLEET}", Scope.PREDICT) is None


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.1", ""])
def test_other_machines_are_not_served_unprotected(host: str, file: Path) -> None:
    with pytest.raises(SettingsError, match=r"tls_certificate.*tokens.*--insecure"):
        check_exposure(Settings(host=host))
    with pytest.raises(SettingsError, match=r"tls_certificate"):
        check_exposure(Settings(host=host, tokens=file))
    with pytest.raises(SettingsError, match=r"set tokens"):
        check_exposure(Settings(host=host, tls_certificate=file, tls_key=file))
    check_exposure(Settings(host=host, tls_certificate=file, tls_key=file, tokens=file))
    check_exposure(Settings(host=host, insecure=True))


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.2", "::1", "localhost"])
def test_this_machine_is_served_openly(host: str) -> None:
    check_exposure(Settings(host=host))


def test_files_that_are_no_certificate_are_told(file: Path) -> None:
    with pytest.raises(SettingsError, match="without the other"):
        load_tls(Settings(tls_certificate=file))
    with pytest.raises(SettingsError, match="no certificate with its"):
        load_tls(Settings(tls_certificate=file, tls_key=file))
    with pytest.raises(SettingsError, match=r"cannot read .*nowhere"):
        load_tls(Settings(tls_certificate=file, tls_key=file.parent / "nowhere"))
    assert load_tls(Settings()) is None


def test_a_token_may_be_made_to_expire(file: Path) -> None:
    soon = new_token()
    at = datetime(2030, 1, 1, 12, tzinfo=UTC)
    file.write_text(file.read_text() + entry(soon, "fleet", [Scope.ADMIN], at))
    assert Tokens(file, clock=lambda: at.timestamp() - 1.0).find(soon) is not None
    assert Tokens(file, clock=at.timestamp).find(soon) is None
    assert Tokens(file, clock=at.timestamp).find(FLEET) is not None


def test_the_quotas_of_the_docs_mean_what_they_say(file: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "security.md").read_text()
    (example,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    file.write_text(file.read_text() + example)
    known = Tokens(file)
    assert known.quotas("fleet") == Quotas(sessions=2000, frames_per_s=5000, requests_per_s=50)
    assert known.quotas("another") == Quotas(sessions=100, requests_per_s=50)
    for name in Quotas.model_fields:
        assert f"`{name}`" in page


def test_quotas_of_nobody_are_told(file: Path, said: list[tuple[str, str]]) -> None:
    file.write_text(file.read_text() + "[tenants.flet]\nsessions = 1\n")
    Tokens(file)
    assert ("warning", "quotas of tenants without a token") in said
