"""What a client shows to be let in: a token, and the certificates of a TLS connection."""

from __future__ import annotations

import os
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import grpc

_PREFIX = "TRAJECTRON_CLIENT_"


@dataclass(frozen=True)
class Access:
    """How to reach a protected service; everything may be left out.

    Attributes:
        token: sent as ``Authorization: Bearer`` with every call.
        ca: file of the authorities that signed the service's certificate, PEM; those of the
            system when None. Giving it, or a certificate, asks for TLS over gRPC.
        certificate: file of the client's own certificate chain, PEM, for mutual TLS.
        key: file of its private key, PEM.
        tls: TLS over gRPC with the system's authorities; over HTTP the address says it.
    """

    token: str | None = None
    ca: Path | str | None = None
    certificate: Path | str | None = None
    key: Path | str | None = None
    tls: bool = False

    def __post_init__(self) -> None:
        if (self.certificate is None) != (self.key is None):
            raise ValueError("a client certificate and its key go together")

    @classmethod
    def from_environment(cls) -> Self:
        """From ``TRAJECTRON_CLIENT_TOKEN``, ``_CA``, ``_CERTIFICATE``, ``_KEY`` and ``_TLS=1``."""

        def path(name: str) -> Path | None:
            value = os.environ.get(_PREFIX + name)
            return Path(value) if value else None

        return cls(
            token=os.environ.get(_PREFIX + "TOKEN") or None,
            ca=path("CA"),
            certificate=path("CERTIFICATE"),
            key=path("KEY"),
            tls=os.environ.get(_PREFIX + "TLS", "") not in ("", "0"),
        )

    def __repr__(self) -> str:
        """Without the token."""
        shown = "..." if self.token else None
        return f"Access(token={shown}, ca={self.ca}, certificate={self.certificate})"

    @property
    def metadata(self) -> tuple[tuple[str, str], ...]:
        """For gRPC calls."""
        return (("authorization", f"Bearer {self.token}"),) if self.token else ()

    @property
    def headers(self) -> dict[str, str]:
        """For HTTP calls."""
        return {"Authorization": f"Bearer {self.token}"} if self.token else {}

    def credentials(self) -> grpc.ChannelCredentials | None:
        """For a gRPC channel, None for plain text; raises OSError for a file not to be read."""
        if not self.tls and self.ca is None and self.certificate is None:
            return None
        return grpc.ssl_channel_credentials(
            _bytes(self.ca),
            private_key=_bytes(self.key),
            certificate_chain=_bytes(self.certificate),
        )

    def ssl_context(self) -> ssl.SSLContext:
        """For HTTPS; raises OSError for a file not to be read."""
        context = ssl.create_default_context(cafile=self.ca)
        if self.certificate is not None:
            context.load_cert_chain(self.certificate, self.key)
        return context


def _bytes(path: Path | str | None) -> bytes | None:
    return None if path is None else Path(path).read_bytes()
