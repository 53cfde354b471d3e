"""The analytic mixture of forecasts that were given without it, drawn from the same state."""

from __future__ import annotations

from trajectron_service.messages import AgentForecast, ForecastMode, Sampling
from trajectron_service.records import SceneRecord
from trajectron_service.scenes import ForecastTask, SceneEngine, SceneJob
from trajectron_service.timebase import head
from trajectron_service.watching.accuracy import Draw


def mixture_drawer(engine: SceneEngine, record: SceneRecord) -> Draw:
    """Forecasts with modes from the newest frame of a session, for the inference thread.

    Args:
        engine: makes them.
        record: the session; its states are held until the drawer is let go.
    """

    def draw(agents: tuple[str, ...]) -> tuple[AgentForecast, ...]:
        task = ForecastTask(
            head=head(record.timeline),
            mode=ForecastMode.FULL,
            num_samples=1,  # `gmm`, which draws none, would leave modes out
            horizon=engine.models[record.model].info.horizon,
            seed=0,
            step=record.version,
            agents=agents,
            include_modes=True,
            sampling=Sampling.IID,
        )
        serials = tuple(state.serial for state in record.timeline.committed)
        job = SceneJob(record.model, serials, record.states, forecasts=(task,))
        (result,) = engine.run([job])
        return result.forecasts[0]

    return draw
