"""Writers of recordings, in the formats that the readers read."""

from __future__ import annotations

import csv
from typing import TextIO

from trajectron_model.data.parsing import CSV_COLUMNS
from trajectron_model.data.recording import Recording


def write_csv(recording: Recording, file: TextIO) -> None:
    """The recording as CSV, ``time,id,type,x,y``: seconds and metres, sorted by time.

    Args:
        file: opened for text with ``newline=""``, as the csv module asks for.
    """
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    rows = zip(
        recording.step.tolist(), recording.agent.tolist(), recording.position.tolist(), strict=True
    )
    for step, agent, (x, y) in rows:
        # Times and positions of a micrometre keep the file readable.
        time = round(recording.time_s(step), 6)
        writer.writerow(
            (time, recording.ids[agent], recording.types[agent], round(x, 6), round(y, 6))
        )


def write_eth_ucy(recording: Recording, file: TextIO, *, frames_per_step: int = 10) -> None:
    """The recording as ETH/UCY text: frame, id, x, y, split by tabs.

    Agents get numbers from 1, since the format has no text in it; types and the time of step 0
    are not kept.
    """
    rows = zip(
        recording.step.tolist(), recording.agent.tolist(), recording.position.tolist(), strict=True
    )
    file.writelines(
        f"{step * frames_per_step}\t{agent + 1}\t{round(x, 6)}\t{round(y, 6)}\n"
        for step, agent, (x, y) in rows
    )
