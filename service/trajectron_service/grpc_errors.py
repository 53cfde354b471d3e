"""Errors over gRPC: ``google.rpc.Status`` with its standard details (AIP-193)."""

from __future__ import annotations

from typing import NoReturn, TypeVar

import grpc
from google.protobuf import any_pb2, duration_pb2
from google.protobuf.message import Message
from google.rpc import error_details_pb2, status_pb2

from trajectron_service.errors import DOMAIN, ServiceError

Request = TypeVar("Request")
Answer = TypeVar("Answer")

# Where every gRPC library looks for the details of a status.
_DETAILS_KEY = "grpc-status-details-bin"
# Trailing metadata has room for 8 KiB: a message may quote an id as long as a book.
_LONGEST_TEXT = 1000
_MOST_VIOLATIONS = 10
_LONGEST_VIOLATION = 200


def status_message(error: ServiceError) -> status_pb2.Status:
    """An error of the core with ``ErrorInfo``, ``BadRequest`` and, if retryable, ``RetryInfo``."""
    details: list[Message] = [error_details_pb2.ErrorInfo(reason=error.kind.value, domain=DOMAIN)]
    if error.violations:
        details.append(
            error_details_pb2.BadRequest(
                field_violations=[
                    error_details_pb2.BadRequest.FieldViolation(
                        field=violation.field[:_LONGEST_VIOLATION],
                        description=violation.description[:_LONGEST_VIOLATION],
                    )
                    for violation in error.violations[:_MOST_VIOLATIONS]
                ]
            )
        )
    if error.codes.retryable:
        delay = duration_pb2.Duration()
        delay.FromNanoseconds(round((error.retry_after_s or 1.0) * 1e9))
        details.append(error_details_pb2.RetryInfo(retry_delay=delay))
    return status_pb2.Status(
        code=status_code(error).value[0],
        message=error.message[:_LONGEST_TEXT],
        details=[_packed(detail) for detail in details],
    )


def status_code(error: ServiceError) -> grpc.StatusCode:
    """The gRPC code of an error's kind."""
    return grpc.StatusCode[error.codes.grpc]


async def abort(
    context: grpc.aio.ServicerContext[Request, Answer], error: ServiceError
) -> NoReturn:
    """Ends a call with an error's status and its details."""
    status = status_message(error)
    metadata = ((_DETAILS_KEY, status.SerializeToString()),)
    await context.abort(status_code(error), status.message, metadata)


def _packed(detail: Message) -> any_pb2.Any:
    packed = any_pb2.Any()
    packed.Pack(detail)
    return packed
