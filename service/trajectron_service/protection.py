"""TLS for both ports, and the refusal to serve other machines unprotected."""

from __future__ import annotations

import ipaddress
import socket
import ssl
from dataclasses import dataclass
from pathlib import Path

import grpc

from trajectron_service.settings import Settings, SettingsError


@dataclass(frozen=True)
class Tls:
    """The same certificate for uvicorn and for gRPC."""

    http: ssl.SSLContext
    grpc: grpc.ServerCredentials


def load_tls(settings: Settings) -> Tls | None:
    """TLS as the settings have it, TLS 1.2 at least; None where they name no certificate.

    Raises:
        SettingsError: a file is missing, unreadable, or does not go with the others.
    """
    certificate, key, client_ca = (
        settings.tls_certificate, settings.tls_key, settings.tls_client_ca,
    )  # fmt: skip
    if certificate is None or key is None:
        if certificate or key or client_ca:
            raise SettingsError("tls_certificate and tls_key: one goes not without the other")
        return None
    chain = _bytes("tls_certificate", certificate)
    secret = _bytes("tls_key", key)
    roots = None if client_ca is None else _bytes("tls_client_ca", client_ca)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        # An encrypted key must not have the service wait for somebody to type.
        context.load_cert_chain(certificate, key, password="")
    except (ssl.SSLError, OSError) as error:
        raise SettingsError(
            f"tls_certificate, tls_key: {certificate} and {key} are no certificate with its "
            f"unencrypted key, both in PEM: {error}"
        ) from error
    if client_ca is not None:
        try:
            context.load_verify_locations(cafile=client_ca)
        except (ssl.SSLError, OSError) as error:
            raise SettingsError(f"tls_client_ca: {client_ca}: no PEM: {error}") from error
        context.verify_mode = ssl.CERT_REQUIRED
    credentials = grpc.ssl_server_credentials(
        [(secret, chain)], root_certificates=roots, require_client_auth=roots is not None
    )
    return Tls(context, credentials)


def check_exposure(settings: Settings) -> None:
    """Refuses to serve other machines in plain text, or whoever comes.

    Raises:
        SettingsError: says what is missing and what to do.
    """
    if settings.insecure or _is_loopback(settings.host):
        return
    missing = []
    if settings.tls_certificate is None:
        missing.append("anybody on the way can read and change it (set tls_certificate, tls_key)")
    if settings.tokens is None and settings.tls_client_ca is None:
        missing.append("anybody who reaches it can use it (set tokens, or tls_client_ca)")
    if missing:
        raise SettingsError(
            f"host: {settings.host} is not this machine's loopback address, and "
            f"{' and '.join(missing)}; or say --insecure where something else protects it"
        )


def _is_loopback(host: str) -> bool:
    try:
        found = socket.getaddrinfo(host or None, None, flags=socket.AI_PASSIVE)
    except OSError:
        return False  # binding will say what is wrong with it
    addresses = {ipaddress.ip_address(str(entry[4][0]).partition("%")[0]) for entry in found}
    return all(address.is_loopback for address in addresses)


def _bytes(setting: str, path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise SettingsError(f"{setting}: cannot read {path}: {error.strerror}") from error
