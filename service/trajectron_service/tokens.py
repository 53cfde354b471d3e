"""The tokens of a file: who a bearer is, and what it may do.

A token is 256 random bits; only its SHA-256 is kept. A slow hash protects secrets that can be
guessed, such as passwords. Nobody can try 2^256 tokens however fast the hash is, and a fast one
cannot be used to keep the service busy with wrong tokens.

::

    [[token]]
    tenant = "fleet"
    scopes = ["predict", "sessions"]
    sha256 = "..."
    expires = 2030-01-01T00:00:00Z   # optional

    [quotas]                         # optional, of each tenant
    sessions = 100

    [tenants.fleet]                  # optional, before those of each tenant
    requests_per_s = 50
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import time
import tomllib
from collections import ChainMap
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from trajectron_service import logs
from trajectron_service.quotas import Quotas
from trajectron_service.settings import SettingsError, explained
from trajectron_service.tenancy import Scope

_TOKEN_BYTES = 32
_PREFIX = "trj_"
_SHA256 = re.compile(r"[0-9a-f]{64}")
_TENANT = re.compile(r"[A-Za-z0-9._-]{1,64}")
_FIELDS = frozenset({"tenant", "scopes", "sha256", "expires"})

log = logs.get(__name__)


@dataclass(frozen=True)
class Token:
    """One entry of the file; ``expires_at`` in Unix seconds."""

    tenant: str
    scopes: frozenset[Scope]
    sha256: str
    expires_at: float | None = None


@dataclass(frozen=True)
class TokensFile:
    """What a file says: tokens, the quotas of tenants that it names, and those of all others."""

    tokens: tuple[Token, ...]
    tenants: Mapping[str, Quotas]
    others: Quotas

    @cached_property
    def by_sha256(self) -> Mapping[str, Token]:
        """The tokens by what is kept of them."""
        return {token.sha256: token for token in self.tokens}


def new_token() -> str:
    """A token that nobody has yet."""
    return _PREFIX + secrets.token_urlsafe(_TOKEN_BYTES)


def digest(token: str) -> str:
    """What is kept of a token."""
    return hashlib.sha256(token.encode("utf-8", "surrogateescape")).hexdigest()


def entry(token: str, tenant: str, scopes: list[Scope], expires: datetime | None = None) -> str:
    """The lines of a token for the file; ``expires`` with its offset.

    Raises:
        SettingsError: no such name can be a tenant's, or there are no scopes.
    """
    names = [scope.value for scope in scopes]
    _parsed({"tenant": tenant, "scopes": names, "sha256": digest(token)}, "the new token")
    listed = ", ".join(f'"{name}"' for name in names)
    lines = f'[[token]]\ntenant = "{tenant}"\nscopes = [{listed}]\nsha256 = "{digest(token)}"\n'
    return lines if expires is None else f"{lines}expires = {expires.isoformat('T', 'seconds')}\n"


def read(path: Path) -> TokensFile:
    """A file of tokens, which may have none.

    Raises:
        SettingsError: it cannot be read or understood; the message names the entry.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise SettingsError(f"tokens: cannot read {path}: {error}") from error
    entries, tenants = table.pop("token", []), table.pop("tenants", {})
    general = table.pop("quotas", {})
    kinds = isinstance(entries, list), isinstance(tenants, dict), isinstance(general, dict)
    if table or not all(kinds):
        raise SettingsError(
            f"tokens: {path}: may hold [[token]] entries, [quotas] and [tenants.NAME] only"
        )
    tokens = tuple(
        _parsed(fields, f"{path}, token {place}") for place, fields in enumerate(entries, 1)
    )
    if len({token.sha256 for token in tokens}) < len(tokens):
        raise SettingsError(f"tokens: {path}: the same sha256 stands there twice")
    return TokensFile(
        tokens,
        {name: _quotas(path, f"tenants.{name}", general, own) for name, own in tenants.items()},
        _quotas(path, "quotas", general),
    )


class Tokens:
    """The tokens in force: those of the file as it is now.

    An emptied file means that nobody may call. One that cannot be used, or is gone, leaves the
    tokens as they were: ``stale``, with an error in the log.

    Args:
        path: the file.
        clock: Unix seconds, to see what has expired.

    Raises:
        SettingsError: as ``read``.

    Attributes:
        stale: whether the file cannot be used, so that what it held before counts.
    """

    def __init__(self, path: Path, clock: Callable[[], float] = time.time) -> None:
        self._path = path
        self._clock = clock
        self._stamp = self._seen = _stamp(path)
        self._file = read(path)
        self.stale = False
        self._tell()

    def __len__(self) -> int:
        return len(self._file.tokens)

    def quotas(self, tenant: str) -> Quotas:
        """What a tenant may use."""
        return self._file.tenants.get(tenant, self._file.others)

    def find(self, presented: str) -> Token | None:
        """The token presented, None when it is unknown or has expired.

        All entries are compared, each in constant time: how long it takes tells nothing.
        """
        sha256, found = digest(presented), None
        for token in self._file.tokens:
            if hmac.compare_digest(token.sha256, sha256):
                found = token
        return self._unexpired(found)

    def again(self, token: Token) -> Token | None:
        """A token found before as it is now; None when it is gone, has expired, or is another's."""
        found = self._file.by_sha256.get(token.sha256)
        return self._unexpired(found) if found and found.tenant == token.tenant else None

    def _unexpired(self, token: Token | None) -> Token | None:
        if token and token.expires_at is not None and token.expires_at <= self._clock():
            return None
        return token

    def look(self) -> None:
        """Reads the file again once it has changed and stays so from one look to the next.

        A file that is just being written may be empty, or lack its end.
        """
        stamp = _stamp(self._path)
        if stamp != self._stamp and stamp == self._seen:
            self.reload()
        self._seen = stamp

    def reload(self) -> None:
        """Reads the file again, now."""
        self._stamp = _stamp(self._path)
        try:
            self._file = read(self._path)
        except SettingsError as error:
            self.stale, reason = True, str(error)
        else:
            self.stale, reason = False, ""
        if self.stale:
            log.error("the file of tokens cannot be used, those before hold", reason=reason)
        else:
            self._tell()

    def _tell(self) -> None:
        if self._file.tokens:
            log.info("tokens read", count=len(self))
        else:
            log.warning("the file of tokens has none: nobody may call", path=str(self._path))
        idle = self._file.tenants.keys() - {token.tenant for token in self._file.tokens}
        if idle:
            log.warning("quotas of tenants without a token", tenants=sorted(idle))


def _stamp(path: Path) -> tuple[int, int, int] | None:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino


def _parsed(fields: Any, where: str) -> Token:
    if not isinstance(fields, dict) or not fields.keys() <= _FIELDS:
        raise SettingsError(f"tokens: {where}: may have {', '.join(sorted(_FIELDS))} only")
    tenant, sha256 = fields.get("tenant"), fields.get("sha256")
    if not isinstance(tenant, str) or not _TENANT.fullmatch(tenant):
        raise SettingsError(
            f"tokens: {where}: tenant must be 1 to 64 of letters, digits, '.', '_', '-'"
        )
    if not isinstance(sha256, str) or not _SHA256.fullmatch(sha256):
        raise SettingsError(f"tokens: {where}: sha256 must be 64 digits of lower-case hexadecimal")
    expires = fields.get("expires")
    if expires is not None and not (isinstance(expires, datetime) and expires.tzinfo):
        raise SettingsError(f"tokens: {where}: expires must be a date and time with its offset")
    return Token(
        tenant,
        _scopes(fields.get("scopes"), where),
        sha256,
        None if expires is None else expires.timestamp(),
    )


def _quotas(path: Path, table: str, *tables: Any) -> Quotas:
    """Quotas of a table; later ones go before earlier ones."""
    try:
        return Quotas(**dict(ChainMap(*reversed(tables))))
    except (TypeError, ValueError) as error:
        reason = (
            "; ".join(map(explained, error.errors()))
            if isinstance(error, ValidationError)
            else error
        )
        raise SettingsError(f"tokens: {path}: [{table}]: {reason}") from error


def _scopes(names: Any, where: str) -> frozenset[Scope]:
    known = [scope.value for scope in Scope]
    if not isinstance(names, list) or not names or any(name not in known for name in names):
        raise SettingsError(f"tokens: {where}: scopes must list some of {', '.join(known)}")
    return frozenset(map(Scope, names))
