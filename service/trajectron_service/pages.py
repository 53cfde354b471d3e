"""Pages of lists: their sizes, and the tokens that lead from one to the next."""

from __future__ import annotations

import base64
import binascii

from trajectron_service.errors import ServiceError, invalid

DEFAULT_PAGE = 100
LARGEST_PAGE = 1000


def size(asked: int | None) -> int:
    """How many a page has; raises ``INVALID_ARGUMENT`` for a size out of bounds."""
    if asked is None:
        return DEFAULT_PAGE
    if not 1 <= asked <= LARGEST_PAGE:
        raise invalid("page_size", f"is {asked}; must be 1 to {LARGEST_PAGE}")
    return asked


def write_token(last: str) -> str:
    """The token of the page after the one that ends with ``last``."""
    return base64.urlsafe_b64encode(last.encode()).decode()


def read_token(token: str) -> str:
    """The inverse of ``write_token``; raises ``INVALID_ARGUMENT`` for anything else."""
    try:
        return base64.b64decode(token.encode("ascii"), altchars=b"-_", validate=True).decode()
    except (binascii.Error, ValueError) as error:
        raise foreign_token() from error


def foreign_token() -> ServiceError:
    """The refusal of a token that leads nowhere."""
    return invalid("page_token", "is not a token that this service gave out")
