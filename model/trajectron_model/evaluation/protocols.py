"""The protocols: which windows are cut from recordings, and who is judged in them.

* ``sgan``: 8 steps observed, 12 foretold, stride 1; judged are those present in all 20, where
  at least two are (Gupta et al. 2018). What most papers use.
* ``all``: the same where one suffices (Trajectron++ and others).
* ``streaming``: every frame of a recording, observed from its first; judged is everyone in the
  frame, over the steps of their future that exist. What the service does.
* ``paper``: chunks of 100 steps, forecasts from every eighth; the conditions of Ivanovic &
  Pavone 2019, as their code applies them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from trajectron_model.data.recording import Recording
from trajectron_model.data.windows import Window, sgan_windows
from trajectron_model.evaluation.plan import PROTOCOLS, PlanError

OBSERVED = 8
HORIZON = 12

_CHUNK = 100
_STRIDE = 8


def windows(protocol: str, recordings: Iterable[Recording]) -> list[Window]:
    """The windows of these recordings, in their order.

    Args:
        protocol: one of `plan.PROTOCOLS`.
        recordings: of one test set.

    Raises:
        PlanError: another protocol.
    """
    if protocol not in _CUT:
        raise PlanError(f"protocol {protocol!r} is none of {', '.join(PROTOCOLS)}")
    cut = _CUT[protocol]
    return [window for recording in recordings for window in cut(recording)]


def sgan(recording: Recording) -> list[Window]:
    """See the module."""
    return sgan_windows(recording, observed=OBSERVED, horizon=HORIZON, min_agents=2)


def every(recording: Recording) -> list[Window]:
    """``all``, see the module."""
    return sgan_windows(recording, observed=OBSERVED, horizon=HORIZON, min_agents=1)


def streaming(recording: Recording) -> list[Window]:
    """One window for each step at which anyone is seen who is seen again within the horizon.

    All windows of a recording begin at its first step: what is observed grows.
    """
    agent_major = np.lexsort((recording.step, recording.agent))
    agent, step = recording.agent[agent_major], recording.step[agent_major]
    # Rows of one agent by step: the next row tells when it is seen again.
    again = np.zeros(len(step), dtype=bool)
    again[:-1] = (np.diff(agent) == 0) & (np.diff(step) <= HORIZON)
    agent, step = agent[again], step[again]
    order = np.lexsort((agent, step))
    nows, begins = np.unique(step[order], return_index=True)
    judged = np.split(agent[order], begins[1:])
    return [
        Window(recording, 0, now + 1, HORIZON, agents)
        for now, agents in zip(nows.tolist(), judged, strict=True)
    ]


def paper(recording: Recording) -> list[Window]:
    """The windows of the paper's own evaluation.

    A recording is cut into chunks of 100 steps from its first; what is observed begins at the
    chunk's first step, so a person in two chunks is two agents. Forecasts start at t = 8, 16,
    ... while t < L - 12, L being the chunk's length less its trailing empty steps. Judged are
    those present at t - 1 (the newest observed step) and at t; best-of-N is over those of them
    present from t - 8 on. A row with a coordinate of exactly 0 counts as absent.
    """
    recording = _without_zeros(recording)
    found = []
    for first in range(0, recording.num_steps, _CHUNK):
        chunk = recording.rows(first, min(first + _CHUNK, recording.num_steps))
        if chunk.start == chunk.stop:
            continue
        length = int(recording.step[chunk.stop - 1]) + 1 - first
        for observed in range(_STRIDE, length - HORIZON, _STRIDE):
            window = _paper_window(recording, first, observed)
            if len(window.judged):
                found.append(window)
    return found


def _paper_window(recording: Recording, first: int, observed: int) -> Window:
    future = first + observed  # the first step to foretell
    agents, position = recording.dense(future - _STRIDE, future + 1)
    present = ~np.isnan(position[..., 0])  # [9, A']
    judged: NDArray[np.bool_] = np.logical_and.reduce(present[-2:])
    whole: NDArray[np.bool_] = np.logical_and.reduce(present)
    return Window(recording, first, observed, HORIZON, agents[judged], whole[judged])


def _without_zeros(recording: Recording) -> Recording:
    """The recording without rows of which a coordinate is exactly 0."""
    kept = (recording.position != 0.0).all(axis=1)
    if kept.all():
        return recording
    return replace(
        recording,
        step=recording.step[kept],
        agent=recording.agent[kept],
        position=recording.position[kept],
    )


_CUT: dict[str, Callable[[Recording], list[Window]]] = {
    "sgan": sgan,
    "all": every,
    "streaming": streaming,
    "paper": paper,
}


def thinned(found: list[Window], max_windows: int | None) -> tuple[list[Window], int]:
    """Every k-th window, so that at most ``max_windows`` are left; and k."""
    if max_windows is None or len(found) <= max_windows:
        return found, 1
    every_nth = -(-len(found) // max_windows)
    return found[::every_nth], every_nth


def jittered(found: Iterable[Window], jitter_m: float, seed: int) -> list[Window]:
    """The windows with Gaussian noise on what is observed; their truth stays as it is.

    A recording is jittered once, as a tracker's noise would be: windows that overlap see the
    same noise.

    Args:
        found: windows.
        jitter_m: standard deviation for each coordinate, metres; 0 for none.
        seed: of the noise, together with the recording's name.
    """
    if not jitter_m:
        return list(found)
    noisy: dict[int, Recording] = {}
    result = []
    for window in found:
        clean = window.recording
        if id(clean) not in noisy:
            random = np.random.default_rng([seed, *clean.name.encode()])
            noise = random.normal(0.0, jitter_m, clean.position.shape)
            noisy[id(clean)] = replace(clean, position=clean.position + noise)
        result.append(replace(window, recording=noisy[id(clean)], truth=clean))
    return result
