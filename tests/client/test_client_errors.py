"""Every error of the service reaches the caller as its own exception, on both transports."""

from __future__ import annotations

from collections.abc import Callable

import grpc
import httpx
import pytest
from google.rpc import status_pb2

import trajectron_client as tc
from trajectron_client import grpc_errors, http_errors
from trajectron_client.exceptions import BY_REASON
from trajectron_service.errors import CODES, ErrorKind, FieldViolation
from trajectron_service.errors import ServiceError as CoreError
from trajectron_service.grpc_errors import status_message
from trajectron_service.http_errors import problem_response


class FailedCall(grpc.RpcError):
    """A failed call as gRPC raises it."""

    def __init__(
        self,
        code: grpc.StatusCode,
        details: str = "",
        trailing: tuple[tuple[str, str | bytes], ...] = (),
    ) -> None:
        super().__init__()
        self._code, self._details, self._trailing = code, details, trailing

    def code(self) -> grpc.StatusCode:
        return self._code

    def details(self) -> str:
        return self._details

    def trailing_metadata(self) -> tuple[tuple[str, str | bytes], ...]:  # type: ignore[override]  # the stubs name a private class
        return self._trailing


def over_grpc(error: CoreError) -> tc.TrajectronError:
    status = status_message(error)
    call = FailedCall(
        grpc.StatusCode[error.codes.grpc],
        error.message,
        (("other", "text"), ("grpc-status-details-bin", status.SerializeToString())),
    )
    return grpc_errors.from_rpc_error(call)


def over_http(error: CoreError) -> tc.TrajectronError:
    answer = problem_response(error)
    response = httpx.Response(
        answer.status_code, headers=dict(answer.headers), content=bytes(answer.body)
    )
    return http_errors.from_response(response)


Carrier = Callable[[CoreError], tc.TrajectronError]


def test_every_kind_of_the_service_has_its_own_class() -> None:
    assert set(BY_REASON) == {kind.value for kind in ErrorKind}
    assert len(set(BY_REASON.values())) == len(ErrorKind)


@pytest.mark.parametrize("carry", [over_grpc, over_http])
@pytest.mark.parametrize("kind", list(ErrorKind))
def test_an_error_arrives_as_its_class_with_its_message(kind: ErrorKind, carry: Carrier) -> None:
    error = carry(CoreError(kind, "what was wrong and what to do"))
    assert type(error) is BY_REASON[kind.value]
    assert isinstance(error, tc.ServiceError)
    assert error.reason == kind.value
    assert str(error) == error.message == "what was wrong and what to do"
    assert (error.retry_after_s is not None) == CODES[kind].retryable


@pytest.mark.parametrize("carry", [over_grpc, over_http])
def test_violations_and_the_time_to_retry_arrive(carry: Carrier) -> None:
    violation = FieldViolation("frames[0].agents[3].x", "is nan; positions must be finite metres")
    invalid = carry(CoreError(ErrorKind.INVALID_ARGUMENT, "bad", violations=(violation,)))
    assert isinstance(invalid, tc.InvalidArgumentError)
    assert invalid.violations == (
        tc.Violation("frames[0].agents[3].x", "is nan; positions must be finite metres"),
    )
    overloaded = carry(CoreError(ErrorKind.OVERLOADED, "full", retry_after_s=3.0))
    assert isinstance(overloaded, tc.OverloadedError)
    assert overloaded.retry_after_s == 3.0


def test_grpc_carries_fractions_of_a_second_to_wait() -> None:
    error = over_grpc(CoreError(ErrorKind.OVERLOADED, "full", retry_after_s=0.25))
    assert isinstance(error, tc.OverloadedError)
    assert error.retry_after_s == 0.25


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        (grpc.StatusCode.UNAVAILABLE, tc.TransportError),
        (grpc.StatusCode.INTERNAL, tc.TransportError),
        (grpc.StatusCode.UNIMPLEMENTED, tc.TransportError),
        (grpc.StatusCode.DEADLINE_EXCEEDED, tc.DeadlineExceededError),
        (grpc.StatusCode.CANCELLED, tc.CancelledError),
        (grpc.StatusCode.RESOURCE_EXHAUSTED, tc.TooLargeError),
    ],
)
def test_what_grpc_itself_says_is_told_apart_from_the_service(
    code: grpc.StatusCode, expected: type[tc.TrajectronError]
) -> None:
    error = grpc_errors.from_rpc_error(FailedCall(code, "as gRPC says it"))
    assert type(error) is expected
    assert "as gRPC says it" in str(error)


def test_broken_details_do_not_hide_the_error() -> None:
    call = FailedCall(
        grpc.StatusCode.UNAVAILABLE, "gone", (("grpc-status-details-bin", b"\xff\xff"),)
    )
    assert isinstance(grpc_errors.from_rpc_error(call), tc.TransportError)


def test_a_kind_newer_than_the_client_is_a_plain_service_error() -> None:
    status = status_message(CoreError(ErrorKind.INTERNAL, "new"))
    renamed = status_pb2.Status.FromString(
        status.SerializeToString().replace(b"INTERNAL", b"BRANDNEW")
    )
    error = grpc_errors.from_status(renamed)
    assert type(error) is tc.ServiceError
    assert error.reason == "BRANDNEW"


@pytest.mark.parametrize(
    ("content_type", "body"),
    [
        ("text/html", b"<h1>Bad gateway</h1>"),
        ("application/problem+json", b"{not json"),
        ("application/problem+json", b'{"title": "no reason, no detail"}'),
        ("application/problem+json", b"[1, 2]"),
    ],
)
def test_an_answer_of_something_in_between_is_a_transport_error(
    content_type: str, body: bytes
) -> None:
    response = httpx.Response(
        502,
        headers={"content-type": content_type},
        content=body,
        request=httpx.Request("GET", "http://service/v1/models"),
    )
    error = http_errors.from_response(response)
    assert type(error) is tc.TransportError
    assert "502" in str(error)


def test_httpx_failures_are_transport_errors_and_timeouts_deadlines() -> None:
    assert isinstance(http_errors.from_httpx(httpx.ConnectError("refused")), tc.TransportError)
    assert isinstance(http_errors.from_httpx(httpx.ReadTimeout("slow")), tc.DeadlineExceededError)
