"""The command line ``trajectron``: runs a subcommand and turns errors of use into one line."""

from __future__ import annotations

import sys
from collections.abc import Sequence

# By name, so that a command imports only what it needs: these are mistakes in what was given,
# and their messages say where.
_USER_ERRORS = {
    "trajectron_model.data.errors.DataError",
    "trajectron_model.checkpoint.CheckpointError",
    "trajectron_model.evaluation.contenders.ContenderError",
    "trajectron_model.evaluation.plan.PlanError",
    "trajectron_service.settings.SettingsError",
    "trajectron_service.errors.ServiceError",
    "trajectron_service.commands.errors.UsageError",
}
_SERVICE_ERRORS = {"trajectron_client.exceptions.TrajectronError"}

_WRONG_USE = 2
_FAILED = 1


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs a command; exits 2 for wrong use or bad files, 1 when the service is at fault."""
    try:
        from trajectron_service.commands import app
    except ModuleNotFoundError as error:
        _fail(f"{error.name} is missing: pip install 'trajectron-service[service]'", _FAILED)
    try:
        app(arguments, prog_name="trajectron")
    except (FileNotFoundError, IsADirectoryError, PermissionError) as error:
        _fail(f"{error.filename}: {error.strerror}", _WRONG_USE)
    except Exception as error:
        names = {f"{kind.__module__}.{kind.__qualname__}" for kind in type(error).__mro__}
        if names & _USER_ERRORS:
            _fail(str(error), _WRONG_USE)
        if names & _SERVICE_ERRORS:
            _fail(str(error), _FAILED)
        raise


def _fail(message: str, code: int) -> None:
    sys.stderr.write(f"error: {message}\n")
    sys.exit(code)
