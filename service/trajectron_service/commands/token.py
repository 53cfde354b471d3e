"""``trajectron token``: tokens for those who may use a service."""

from __future__ import annotations

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
) -> None:
    """Prints a new token, which is kept nowhere, and the lines for the tokens file.

    Examples:
    `trajectron token new --tenant fleet --scopes predict,sessions`
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
    lines = tokens.entry(made, tenant, wanted)
    typer.echo(f"# The token, shown this once; hand it to {tenant}:\n# {made}")
    typer.echo(f"# Add to the file that the setting `tokens` names:\n{lines}", nl=False)
