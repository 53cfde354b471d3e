"""The service's own use case, run in this process without a server."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable

from trajectron_service import engine, settings
from trajectron_service.application import Application
from trajectron_service.commands.recordings import Scene
from trajectron_service.messages import Agent, Forecast, ForecastOptions, Frame, UnknownTypes
from trajectron_service.metrics import Metrics


def forecast_offline(
    model: str | None, scenes: Iterable[Scene], options: ForecastOptions, frame_interval_s: float
) -> Forecast:
    """What ``POST /predict`` would answer.

    Args:
        model: a bundled name or a path; None for the default.
        scenes: the history, in order of time.
        options: what to forecast.
        frame_interval_s: between two scenes.

    Raises:
        ServiceError: as the service answers.
        SettingsError: the model cannot be loaded.
    """
    chosen = settings.load(models=(model,) if model else None, warm_up=False)
    frames = tuple(
        Frame(scene.time_s, tuple(Agent(*agent) for agent in scene.agents)) for scene in scenes
    )

    async def answer() -> Forecast:
        application = Application(chosen, engine.load(chosen), Metrics())
        await application.start()
        try:
            return await application.predict(
                model=None,
                frames=frames,
                options=options,
                unknown_types=UnknownTypes.REJECT,
                type_map={},
                frame_interval_s=frame_interval_s,
                deadline=None,
            )
        finally:
            await application.close()

    return asyncio.run(answer())
