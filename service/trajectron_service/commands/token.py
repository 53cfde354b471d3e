"""``trajectron token``: tokens for those who may use a service."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Annotated

import typer

token = typer.Typer(no_args_is_help=True, help="Tokens for those who may use a service.")


@token.command()
def new(
    *,
    tenant: Annotated[str, typer.Option(help="Whose token it is; tenants share nothing.")],
    scopes: Annotated[
        str,
        typer.Option(help="Some of predict, sessions, evaluate, admin, separated by commas."),
    ] = "predict,sessions",
    days: Annotated[
        float | None,
        typer.Option(min=0.001, max=36500, help="It expires after so many; never by default."),
    ] = None,
) -> None:
    """Prints a new token, which is kept nowhere, and the lines for the tokens file.

    What the tenant may use at most stands in the same file: `[quotas]` for each tenant,
    `[tenants.NAME]` for one (docs/security.md).

    Examples:
    `trajectron token new --tenant fleet --scopes predict,sessions`

    `trajectron token new --tenant dashboard --scopes admin --days 90`
    """
    from trajectron_service import tokens
    from trajectron_service.settings import SettingsError
    from trajectron_service.tenancy import Scope

    try:
        wanted = [Scope(name.strip()) for name in scopes.split(",")]
    except ValueError as error:
        known = ", ".join(scope.value for scope in Scope)
        raise SettingsError(f"scopes: {error}; must be some of {known}") from error
    made = tokens.new_token()
    expires = None if days is None else datetime.now(UTC) + timedelta(days=days)
    lines = tokens.entry(made, tenant, wanted, expires)
    typer.echo(f"# The token, shown this once; hand it to {tenant}:\n# {made}")
    typer.echo(f"# Add to the file that the setting `tokens` names:\n{lines}", nl=False)
