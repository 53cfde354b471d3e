"""gRPC's errors as the client's exceptions: the kind is in the details of google.rpc.Status."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from typing import cast

import grpc
from google.protobuf.message import DecodeError
from google.rpc import code_pb2, error_details_pb2, status_pb2

from trajectron_client.exceptions import (
    CancelledError,
    DeadlineExceededError,
    ServiceError,
    TooLargeError,
    TrajectronError,
    TransportError,
    Violation,
    service_error,
)

# Codes that gRPC itself gives to a call, without details of the service.
_BY_CODE: dict[str, type[ServiceError]] = {
    "DEADLINE_EXCEEDED": DeadlineExceededError,
    "CANCELLED": CancelledError,
    "RESOURCE_EXHAUSTED": TooLargeError,
    "OUT_OF_RANGE": TooLargeError,
}


def from_rpc_error(error: grpc.RpcError) -> TrajectronError:
    """The exception for a failed call, synchronous or asyncio."""
    code = error.code().name
    details = error.details() or ""
    status = _status(error)
    if status is not None and _reason(status):
        return from_status(status)
    if code in _BY_CODE:
        return _BY_CODE[code](details or code, reason=code)
    return TransportError(f"{code}: {details}" if details else code)


def from_status(status: status_pb2.Status) -> ServiceError:
    """The exception that a ``google.rpc.Status`` of the service stands for."""
    violations: tuple[Violation, ...] = ()
    retry_after_s = None
    for detail in status.details:
        bad_request = error_details_pb2.BadRequest()
        retry = error_details_pb2.RetryInfo()
        if detail.Unpack(bad_request):
            violations = tuple(
                Violation(v.field, v.description) for v in bad_request.field_violations
            )
        elif detail.Unpack(retry):
            retry_after_s = retry.retry_delay.ToNanoseconds() / 1e9
    return service_error(
        _reason(status) or code_pb2.Code.Name(status.code),
        status.message,
        violations=violations,
        retry_after_s=retry_after_s,
    )


def _reason(status: status_pb2.Status) -> str:
    info = error_details_pb2.ErrorInfo()
    for detail in status.details:
        if detail.Unpack(info):
            return str(info.reason)
    return ""


def _status(error: grpc.RpcError) -> status_pb2.Status | None:
    """The status in the trailing metadata; None when there is none, or none that parses."""
    trailing = cast("Iterable[tuple[str, bytes]]", error.trailing_metadata() or ())
    details = dict(trailing).get("grpc-status-details-bin")
    try:
        return status_pb2.Status.FromString(details) if details else None
    except DecodeError:
        return None


@contextlib.contextmanager
def translated() -> Iterator[None]:
    """Turns gRPC's errors in a ``with`` block into the client's."""
    try:
        yield
    except grpc.RpcError as error:
        raise from_rpc_error(error) from error
