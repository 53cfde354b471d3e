"""Reads requests that bring files: ``multipart/form-data``, within the limit of every body."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from typing import TypeVar

from python_multipart.multipart import parse_options_header
from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import Request

from trajectron_service.errors import ErrorKind, ServiceError, invalid
from trajectron_service.evaluations.messages import RecordingFile
from trajectron_service.http_body import parse_body, read_raw
from trajectron_service.http_schemas import Body

MULTIPART = "multipart/form-data"
FILES = "files"
"""The field of a form that brings a file; it may come several times."""

B = TypeVar("B", bound=Body)


async def read_form(
    request: Request, shape: type[B], field: str, limit_bytes: int
) -> tuple[B, tuple[RecordingFile, ...]]:
    """A request's body in its shape, and the files sent along.

    Args:
        request: JSON alone, or a form of one JSON field and files.
        shape: of the JSON.
        field: the form's field that holds the JSON.
        limit_bytes: of the body as a whole.

    Raises:
        ServiceError: as ``read_body`` does, for fields that the form does not have, and
            ``MALFORMED`` for a form in another encoding than UTF-8.
    """
    raw = await read_raw(request, limit_bytes)
    if not request.headers.get("content-type", "").startswith(MULTIPART):
        return parse_body(raw, shape), ()
    _check_encoding(request.headers["content-type"])
    parser = MultiPartParser(request.headers, _whole(raw), max_part_size=limit_bytes)
    try:
        form = await parser.parse()
    except MultiPartException as error:
        raise ServiceError(
            ErrorKind.MALFORMED, f"the body is not a form: {error.message}"
        ) from None
    text, files = b"", []
    try:
        for name, value in form.multi_items():
            if name == FILES and isinstance(value, UploadFile):
                files.append(RecordingFile(value.filename or "", await value.read()))
            elif name == field:
                text = await value.read() if isinstance(value, UploadFile) else value.encode()
            else:
                raise invalid(name, f"is no field of this form; it has {field} (JSON) and {FILES}")
    finally:
        await form.close()
    return parse_body(text, shape), tuple(files)


def _check_encoding(content_type: str) -> None:
    """Refuses charsets other than UTF-8, the encoding of forms (RFC 7578).

    The parser would decode fields by whatever codec of Python's is named. Some raise errors of
    their own, some let lone surrogates through, some take a time quadratic in the text.
    """
    charset = parse_options_header(content_type)[1].get(b"charset", b"utf-8")
    if charset.lower() not in (b"utf-8", b"utf8"):
        raise ServiceError(ErrorKind.MALFORMED, "the form has a charset; forms are UTF-8")


async def _whole(raw: bytes) -> AsyncGenerator[bytes, None]:
    yield raw
